"""Does the motion tell an unknown camera's focal length, and does it keep silent where it does not?

    python benchmarks/focal_length.py --out FOLDER [--data FOLDER] [--frames 120]

Renders phantoms of known field of view along made-up paths (seeds that the estimator was not tried on), and takes real
clips of known camera from `--data`. Each is written as a folder of rectified pictures and opened as a user would who
knows nothing of the camera. A row tells what was found, how far off it is in its own standard deviations, and what a
run would do: take it, or keep the assumed 70 degrees.
"""

from __future__ import annotations

import argparse
import math
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2

from scopemap.calibration.focal_length.estimate import focal_from_motion, with_focal_from_motion
from scopemap.config import Config
from scopemap.io.opening import open_sequence
from scopemap.io.sequence import Sequence
from scopemap.phantom.spec import PhantomSpec
from scopemap.phantom.writer import write_phantom

# Scene, horizontal field of view in degrees, seed, whether tissue breathes.
PHANTOMS = (
    ("laparoscopy", 50.0, 101, False),
    ("laparoscopy", 75.0, 102, True),
    ("laparoscopy", 100.0, 103, False),
    ("colon", 60.0, 104, False),
    ("colon", 90.0, 105, False),
    ("colon", 110.0, 106, True),
    ("tube", 90.0, 107, False),
)
REAL = ("endoscopy/c3vd/cecum_t1_a", "endoscopy/endonerf/pulling_soft_tissues", "rgbd/7scenes_kitchen_100f")


def clips(out: Path, data: Path | None, frames: int) -> Iterator[tuple[str, Sequence]]:
    """Yield name and sequence, camera known, of every phantom and real clip."""
    for scene, fov_deg, seed, deform in PHANTOMS:
        name = f"{scene} {fov_deg:g} deg{', breathing' if deform else ''}"
        folder = out / f"{scene}-{fov_deg:g}-{seed}"
        if not (folder / "phantom.json").is_file():
            write_phantom(PhantomSpec(scene=scene, frames=frames, fov_deg=fov_deg, seed=seed, deform=deform), folder)
        yield name, open_sequence(folder)
    for path in REAL if data is not None else ():
        yield path.rpartition("/")[2], open_sequence(data / path, frames=slice(0, frames))


def of_unknown_camera(sequence: Sequence, folder: Path) -> Sequence:
    """Write the rectified pictures into `folder` and open them without their camera."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for frame in sequence.frames():
        cv2.imwrite(str(folder / f"{frame.index:06d}.png"), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
    return open_sequence(folder)


def row(name: str, known: Sequence, unknown: Sequence) -> str:
    """Measure one clip; return its line of the table."""
    true_deg = 2 * math.degrees(math.atan(known.camera.width / 2 / known.camera.fx))
    estimate = focal_from_motion(unknown, Config())
    found, _ = with_focal_from_motion(unknown, Config())
    kept = found.camera is unknown.camera
    decision = "kept, " + found.camera_source.partition("; ")[2].split(":")[0] if kept else "taken"
    if estimate.reason:
        return f"| {name} | {true_deg:.1f} | - | - | {decision}: {estimate.reason} |"
    off = math.log(estimate.focal_px / known.camera.fx)
    spread = f"{estimate.fov_deg:.1f}, fx +- {estimate.share:.1%}"
    return f"| {name} | {true_deg:.1f} | {spread} | {off:+.1%} ({abs(off) / estimate.share:.1f}) | {decision} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--frames", type=int, default=120)
    options = parser.parse_args()
    print("| clip | true field of view, deg | estimated | fx off (in sd) | a run |\n|---|---|---|---|---|")
    for name, known in clips(options.out, options.data, options.frames):
        print(row(name, known, of_unknown_camera(known, options.out / "unknown")), flush=True)


if __name__ == "__main__":
    main()
