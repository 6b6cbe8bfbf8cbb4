"""What other installed packages add: commands, readers of data sets, trajectory formats, by entry points.

scopemap.commands             one Typer function or Typer app; it replaces a command of the same name
scopemap.readers              a tuple of `Source` classes, which come before scopemap's own
scopemap.trajectory_formats   a tuple of `TrajectoryFormat`
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from typing import Any, Literal

Group = Literal["scopemap.commands", "scopemap.readers", "scopemap.trajectory_formats"]


@cache
def plugins(group: Group) -> tuple[tuple[str, Any], ...]:
    """Return the name and the object of each entry point of a group, by name."""
    found = sorted(entry_points(group=group), key=lambda entry: entry.name)
    return tuple((entry.name, entry.load()) for entry in found)
