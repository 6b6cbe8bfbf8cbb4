"""What `scopemap run` reaches by default on real clips and phantoms: the table and the speed picture of BENCHMARK.md.

    python -m scopemap_bench.scripts.overview --data FOLDER [--out FOLDER] [--picture FILE] [--only NAME ...]
            [--presets NAME ...]
                                  [--repeat N]

FOLDER is the real data's (README, "Tests on real data"). Every row is one run of the command line with the settings of
a preset, by default `default` (and the depth files named), measured by `scopemap evaluate`. Position errors are after a
Sim(3) alignment. Frames per second are those of the whole command, from its start to its end, the median of `--repeat`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

HEADER = (
    "| clip | frames in the result | submaps | ATE RMSE mm | rotation mean / max deg | RPE 10 mm / deg "
    "| depth AbsRel | mesh to truth mm | frames per s |\n|---|---|---|---|---|---|---|---|---|"
)
PHANTOMS = {
    "colon phantom": ("--scene", "colon", "--frames", "120", "--seed", "11"),
    "laparoscopy phantom": ("--scene", "laparoscopy", "--frames", "120", "--seed", "12"),
    "tube phantom, no texture": ("--scene", "tube", "--frames", "120", "--seed", "13"),
    "colon phantom, breathing": ("--scene", "colon", "--frames", "120", "--seed", "14", "--deform"),
}
STAGES = ("focal length", "read", "preprocess", "match", "track", "back end", "fuse")


@dataclass(frozen=True)
class Clip:
    """One row: its name, the input, the truth if there is one, and further arguments of `scopemap run`."""

    name: str
    source: Path
    truth: Path | None
    arguments: tuple[str, ...] = ()


def scopemap(*arguments: str, check: bool = True) -> str:
    """Return what the command line prints; raises `CalledProcessError` where it fails and `check` is set."""
    command = [sys.executable, "-m", "scopemap", *arguments]
    return subprocess.run(command, check=check, capture_output=True, text=True).stdout


def clips(data: Path, phantoms: Path) -> list[Clip]:
    """Return all clips; phantoms are rendered into `phantoms` where they are missing."""
    c3vd, video = data / "endoscopy" / "c3vd", data / "endoscopy" / "video"
    cecum, trans, kitchen = c3vd / "cecum_t1_a", c3vd / "trans_t1_a", data / "rgbd" / "7scenes_kitchen_100f"
    disparity = ("--depth", f"files:{cecum}_depth_anything", "--near-far", "13.5:100")
    room = ("fusion.voxel_mm=10", "fusion.truncation_mm=40", "fusion.max_depth_mm=4000")
    found = [
        Clip("C3VD cecum_t1_a", cecum, cecum),
        Clip("C3VD cecum_t1_a, Depth Anything's disparity", cecum, cecum, disparity),
        Clip("C3VD trans_t1_a (10 frames), true depth", trans, trans, ("--depth", f"files:{trans}")),
        Clip(
            "7-Scenes kitchen, measured depth",
            kitchen,
            kitchen,
            ("--depth", f"files:{kitchen}", *(word for setting in room for word in ("--set", setting))),
        ),
    ]
    for name, arguments in PHANTOMS.items():
        folder = phantoms / name.replace(" ", "-").replace(",", "")
        if not (folder / "mesh_truth.ply").is_file():
            scopemap("phantom", str(folder), *arguments, "--quiet")
        found.append(Clip(name, folder, folder))
    found.append(Clip("colonoscopy video", video / "colonoscopy_nflba_03.mp4", None))
    found.append(Clip("laparoscopy video", video / "laparoscopy_rvim.mp4", None))
    return found


def measure(clip: Clip, preset: str, out: Path, repeat: int = 1) -> tuple[str, dict[str, float]]:
    """Run a clip `repeat` times; return its row of the table and its seconds per frame for each stage."""
    elapsed_s = []
    for _ in range(repeat):
        started = time.perf_counter()
        arguments = ("--preset", preset, "--quiet", "--overwrite", *clip.arguments)
        scopemap("run", str(clip.source), "--out", str(out), *arguments)
        elapsed_s.append(time.perf_counter() - started)
    provenance = json.loads((out / "provenance.json").read_text())
    frames, seconds = provenance["frames"], provenance["seconds"]
    submaps = 1 + len(list((out / "maps").glob("*")))
    name = clip.name if preset == "default" else f"{clip.name}, `{preset}`"
    row = [name, f"{provenance['tracked']} of {frames}", str(submaps), *_errors(clip, out)]
    stages = {stage: seconds.get(stage, 0.0) / frames for stage in STAGES}
    return f"| {' | '.join(row)} | {frames / statistics.median(elapsed_s):.1f} |", stages


def _errors(clip: Clip, out: Path) -> list[str]:
    """Return the cells ATE, rotation, RPE, depth and mesh; empty where there is no truth or too few tracked frames."""
    if clip.truth is None:
        return [""] * 5
    arguments = ("evaluate", str(out), "--truth", str(clip.truth), "--align", "sim3", "--json")
    printed = scopemap(*arguments, "--depth", "median", check=False) or scopemap(*arguments, check=False)
    if not printed:
        return [""] * 5
    found: dict[str, Any] = json.loads(printed)
    rotation = f"{found['rotation_unaligned_mean_deg']:.2f} / {found['rotation_unaligned_max_deg']:.2f}"
    rpe = f"{found['rpe_10_mm']:.3f} / {found['rpe_10_deg']:.3f}" if found.get("rpe_10_mm") is not None else ""
    depth = found.get("depth", {}).get("abs_rel")
    mesh = found.get("mesh_accuracy_mm")
    return [
        f"{found['ate_rmse_mm']:.3f}",
        rotation,
        rpe,
        "" if depth is None else f"{depth:.3f}",
        "" if mesh is None else f"{mesh:.2f}",
    ]


def draw_speed(stages: dict[str, dict[str, float]], file: Path) -> None:
    """Draw the time per frame of each stage for each clip as a PNG; the first three stages overlap with tracking."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 0.5 * len(stages) + 1.4), layout="constrained", dpi=110)
    axes = figure.add_subplot()
    names, left = list(stages), [0.0] * len(stages)
    for stage in STAGES:
        width = [1e3 * stages[name][stage] for name in names]
        axes.barh(names, width, left=left, label=stage)
        left = [a + b for a, b in zip(left, width, strict=True)]
    axes.invert_yaxis()
    axes.set_xlabel('ms per frame, one thread; stages up to "track" run side by side')
    axes.legend(ncols=len(STAGES), loc="lower center", bbox_to_anchor=(0.35, 1.0), frameon=False, fontsize="small")
    figure.savefig(file)


def main() -> None:
    """Run, measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, help="keep phantoms and results here")
    parser.add_argument("--picture", type=Path, help="draw the time of each stage into this PNG")
    parser.add_argument("--only", nargs="+", help="names of clips; * is any text")
    parser.add_argument("--presets", nargs="+", default=["default"])
    parser.add_argument("--repeat", type=int, default=1, help="runs of each clip")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        out, stages = options.out or Path(scratch), {}
        print(HEADER, flush=True)
        for number, clip in enumerate(clips(options.data, out / "phantoms")):
            if options.only and not any(fnmatch(clip.name, name) for name in options.only):
                continue
            for preset in options.presets:
                row, stages[f"{clip.name}, {preset}"] = measure(
                    clip, preset, out / f"{number:02d}_{preset}", options.repeat
                )
                print(row, flush=True)
        if options.picture:
            draw_speed(stages, options.picture)


if __name__ == "__main__":
    main()
