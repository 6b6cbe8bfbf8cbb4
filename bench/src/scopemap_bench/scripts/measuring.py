"""What the scripts share: the command line, phantoms that are drawn once, figures of a run, Markdown rows, memory."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def options_of(doc: str | None, *, data: bool = False, out: bool = False) -> argparse.ArgumentParser:
    """Return the parser of a script whose help is its docstring, with `--data` and `--out` where wanted."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if data:
        parser.add_argument("--data", type=Path, required=True, help="folder of the real data")
    if out:
        parser.add_argument("--out", type=Path, help="keep phantoms and runs here; those that are there are used again")
    return parser


def command_line(*words: object) -> list[str]:
    """Return the words that run the command line in a process of its own."""
    return [sys.executable, "-m", "scopemap", *map(str, words)]


def scopemap(*words: object) -> None:
    """Run the command line; raises `CalledProcessError` where it fails."""
    subprocess.run(command_line(*words), check=True)


def phantom(folder: Path, *words: object) -> Path:
    """Render a phantom by `scopemap phantom` unless it is there, whole; return its folder."""
    if not (folder / "mesh_truth.ply").is_file():
        scopemap("phantom", folder, *words, "--quiet")
    return folder


def run_once(source: Path, out: Path, *words: object) -> Path:
    """Run a source unless its result is there; return the result's folder."""
    if not (out / "provenance.json").is_file():
        scopemap("run", source, "--out", out, "--quiet", *words)
    return out


def provenance(run: Path) -> dict[str, Any]:
    """Return what a result says of itself."""
    found: dict[str, Any] = json.loads((run / "provenance.json").read_text(encoding="utf-8"))
    return found


def evaluated(run: Path, *words: object) -> dict[str, Any]:
    """Return the figures of `scopemap evaluate`; {} where it refuses, and the reason goes to standard error."""
    done = subprocess.run(command_line("evaluate", run, *words, "--json"), capture_output=True, text=True)
    if done.returncode:
        print(f"{run.name}: {done.stderr.strip()}", file=sys.stderr)
        return {}
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def submaps(run: Path) -> int:
    """Return how many submaps a result has."""
    return 1 + len(list((run / "maps").glob("*")))


def cell(figures: dict[str, Any], form: str, *names: str) -> str:
    """Return figures in a form, separated by slashes; "" where one is missing."""
    values = [figures.get(name) for name in names]
    return "" if any(value is None for value in values) else " / ".join(format(value, form) for value in values)


def rotation(figures: dict[str, Any]) -> str:
    """Return mean and largest rotation error since the first frame, unaligned, degrees."""
    return cell(figures, ".2f", "rotation_unaligned_mean_deg", "rotation_unaligned_max_deg")


def print_row(*cells: object) -> None:
    """Print a row of a Markdown table at once."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def print_head(*heads: str) -> None:
    """Print the head of a Markdown table."""
    print_row(*heads)
    print(f"|{'---|' * len(heads)}", flush=True)


@contextmanager
def folder_or_scratch(folder: Path | None) -> Iterator[Path]:
    """Yield a folder, or one that is removed afterwards."""
    with tempfile.TemporaryDirectory() as scratch:
        yield folder or Path(scratch)


def memory_mb(process: int | str = "self") -> float:
    """Return the resident memory of a process, MB; raises `OSError` where it has ended."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def there_and_back(count: int, length: int) -> list[int]:
    """Return so many numbers of `length` frames, from the first to the last and back, again and again."""
    loop = [*range(length), *range(length - 2, 0, -1)]
    return [loop[number % len(loop)] for number in range(count)]
