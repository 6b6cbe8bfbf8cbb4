"""What other installed packages add: commands, readers of data sets, trajectory formats, by entry points.

scopemap.commands             one Typer function or Typer app; it replaces a command of the same name
scopemap.readers              a tuple of `Source` classes, which come before scopemap's own
scopemap.trajectory_formats   a tuple of `TrajectoryFormat`

What a result can be asked is found by name in the same way, though it is scopemap's own: a result imports no action.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Literal

Group = Literal["scopemap.commands", "scopemap.readers", "scopemap.trajectory_formats"]
_ACTIONS = {
    "coverage": "scopemap.actions.coverage.coverage",
    "measure": "scopemap.actions.measure",
    "measure_lesion": "scopemap.actions.lesion",
    "locate": "scopemap.actions.locate",
}


@cache
def plugins(group: Group) -> tuple[tuple[str, Any], ...]:
    """Return the name and the object of each entry point of a group, by name."""
    found = sorted(entry_points(group=group), key=lambda entry: entry.name)
    return tuple((entry.name, entry.load()) for entry in found)


def action(name: str) -> Callable[..., Any]:
    """Return what answers a question about a result's folder, its first argument."""
    found: Callable[..., Any] = getattr(import_module(_ACTIONS[name]), name)
    return found
