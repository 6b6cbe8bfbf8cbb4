"""What the comparison of two examinations says, in the window, in the terminal and on its page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from scopemap.apps.exams.fit import ExamFit, judgement

if TYPE_CHECKING:
    from scopemap.apps.exams.change import Change
    from scopemap.apps.exams.compare_exams import ExamComparison

_UNNAMED = "the first", "the second"


def names_of(first: str, second: str) -> tuple[str, str]:
    """Return what texts call two results: their names, where these tell them apart."""
    return (first, second) if first != second else _UNNAMED


def seen_words(change: Change, names: tuple[str, str]) -> str:
    """Return whose views show a change: "both", or the name of one examination."""
    return {"both": "both", "first": names[0], "second": names[1]}[change.seen_in]


def summary(found: ExamComparison, scale: str, names: tuple[str, str]) -> Iterator[str]:
    """Yield what was found, a sentence a line: first whether the two fit.

    scale : what the first one's sizes rest on. names : of both, as by `names_of`.
    """
    by, (first, second) = found.registration, names
    yield judgement(by.residual, found.only_first, found.only_second)
    yield f"Found in {first}: {by.located_second:.0%} of the keyframes of {second}."
    yield f"Found in {second}: {by.located_first:.0%} of the keyframes of {first}."
    yield f"Points were matched by the keyframes of {second if by.by_second else first}."
    yield f"Far from the other surface: {found.only_first:.0%} of {first}, {found.only_second:.0%} of {second}."
    count = len(found.changes)
    if found.fit is ExamFit.NONE:
        yield "Changed places are not judged."
    else:
        yield f"{count or 'No'} place{'s' * (count != 1)} changed by more than the surfaces differ elsewhere."
    if count:
        sides = [sum(change.seen_in == side for change in found.changes) for side in ("both", "first", "second")]
        yield f"In the views of both: {sides[0]}; in those of {first} alone: {sides[1]}, of {second} alone: {sides[2]}."
    yield f"Sizes are those of {first}: {scale}."
