"""What the paper printed: tables 1, 2 and 3 of arXiv 2508.11282, to stand beside what is measured here.

The files in `published/` hold the figures as printed; its README says what they are.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Literal

PublishedTable = Literal["table1_pose_scared", "table2_methods_scared", "table3_ablation_scared"]

_METHOD_COLUMNS = ("framework", "variant")
# The paper's column to the name of the same figure in `PaperReport`. Its RPE has no stated interval: none of ours.
_NAMES = {
    "T_avg_mm": "t_avg_mm",
    "T_avg_std": "t_std_mm",
    "R_avg": "r_avg_rad",
    "R_avg_std": "r_std_rad",
    "RMSE_mm": "rmse_mm",
    "T_fin_mm": "t_fin_mm",
    "R_fin": "r_fin_rad",
    "RPE_mm": "rpe_unstated_mm",
    "RPE_std": "rpe_unstated_std_mm",
    "T_max_mm": "t_max_mm",
    "R_max": "r_max_rad",
    "T_below_avg_percent": "t_below_avg_percent",
    "R_below_avg_percent": "r_below_avg_percent",
    "TLR": "tlr",
}


@dataclass(frozen=True)
class PublishedRow:
    """One printed row.

    Attributes
    ----------
    sequence : "S1" to "S6"; empty in table 2, which averages over sequences. method : as printed.
    figures : by the names of `PaperReport`, mm and rad; the RPE, whose interval is not stated, as `rpe_unstated_mm`.
    """

    sequence: str
    method: str
    figures: Mapping[str, float]

    def figure(self, name: str) -> float:
        """Return one figure; NaN where the paper has none."""
        return self.figures.get(name, math.nan)


def published_rows(table: PublishedTable) -> tuple[PublishedRow, ...]:
    """Return the rows of one of the paper's tables, in its order."""
    file = resources.files("scopemap.benchmark") / "published" / f"{table}.csv"
    rows = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
    return tuple(_row(row) for row in rows)


def _row(row: dict[str, str]) -> PublishedRow:
    method = next(row[column] for column in _METHOD_COLUMNS if column in row)
    figures = {name: float(row[column]) for column, name in _NAMES.items() if column in row}
    return PublishedRow(row.get("sequence", ""), method, figures)
