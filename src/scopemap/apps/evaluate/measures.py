"""What other packages add to `scopemap evaluate`: measures, each with options of its own.

A measure is a function `measure(compared, option=default, ...)`; its further parameters are Typer options. It returns
groups of figures by name, or {} where it has nothing to measure. Packages name a tuple of measures as an entry point of
`scopemap.measures` (`input/plugins.py`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scopemap.evaluation.poses import MatchedTrajectories
    from scopemap.input.trajectory.trajectory import Trajectory

Measure = Callable[..., dict[str, Any]]


@dataclass(frozen=True)
class Compared:
    """What is compared.

    run : a run's folder or a trajectory file, of which `estimate` was read. truth : file or folder. reference : its
    poses, on the estimate's clock; None where it has none. matched : both, aligned; None without a reference.
    """

    run: Path
    truth: Path
    estimate: Trajectory
    reference: Trajectory | None = None
    matched: MatchedTrajectories | None = None


@dataclass(frozen=True)
class Asked:
    """A measure with the options of one call."""

    measure: Measure
    options: dict[str, Any]

    @property
    def by_name(self) -> bool:
        """Whether an option differs from its default: then a truth is needed."""
        defaults = _options_of(self.measure)
        return any(value != defaults[name].default for name, value in self.options.items())

    def __call__(self, compared: Compared) -> dict[str, Any]:
        """Return the measure's groups of figures."""
        return self.measure(compared, **self.options)


def with_measures(command: Callable[..., None], measures: Sequence[Measure]) -> Callable[..., None]:
    """Return a command with the options of measures after its own; it passes them on as `further`, a list of `Asked`.

    Raises `ValueError` where two options have one name.
    """
    own = [one for one in _parameters(command) if one.name != "further"]
    added = [one for measure in measures for one in _options_of(measure).values()]

    @wraps(command)
    def extended(**given: Any) -> None:
        further = [Asked(measure, {name: given.pop(name) for name in _options_of(measure)}) for measure in measures]
        command(**given, further=further)

    # Typer makes its options from this.
    extended.__signature__ = inspect.Signature([*own, *added])  # type: ignore[attr-defined]
    return extended


def _options_of(measure: Measure) -> dict[str, inspect.Parameter]:
    return {one.name: one.replace(kind=one.KEYWORD_ONLY) for one in _parameters(measure)[1:]}


def _parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    return list(inspect.signature(function, eval_str=True).parameters.values())
