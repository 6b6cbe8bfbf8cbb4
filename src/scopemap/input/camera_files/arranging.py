"""Reading a camera's mapping by its program's row in the table (`programs.py`): as names of ours."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from scopemap.input.camera_files.conversions import Values
from scopemap.input.camera_files.lens_models import LENS_MODELS
from scopemap.input.camera_files.parsing import SEPARATORS, Fields, as_number, mappings_below, numbers_in, plain_name
from scopemap.input.camera_files.programs import PROGRAMS, Program

_OUR_NAMES = {"width": "image_width", "height": "image_height", "lens": "distortion_coefficients"}
# What conversions start from.
_USED_UP = ("f", "b1", "b2", "sensor", *(term for lens in LENS_MODELS for term in lens.terms))
_LONGEST_QUOTE = 40
_MOST_QUOTED = 9


@dataclass(frozen=True)
class Arranged:
    """A camera's mapping in our names, the one in which its size may be, too, and what its program's row says."""

    place: Fields
    root: Fields
    note: str = ""
    corner_px: float = 0.0


def arranged(tree: Fields) -> Arranged:
    """Return a tree by the row of its program, as it is where it is of none in the table.

    Raises `ValueError`, with their number, where it holds several cameras, and, with its name, for what is missing and
    for a lens that has no counterpart here.
    """
    for program in PROGRAMS:
        places = _places(program, tree)
        if not places:
            continue
        if len(places) > 1 and not program.takes_first:
            raise ValueError(f"it holds {len(places)} cameras ({program.name}): leave the one of these images in it")
        name, place = places[0]
        if not program.takes:
            return arranged(place)
        ours = _ours(program, place, tree)
        chosen = f", {name or 'the first'} of {len(places)} cameras" if len(places) > 1 else ""
        return Arranged(ours, tree if program.beside else ours, chosen + program.note, program.corner_px)
    return Arranged(tree, tree)


# ---- where a camera is


def _places(program: Program, tree: Fields) -> list[tuple[str, Fields]]:
    """Return the mappings that a program's row tells as cameras, with their names."""
    for path in program.at:
        found = [(name, node) for name, node in _nodes_at(tree, path) if isinstance(node, Fields)]
        if told := [(name, node) for name, node in found if all(_has(node, sign) for sign in program.signs)]:
            return told
    return []


def _has(place: Fields, sign: str) -> bool:
    """Return whether a mapping has a sign, as in `Program.signs`."""
    if sign.startswith("="):
        return any(name == sign[1:] for name, _ in place.called(sign[1:]))
    path, _, counts = sign.partition("#")
    found = [node for one in path.split("|") for _, node in _nodes_at(place, one)]
    if not counts:
        return bool(found)
    listed = numbers_in(found[0], path) if found and not isinstance(found[0], Fields) else None
    return listed is not None and str(len(listed)) in counts.split(",")


def _nodes_at(root: Any, path: str) -> list[tuple[str, Any]]:
    """Return the nodes that a path leads to, with the last names on it."""
    nodes = [("", root)]
    for part in filter(None, path.split("/")):
        nodes = [inner for _, node in nodes for inner in _step(node, part)]
    return nodes


def _step(node: Any, part: str) -> Iterable[tuple[str, Any]]:
    """Return what one part of a path leads to; what it finds by a pattern may not be there twice."""
    if isinstance(node, list):
        return [("", one) for i, one in enumerate(node) if part in ("*", str(i))]
    if not isinstance(node, Fields):
        return []
    if part == "**":
        return [("", node), *mappings_below(node)]
    if part == "*":
        return node.pairs
    if "\\" in part:
        return node.nodes(sorted({name for name, _ in node.pairs if re.fullmatch(part, name)}))
    return node.called(part)


# ---- what a camera's mapping says


