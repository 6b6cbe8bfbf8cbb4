"""The thirteen tables of bench/results/: made at one commit, and checked for being older than the code.

    python -m scopemap_bench.scripts.record --all --data FOLDER       make all; the commit must be whole
    python -m scopemap_bench.scripts.record NAME ... --data FOLDER    make some
    python -m scopemap_bench.scripts.record --check                   name the tables that the code has outdated

A table is outdated where `src/` or `bench/src/` has changed since its commit. `.ci/release` asks; tests do not.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from scopemap.engine.errors import ScopemapError
from scopemap_bench.plan import read_plan
from scopemap_bench.runner import planned, what_is_missing
from scopemap_bench.scripts.measuring import options_of

ROOT = Path(__file__).resolve().parents[4]
RESULTS = ROOT / "bench" / "results"
MEASURED = ("src", "bench/src")
"""What a table depends on."""

SCRIPT = "python -m scopemap_bench.scripts"
PLAN = "env SCOPEMAP_WEIGHTS_DIR=DATA/weights python -m scopemap bench"
TABLES: dict[str, tuple[str, str]] = {
    "overview": (f"{SCRIPT}.overview --data DATA --out OUT --repeat 3", ""),
    "real": (f"{SCRIPT}.real --data DATA --out OUT/real", ""),
    "earns": (f"{SCRIPT}.earns --data DATA --out OUT/earns", ""),
    "inside-out": (f"{SCRIPT}.inside_out --out OUT/inside-out", ""),
    "surface": (f"{SCRIPT}.surface --data DATA --out OUT", ""),
    "clinical-phantoms": (f"{SCRIPT}.clinical_phantoms --seed 21 22 23", ""),
    "unknown-lenses": (f"{SCRIPT}.unknown_lenses --data DATA", ""),
    "depth": (f"{SCRIPT}.depth_without_download --data DATA --size 320x256", ""),
    "methods": (f"{PLAN} real-and-phantom --data DATA --out OUT/methods", "methods/tables/overview.md"),
    "ablations": (f"{PLAN} real-and-phantom-ablations --data DATA --out OUT/ablations", "ablations/tables/overview.md"),
    "verdicts": (f"{SCRIPT}.verdicts --data DATA --out OUT/verdicts", ""),
    "lesions": (f"{SCRIPT}.lesions --out OUT/lesions", ""),
    "long-clip": (f"{SCRIPT}.long_runs --frames --clip DATA/endoscopy/c3vd/cecum_t1_a", ""),
    "long-runs": (
        f"{SCRIPT}.long_runs --frames 300 1200 --live DATA/endoscopy/video/laparoscopy_rvim.mp4 --minutes 0.5"
        f" && {SCRIPT}.robustness --kills 16 --failures 6 --videos 6",
        "",
    ),
}
"""By name: the command (or several, joined by &&), whose DATA and OUT are folders, and the file below OUT that holds
the table; "": printed."""


def git(*arguments: str) -> str:
    """Return what git prints in the project."""
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def record(name: str, data: Path, out: Path, commit: str) -> None:
    """Make a table and write it to bench/results/; raises `SystemExit` where its command fails."""
    command, file = TABLES[name]
    started, printed = time.monotonic(), []
    for part in command.split(" && "):
        words = [word.replace("DATA", str(data)).replace("OUT", str(out)) for word in shlex.split(part)]
        words = [sys.executable if word == "python" else word for word in words]
        run = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        printed.append(run.stdout)
        if run.returncode != 0:
            sys.exit(f"record: {part} failed with exit code {run.returncode}\n{run.stdout}")
    table = (out / file).read_text(encoding="utf-8") if file else "\n".join(printed)
    table = re.sub(r"\A# .*\n+", "", table).strip()
    date = datetime.now(UTC).date().isoformat()
    text = f"# {name}\n\nCommit {commit}, {date}, by\n\n    {command}\n\n{table}\n"
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.md").write_text(text, encoding="utf-8")
    print(f"{name}: {time.monotonic() - started:.0f} s", flush=True)


def outdated() -> list[str]:
    """Return one line for each table that is missing, or whose commit is unknown or older than the last change."""
    found = []
    for name in TABLES:
        file = RESULTS / f"{name}.md"
        text = file.read_text(encoding="utf-8") if file.is_file() else ""
        commit = re.search(r"^Commit (\w+)", text, flags=re.MULTILINE)
        try:
            changes = git("rev-list", "--count", f"{commit[1]}..HEAD", "--", *MEASURED) if commit else "unknown"
        except subprocess.CalledProcessError:
            changes = "unknown"
        if changes != "0":
            found.append(f"{name}: {changes} commits to the sources since it was measured")
    return found


def lacking(name: str, data: Path) -> list[str]:
    """Return what the plan of a table needs and this machine does not have: sequences, packages, weights, files.

    Scripts need nothing but scopemap-bench, and phantoms or `data`.
    """
    plan = re.match(rf"{re.escape(PLAN)} (\S+)", TABLES[name][0])
    if plan is None:
        return []
    os.environ["SCOPEMAP_WEIGHTS_DIR"] = str(data / "weights")  # where the command looks
    try:
        entries, notes = planned(read_plan(plan[1]), data, data)
    except ScopemapError as error:
        return [str(error)]
    return [*notes, *dict.fromkeys(filter(None, map(what_is_missing, entries)))]


def make(names: list[str], data: Path) -> None:
    """Make tables at the present commit; raises `SystemExit` where it is not whole, or a plan lacks something."""
    if git("status", "--porcelain", "--", *MEASURED):
        sys.exit("record: the sources differ from the last commit; commit first: a table names what made it")
    for name in names:
        if lacks := lacking(name, data.resolve()):
            sys.exit(f"record: the table {name} would have rows without figures: {'; '.join(lacks)}")
    commit = git("rev-parse", "--short", "HEAD")
    with tempfile.TemporaryDirectory() as out:
        for name in names:
            record(name, data.resolve(), Path(out), commit)


def main() -> None:
    """Make or check."""
    parser: argparse.ArgumentParser = options_of(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(TABLES))
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--data", type=Path, help="folder of the real data")
    options = parser.parse_args()
    names = list(TABLES) if options.all else options.names
    if unknown := set(names) - set(TABLES):
        parser.error(f"unknown table: {', '.join(sorted(unknown))}")
    if options.check:
        lines = outdated()
        print("\n".join(lines) or "all tables were made by the present code")
        sys.exit(1 if lines else 0)
    if not names or options.data is None:
        parser.error("give --all or names of tables, and --data; or --check")
    make(names, options.data)


if __name__ == "__main__":
    main()
