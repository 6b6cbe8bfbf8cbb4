"""`provenance.json` of a run's folder, and JSON of figures."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any


def read_provenance(run: Path) -> dict[str, Any]:
    """Return the `provenance.json` of a run's folder; {} where there is none that can be read."""
    try:
        found = json.loads((run / "provenance.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def without_nan(tree: Any) -> Any:
    """Return nested dictionaries and lists with None for numbers that are not finite, which JSON does not have."""
    if isinstance(tree, dict):
        return {key: without_nan(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [without_nan(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree
