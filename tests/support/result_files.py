"""What lies in the folder of a result or of a batch, as tests look at it."""

from __future__ import annotations

import csv
from pathlib import Path

# They hold times, or what holds times.
NOT_COMPARED = {"provenance.json", "SHA256SUMS", "report.html", "frames/measures.csv"}


def table_rows(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as table:
        return list(csv.DictReader(table))


def frame_rows(out: Path) -> list[dict[str, str]]:
    return table_rows(out / "frames.csv")


def batch_rows(file: Path) -> dict[str, dict[str, str]]:
    """The rows of a batch's table by the folders of their results."""
    return {row["folder"]: row for row in table_rows(file)}


def compared_files(folder: Path) -> dict[str, bytes]:
    """The content of the files of a result that two equal runs have in common, by their names."""
    names = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in names.items() if name not in NOT_COMPARED}
