"""Next steps in plain words: without options of the command and names of tables, which a reader does not type."""

from __future__ import annotations

import re

# A part of a sentence that names an option of the command: in brackets, after "; ", or after "or", "and", "with".
_IN_BRACKETS = re.compile(r" \([^()]*--[^()]*\)")
_CLAUSE = re.compile(r"(?:;|,? (?:or|and)|,? with) [^,.;]*--[^,.;]*")
_NOT_SAID = ("Run again with --", "See surfaces/", "See frames.csv")
"""How sentences begin that are of files and options alone."""


def plain_step(step: str) -> str:
    """Return a next step without options and tables; "" where it is of nothing else."""
    others = [one for one in re.split(r"(?<=\.) ", step) if not one.startswith(_NOT_SAID)]
    return _CLAUSE.sub("", _IN_BRACKETS.sub("", " ".join(others)))