def _ours(program: Program, place: Fields, tree: Fields) -> Fields:
    """Return the mapping in our names."""
    if program.adjusted is not None:
        place = _adjusted(place, *program.adjusted)
    for name, (expected, sentence) in program.only.items():
        if (found := _numbers(place, name)) and found[0] not in (expected, 0.0):  # 0: not set
            raise ValueError(f"{name} {sentence}")
    model, names = _lens(program, place)
    values: Values = {}
    kept: list[tuple[str, Any]] = []
    for targets, path in program.takes.items():
        if targets == "*":
            used = {plain_name(taken) for taken in program.takes.values()}
            inner = [node for _, node in _nodes_at(place, path) if isinstance(node, Fields)]
            kept = [pair for node in inner for pair in node.pairs if plain_name(pair[0]) not in used]
            continue
        values |= dict(_named(program, targets, path, _numbers(tree if path[0] == "/" else place, path)))
    for convert in program.convert:
        values = convert(values)
    if program.lenses and names != ["*"]:
        values["lens"] = _in_order(model, names, values)
    kept += [(_OUR_NAMES.get(name, name), value) for name, value in values.items() if name not in _USED_UP]
    return Fields([*kept, *([("model", model)] if model else [])])


def _adjusted(place: Fields, name: str, word: str) -> Fields:
    """Return the mapping of a name that has a word in it, else the first of this name."""
    found = [node for _, node in _nodes_at(place, name) if isinstance(node, Fields)]
    return next((node for node in found if any(leaf == word for _, leaf in node.pairs)), found[0])


def _numbers(start: Fields, paths: str) -> list[float] | None:
    """Return the numbers at the first of several paths that leads to any, None where none does."""
    for path in paths.split("|"):
        nodes = [node for _, node in _nodes_at(start, path)]
        if len(nodes) > 1:
            raise ValueError(f"{path!r} is there twice: leave one out")
        for node in nodes:
            text = node.translate(SEPARATORS) if isinstance(node, str) else node
            if (listed := numbers_in(text, path)) is None and not isinstance(node, Fields | list):
                return [as_number(node, path)]
            return listed
    return None


def _named(program: Program, targets: str, path: str, found: list[float] | None) -> Iterator[tuple[str, Any]]:
    """Yield numbers of a file by our names of them."""
    names, optional = targets.rstrip("?").split(), targets.endswith("?")
    spelled, rest = path.replace("|", " or "), names.pop()[:-3] if names[-1].endswith("...") else ""
    if not found and optional:
        return
    if found is None:
        raise ValueError(f"it is of {program.name}, but has no {spelled}")
    if len(found) < len(names) or (len(found) > len(names) and not rest):
        expected = f"expected {len(names)} numbers in {spelled}, {' '.join(names)}"
        raise ValueError(f"{expected}{' and more' if rest else ''}, found {len(found)}")
    for name, value in zip(names, found, strict=False):
        if name in ("0", "1") and not np.isclose(value, float(name)):
            raise ValueError(f"its {spelled} is not [{' '.join(names)}], but has {value:g} for {name}")
        if name not in ("0", "1", "_"):
            yield name, value
    if rest:
        yield rest, found[len(names) :]


def _lens(program: Program, place: Fields) -> tuple[str, list[str]]:
    """Return our word for the lens, and the names of its coefficients in the order of the file."""
    words = place.words(program.lens_words)
    if not program.lenses:
        return words, ["*"]
    if words not in program.lenses:
        spelled = f"the lens model {words[:_LONGEST_QUOTE]!r} of {program.name}"
        raise ValueError(f"{spelled} has no counterpart here; these have one: {program.lenses_read}")
    model, *names = program.lenses[words].split()
    return model, names


def _in_order(model: str, names: list[str], values: Values) -> list[float]:
    """Return coefficients in the order of our lens: those of a list by their place in it, others by their names."""
    named, listed = values, values.get("lens")
    if listed is not None:
        if len(listed) < len(names) or any(listed[len(names) :]):
            expected = f"{len(names)} coefficients ({' '.join(names) or 'none'})"
            raise ValueError(f"its lens, {model}, has {expected}, found {len(listed)}{_quoted(listed)}")
        named = dict(zip(names, listed, strict=False))
    lens = next(lens for lens in LENS_MODELS if lens.name == model)
    return lens.in_order({name: named.get(name, 0.0) for name in names})


def _quoted(numbers: list[float]) -> str:
    return f": {' '.join(f'{number:g}' for number in numbers[:_MOST_QUOTED])}" if numbers else ""
