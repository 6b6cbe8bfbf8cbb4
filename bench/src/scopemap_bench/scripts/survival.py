"""How much of a video survives? Frames tracked, and the maps that they are in, after the back end; no truth needed.

    python -m scopemap_bench.scripts.survival --input VIDEO_OR_FOLDER... [--frames 0:247] [--set KEY=VALUE ...]

Nothing is fused, and no depth triangulated: neither changes a pose. With a data set that has poses, the error of the
largest map's positions after Sim(3), too.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path

from scopemap.cli.options import parse_settings
from scopemap.config import Config
from scopemap.evaluation.poses import match, pose_report
from scopemap.io.opening import open_sequence
from scopemap.reconstruction import Reconstruction
from scopemap.runner.reconstruct import reconstruct
from scopemap.trajectory.formats.opening import read_trajectory

FIXED = {"fusion.enabled": "false", "mapping.triangulate_depth": "false"}
SMALL, LARGE = 10, 50


def row(path: Path, frames: slice, config: Config) -> list[str]:
    """Return the cells of a clip."""
    started = time.process_time()
    result = reconstruct(open_sequence(path, frames=frames), config)
    seconds = time.process_time() - started
    sizes = Counter(number for number in result.frames["map"].tolist() if number >= 0)
    count, tracked = len(result.frames), int((result.frames["status"] != "lost").sum())
    large = sum(size for size in sizes.values() if size >= LARGE)
    return [
        path.stem,
        f"{tracked} of {count} ({tracked / count:.0%})",
        str(max(sizes.values())),
        str(sum(size >= SMALL for size in sizes.values())),
        f"{large / count:.0%}",
        error_mm(path, result),
        f"{seconds:.0f}",
    ]


def error_mm(path: Path, result: Reconstruction) -> str:
    """Return the root mean square error of the largest map's positions after Sim(3); "" where no truth is known."""
    if not path.is_dir():
        return ""
    report = pose_report(match(result.trajectory, read_trajectory(path), "sim3"))
    return f"{report['ate_rmse_mm']:.3f}"


def main(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--input", type=Path, nargs="+", required=True)
    parser.add_argument("--frames", default=":")
    parser.add_argument("--set", dest="settings", action="append", default=[])
    options = parser.parse_args(arguments)
    config = Config.load(settings=FIXED | parse_settings(options.settings))
    frames = slice(*(int(part) if part else None for part in options.frames.split(":")))
    print(f"| clip | tracked | largest map | maps of {SMALL} | in maps of {LARGE} | ATE, mm | processor, s |")
    print("|---|---|---|---|---|---|---|")
    for path in options.input:
        print("|", " | ".join(row(path, frames, config)), "|", flush=True)


if __name__ == "__main__":
    main()
