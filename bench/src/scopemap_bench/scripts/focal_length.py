"""What a run makes of an unknown camera: is the lens that it takes right, and does it keep silent where it cannot know?

    python -m scopemap_bench.scripts.focal_length --out FOLDER [--data FOLDER] [--frames 120]

Renders phantoms through lenses of known kind and field of view along made-up paths (seeds that nothing was chosen on),
every fourth frame, as the estimate uses them, and takes real clips of known camera from `--data`. Each is written as a
folder of pictures, bent as the lens bends them, and opened as a user would who knows nothing of the camera. A row
tells what the run would say, how far its focal length is off at the picture's centre, and the processor time.
"""

from __future__ import annotations

import argparse
import math
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from scopemap.calibration.focal_length.from_motion import with_focal_from_motion
from scopemap.calibration.focal_length.trial import KINDS
from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.cameras.lenses import FisheyeCamera
from scopemap.config import Config
from scopemap.io.opening import open_sequence
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec

# Scene, kind of the lens, horizontal field of view in degrees, seed, whether tissue breathes.
PHANTOMS = (
    ("laparoscopy", "pinhole", 60.0, 301, False),
    ("laparoscopy", "pinhole", 90.0, 302, True),
    ("laparoscopy", "equidistant fisheye", 75.0, 303, False),
    ("laparoscopy", "orthographic fisheye", 100.0, 304, False),
    ("laparoscopy", "equidistant fisheye", 110.0, 305, True),
    ("colon", "pinhole", 75.0, 306, False),
    ("colon", "pinhole", 100.0, 307, False),
    ("colon", "equidistant fisheye", 90.0, 308, False),
    ("colon", "orthographic fisheye", 120.0, 309, False),
    ("tube", "pinhole", 90.0, 310, False),
)
SIZE = (320, 256)
EVERY = 4
REAL = (
    "endoscopy/c3vd/cecum_t1_a",
    "endoscopy/c3vd/trans_t1_a",
    "endoscopy/endonerf/pulling_soft_tissues",
    "rgbd/7scenes_kitchen_100f",
)


def lens_of(kind: str, fov_deg: float) -> PinholeCamera | FisheyeCamera:
    """Return a lens of a kind and a horizontal field of view for pictures of `SIZE`."""
    radius = {"pinhole": math.tan, "equidistant fisheye": float, "orthographic fisheye": math.sin}[kind]
    focal_px = SIZE[0] / 2 / radius(math.radians(fov_deg / 2))
    plane = PinholeCamera(focal_px, focal_px, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2, *SIZE)
    return FisheyeCamera(plane, KINDS[kind]) if KINDS[kind] else plane


def clips(out: Path, data: Path | None, frames: int) -> Iterator[tuple[str, Path, float]]:
    """Yield name, folder of pictures without a camera, and true focal length over the width, of each clip."""
    for scene, kind, fov_deg, seed, deform in PHANTOMS:
        camera, folder = lens_of(kind, fov_deg), out / f"{scene}-{seed}"
        if not folder.is_dir():
            file = out / f"{scene}-{seed}.yaml"
            write_calibration(camera, file)
            spec = PhantomSpec(scene=scene, frames=frames, seed=seed, deform=deform, camera_file=file)
            phantom = prepare(spec)
            write_pictures(folder, (render_frame(phantom, index)[0] for index in range(0, frames, EVERY)))
        name = f"{scene}, {kind}, {fov_deg:g} deg{', breathing' if deform else ''}"
        yield name, folder, camera.central.fx / SIZE[0]
    for path in REAL if data is not None else ():
        known, folder = open_sequence(data / path, frames=slice(0, frames)), out / Path(path).name
        size = (known.camera.width, known.camera.height)
        # Pictures as they are in the file, at the working size.
        seen = known.source.frames(known.selection)
        shutil.rmtree(folder, ignore_errors=True)
        write_pictures(folder, (cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA) for frame in seen))
        lens = known.rectifier.source
        yield f"{Path(path).name}, {type(lens).__name__}", folder, lens.central.fx / lens.width


def write_pictures(folder: Path, pictures: Iterator[np.ndarray]) -> None:
    """Write pictures (H, W, 3) uint8 into a new folder."""
    folder.mkdir(parents=True)
    for number, rgb in enumerate(pictures):
        cv2.imwrite(str(folder / f"{number:06d}.png"), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def row(name: str, folder: Path, true_share: float) -> str:
    """Measure one clip; return its line of the table."""
    unknown, started = open_sequence(folder), time.process_time()
    found, _ = with_focal_from_motion(unknown, Config())
    seconds = time.process_time() - started
    off = found.camera.fx / (true_share * found.camera.width) - 1
    knows = found.camera_source.startswith("estimated") or "consistent with" in found.camera_source
    verdict = f"{off:+.1%}" if knows else f"does not know (default {off:+.0%})"
    return f"| {name} | {true_share:.3f} | {verdict} | {found.camera_source} | {seconds:.0f} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--frames", type=int, default=120)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    print(
        "| clip, lens | true f / width | fx off | the camera's source, as a run states it | s |\n|---|---|---|---|---|"
    )
    for clip in clips(options.out, options.data, options.frames):
        print(row(*clip), flush=True)


if __name__ == "__main__":
    main()
