"""Settings of a stage from flat names, whatever group of the stage they are in."""

from __future__ import annotations

from typing import Any, TypeVar

from scopemap.config import Settings

Chosen = TypeVar("Chosen", bound=Settings)


def chosen(kind: type[Chosen], **values: Any) -> Chosen:
    """Return settings of `kind` with the values given, each in the nested group (`advanced`, `paper`) that has it."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        groups = [field for field, info in kind.model_fields.items() if _has(info.annotation, name)]
        (tree if name in kind.model_fields else tree.setdefault(groups[0], {}))[name] = value
    return kind.model_validate(tree)


def _has(annotation: Any, name: str) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Settings) and name in annotation.model_fields
