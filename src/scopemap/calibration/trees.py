"""Trees of names, lists and words: what YAML, JSON and OpenCV's XML have in common, read within limits.

A tree is a dict by name, a list, or a leaf (text or number). OpenCV's own parser is not used: nested deeply, a file of
300 kB makes it take all memory there is. Anchors may stand, aliases may not, so that nothing grows.
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
        except json.JSONDecodeError:
            pass  # OpenCV wrote numbers such as 318. into its JSON, which YAML allows
        except RecursionError:
            raise ValueError("it is nested deeper than any calibration") from None
    return _yaml(text)


def number(tree: Tree, names: Iterable[str]) -> float | None:
    """Return the first of `names` that is there, None where none is; `ValueError` where it is no finite number."""
    return next((as_number(tree[name], name) for name in names if name in tree), None)


def numbers(tree: Tree, names: Iterable[str]) -> list[float] | None:
    """Return the first of `names` that holds several numbers: a list, rows of them, OpenCV's or ROS' matrix.

    None where none does. Raises `ValueError` for what is in it that is no finite number, and for a wrong count.
    """
    for name in names:
        node = tree.get(name)
        counts = [node.get(side) for side in ("rows", "cols")] if isinstance(node, dict) else [None]
        node = node.get("data") if isinstance(node, dict) else node
        node = node.split() if isinstance(node, str) else node
        if isinstance(node, list) and (len(node) > 1 or not isinstance(tree[name], str)):
            cells = [cell for row in node for cell in (row if isinstance(row, list) else [row])]
            found = [as_number(cell, name) for cell in cells]
            if None not in counts and math.prod(as_number(count, name) for count in counts) != len(found):
                raise ValueError(f"{name} holds {len(found)} numbers, but should be {counts[0]}x{counts[1]}")
            return found
    return None


def words(tree: Tree, names: Iterable[str]) -> str:
    """Return the texts that stand under `names`, in lower case."""
    return " ".join(tree[name].strip().strip("\"'").lower() for name in names if isinstance(tree.get(name), str))


def as_number(node: Any, name: str) -> float:
    """Return a leaf as a number; `ValueError` where it is none, NaN or infinity."""
    try:
        value = math.nan if isinstance(node, bool) else float(node)
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, found {str(node)[:_LONGEST_QUOTE]!r}")
    return value


def _yaml(text: str) -> Any:
    # OpenCV's first line, %YAML:1.0, is no YAML, and later versions than a parser's own make it stop.
    text = "\n".join("" if line.startswith("%YAML") else line for line in text.splitlines())
    open_nodes: list[list[Any]] = [[]]
    try:
        for count, event in enumerate(yaml.parse(text, Loader=_YAML_LOADER)):
            if count > _MOST_NODES or len(open_nodes) > _DEEPEST:
                raise ValueError("it is larger or nested deeper than any calibration")
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"it holds the alias *{event.anchor}, which no calibration needs: write it out")
            if isinstance(event, yaml.ScalarEvent):
                open_nodes[-1].append(event.value)
            elif isinstance(event, yaml.SequenceStartEvent | yaml.MappingStartEvent):
                open_nodes.append([])
            elif isinstance(event, yaml.SequenceEndEvent):
                open_nodes[-2].append(open_nodes.pop())
            elif isinstance(event, yaml.MappingEndEvent):
                flat = open_nodes.pop()
                open_nodes[-1].append(_mapping(zip(flat[::2], flat[1::2], strict=True)))
            elif isinstance(event, yaml.DocumentEndEvent):
                break  # a recorded topic repeats itself
    except yaml.YAMLError as error:
        raise ValueError(f"it is no YAML: {' '.join(str(error).split())[:200]}") from None
    return open_nodes[0][0] if open_nodes[0] else None


def _mapping(pairs: Iterable[tuple[Any, Any]]) -> Tree:
    tree: Tree = {}
    for name, node in pairs:
        if not isinstance(name, str):
            continue
        if name in tree:
            raise ValueError(f"{name[:_LONGEST_QUOTE]!r} stands in it twice: leave one out")
        tree[name] = node
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
