"""Trees of names, lists and words: what YAML, JSON and OpenCV's XML have in common, read within limits.

A tree is a dict by name, a list, or a leaf (text or number). OpenCV's own parser is not used: nested deeply, a file of
300 kB makes it take all memory there is. Aliases may stand for flat lists of numbers
alone, so that nothing grows.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias, cast
from xml.etree import ElementTree

import yaml

Tree: TypeAlias = dict[str, Any]

_DEEPEST = 24
_MOST_NODES = 100_000
_CHUNK = 1 << 14
_LONGEST_QUOTE = 40
# libyaml where PyYAML was built with it: ten times faster.
_YAML_LOADER = getattr(yaml, "CLoader", yaml.Loader)


def read_tree(text: str) -> Any:
    """Return the tree in JSON, XML or else YAML; `ValueError` for what is none, or larger or deeper than any camera."""
    start = text.lstrip()[:1]
    if not start:
        raise ValueError("it is empty")
    if start == "<":
        return _xml(text)
    if start in ("{", "["):
        try:
            return json.loads(text, object_pairs_hook=_mapping, parse_int=float)
        except json.JSONDecodeError as error:  # OpenCV wrote numbers such as 318. into its JSON, which YAML allows
            return _yaml(text, f"it is no JSON: {error}")
        except RecursionError:
            raise ValueError("it is nested deeper than any calibration") from None
    return _yaml(text)


class Repeated:
    """What stands in place of a name's content where the name comes again: an error for whoever asks for it."""


def as_number(node: Any, name: str) -> float:
    """Return a leaf as a number; `ValueError` where it is none, NaN or infinity."""
    if isinstance(node, Repeated):
        raise ValueError(f"{name[:_LONGEST_QUOTE]!r} stands in it twice: leave one out")
    try:
        value = math.nan if isinstance(node, bool) else float(node)
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, found {str(node)[:_LONGEST_QUOTE]!r}")
    return value


def _yaml(text: str, fault: str = "") -> Any:
    """Return the tree in YAML; `fault` is the error where it is none, "": the parser's own."""
    # OpenCV's first line, %YAML:1.0, is no YAML, and later versions than a parser's own make it stop.
    text = "\n".join("" if line.startswith("%YAML") else line for line in text.splitlines())
    open_nodes: list[list[Any]] = [[]]
    open_anchors: list[str | None] = []
    anchored: dict[str | None, Any] = {}
    repeated = 0
    try:
        for count, event in enumerate(yaml.parse(text, Loader=_YAML_LOADER)):
            if count + repeated > _MOST_NODES or len(open_nodes) > _DEEPEST:
                raise ValueError("it is larger or nested deeper than any calibration")
            if isinstance(event, yaml.AliasEvent):
                node = anchored.get(event.anchor, ())
                if not _is_flat(node):
                    raise ValueError(f"it holds the alias *{event.anchor} of no list of numbers: write it out")
                repeated += len(node)
                open_nodes[-1].append(node)
            elif isinstance(event, yaml.ScalarEvent):
                open_nodes[-1].append(event.value)
            elif isinstance(event, yaml.SequenceStartEvent | yaml.MappingStartEvent):
                open_nodes.append([])
                open_anchors.append(event.anchor)
            elif isinstance(event, yaml.SequenceEndEvent):
                open_nodes[-2].append(open_nodes.pop())
                anchored[open_anchors.pop()] = open_nodes[-1][-1]
            elif isinstance(event, yaml.MappingEndEvent):
                flat = open_nodes.pop()
                anchored.pop(open_anchors.pop(), None)
                open_nodes[-1].append(_mapping(zip(flat[::2], flat[1::2], strict=True)))
            elif isinstance(event, yaml.DocumentEndEvent):
                break  # a recorded topic repeats itself
    except yaml.YAMLError as error:
        raise ValueError(fault or f"it is no YAML: {' '.join(str(error).split())[:200]}") from None
    return open_nodes[0][0] if open_nodes[0] else None


def _is_flat(node: Any) -> bool:
    """Whether a node is a list of numbers alone, which an alias may repeat: it grows by its own length only."""
    if not isinstance(node, list):
        return False
    try:
        return all(isinstance(cell, str) and math.isfinite(float(cell)) for cell in node)
    except ValueError:
        return False


def _mapping(pairs: Iterable[tuple[Any, Any]]) -> Tree:
    tree: Tree = {}
    for name, node in pairs:
        if not isinstance(name, str):
            continue
        tree[name] = Repeated() if name in tree else node
    return tree


def xml_root(text: str) -> ElementTree.Element:
    """Return the root of XML; `ValueError` for what is none, defines entities, or is larger or deeper than any camera.

    Entities of its own are what bombs are made of; no calibration has them.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it holds a document type or entities, which no calibration needs")
    parser: ElementTree.XMLPullParser = ElementTree.XMLPullParser(("start", "end"))
    root: ElementTree.Element | None = None
    depth = count = 0
    try:
        for start in range(0, len(text), _CHUNK):
            parser.feed(text[start : start + _CHUNK])
            for event, element in cast(Iterator[tuple[str, ElementTree.Element]], parser.read_events()):
                root = element if root is None else root
                depth += 1 if event == "start" else -1
                count += 1
                if depth > _DEEPEST or count > _MOST_NODES:
                    raise ValueError("it is larger or nested deeper than any calibration")
        parser.close()
    except ElementTree.ParseError as error:
        raise ValueError(f"it is no XML: {error}") from None
    if root is None:
        raise ValueError("it is no XML: it has no element")
    return root


def _xml(text: str) -> Any:
    return _of_element(xml_root(text.lstrip()))


def _of_element(element: ElementTree.Element) -> Any:
    inner = list(element)
    if not inner:
        return (element.text or "").strip()
    if all(child.tag == "_" for child in inner):
        return [_of_element(child) for child in inner]
    return _mapping((child.tag, _of_element(child)) for child in inner)
