"""What each number of tracking, mapping and fusion moves: halved and doubled, one at a time, on five clips.

    python -m scopemap_bench.scripts.sensitivity --data FOLDER --out FOLDER [--only NAME ...] [--part K/N]
    python -m scopemap_bench.scripts.sensitivity --data FOLDER --out FOLDER --table

Three real clips of 100 frames and two phantoms. A number is a constant (`mapping.judge._NOISE_PX`) or an advanced
setting (`mapping.local_window`); whole ones stay whole. Moved: by what share the error of a clip changes, the largest
of all its errors: of the path, mm, and of depth (AbsRel) where the truth has them; else those of frames kept out of
fusion, depth and 1 - SSIM. OUT/figures.jsonl holds what was measured, so that a script that was stopped goes on, and
several with other parts can share it. --table prints what is there, the largest first.
"""

from __future__ import annotations

import argparse
import ast
import json
import math
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

import scopemap
from scopemap.apps.evaluate.against_video import held_out_agreement
from scopemap.engine.config.config import Config
from scopemap.engine.errors import ScopemapError
from scopemap.evaluation.clock import by_clock
from scopemap.evaluation.poses import match, pose_report
from scopemap.result.reference import read_reference
from scopemap.result.result import Result
from scopemap.result.trajectories import read_trajectory
from scopemap.result.verdict import verdict
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.earns import drawn, folder_name
from scopemap_bench.scripts.real import RealClip, clips, depth_figures
from scopemap_bench.scripts.with_number import constant_of

STAGES = ("tracking", "mapping", "fusion")
DECIDE_NOTHING = ("alike", "frame_store", "mesh_files", "tsdf", "texture*", "watertight")
"""Modules whose numbers are formats, sizes of a network or of memory, or of parts that a default run leaves out."""
REAL = {"C3VD cecum_t1_a": "0:100", "Hamlyn laparoscopy": "0:100", "laparoscopy_rvim": "60:160"}
PHANTOMS = ("phantom: cut: 30 degrees between two frames", "phantom: pulled")
FACTORS = (0.5, 2.0)
LONGEST_S = 3600
"""A process with a changed number that runs so long counts as one that fails."""
NOTHING = 0.01
"""Change of an error below which a number moves nothing."""
MUCH = 0.1
"""Change of an error above which a number moves much."""


@dataclass(frozen=True)
class Number:
    """A number that decides something. module : where it is a constant; "": it is a setting."""

    name: str
    value: float
    module: str = ""

    def times(self, factor: float) -> float:
        """Return it times a factor; a whole one stays whole, and at least 1."""
        return max(1, round(self.value * factor)) if isinstance(self.value, int) else self.value * factor


def constants() -> Iterator[Number]:
    """Yield the plain numbers that the modules of the stages name."""
    engine = Path(scopemap.__file__).parent / "engine"
    for stage in STAGES:
        for file in sorted((engine / stage).glob("*.py")):
            if any(fnmatch(file.stem, pattern) for pattern in DECIDE_NOTHING):
                continue
            for node in ast.parse(file.read_text(encoding="utf-8")).body:
                if (found := constant_of(node)) is not None:
                    name = f"{stage}.{file.stem}.{found[0]}"
                    yield Number(name, found[1], f"scopemap.engine.{stage}.{file.stem}")


def settings() -> Iterator[Number]:
    """Yield the advanced settings of the stages that are numbers."""
    config = Config.load()
    for stage in STAGES:
        group = getattr(config, stage)
        for name in type(group).sources():
            value = getattr(group, name)
            if isinstance(value, int | float) and not isinstance(value, bool) and value:
                yield Number(f"{stage}.{name}", value)


def ruler(data: Path, out: Path) -> list[RealClip]:
    """Return the clips of a row; phantoms are drawn."""
    real = [
        replace(one, arguments=(*one.arguments, "--frames", REAL[one.name])) for one in clips(data) if one.name in REAL
    ]
    return [*real, *drawn(out, list(PHANTOMS))]


