"""The ruler: every real clip beside the project, by what is known of the truth.

    python -m scopemap_bench.scripts.real --data FOLDER [--out FOLDER] [--only NAME ...] [--preset NAME ...]
                                          [--set NAME=VALUE ...]

A row is a run of the command line. Path: RMSE of positions after a Sim(3) alignment, mm, and in brackets that of the
poses as tracked (a second run, `mapping.method=none`); then both with the truth read later by the clock offset that
fits the run best (`scopemap evaluate --time-offset fit`), in frames of 1/30 s, where the path tells it: C3VD's recorded
poses are ahead of its pictures, so these are negative. AbsRel: mean over frames, one median scale a frame; then that of
the worst fifth of the clip; then with one scale for all frames, the path's (as recorded) where the path is known.
Correlation: of ln depth with the true one, mean over frames. Spread: standard deviation over frames of ln (true over
estimated depth). Pairs: of which the nearer pixel is nearer. Held out: SSIM and relative depth error of frames kept out
of fusion. At rest: how far a camera that does not move drifts, share of the scene's median depth. --set: for all runs.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.input.opening import open_sequence
from scopemap.input.trajectory.trajectory import ASSUMED_FRAMES_PER_S
from scopemap.result.result import Result
from scopemap.result.verdict import verdict
from scopemap_bench.evaluation.depth import DepthFit, compared_depths, depth_scale, evaluate_depth
from scopemap_bench.evaluation.partial_truth import drift, pairs_in_order
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.overview import Clip
from scopemap_bench.speed import calibrations_ms

DEPTH_RANGE_MM = (1.0, 300.0)
"""True depth that counts: what C3VD and Hamlyn have in common."""


@dataclass(frozen=True)
class RealClip(Clip):
    """A row. pairs : file of pairs of pixels. held_out : measured against its own video. at_rest : the camera is."""

    pairs: Path | None = None
    held_out: bool = False
    has_depth: bool = False
    at_rest: bool = False
    realtime: bool = True


def clips(data: Path) -> list[RealClip]:
    """Return all real clips."""
    scopes, video, pairs = data / "endoscopy", data / "endoscopy" / "video", data / "endoscopy" / "ordinal"
    c3vd, cecum = scopes / "c3vd", scopes / "c3vd" / "cecum_t1_a"
    lens = ("--camera", str(c3vd / "trans_t2_a" / "camera.yaml"))
    pulling: dict[str, Any] = {
        "has_truth": False,
        "has_depth": True,
        "held_out": True,
        "at_rest": True,
        "realtime": False,
    }
    found = [
        RealClip("C3VD cecum_t1_a", cecum, true_depth=c3vd / "cecum_t1_a_true_depth", has_depth=True),
        RealClip("C3VD trans_t1_a", c3vd / "trans_t1_a", has_depth=True, realtime=False),
        RealClip("C3VD trans_t2_a", c3vd / "trans_t2_a", arguments=lens),
        RealClip("Hamlyn laparoscopy", scopes / "hamlyn" / "rectified01_part", has_truth=False, has_depth=True),
        RealClip("EndoNeRF pulling", scopes / "endonerf" / "pulling_soft_tissues", **pulling),
    ]
    for name in ("colonoscopy_nflba_03", "laparoscopy_rvim", "laparoscopy_endo3r_rgb3"):
        known: dict[str, Any] = {"has_truth": False, "pairs": pairs / f"{name}.csv", "held_out": True}
        found.append(RealClip(name, video / f"{name}.mp4", **known))
    return found


def depth_pairs(run: Result, truth: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield estimated and true depth (H, W), mm, of the result's frames that have both."""
    inside = set(run.frames["index"][run.frames.submap == 0].tolist())
    for frame, true in open_sequence(truth):
        if frame.index in inside and true is not None and true.depth_mm is not None:
            depth_mm = run.depth.read(frame.index)
            if depth_mm is not None and depth_mm.shape == true.depth_mm.shape:
                yield depth_mm, true.depth_mm


def depth_figures(run: Result, truth: Path, path_scale: float | None) -> dict[str, float]:
    """Return the errors of a run's depth; {} without any."""
    pairs = list(depth_pairs(run, truth))
    if not pairs:
        return {}
    scales = np.array([depth_scale(*pair, DEPTH_RANGE_MM) for pair in pairs])
    scale = float(np.nanmedian(scales)) if path_scale is None else path_scale
    own = [evaluate_depth(*pair, scaling="median", truth_range_mm=DEPTH_RANGE_MM)["abs_rel"] for pair in pairs]
    fit = DepthFit(scale=scale)
    one = [evaluate_depth(*pair, scaling=fit, truth_range_mm=DEPTH_RANGE_MM)["abs_rel"] for pair in pairs]
    fifths = [np.nanmean(part) for part in np.array_split(own, 5) if len(part)]
    correlations = []
    for pair in pairs:
        d, g, _ = compared_depths(*pair, DEPTH_RANGE_MM)
        if len(d):
            correlations.append(np.corrcoef(np.log(d), np.log(g))[0, 1])
    found = {"abs_rel": np.nanmean(own), "worst_fifth": max(fifths), "one_scale": np.nanmean(one)}
    return found | {"correlation": np.nanmean(correlations), "spread": np.nanstd(np.log(scales))}


