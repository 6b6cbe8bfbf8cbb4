"""Tables 1 to 3 as CSV: every column of the paper, and a trajectory whose figures are computed by hand."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest

from tests.support.front_door import call

# Errors of four frames 10 mm apart: 0, 0, 3 and 4 mm aside, and a turn of 0.4 rad in the last one.
REFERENCE = [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (20.0, 0.0, 0.0), (30.0, 0.0, 0.0)]
ESTIMATE = [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (20.0, 3.0, 0.0), (30.0, 4.0, 0.4)]
# By hand; angles in rad. Relative errors of the three pairs: 0, 3 and 1 mm.
BY_HAND = {
    "T_avg": 7 / 4,
    "T_avg std": math.sqrt(25 / 4 - 49 / 16),
    "R_avg": 0.1,
    "R_avg std": math.sqrt(0.04 - 0.01),
    "RMSE": 2.5,
    "T_fin": 4.0,
    "R_fin": 0.4,
    "RPE 1 frame": 4 / 3,
    "RPE 1 frame std": math.sqrt(10 / 3 - 16 / 9),
    "RPE 10 mm path": 4 / 3,
    "RPE 10 mm path std": math.sqrt(10 / 3 - 16 / 9),
    "T_max": 4.0,
    "R_max": 0.4,
    "T<T_avg": 50.0,
    "R<R_avg": 75.0,
    "TLR": (10 + math.sqrt(109) + math.sqrt(101)) / 30,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("by hand")
    for name, poses in (("reference.txt", REFERENCE), ("ours.txt", ESTIMATE)):
        lines = [f"{n} {x} {y} 0 0 0 {math.sin(a / 2)} {math.cos(a / 2)}" for n, (x, y, a) in enumerate(poses)]
        (root / name).write_text("\n".join(["# unit: mm", *lines]) + "\n")
    for out, options in (("rad", ["--paper-units"]), ("deg", [])):
        arguments = (root / "ours.txt", "--truth", root / "reference.txt", "--align", "none", "--out", root / out)
        assert call("compare", *arguments, "--names", "ours", "--quiet", *options) == 0
    return root


def measured(table: Path) -> dict[str, str]:
    """The row that was measured, by the heads without their units."""
    (row,) = [row for row in csv.DictReader(table.open()) if row["source"] == "measured"]
    return {head.partition(" [")[0]: text for head, text in row.items()}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "columns"), [("table1", 13), ("table2", 10), ("table3", 9)])
def test_figures_are_those_by_hand(name: str, columns: int, folder: Path) -> None:
    radians, degrees = (measured(folder / unit / "tables" / f"{name}.csv") for unit in ("rad", "deg"))
    compared = [head for head in BY_HAND if head in radians]
    assert len(compared) == columns
    for head in compared:
        assert float(radians[head]) == pytest.approx(BY_HAND[head], rel=1e-5)
        factor = math.degrees(1) if head.startswith("R_") else 1.0
        assert float(degrees[head]) == pytest.approx(factor * BY_HAND[head], rel=1e-5)
