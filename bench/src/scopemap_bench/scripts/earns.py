"""What each part of a run earns: every real clip and eight phantoms, with one switch off at a time.

    python -m scopemap_bench.scripts.earns --data FOLDER [--out FOLDER] [--only NAME ...] [--switch NAME=VALUE ...]
    python -m scopemap_bench.scripts.earns --data FOLDER --ideas [--out FOLDER] [--only NAME ...]

A row is a clip, a column a switch: a setting, or a constant of the engine (`mapping.judge._MOST_REFUSED=1e9`). --ideas:
the columns are the ideas of the engine that have no setting. A cell has what is known of the truth, and the report's
verdict. With a path: RMSE of positions after a Sim(3) alignment, mm, by the clock that fits the run best where the path
tells it. Else, with depth: AbsRel, mean over frames, one median scale a frame. Of the other videos: relative depth
error and SSIM of frames kept out of fusion. A part that changes no cell, neither the figure nor the verdict, earns
nothing.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

from scopemap.result.result import Result
from scopemap.result.verdict import verdict
from scopemap_bench.scripts import clinical_phantoms, measuring
from scopemap_bench.scripts.real import RealClip, clips, depth_figures

SWITCHES = (
    "mapping.method=none",
    "mapping.local_window=0",
    "mapping.triangulate_depth=false",
    "mapping.min_loop_inliers=0",
    "mapping.other_starts=false",
    "mapping.depth_step_sigma=0",
    "fusion.method=no-free-space",
    "tracking.relocalisation_keyframes=0",
)
"""Parts of a run that can be turned off; the first column has none of them off."""
IDEAS = (
    "mapping.keyframes._DRIFT_SIGMA=1e-6",  # the drift of the scale is divided out
    "mapping.judge._MAX_DEPTH_FACTOR=1e9",  # an adjustment is refused where predicted depths agree less
    "mapping.judge._MOST_OVER_TRACKED=1e9",  # the same where left-out tracks prefer the poses as tracked
    "mapping.judge._LEAST_SEEN=-1.0",  # a window is refused where it observes little of a keyframe
    "mapping.judge._MOST_REFUSED=1e9",  # tissue moves where many windows are refused
    "mapping.judge._MOST_AFTER=1e9",  # an interval is as tracked where its depths agree less
    "mapping.judge._GOOD_AGREEMENT=0.0",  # intervals are merged as tracked where their surface can be used
    "mapping.judge._MOST_OVER_PARTS=0.0",  # the same where they are not rigid, and none of the parts is better
    "mapping.judge._MIN_LOOPED=1000000",  # maps are merged by features alone, and as tracked
    "backwards._OVERLAP=1000000",  # maps are merged by tracking backwards
    "tracking.tracker._EARLIER_KEYFRAMES=0",  # frames are tracked against an earlier keyframe
    "tracking.tracker._WEAK_COVERAGE=0.0",  # weak poses are compared with those by features
    "tracking.keyframe_choice._PATIENCE=0",  # a keyframe waits for a clear picture
    "tracking.keyframe_choice._MIN_KEYFRAME_MOTION=0.0",  # and for motion
    "tracking.relocalisation._CLOSE_UP_RANGE=0.0",  # a close-up is told from other losses
    "depth.under_highlights._LARGEST=0.0",  # depth under highlights is that around them
    "fusion.frame_selection._LEAST_NEW=0.0",  # frames that show nothing anew are not fused
)
"""Constants of the engine that turn off an idea without a setting: what it does."""
CLINICAL = (
    "cut: 30 degrees between two frames",
    "instruments, twice",
    "fluid over the lens",
    "black, blurred, full of smoke: 10 frames each",
    "dark omentum before a lit wall, narrow beam, 45 degrees, sideways",
)
"""Of `clinical_phantoms`: what the switches are for (losses, instruments, outliers, a wrong relief)."""
MOVING = {
    "breath": ("--scene", "colon", "--deform", "--set", "breath_mm=4", "--set", "breath_frames=60"),
    "rebound": ("--scene", "laparoscopy", "--events", "rebound:20-80"),
    "pulled": ("--scene", "laparoscopy", "--events", "grasp:10-90"),
}
"""Phantoms whose tissue moves: it breathes by 4 mm, a push is let go, an instrument pulls."""
FRAMES = 100
SEED = 31


def phantoms() -> dict[str, tuple[object, ...]]:
    """Return the words that draw each phantom, by name."""
    clinical = ("--frames", clinical_phantoms.FRAMES, "--seed", clinical_phantoms.SEED)
    moving = ("--frames", FRAMES, "--seed", SEED)
    found = {f"phantom: {name}": (*clinical, *clinical_phantoms.PHANTOMS[name]) for name in CLINICAL}
    return found | {f"phantom: {name}": (*moving, *words) for name, words in MOVING.items()}


def drawn(out: Path, wanted: list[str]) -> Iterator[RealClip]:
    """Yield the wanted phantoms as clips with a true path, drawn in a folder."""
    for name, words in phantoms().items():
        if is_wanted(name, wanted):
            yield RealClip(name, measuring.phantom(out / "phantoms" / folder_name(name), *words))


def is_wanted(name: str, patterns: list[str]) -> bool:
    """Return whether a name fits a pattern."""
    return any(fnmatch(name, pattern) for pattern in patterns)


def folder_name(text: str) -> str:
    """Return a text as the name of a folder."""
    return re.sub(r"\W+", "-", text)


def figure(clip: RealClip, run: Path, out: Path) -> str:
    """Return what is known of a run's error; "" where that refuses to be measured."""
    truth = clip.truth(out / "truth" / folder_name(clip.name))
    if clip.has_truth:
        against = ("--truth", truth, "--align", "sim3")
        fitted = measuring.evaluated(run, *against, "--time-offset", "fit")
        figures = fitted if "time_offset_s" in fitted else measuring.evaluated(run, *against)
        return measuring.cell(figures, ".3f", "ate_rmse_mm")
    if clip.has_depth:
        return measuring.cell(depth_figures(Result(run), truth, None), ".3f", "abs_rel")
    kept_out = measuring.evaluated(run, "--against-video").get("against_video", {}).get("held_out", {})
    return measuring.cell(kept_out, ".3f", "depth_error", "ssim")


