"""What other installed packages add: commands, measures, readers of data sets, trajectory formats, by entry points.

scopemap.commands             one Typer function or Typer app; left out, with a warning, where scopemap has its name
scopemap.measures             a tuple of measures of `scopemap evaluate` (`apps/evaluate/measures.py`)
scopemap.readers              a tuple of `Source` classes, which come before scopemap's own
scopemap.trajectory_formats   a tuple of `TrajectoryFormat`
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from typing import Any, Literal

Group = Literal["scopemap.commands", "scopemap.measures", "scopemap.readers", "scopemap.trajectory_formats"]


@cache
def plugins(group: Group) -> tuple[tuple[str, Any], ...]:
    """Return the name and the object of each entry point of a group, by name."""
    found = sorted(entry_points(group=group), key=lambda entry: entry.name)
    return tuple((entry.name, entry.load()) for entry in found)
