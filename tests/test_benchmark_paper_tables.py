"""Tables 1 to 3 as CSV: every column of the paper, and a trajectory whose figures are computed by hand."""

from __future__ import annotations

import csv
import math
from importlib import resources
from pathlib import Path

import pytest
from front_door import call

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
# The paper's columns and ours. Its RPE has no stated interval: ours are two.
COLUMNS = {
    "sequence": ["sequence"],
    "framework": ["framework"],
    "variant": ["variant"],
    "T_avg_mm": ["T_avg"],
    "T_avg_std": ["T_avg std"],
    "R_avg": ["R_avg"],
    "R_avg_std": ["R_avg std"],
    "RMSE_mm": ["RMSE"],
    "T_fin_mm": ["T_fin"],
    "R_fin": ["R_fin"],
    "RPE_mm": ["RPE 1 frame", "RPE 10 mm path"],
    "RPE_std": ["RPE 1 frame std", "RPE 10 mm path std"],
    "T_max_mm": ["T_max"],
    "R_max": ["R_max"],
    "T_below_avg_percent": ["T<T_avg"],
    "R_below_avg_percent": ["R<R_avg"],
    "TLR": ["TLR"],
}
PUBLISHED = {"table1": "table1_pose_scared", "table2": "table2_methods_scared", "table3": "table3_ablation_scared"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("by hand")
    for name, poses in (("reference.txt", REFERENCE), ("ours.txt", ESTIMATE)):
        lines = [f"{n} {x} {y} 0 0 0 {math.sin(a / 2)} {math.cos(a / 2)}" for n, (x, y, a) in enumerate(poses)]
        (root / name).write_text("\n".join(lines) + "\n")
    for out, options in (("rad", ["--paper-units"]), ("deg", [])):
        arguments = (root / "ours.txt", "--truth", root / "reference.txt", "--align", "none", "--out", root / out)
        assert call("compare", *arguments, "--names", "ours", "--quiet", *options) == 0
    return root


def measured(table: Path) -> dict[str, str]:
    """The row that was measured, by the heads without their units."""
    (row,) = [row for row in csv.DictReader(table.open()) if row["source"] == "measured"]
    return {head.partition(" [")[0]: text for head, text in row.items()}


@pytest.mark.parametrize("name", PUBLISHED)
def test_every_column_of_the_paper_is_measured(name: str, folder: Path) -> None:
    file = resources.files("scopemap_bench") / "published" / f"{PUBLISHED[name]}.csv"
    columns = file.read_text().splitlines()[0].split(",")
    row = measured(folder / "rad" / "tables" / f"{name}.csv")
    assert all(row[ours] for column in columns for ours in COLUMNS[column])


@pytest.mark.parametrize("name", PUBLISHED)
def test_figures_are_those_by_hand(name: str, folder: Path) -> None:
    radians, degrees = (measured(folder / unit / "tables" / f"{name}.csv") for unit in ("rad", "deg"))
    compared = [head for head in BY_HAND if head in radians]
    assert len(compared) >= 9
    for head in compared:
        assert float(radians[head]) == pytest.approx(BY_HAND[head], rel=1e-5)
        factor = math.degrees(1) if head.startswith("R_") else 1.0
        assert float(degrees[head]) == pytest.approx(factor * BY_HAND[head], rel=1e-5)
