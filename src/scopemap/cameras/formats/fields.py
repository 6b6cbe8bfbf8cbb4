"""What stands in a tree under a name, whose case, underscores, hyphens and blanks do not matter."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from typing import Any

from scopemap.cameras.formats.trees import Repeated, Tree, as_number

_BETWEEN = re.compile(r"[-_\s]+")
_WORD_BETWEEN = re.compile(r"[-_.\s]+")
_FLAGS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False, "": False}


class Fields:
    """The names of one level of a tree; a name that stands there twice is an error only where it is asked for."""

    def __init__(self, tree: Tree) -> None:
        self._spelled: dict[str, list[tuple[str, Any]]] = {}
        for name, node in tree.items():
            self._spelled.setdefault(_normal(name), []).append((name, node))

    def items(self) -> Iterator[tuple[str, Any]]:
        """Yield each name as it is spelled, and what stands under it."""
        for spelled in self._spelled.values():
            yield from spelled

    def nodes(self, names: Iterable[str]) -> Iterator[tuple[str, Any]]:
        """Yield what stands under each of `names` with its spelling, that of `names` first; `ValueError` for twice."""
        for name in names:
            for spelling, node in sorted(self._spelled.get(_normal(name), ()), key=lambda pair: pair[0] != name):
                if isinstance(node, Repeated):
                    raise ValueError(f"{spelling[:40]!r} stands in it twice: leave one out")
                yield spelling, node

    def number(self, names: Iterable[str]) -> float | None:
        """Return the first of `names` that is a leaf, None where none is; `ValueError` where it is no finite number."""
        leaves = (pair for pair in self.nodes(names) if not isinstance(pair[1], dict | list))
        return next((as_number(node, name) for name, node in leaves), None)

    def numbers(self, names: Iterable[str], count: int | None = None) -> list[float] | None:
        """Return the first of `names` that holds several numbers, `count` where it is given; None where none does."""
        lists = (numbers_in(node, name) for name, node in self.nodes(names))
        return next((found for found in lists if found is not None and count in (None, len(found))), None)

    def words(self, names: Iterable[str]) -> str:
        """Return the texts that stand under `names`, in lower case, blanks for hyphens, underscores and dots."""
        texts = (node for _, node in self.nodes(names) if isinstance(node, str))
        return " ".join(_WORD_BETWEEN.sub(" ", text.strip().strip("\"'").lower()).strip() for text in texts).strip()

    def flag(self, names: Iterable[str]) -> bool:
        """Return whether one of `names` says yes: true, yes, on, or a number that is not zero."""
        said = (pair for pair in self.nodes(names) if not isinstance(pair[1], dict | list))
        return any(
            _FLAGS[word] if (word := str(node).lower()) in _FLAGS else as_number(node, name) for name, node in said
        )

    def inner(self, names: Iterable[str]) -> Iterator[Fields]:
        """Yield the mappings under `names` that are no matrices."""
        return (Fields(node) for _, node in self.nodes(names) if isinstance(node, dict) and "data" not in node)


def numbers_in(node: Any, name: str) -> list[float] | None:
    """Return the numbers of a list, rows of them, OpenCV's or ROS' matrix, or a text of several; None for all else.

    Raises `ValueError` for what is in a list that is no finite number, and for a matrix of another count.
    """
    counts: list[Any] = [None]
    if isinstance(node, dict):
        counts, node = [node.get(side) for side in ("rows", "cols")], node.get("data")
        if isinstance(node, Repeated):
            raise ValueError(f"'data' stands in {name} twice: leave one out")
        node = node.split() if isinstance(node, str) else node
    if isinstance(node, str) and len(node.split()) > 1 and all(map(is_number, node.split())):
        node = node.split()
    if not isinstance(node, list):
        return None
    cells = [cell for row in node for cell in (row if isinstance(row, list) else [row])]
    found = [as_number(cell, name) for cell in cells]
    if None not in counts and math.prod(as_number(count, name) for count in counts) != len(found):
        raise ValueError(f"{name} holds {len(found)} numbers, but should be {counts[0]}x{counts[1]}")
    return found


def is_number(word: Any) -> bool:
    """Whether a leaf is a finite number."""
    try:
        as_number(word, "")
    except ValueError:
        return False
    return True


def _normal(name: str) -> str:
    return _BETWEEN.sub("", name.lower())