def run_all(clips: list[RealClip], out: Path, number: Number | None, value: float) -> None:
    """Run every clip in one process, with a number changed; a run that fails leaves no result."""
    words = ["--set", f"{number.name}={value}"] if number is not None and not number.module else []
    commands = [
        shlex.join(
            map(str, ["run", one.source, "--out", out / folder_name(one.name), "--quiet", *one.arguments, *words])
        )
        for one in clips
    ]
    changed = number.module if number is not None else ""
    name = number.name.rpartition(".")[2] if changed and number is not None else ""
    script = [sys.executable, "-m", "scopemap_bench.scripts.with_number", changed, name, repr(value), *commands]
    try:
        subprocess.run(script, timeout=LONGEST_S, check=False, stdout=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        print(f"{changed or 'a setting'} {name}: longer than {LONGEST_S} s", file=sys.stderr)


def errors(clip: RealClip, run: Path, out: Path) -> dict[str, float]:
    """Return a run's errors by name, with what it says of itself; {} where it failed."""
    if not (run / "provenance.json").is_file():
        return {}
    result, truth, found = Result(run), clip.truth(out / "truth" / folder_name(clip.name)), {}
    if clip.has_truth:
        estimate, reference = read_trajectory(run), read_reference(truth)
        assert reference is not None
        reference, _ = by_clock(estimate, reference, "sim3", "fit")
        found["path_mm"] = pose_report(match(estimate, reference, "sim3"))["ate_rmse_mm"]
    if clip.has_depth:
        found["abs_rel"] = depth_figures(result, truth, None).get("abs_rel", math.nan)
    if clip.held_out:
        kept_out = held_out_agreement(run).figures()["held_out"]
        found |= {"depth_error": kept_out["depth_error"], "dissimilarity": 1 - kept_out["ssim"]}
    return found | {
        "lost": float(result.frames.lost.sum()),
        "good": float(verdict(result).word == "good"),
    }


def measure(clips: list[RealClip], out: Path, number: Number | None, factor: float) -> dict[str, dict[str, float]]:
    """Run all clips, and return the errors of each by its name; runs are removed."""
    runs = out / "runs" / folder_name(f"{number.name if number else 'as it is'} {factor}")
    run_all(clips, runs, number, number.times(factor) if number else 1.0)
    found = {}
    for clip in clips:
        try:
            found[clip.name] = errors(clip, runs / folder_name(clip.name), out)
        except ScopemapError as error:
            print(f"{runs.name}, {clip.name}: {error}", file=sys.stderr)
            found[clip.name] = {}
    shutil.rmtree(runs, ignore_errors=True)
    return found


def known(out: Path) -> dict[tuple[str, float], dict[str, dict[str, float]]]:
    """Return what was measured, by name and factor; "" and 1: nothing changed."""
    file = out / "figures.jsonl"
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return {(row["name"], row["factor"]): row["errors"] for row in map(json.loads, lines)}


def keep(out: Path, name: str, factor: float, found: dict[str, dict[str, float]]) -> None:
    """Add a row to what was measured."""
    with (out / "figures.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps({"name": name, "factor": factor, "errors": found}) + "\n")


def measure_missing(numbers: list[Number], data: Path, out: Path) -> None:
    """Measure the clips with nothing changed, then with each number halved and doubled, unless that is known."""
    clips = ruler(data, out)
    if ("", 1.0) not in known(out):
        keep(out, "", 1.0, measure(clips, out, None, 1.0))
    for number in numbers:
        for factor in FACTORS:
            if number.times(factor) != number.value and (number.name, factor) not in known(out):
                keep(out, number.name, factor, measure(clips, out, number, factor))


def moved(before: dict[str, dict[str, float]], after: dict[str, dict[str, float]]) -> tuple[float, str]:
    """Return the largest share by which an error changes, with its sign, and which; infinite where a run fails.

    What a run says of itself, and frames that it loses, are named where they change.
    """
    most, where, said = 0.0, "", []
    for clip, errors_before in before.items():
        if errors_before and not after.get(clip):
            return math.inf, f"{clip} fails"
        for name, error in errors_before.items():
            now = after[clip][name]
            if name in ("lost", "good"):
                said += [f"{clip}: {name} {error:g} -> {now:g}"] if now != error else []
            elif error > 0 and not abs(now / error - 1) <= abs(most):
                most, where = now / error - 1, f"{clip}, {name}"
    return most, "; ".join(filter(None, (where, *said)))


def print_table(numbers: list[Number], out: Path) -> None:
    """Print what was measured: a row a number, that which moves most first, and how many move nothing."""
    measured = known(out)
    before = measured["", 1.0]
    rows = []
    for number in numbers:
        cells = {f: moved(before, measured[number.name, f]) for f in FACTORS if (number.name, f) in measured}
        if cells:
            rows.append((max(abs(share) for share, _ in cells.values()), number, cells))
    measuring.print_head("number", "value", "halved: moved", "where", "doubled: moved", "where")
    for _, number, cells in sorted(rows, key=lambda row: (-row[0], row[1].name)):
        shown = [text for f in FACTORS for text in ((f"{cells[f][0]:+.1%}", cells[f][1]) if f in cells else ("", ""))]
        measuring.print_row(f"`{number.name}`", f"{number.value:.4g}", *shown)
    most = np.array([row[0] for row in rows])
    print(
        f"\n{len(rows)} of {len(numbers)} numbers: {np.sum(most > MUCH)} move an error by more than {MUCH:.0%}, ",
        end="",
    )
    print(f"{np.sum(most < NOTHING)} none by {NOTHING:.0%}.")


def main() -> None:
    """Measure what is missing, or print."""
    parser = measuring.options_of(__doc__, data=True)
    parser.add_argument("--out", type=Path, required=True, help="what was measured is kept here, and used again")
    parser.add_argument("--only", nargs="+", default=["*"], help="names of numbers; * is any text")
    parser.add_argument("--part", type=part, default=(1, 1), metavar="K/N", help="every N-th number, from the K-th")
    parser.add_argument("--table", action="store_true", help="measure nothing; print what is there")
    options = parser.parse_args()
    wanted = [one for one in (*settings(), *constants()) if any(fnmatch(one.name, each) for each in options.only)]
    if options.table:
        print_table(wanted, options.out)
    else:
        first, step = options.part
        measure_missing(wanted[first - 1 :: step], options.data, options.out)


def part(text: str) -> tuple[int, int]:
    """Return K and N of "K/N"; raises `ArgumentTypeError` for others."""
    first, _, step = text.partition("/")
    if not (first.isdigit() and step.isdigit() and 1 <= int(first) <= int(step)):
        raise argparse.ArgumentTypeError(f"expected K/N with K from 1 to N, got {text!r}")
    return int(first), int(step)


if __name__ == "__main__":
    main()
