"""The numbers of the engine: one a name, each with a comment that says what it is and where it comes from."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

import scopemap.engine

ENGINE = Path(scopemap.engine.__file__).parent
# Settings have a source each instead (`advanced`), and presets are settings.
FILES = [file for file in sorted(ENGINE.rglob("*.py")) if file.parent.name != "config"]


def _has_numbers(value: ast.expr) -> bool:
    return any(isinstance(node, ast.Constant) and type(node.value) in (int, float) for node in ast.walk(value))


def _faults(text: str) -> Iterator[str]:
    """Yield the module's constants without a comment before them, at their end, or a docstring after them."""
    tokens = [t for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type == tokenize.COMMENT]
    whole, trailing = ({t.start[0] for t in tokens if bool(t.start[1]) == ends} for ends in (False, True))
    body = ast.parse(text).body
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None or not _has_numbers(node.value):
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        if isinstance(target, ast.Tuple):
            yield f"line {node.lineno}: several constants in one line, {ast.unparse(target)}"
        documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if not (documented or node.lineno - 1 in whole or trailing & {node.lineno, node.end_lineno}):
            yield f"line {node.lineno}: {ast.unparse(target)} has no comment"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(ENGINE).as_posix())
def test_each_number_has_a_comment(file: Path) -> None:
    assert not list(_faults(file.read_text(encoding="utf-8")))


@pytest.mark.parametrize(
    "text",
    ["_MOST = 3\n", "_ONE = 1  # by hand\n_TWO = 2\n", "x = '# no'\n_FEW: float = 0.5\n", "_A, _B = 1, 2  # by hand\n"],
)
def test_a_number_without_one_is_found(text: str) -> None:
    assert list(_faults(text))
