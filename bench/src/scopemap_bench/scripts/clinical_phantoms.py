"""What clinical video does to a run, on phantoms with exact truth; and what a run makes of an unknown lens.

    python -m scopemap_bench.scripts.clinical_phantoms [--out FOLDER]

First table: phantoms with one difficulty each, of 120 frames where nothing else is said; ATE is that of the largest
submap after a Sim(3) alignment, whose scale is the path's. Second table: lenses of known kind and field of view, given
as plain pictures, every fourth of 120 frames.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scopemap.calibration.focal_length.from_motion import with_focal_from_motion
from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.cameras.lenses import FisheyeCamera
from scopemap.cameras.scopes import KINDS
from scopemap.config import Config
from scopemap.io.depth_maps import DepthReader
from scopemap.io.opening import open_sequence
from scopemap_bench.evaluation.depth import DepthFit, evaluate_depth
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.scoring import true_pairs
from scopemap_bench.scripts import measuring

FRAMES, SEED = 120, 21
EXPOSURE = ("--set", "auto_exposure=true", "--set", "exposure_lag_frames=4")
CAMERA = ("--set", "shutter=0.8", "--set", "h264_crf=30", "--set", "indirect=0.15", *EXPOSURE)
PHANTOMS = {
    "fast: ten pixels a frame, two turns of 30 degrees": (
        *("--scene", "colon", "--set", "speed=6", "--events", "turn:40-48,turn:80-88"),
    ),
    "cut: 30 degrees between two frames": ("--scene", "colon", "--events", "turn:60-60"),
    "instruments, twice": ("--scene", "laparoscopy", "--events", "instrument:15-60,instrument:70-110"),
    "contact, automatic exposure": ("--scene", "colon", "--events", "contact:45-75", *EXPOSURE),
    "fluid over the lens": ("--scene", "colon", "--events", "fluid:40-80"),
    "pushed organs that stay so": ("--scene", "laparoscopy", "--events", "push:40-70"),
    "breathing": ("--scene", "colon", "--deform"),
    "black, blurred, full of smoke: 10 frames each": (
        *("--scene", "colon", "--events", "black:40-49,blur:65-74,smoke:95-104"),
    ),
    "motion blur, H.264, lagging exposure, scattered light": ("--scene", "colon", *CAMERA),
    "abdominal wall seen sideways, 600 frames": (
        *("--scene", "abdominal_wall", "--frames", 600, "--set", "route=sideways", "--set", "fov_deg=65"),
        *("--set", "indirect=0.15", "--set", "h264_crf=30", *EXPOSURE),
    ),
    "withdrawal along a straight colon, 184 frames": (
        *("--scene", "colon", "--frames", 184, "--set", "route=withdrawal", "--set", "gloss=2"),
        *("--set", "texture=0", "--set", "indirect=0.8", "--set", "h264_crf=36", *EXPOSURE),
    ),
}
SIZE, EVERY, LENS_FRAMES = (320, 256), 4, 120
# Scene, kind of the lens, horizontal field of view in degrees, seed, whether tissue breathes.
LENSES = (
    ("laparoscopy", "pinhole", 60.0, 301, False),
    ("laparoscopy", "equidistant fisheye", 75.0, 303, False),
    ("laparoscopy", "orthographic fisheye", 100.0, 304, False),
    ("colon", "pinhole", 75.0, 306, False),
    ("laparoscopy", "pinhole", 90.0, 302, True),
)


def print_phantoms(folder: Path) -> None:
    """Render, run, measure and print the first table."""
    heads = ("phantom", "frames tracked", "frames in the largest submap", "submaps")
    errors = ("ATE RMSE mm", "ATE as tracked mm", "rotation mean / max deg", "mesh to truth mm")
    measuring.print_head(*heads, *errors, "scale drift", "scale spread", "worst tenth AbsRel")
    for name, words in PHANTOMS.items():
        stem = name.split(":")[0].split(",")[0].replace(" ", "-")
        source = measuring.phantom(folder / stem, "--frames", FRAMES, "--seed", SEED, *words)
        run = measuring.run_once(source, folder / f"{stem}-run")
        tracked_run = measuring.run_once(source, folder / f"{stem}-tracked", "--set", "mapping.method=none")
        against = ("--truth", source, "--align", "sim3")
        facts, figures = measuring.provenance(run), measuring.evaluated(run, *against, "--depth", "none")
        as_tracked = measuring.evaluated(tracked_run, *against)
        tracked = facts["tracked"] + facts.get("in_other_maps", 0)
        cells = [name, f"{tracked} of {facts['frames']}", facts["tracked"], measuring.submaps(run)]
        cells += [measuring.cell(each, ".3f", "ate_rmse_mm") for each in (figures, as_tracked)]
        cells += [measuring.rotation(figures), measuring.cell(figures, ".2f", "mesh_accuracy_mm")]
        measuring.print_row(*cells, *scale_cells(run, source, figures))


def scale_cells(run: Path, source: Path, figures: dict[str, Any]) -> list[str]:
    """Return how depth keeps the path's scale: drift, spread, and mean AbsRel of the worst tenth of the clip.

    Drift: mean ln (true over estimated depth) of the last tenth of the frames less that of the first; spread: its
    standard deviation over the frames.
    """
    if not figures:
        return [""] * 3
    logs, fit = np.log(figures["depth"]["metric_consistency"]["frames"]), DepthFit(scale=figures["scale"])
    pairs = true_pairs(DepthReader(run), open_sequence(source))()
    errors = [evaluate_depth(*pair, scaling=fit)["abs_rel"] for pair in pairs]
    first, *_, last = (part.mean() for part in np.array_split(logs, 10))
    worst = max(np.nanmean(part) for part in np.array_split(errors, 10))
    return [f"{last - first:+.3f}", f"{logs.std():.3f}", f"{worst:.3f}"]


def lens_of(kind: str, fov_deg: float) -> PinholeCamera | FisheyeCamera:
    """Return a lens of a kind and a horizontal field of view for pictures of `SIZE`."""
    radius = {"pinhole": math.tan, "equidistant fisheye": float, "orthographic fisheye": math.sin}[kind]
    focal_px = SIZE[0] / 2 / radius(math.radians(fov_deg / 2))
    plane = PinholeCamera(focal_px, focal_px, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2, *SIZE)
    return FisheyeCamera(plane, KINDS[kind]) if KINDS[kind] else plane


def print_lenses(folder: Path) -> None:
    """Print how far the estimated focal length is off at the picture's centre, or that the run does not know."""
    measuring.print_head("scene, lens", "true f / width", "fx off", "camera's source, as a run states it")
    for scene, kind, fov_deg, seed, deform in LENSES:
        camera, pictures = lens_of(kind, fov_deg), folder / f"lens-{seed}"
        file = folder / f"lens-{seed}.yaml"
        write_calibration(camera, file)
        spec = PhantomSpec(scene=scene, frames=LENS_FRAMES, seed=seed, deform=deform, camera_file=file)
        model = prepare(spec)
        pictures.mkdir(exist_ok=True)
        for index in range(0, LENS_FRAMES, EVERY):
            cv2.imwrite(str(pictures / f"{index:06d}.png"), render_frame(model, index)[0][..., ::-1])
        found, _ = with_focal_from_motion(open_sequence(pictures), Config())
        true_share = camera.central.fx / SIZE[0]
        off = found.camera.fx / (true_share * found.camera.width) - 1
        knows = found.camera_source.startswith("estimated")
        verdict = f"{off:+.1%}" if knows else f"unknown; assumed {off:+.0%}"
        name = f"{scene}{', breathing' if deform else ''}, {kind}, {fov_deg:g} deg"
        measuring.print_row(name, f"{true_share:.3f}", verdict, found.camera_source.split(";")[0])


def main() -> None:
    """Print both tables."""
    options = measuring.options_of(__doc__, out=True).parse_args()
    with measuring.folder_or_scratch(options.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        print_phantoms(folder)
        print()
        print_lenses(folder)


if __name__ == "__main__":
    main()
