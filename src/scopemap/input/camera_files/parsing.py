"""Calibration files as trees of names, lists and numbers: YAML, JSON, XML, INI, `name: value` lines, in bounded memory.

A tree is a `Fields`, a list, or a leaf (text or number). OpenCV's own parser is not used: nested deeply, a file of
300 kB makes it take all memory there is.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree

import yaml

from scopemap.engine.errors import CalibrationError

MOST_TERMS = 20
_MAX_BYTES = 1 << 20
_MAX_DEPTH = 24
_DEEPEST_MAPPING = 3
_MAX_EVENTS = 100_000
_MAX_NUMBERS = 1000
_LONGEST_QUOTE = 40
# ORB-SLAM writes `Camera.fx` or `Camera1.fx` for fx, SVO `cam_fx`.
_PASSED_OVER = re.compile(r"^camera1?\.|^cam_|[-_\s]+")
_WORD_BREAK = re.compile(r"[-_.\s]+")
_BARE_POINT = re.compile(r"(?<=\d)\.(?=[\s,\]}eE])")
SEPARATORS = str.maketrans(",;[]", "    ")
_SECTION = re.compile(r"\[\s*([A-Za-z_][^\[\],\"']*)\]")
_YAML_NODES = "[{*&!|>"
_COMMENT = re.compile(r"(#|//|%|^\s*;).*")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_WITH_COMMA = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?;?")
_LEAST_WITH_COMMA = 4  # numbers of a camera
_UNSET = ("false", "no", "off", "", "0", "0.0")


def calibration_bytes(file: Path) -> bytes:
    """Return the file's content; `CalibrationError` where it cannot be read or is larger than 1 MiB."""
    try:
        if not file.is_file():  # a pipe would be waited for
            raise OSError("there is no such file" if not file.exists() else "it is no file")
        if file.stat().st_size > _MAX_BYTES:
            raise OSError(f"it is larger than any calibration: more than {_MAX_BYTES} bytes")
        return file.read_bytes()
    except (OSError, ValueError) as error:
        raise CalibrationError(f"cannot read the calibration in {file}: {error}") from None


class Fields:
    """A mapping of a file; case, `-`, `_`, blanks, ORB-SLAM's `Camera.` and SVO's `cam_` do not matter in names."""

    def __init__(self, pairs: Iterable[tuple[Any, Any]]) -> None:
        self.pairs = [(name, node) for name, node in pairs if isinstance(name, str)]
        self._by_name: dict[str, list[tuple[str, Any]]] = {}
        for name, node in self.pairs:
            self._by_name.setdefault(plain_name(name), []).append((name, node))

    def nodes(self, names: Iterable[str]) -> Iterator[tuple[str, Any]]:
        """Yield spelling and node of each of `names`, same spelling first; `ValueError` where one is there twice."""
        for name in names:
            found = self.called(name)
            if len({spelling for spelling, _ in found}) < len(found):
                raise ValueError(f"{found[0][0][:_LONGEST_QUOTE]!r} is there twice: leave one out")
            yield from sorted(found, key=lambda pair: pair[0] != name)

    def called(self, name: str) -> list[tuple[str, Any]]:
        """Return spelling and node of all that have a name."""
        return self._by_name.get(plain_name(name), [])

    def number(self, names: Iterable[str]) -> float | None:
        """Return the first of `names` that is a leaf, None where none is; `ValueError` where it is no finite number."""
        leaves = (pair for pair in self.nodes(names) if not isinstance(pair[1], Fields | list))
        return next((as_number(node, name) for name, node in leaves), None)

    def numbers(self, names: Iterable[str], count: int | None = None) -> list[float] | None:
        """Return the first of `names` that holds several numbers, `count` where it is given; None where none does."""
        lists = (numbers_in(node, name) for name, node in self.nodes(names))
        return next((found for found in lists if found is not None and count in (None, len(found))), None)

    def words(self, names: Iterable[str]) -> str:
        """Return the texts under `names` in lower case, with blanks for hyphens, underscores and dots."""
        texts = (node for _, node in self.nodes(names) if isinstance(node, str))
        return " ".join(_WORD_BREAK.sub(" ", text.strip("\"' \t").lower()).strip() for text in texts).strip()

    def flag(self, names: Iterable[str]) -> bool:
        """Return whether one of `names` is set, to anything but false, no, off or 0."""
        leaves = (node for _, node in self.nodes(names) if not isinstance(node, Fields | list))
        return any(str(node).lower() not in _UNSET for node in leaves)

    def inner(self, names: Iterable[str]) -> list[Fields]:
        """Return the mappings under `names` that are no matrices."""
        return [node for _, node in self.nodes(names) if isinstance(node, Fields) and not any(node.nodes(("data",)))]


