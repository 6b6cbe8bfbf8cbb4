"""The runs of each method on each sequence, over all seeds, as one row of a data frame."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from scopemap_bench.result import RunResult
from scopemap_bench.table import SPREAD, pd

MIN_COVERAGE = 0.9
"""Share of the frames that a method must track for its figures to compete: a method that loses the hard frames has
smaller errors."""

_LONGEST_ERROR = 80
# Columns of text, and where the runs keep their words: rows compete where the figures were measured alike.
_WORDS = {"alignment": "poses.align", "flow": "consistency.flow", "scaling": "depth.scaling", "depth": "facts.depth"}


def summarise(results: Iterable[RunResult]) -> pd.DataFrame:
    """Return one row per sequence and method, both in the order in which they first appear.

    Figures are medians over the seeds, by "group.name" ("timing.ms_per_frame"), with half their range under the same
    name and `SPREAD`. Columns of text are "sequence", "method", "runs", "frames tracked", "alignment", "depth", "flow",
    "scaling", "failure"; others "done", "competes", "tracked", "frames". A sequence whose name ends with its seed
    ("colon, seed 1"), as a plan's entries are called, is that sequence.
    """
    runs = _runs(results)
    order = {name: place for place, name in enumerate(dict.fromkeys(runs["sequence"]))}
    runs = runs.sort_values("sequence", key=lambda names: names.map(order), kind="stable", ignore_index=True)
    by = [runs["sequence"], runs["method"]]
    figures = runs.drop(columns=["sequence", "method", "done", "error", *_columns_of(runs, str | list)])
    figures = figures.map(lambda cell: cell if isinstance(cell, int | float) and math.isfinite(cell) else math.nan)
    figures = figures.astype(float)
    over_seeds = figures.groupby(by, sort=False)
    half_range = (0.5 * (over_seeds.max() - over_seeds.min())).where(over_seeds.count() > 1)
    rows = over_seeds.median().join(half_range.add_suffix(SPREAD))

    count, rows["done"] = over_seeds.size(), runs["done"].groupby(by, sort=False).sum()
    tracked = over_seeds["poses.tracked"]
    longest = figures["poses.frames"].groupby(runs["sequence"]).max()
    rows["tracked"] = tracked.sum()
    # A run that ended early has fewer frames than the sequence: the others are lost.
    rows["frames"] = tracked.count() * longest.reindex(rows.index.get_level_values("sequence")).to_numpy()
    rows["competes"] = (rows["done"] == count) & ~(rows["tracked"] / rows["frames"] < MIN_COVERAGE)
    rows["runs"] = [str(n) if done == n else f"{done} of {n}" for n, done in zip(count, rows["done"], strict=True)]
    rows["frames tracked"] = of_frames(rows)
    for name, column in _WORDS.items():
        words = runs.get(column, pd.Series("", index=runs.index))
        rows[name] = words.groupby(by, sort=False).agg(joined)
    rows["failure"] = runs["error"].groupby(by, sort=False).first().where(rows["done"] == 0, "")
    return rows.reset_index()


def of_frames(rows: pd.DataFrame) -> list[str]:
    """Return "270 of 276" for the columns "tracked" and "frames"; "" where no poses were scored."""
    pairs = zip(rows["tracked"], rows["frames"], strict=True)
    return [f"{tracked:.0f} of {frames:.0f}" if frames > 0 else "" for tracked, frames in pairs]


def joined(words: Iterable[Any]) -> str:
    """Return the different words, joined by "/"; cells that are no text or empty do not count."""
    return "/".join(dict.fromkeys(word for word in words if isinstance(word, str) and word))


def _runs(results: Iterable[RunResult]) -> pd.DataFrame:
    """Return one row per run, its figures under "group.name", stages also in milliseconds per frame."""
    runs = pd.json_normalize(
        [
            {
                "sequence": result.sequence.removesuffix(f", seed {result.seed}"),
                "method": result.method,
                "done": result.status == "done",
                "error": _reason(result),
                "facts": {"depth": result.facts.get("depth", "")},
                "poses": {"frames": math.nan, "tracked": math.nan},
                **result.figures,
                "timing": _with_stages(result),
            }
            for result in results
        ]
    )
    return runs.reindex(columns=[*runs, *{"poses.frames", "poses.tracked"} - set(runs)])


def _with_stages(result: RunResult) -> dict[str, float]:
    frames = result.figure("poses", "frames")
    stages = {
        f"ms_of_{key.removeprefix('seconds_')}": 1e3 * seconds / frames
        for key, seconds in result.timing.items()
        if key.startswith("seconds_") and key != "seconds_total" and seconds and frames > 0
    }
    return result.timing | stages


def _columns_of(runs: pd.DataFrame, kind: Any) -> list[str]:
    return [name for name in runs if runs[name].map(lambda cell: isinstance(cell, kind)).any()]


def _reason(result: RunResult) -> str:
    """Return why a run has no figures, cut to the width of a cell."""
    reason = " ".join(result.error.split())
    short = reason if len(reason) <= _LONGEST_ERROR else f"{reason[: _LONGEST_ERROR - 1]}…"
    if result.status == "missing":
        return short
    return f"failed: {short}" if short else "failed"
