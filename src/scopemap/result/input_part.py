"""Which part of its input a run used, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_ORDINALS = {1: "st", 2: "nd", 3: "rd"}


def part_of_input(provenance: Mapping[str, Any]) -> str:
    """Return which frames were chosen and of how many, and what was left out of them; "" where all were used.

    Frames that repeat the one before are no loss: they are not named.
    """
    parts = [_selected(provenance.get("selection") or {})]
    skipped = provenance.get("skipped") or {}
    parts += [f"thinned by {skipped['thinned']} to a lower rate"] if skipped.get("thinned") else []
    parts += [f"without {skipped['size']} of another size"] if skipped.get("size") else []
    return ", ".join(filter(None, parts))


def _selected(selection: Mapping[str, Any]) -> str:
    text, count = str(selection.get("frames", "")), selection.get("of")
    if not text:
        return ""
    start, stop, step = (int(part) if part else None for part in [*text.split(":"), ""][:3])
    every = "" if step in (None, 1) else f", every {step}{_ordinal(int(step or 1))}"
    chosen = range(0) if count is None else range(int(count))[start:stop:step]
    if not chosen:
        return f"frames {text}"
    return "" if len(chosen) == count else f"frames {chosen[0]} to {chosen[-1]} of {count}{every}"


def _ordinal(number: int) -> str:
    return "th" if number // 10 % 10 == 1 else _ORDINALS.get(number % 10, "th")