def mappings_below(root: Fields, passed_over: re.Pattern[str] | None = None) -> Iterator[tuple[str, Fields]]:
    """Yield the mappings in a mapping with their names, three deep, each once: YAML's aliases may repeat them.

    One whose name `passed_over` finds is left out, with what is in it.
    """
    places, seen = [root], {id(root)}
    for _ in range(_DEEPEST_MAPPING):
        inner = [(name, node) for place in places for name, node in place.pairs if isinstance(node, Fields)]
        places = []
        for name, node in inner:
            if id(node) not in seen and not (passed_over and passed_over.search(name)):
                seen.add(id(node))
                places.append(node)
                yield name, node


def plain_name(name: str) -> str:
    """Return a name without what does not matter in it."""
    return _PASSED_OVER.sub("", name.lower())


def as_number(node: Any, name: str) -> float:
    """Return a leaf as a number; `ValueError` where it is none, NaN or infinity."""
    try:
        value = math.nan if isinstance(node, bool) else float(node)
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if not math.isfinite(value):
        if isinstance(node, str) and _DECIMAL_COMMA.fullmatch(node.strip()):
            raise ValueError(f"{name} has a decimal comma ({node.strip()}): write a point")
        found = "a list" if isinstance(node, list | Fields) else repr(str(node)[:_LONGEST_QUOTE])
        raise ValueError(f"{name} must be a finite number, found {found}")
    return value


def numbers_in(node: Any, name: str) -> list[float] | None:
    """Return the numbers of a list, rows, a matrix or a text; None for all else, `ValueError` for infinite ones."""
    counts: list[float] = []
    if isinstance(node, Fields):
        counts = [count for side in ("rows", "cols") if (count := node.number((side,))) is not None]
        node = next((data for _, data in node.nodes(("data",))), None)
        node = node.split() if isinstance(node, str) else node
    if isinstance(node, str) and len(node.split()) > 1 and all(map(is_number, node.split())):
        node = node.split()
    if not isinstance(node, list):
        return None
    cells = chain.from_iterable(row if isinstance(row, list) else (row,) for row in node)
    found = [as_number(cell, name) for cell in islice(cells, _MAX_NUMBERS)]
    if len(counts) == 2 and math.prod(counts) != len(found):
        raise ValueError(f"{name} holds {len(found)} numbers, but should be {counts[0]:g}x{counts[1]:g}")
    return found


def is_number(leaf: Any) -> bool:
    """Return whether a leaf is a finite number."""
    try:
        return math.isfinite(as_number(leaf, ""))
    except ValueError:
        return False


def number_rows(text: str) -> list[list[float]] | None:
    """Return the numbers of each line that has some, comments after #, % and // aside; None for anything else.

    Raises `ValueError` for numbers with decimal commas.
    """
    plain = [_COMMENT.sub("", line) for line in text.splitlines()]
    words = " ".join(plain).split()
    commas = [word for word in words if "," in word]
    if commas and len(words) >= _LEAST_WITH_COMMA and all(map(_WITH_COMMA.fullmatch, words)):
        raise ValueError(f"it has decimal commas ({commas[0]}): write points")
    lines = (line.translate(SEPARATORS) for line in plain)
    try:
        return [row for line in lines if (row := [float(word) for word in line.split()])]
    except ValueError:
        return None


def named_values(text: str) -> Fields | None:
    """Return `name: value` or `name=value`, on lines of their own or separated by , or ;. None for anything else.

    Sections `[name]` are mappings, as in INI files, whose comments begin with ; or #.
    """
    top: list[tuple[str, Any]] = []
    pairs = top
    lines = [line for line in (_COMMENT.sub("", line).strip() for line in text.splitlines()) if line]
    yaml_nodes = "" if any(map(_SECTION.fullmatch, lines)) else _YAML_NODES
    for line in lines:
        if section := _SECTION.fullmatch(line):
            pairs = []
            top.append((section[1].strip(), pairs))
            continue
        parts = [_pair(part, yaml_nodes) for part in re.split("[,;]", line) if part.strip()]
        if not all(parts):  # a list, or a comment behind a value
            parts = [_pair(line.partition(";")[0], yaml_nodes)]
        if not all(parts):
            return None
        pairs += [part for part in parts if part]
    found = [(name, Fields(node) if isinstance(node, list) else node) for name, node in top]
    return Fields(found) if found else None


