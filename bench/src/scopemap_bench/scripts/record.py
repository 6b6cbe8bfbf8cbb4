"""Keeps a table with the command, commit and date that made it, and tells which tables are older than the code.

    python -m scopemap_bench.scripts.record [--note TEXT] NAME -- COMMAND ...     run COMMAND, write
            bench/results/NAME.md
    python -m scopemap_bench.scripts.record --check                               name the tables that the code has
            outdated

A table is outdated where `src/` or `bench/src/` has changed since its commit. `.ci/release` asks; tests do not.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[4]
RESULTS = ROOT / "bench" / "results"
MEASURED = ("src", "bench/src")
"""What a table depends on."""


def git(*arguments: str) -> str:
    """Return what git prints in the project."""
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def record(name: str, note: str, command: list[str]) -> Path:
    """Run a command and keep what it prints; raises `SystemExit` where it fails or the code is not committed."""
    if git("status", "--porcelain", "--", *MEASURED):
        sys.exit("record: the sources differ from the last commit; commit first: the table names what ran by it")
    commit, date = git("rev-parse", "--short", "HEAD"), datetime.now(UTC).date().isoformat()
    run = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    printed = ""
    for line in run.stdout or []:
        print(line, end="", flush=True)
        printed += line
    if run.wait() != 0:
        sys.exit(f"record: {shlex.join(command)} failed with exit code {run.returncode}")
    RESULTS.mkdir(exist_ok=True)
    file = RESULTS / f"{name}.md"
    head = f"# {name}\n\nCommit {commit}, {date}, by\n\n    {shlex.join(command)}\n\n"
    file.write_text(head + (f"{note}\n\n" if note else "") + printed.strip() + "\n", encoding="utf-8")
    return file


def outdated() -> list[str]:
    """Return one line for each table whose commit is not known or older than the last change of src/."""
    found = []
    for file in sorted(RESULTS.glob("*.md")):
        commit = re.search(r"^Commit (\w+)", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
        try:
            changes = git("rev-list", "--count", f"{commit[1]}..HEAD", "--", *MEASURED) if commit else "unknown"
        except subprocess.CalledProcessError:
            changes = "unknown"
        if changes != "0":
            found.append(f"{file.relative_to(ROOT)}: {changes} commits to the sources since it was measured")
    return found


def main() -> None:
    """Record or check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?")
    parser.add_argument("--note", default="")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    if options.check:
        lines = outdated()
        print("\n".join(lines) or "all tables are of the present code")
        sys.exit(1 if lines else 0)
    command = [word for word in options.command if word != "--"]
    if not options.name or not command:
        parser.error("give a name and, after --, the command")
    print(record(options.name, options.note, command))


if __name__ == "__main__":
    main()
