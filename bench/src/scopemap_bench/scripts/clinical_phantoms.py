"""What clinical video does to a run, on phantoms with exact truth.

    python -m scopemap_bench.scripts.clinical_phantoms [--out FOLDER] [--only WORD] [--seed N ...]

One difficulty each, 120 frames where nothing else is said. ATE is that of the largest submap after a Sim(3) alignment,
whose scale is the path's; beside it that of the frames that the run without a back end tracks as well, adjusted and as
tracked. Where little is seen twice, as in `fast`, ATE differs by a factor of ten between seeds: compare several.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scopemap.engine.errors import AlignmentError
from scopemap.evaluation.poses import ErrorSummary, match, translation_errors_mm
from scopemap.input.opening import open_sequence
from scopemap.result.depth_maps import DepthReader
from scopemap.result.reference import read_reference
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.evaluation.depth import DepthFit, evaluate_depth
from scopemap_bench.scoring import true_pairs
from scopemap_bench.scripts import measuring
from scopemap_bench.true_depth import TrueDepths

FRAMES = 120
SEED = 21
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
    "dark omentum before a lit wall, narrow beam, 45 degrees, sideways": (
        *("--scene", "abdominal_wall", "--set", "route=sideways", "--set", "fov_deg=45"),
        *("--set", "beam_deg=24", "--set", "omentum_mm=40"),
    ),
    "withdrawal along a straight colon, 184 frames": (
        *("--scene", "colon", "--frames", 184, "--set", "route=withdrawal", "--set", "gloss=2"),
        *("--set", "texture=0", "--set", "indirect=0.8", "--set", "h264_crf=36", *EXPOSURE),
    ),
}


def print_phantoms(folder: Path, only: str, seed: int) -> None:
    """Render, run, measure and print the rows whose names begin with `only`."""
    for name, words in PHANTOMS.items():
        if not name.startswith(only):
            continue
        stem = f"{name.split(':')[0].split(',')[0].replace(' ', '-')}-{seed}"
        source = measuring.phantom(folder / stem, "--frames", FRAMES, "--seed", seed, *words)
        run = measuring.run_once(source, folder / f"{stem}-run")
        tracked_run = measuring.run_once(source, folder / f"{stem}-tracked", "--set", "mapping.method=none")
        against = ("--truth", source, "--align", "sim3")
        facts, figures = measuring.provenance(run), measuring.evaluated(run, *against, "--depth", "none")
        both = " / ".join(f"{one:.3f}" for one in errors_mm(run, tracked_run, source))
        tracked = facts["tracked"] + facts.get("in_other_maps", 0)
        cells = [name, seed, f"{tracked} of {facts['frames']}", facts["tracked"], measuring.submaps(run)]
        cells += [measuring.cell(figures, ".3f", "ate_rmse_mm"), both]
        cells += [measuring.rotation(figures), measuring.cell(figures, ".2f", "mesh_accuracy_mm")]
        measuring.print_row(*cells, *scale_cells(run, source, figures))


def errors_mm(run: Path, other: Path, truth: Path) -> list[float]:
    """Return the ATE RMSE of two runs, Sim(3), in the frames that both track; NaN where these are too few."""
    reference, trajectories = read_reference(truth), [read_trajectory(one) for one in (run, other)]
    assert reference is not None
    both = np.intersect1d(*(one.indices[one.tracked] for one in trajectories))
    found = []
    for one in trajectories:
        try:
            matched = match(one.rows(np.isin(one.indices, both)), reference, "sim3")
            found.append(ErrorSummary.of(translation_errors_mm(matched.aligned, matched.reference)).rmse)
        except AlignmentError:
            found.append(float("nan"))
    return found


def scale_cells(run: Path, source: Path, figures: dict[str, Any]) -> list[str]:
    """Return how depth keeps the path's scale: drift, spread, and mean AbsRel of the worst tenth of the clip.

    Drift: mean ln (true over estimated depth) of the last tenth of the frames less that of the first; spread: its
    standard deviation over the frames.
    """
    if not figures:
        return [""] * 3
    logs, fit = np.log(figures["depth"]["metric_consistency"]["frames"]), DepthFit(scale=figures["scale"])
    pairs = true_pairs(DepthReader(run), TrueDepths(open_sequence(source)))()
    errors = [evaluate_depth(*pair, scaling=fit)["abs_rel"] for pair in pairs]
    first, *_, last = (part.mean() for part in np.array_split(logs, 10))
    worst = max(np.nanmean(part) for part in np.array_split(errors, 10))
    return [f"{last - first:+.3f}", f"{logs.std():.3f}", f"{worst:.3f}"]


def main() -> None:
    """Print the table."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--only", default="", help="rows whose names begin with this")
    parser.add_argument(
        "--seed", type=int, nargs="+", default=[SEED], help="of the phantoms; those that --out holds are used again"
    )
    options = parser.parse_args()
    if not any(name.startswith(options.only) for name in PHANTOMS):
        parser.error(f"no row begins with {options.only!r}; rows: {'; '.join(PHANTOMS)}")
    with measuring.folder_or_scratch(options.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        heads = ("phantom", "seed", "frames tracked", "frames in the largest submap", "submaps", "ATE RMSE mm")
        both = "ATE mm in frames of both: adjusted / as tracked"
        last = ("mesh to truth mm", "scale drift", "scale spread", "worst tenth AbsRel")
        measuring.print_head(*heads, both, "rotation mean / max deg", *last)
        for seed in options.seed:
            print_phantoms(folder, options.only, seed)


if __name__ == "__main__":
    main()