def run_with(clip: RealClip, switch: str, run: Path) -> None:
    """Run a clip with a switch off ("": none), unless its result is there; raises `CalledProcessError`."""
    name, _, value = switch.partition("=")
    module, _, constant = name.rpartition(".")
    if not constant.isupper():
        measuring.run_once(clip.source, run, *clip.arguments, *(("--set", switch) if switch else ()))
    elif not (run / "provenance.json").is_file():
        words = ("run", clip.source, "--out", run, "--quiet", *clip.arguments)
        changed = (f"scopemap.engine.{module}", constant, value, shlex.join(map(str, words)))
        script = "scopemap_bench.scripts.with_number"
        subprocess.run([sys.executable, "-m", script, *changed], check=True)
        if not (run / "provenance.json").is_file():  # it has told why, and ended as usual
            raise subprocess.CalledProcessError(1, script)


def cell(clip: RealClip, switch: str, out: Path) -> str:
    """Run a clip with a switch off ("": none) and return its cell; where the run fails, that."""
    run = out / (folder_name(switch) or "as-it-is") / folder_name(clip.name)
    try:
        run_with(clip, switch, run)
    except subprocess.CalledProcessError:
        return "the run fails"
    return ", ".join(filter(None, (figure(clip, run, out), verdict(Result(run)).word)))


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, data=True, out=True)
    parser.add_argument("--only", nargs="+", default=["*"], help="names of clips and phantoms; * is any text")
    parser.add_argument("--ideas", action="store_true", help="of the engine that have no setting, one off at a time")
    parser.add_argument("--switch", nargs="+", help="settings or constants, one off at a time, NAME=VALUE")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        switches = options.switch or (IDEAS if options.ideas else SWITCHES)
        measuring.print_head("clip", "as it is", *(f"`{switch}`" for switch in switches))
        wanted = [clip for clip in clips(options.data) if is_wanted(clip.name, options.only)]
        for clip in (*wanted, *drawn(out, options.only)):
            measuring.print_row(clip.name, *(cell(clip, switch, out) for switch in ("", *switches)))


if __name__ == "__main__":
    main()
