"""What each part of a run earns: every real clip and eight phantoms, with one switch off at a time.

    python -m scopemap_bench.scripts.earns --data FOLDER [--out FOLDER] [--only NAME ...] [--switch NAME=VALUE ...]

A row is a clip, a column a switch. A cell has what is known of the truth, and the report's verdict. With a path: RMSE
of positions after a Sim(3) alignment, mm, by the clock that fits the run best where the path tells it. Else, with
depth: AbsRel, mean over frames, one median scale a frame. Of the other videos: relative depth error and SSIM of frames
kept out of fusion. A part that changes no cell, neither the figure nor the verdict, earns nothing.
"""

from __future__ import annotations

import re
import subprocess
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


def cell(clip: RealClip, switch: str, out: Path) -> str:
    """Run a clip with a switch off ("": none) and return its cell; where the run fails, that."""
    folder = out / (folder_name(switch) or "as-it-is") / folder_name(clip.name)
    words = ("--set", switch) if switch else ()
    try:
        run = measuring.run_once(clip.source, folder, *clip.arguments, *words)
    except subprocess.CalledProcessError:
        return "the run fails"
    return ", ".join(filter(None, (figure(clip, run, out), verdict(Result(run)).word)))


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, data=True, out=True)
    parser.add_argument("--only", nargs="+", default=["*"], help="names of clips and phantoms; * is any text")
    parser.add_argument("--switch", nargs="+", default=[*SWITCHES], help="settings, one off at a time, NAME=VALUE")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        measuring.print_head("clip", "as it is", *(f"`{switch}`" for switch in options.switch))
        wanted = [clip for clip in clips(options.data) if is_wanted(clip.name, options.only)]
        for clip in (*wanted, *drawn(out, options.only)):
            measuring.print_row(clip.name, *(cell(clip, switch, out) for switch in ("", *options.switch)))


if __name__ == "__main__":
    main()