def path_cell(run: Path, tracked: Path, truth: Path, *offset: str) -> tuple[str, dict[str, Any]]:
    """Return the error of a run's path and, in brackets, of its poses as tracked, and the run's figures."""
    against = ("--truth", truth, "--align", "sim3", *offset)
    figures, before = measuring.evaluated(run, *against), measuring.evaluated(tracked, *against)
    name = "ate_rmse_mm"
    return f"{measuring.cell(figures, '.3f', name)} ({measuring.cell(before, '.3f', name)})", figures


def measure(clip: RealClip, preset: str, out: Path, settings: list[str]) -> None:
    """Run a clip and print its row."""
    run, words = out / preset / re.sub(r"\W+", "-", clip.name), [w for s in settings for w in ("--set", s)]
    flows_ms, started = calibrations_ms(), time.perf_counter()
    measuring.run_once(clip.source, run, "--preset", preset, *clip.arguments, *words)
    elapsed_s = time.perf_counter() - started
    cost = ""
    if elapsed_s > 1:
        cost = f"{1e3 * elapsed_s / measuring.provenance(run)['frames'] / np.median(flows_ms):.1f}"
    folder, facts = Result(run), measuring.provenance(run)
    path = at_rest = pairs = held_out = ""
    scale = None
    truth = clip.truth(out / "truth" / run.name)
    if clip.has_truth:
        tracked = run.with_name(f"{run.name}-tracked")
        as_tracked = ("--set", "mapping.method=none", "--set", "fusion.enabled=false")
        measuring.run_once(clip.source, tracked, "--preset", preset, *clip.arguments, *words, *as_tracked)
        path, figures = path_cell(run, tracked, truth)
        scale = figures.get("scale")
        fitted, by_clock = path_cell(run, tracked, truth, "--time-offset", "fit")
        offset_s = by_clock.get("time_offset_s")  # none where the path does not tell it
        path += "" if offset_s is None else f" / {fitted} by {offset_s * ASSUMED_FRAMES_PER_S:+.1f} frames"
    depth = depth_figures(folder, truth, scale) if clip.has_depth else {}
    if clip.at_rest:
        at_rest = f"{drift(folder):.3f}"
    if clip.pairs is not None:
        pairs = "{} of {}".format(*pairs_in_order(folder, clip.pairs))
    if clip.held_out:
        kept_out = measuring.evaluated(run, "--against-video").get("against_video", {}).get("held_out", {})
        held_out = measuring.cell(kept_out, ".3f", "ssim", "depth_error")
    said = verdict(folder)
    doubts = ", ".join(reason.code for reason in said.reasons if reason.level in ("bad", "doubtful"))
    measuring.print_row(
        clip.name if preset == "default" else f"{clip.name}, `{preset}`",
        f"{facts['tracked']} of {facts['frames']}",
        path,
        measuring.cell(depth, ".3f", "abs_rel", "worst_fifth", "one_scale"),
        measuring.cell(depth, ".2f", "correlation"),
        measuring.cell(depth, ".3f", "spread"),
        pairs,
        held_out,
        at_rest,
        f"{said.word}: {doubts}" if doubts else said.word,
        cost,
    )


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, data=True, out=True)
    parser.add_argument("--only", nargs="+", default=["*"], help="names of clips; * is any text")
    parser.add_argument("--preset", nargs="+", default=["default", "realtime"], help="presets")
    parser.add_argument("--set", nargs="+", default=[], help="settings of all runs, NAME=VALUE")
    options = parser.parse_args()
    heads: list[str] = ["clip", "frames", "path mm (as tracked) / clock fitted (as tracked)"]
    heads += ("AbsRel: frame / worst fifth / one scale", "correlation")
    heads += ("spread", "pairs in order", "held out: SSIM / depth", "at rest", "verdict", "DIS flows a frame")
    with measuring.folder_or_scratch(options.out) as out:
        measuring.print_head(*heads)
        for preset in options.preset:
            for clip in clips(options.data):
                wanted = any(fnmatch(clip.name, pattern) for pattern in options.only)
                if wanted and (clip.realtime or preset == "default"):
                    measure(clip, preset, out, options.set)


if __name__ == "__main__":
    main()
