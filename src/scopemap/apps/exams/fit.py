"""Whether two registered examinations fit: the judgement that stands before all else that their comparison found."""

from __future__ import annotations

from enum import StrEnum

from scopemap.apps.exams.examination import HIDDEN

GOOD_RESIDUAL = 0.05
"""Median distance of matched points, of the median depth. A choice: half of the 10 % of phantom 72 and a laparoscopy,
where 32 to 60 % of the surfaces are far from the other; 2026-11."""

MOST_RESIDUAL = HIDDEN
"""As far apart two surfaces are not the same wall. Right: 10 % (phantom 72), 11 % (a laparoscopy, the better way);
wrong: 32 % (the same one, the other way); 2026-11."""

MOST_FAR = 0.5
"""Of each surface, far from the other: they have less in common than not. A choice without cases of its own."""


class ExamFit(StrEnum):
    """How well two examinations fit, in words."""

    GOOD = "fit"
    ROUGH = "fit roughly"
    NONE = "do not fit"


def fit_of(residual: float, only_first: float, only_second: float) -> ExamFit:
    """Return whether two examinations fit; the parameters are those of `ExamComparison`."""
    if residual > MOST_RESIDUAL:
        return ExamFit.NONE
    # Of the two: one examination may have seen much more than the other.
    is_far = min(only_first, only_second) > MOST_FAR
    return ExamFit.ROUGH if is_far or residual > GOOD_RESIDUAL else ExamFit.GOOD


def judgement(residual: float, only_first: float, only_second: float) -> str:
    """Return the sentence of `fit_of`, with the figures that decide."""
    fit = fit_of(residual, only_first, only_second)
    apart = f"They {fit}: matched points are {residual:.1%} of the depth apart (median)"
    if fit is ExamFit.NONE:
        return f"{apart}; do not rely on what follows."
    if fit is ExamFit.GOOD:
        return f"{apart}."
    if residual > GOOD_RESIDUAL:
        return f"{apart}. Check each change in the pictures of both."
    far = min(only_first, only_second)
    return f"{apart}, but {far:.0%} or more of each surface is far from the other. Check that both show the same place."