def _pair(part: str, yaml_nodes: str) -> tuple[str, str] | None:
    name, separator, value = (piece.strip() for piece in part.partition("=" if "=" in part else ":"))
    if not (separator and name and value) or value[0] in yaml_nodes:
        return None
    bare = value.strip("\"'")
    return name, bare if is_number(bare) else value.translate(SEPARATORS).strip()


def read_tree(text: str) -> Any:
    """Return the tree in JSON, XML, INI, lines or else YAML; `ValueError` for anything else, or nested too deeply."""
    start = text.lstrip()[:1]
    is_ini = bool(start == "[" and _SECTION.fullmatch(text.lstrip().splitlines()[0].strip()))
    try:
        if start == "<":
            root = xml_root(text)
            inner = _of_element(root)
            # What the whole is called tells some programs' files.
            return Fields([(f"<{root.tag}>", ""), *inner.pairs]) if isinstance(inner, Fields) else inner
        if is_ini or start not in ("{", "["):
            return named_values(text) or (_not_ini() if is_ini else _yaml(text))
        # OpenCV wrote numbers such as 318. into its JSON.
        return json.loads(_BARE_POINT.sub(".0", text), object_pairs_hook=Fields, parse_int=float)
    except json.JSONDecodeError as error:
        raise ValueError(f"it is no JSON that can be read: line {error.lineno}, column {error.colno}") from None
    except RecursionError:
        raise ValueError("it is nested deeper than any calibration") from None


def _not_ini() -> NoReturn:
    raise ValueError("it begins as INI does, with [section], but has lines that are not name = value")


class _YamlLoader(getattr(yaml, "CBaseLoader", yaml.BaseLoader)):  # type: ignore[misc]
    """Reads every leaf as text and every mapping as `Fields`; tags have no effect."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Fields:
        """Return the pairs, repeated ones included; an alias is the node that it stands for, not a copy."""
        return Fields([(self.construct_object(k, deep), self.construct_object(v, deep)) for k, v in node.value])


def _yaml(text: str) -> Any:
    """Return the first document."""
    # OpenCV's first line, %YAML:1.0, is no YAML, and versions later than a parser's own make it stop.
    text = "\n".join("" if line.startswith("%YAML") else line for line in text.splitlines())
    depth = 0
    try:
        for count, event in enumerate(yaml.parse(text, Loader=_YamlLoader)):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_DEPTH or count > _MAX_EVENTS:  # deep nesting overflows the stack of PyYAML's C code
                raise ValueError("it is larger or nested deeper than any calibration")
            if isinstance(event, yaml.DocumentEndEvent):
                break  # a recorded topic repeats itself
        return next(yaml.load_all(text, Loader=_YamlLoader), None)
    except yaml.YAMLError as error:
        if "nesting" in str(getattr(error, "problem", "")):  # newer parsers have a limit of their own
            raise ValueError("it is nested deeper than any calibration") from None
        mark = getattr(error, "problem_mark", None)
        where = f": line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ValueError(f"it is no YAML that can be read{where}") from None


def xml_root(text: str) -> ElementTree.Element:
    """Return the root of XML; `ValueError` for anything else, and for entities, which may grow without bound."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it holds a document type or entities, which no calibration needs")
    try:
        return ElementTree.fromstring(text.lstrip())  # noqa: S314 - entities are refused above
    except ElementTree.ParseError as error:
        line, column = error.position
        raise ValueError(f"it is no XML that can be read: line {line}, column {column + 1}") from None


def _of_element(element: ElementTree.Element) -> Any:
    """Return the children of an element by their tags, and its attributes, where no child has the name of one."""
    inner = [(child.tag, _of_element(child)) for child in element]
    if inner and all(tag == "_" for tag, _ in inner):
        return [node for _, node in inner]
    text = (element.text or "").strip()
    tags = {tag for tag, _ in inner}
    attributes = [] if text and not inner else [pair for pair in element.items() if pair[0] not in tags]
    return Fields([*inner, *attributes]) if inner or attributes else text
