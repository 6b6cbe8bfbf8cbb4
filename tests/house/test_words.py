"""Plain English: the length of sentences and the words in documents, notices, verdicts, --help and all other texts."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from string import Formatter
from typing import Any

import pytest
import typer.main

from scopemap.cli.app import app
from scopemap.engine.notices import KINDS, Notice
from scopemap.result.losses import ADVICE
from scopemap.result.wording import WORDINGS, text_of
from tests.support.places import ROOT

GENERATED = {ROOT / "docs" / name for name in ("api.md", "settings.md", "licences.md")}
PAGES = [ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "SECURITY.md")]
PAGES += sorted(set((ROOT / "docs").rglob("*.md")) - GENERATED)
SOURCES = [*(ROOT / "src").rglob("*.py"), *(ROOT / "bench/src").rglob("*.py")]
ASSETS = [path for path in (ROOT / "src/scopemap/report/assets").iterdir() if path.suffix in (".js", ".html")]
_LINES = (ROOT / "tests/house/unclear_words.txt").read_text(encoding="utf-8").splitlines()
UNCLEAR = [line.split("\t") for line in _LINES if not line.startswith("#")]
# Most texts match none of them: one search tells.
ANY_UNCLEAR = re.compile("|".join(f"(?:{pattern})" for pattern, _ in UNCLEAR), re.IGNORECASE)
TEXTS = {
    "path": "videos/my.mp4",
    "text": "the video my.mp4 holds 3 damaged pictures, which were left out",
    "reason": "depth failed: CUDA ran out of memory",
    "causes": "12 too dark, 3 contact with the wall",
    "folder": "result/masks",
    "where": "12 blocks of 3.2 mm",
    "periodic": ", 16 times a minute",
    "source": "assumed: horizontal field of view 70 deg",
}


def sentences(text: str) -> list[str]:
    """Return the sentences of a page, without code, tables and headings; code within a line is a word."""
    text = re.sub(r"^```.*?^```|<!--.*?-->", "\n\n", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"`[^`\n]*`", "x", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"^(?: {4}.*| *\|.*|#.*|<.*)$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^ *(?:[-*]|\d+\.) ", "\n\n", text, flags=re.MULTILINE)
    blocks = (" ".join(block.split()) for block in re.split(r"\n\s*\n", text))
    found = [one for block in blocks for one in re.split(r"(?<=[.!?:])[\"*)]*\s+(?=[A-Z\"*(x])", block)]
    return [one for one in found if re.search(r"\w", one)]


def length(sentence: str) -> int:
    return sum(bool(re.search(r"\w", word)) for word in sentence.split())


def unclear(text: str) -> list[str]:
    """Return what a text says that the list has a better word for, with that word."""
    text = " ".join(text.split())
    if ANY_UNCLEAR.search(text) is None:
        return []
    found = ((re.search(pattern, text, re.IGNORECASE), better) for pattern, better in UNCLEAR)
    return [f"{text[max(0, one.start() - 30) : one.end() + 10]!r}: {better}" for one, better in found if one]


def typical(code: str) -> Notice:
    """Return a notice with values of usual length."""
    values: dict[str, Any] = dict.fromkeys(KINDS[code].values, 0)
    for _, name, spec, _ in Formatter().parse(WORDINGS[code].text):
        if name:
            values[name] = TEXTS.get(name, 1234) if not spec else 0.125 if spec[-1] in "%f" else 123
    return Notice(code, values)


@pytest.fixture(scope="module")
def trees() -> dict[Path, ast.Module]:
    """The sources of the program."""
    return {source: ast.parse(source.read_text(encoding="utf-8")) for source in SOURCES}


def shown_texts(tree: ast.Module) -> Iterator[str]:
    """Yield the texts of a module that are no docstrings."""
    documents = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in documents)
    yield from (node.value for node in texts if isinstance(node.value, str))


def helps(command: Any, name: str = "scopemap") -> Iterator[tuple[str, str]]:
    """Yield the names of all commands and options, and their help."""
    yield name, command.help.split("\n\n")[0]
    for below in getattr(command, "commands", {}).values():
        yield from helps(below, f"{name} {below.name}")
    own = [one for one in command.params if one.name != "help" and not hasattr(command, "commands")]
    yield from ((f"{name} {one.opts[0]}", one.help or "") for one in own)


def test_long_sentences_and_unclear_words_are_found() -> None:
    text = f"# {'a head ' * 50}\n\nShort. W{'ord ' * 50}ends `c d`.\n\n- One.\n- Two: Three.\n\n    code {'x ' * 60}\n"
    assert [length(one) for one in sentences(text)] == [1, 52, 1, 1, 1]
    assert unclear("The views do not tell\nthe focal length, and the views do not tell it.")
    assert not unclear("The camera motion does not constrain the focal length.")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_sentences_are_short(page: Path) -> None:
    found = sentences(page.read_text(encoding="utf-8"))
    assert sum(map(length, found)) <= 30 * len(found)
    assert [one for one in found if length(one) > 45] == []


@pytest.mark.parametrize("page", [*PAGES, *sorted(GENERATED), *sorted(ASSETS)], ids=lambda page: page.name)
def test_pages_have_no_unclear_words(page: Path) -> None:
    assert unclear(page.read_text(encoding="utf-8")) == []


def test_texts_of_the_program_have_no_unclear_words(trees: dict[Path, ast.Module]) -> None:
    assert [
        f"{source.name}: {one}" for source, tree in trees.items() for text in shown_texts(tree) for one in unclear(text)
    ] == []


@pytest.mark.parametrize("code", KINDS)
def test_a_notice_is_one_short_sentence_and_a_next_step(code: str) -> None:
    text, next_step = text_of(typical(code)), WORDINGS[code].next_step
    assert len(text) <= 120
    assert not re.search(r"\. [A-Z]", text)
    assert len(next_step) <= 80
    assert next_step == "" or re.fullmatch(r"[A-Z].*\.", next_step)


def noted_texts(tree: ast.Module) -> Iterator[str]:
    """Yield the texts with values, of eight letters each, that a module warns of or notes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call | ast.AnnAssign | ast.AugAssign):
            place = ast.unparse(node.func if isinstance(node, ast.Call) else node.target)
            if re.search(r"_warn$|(?:notes|warnings)(?:\.append)?$", place):
                for text in (one for one in ast.walk(node) if isinstance(one, ast.JoinedStr)):
                    parts = (getattr(part, "value", "") for part in text.values)
                    yield "".join(part if isinstance(part, str) else "x" * 8 for part in parts)


def test_notes_on_an_input_are_short(trees: dict[Path, ast.Module]) -> None:
    found = [(source.name, text) for source, tree in trees.items() for text in noted_texts(tree)]
    assert found
    assert [(name, text) for name, text in found if len(text) > 120] == []


def test_advice_after_a_loss_is_a_short_sentence() -> None:
    assert {cause: text for cause, text in ADVICE.items() if not re.fullmatch(r"[A-Z].{,78}\.", text)} == {}


def test_help_is_one_line_for_each_command_and_option() -> None:
    found = dict(helps(typer.main.get_command(app)))
    commands = {name: text for name, text in found.items() if name.count(" ") == 1 and "--" not in name}
    assert {name: text for name, text in commands.items() if len(text) > 61} == {}
    assert {name: text for name, text in found.items() if not re.fullmatch(r"(?s)[A-Z0-9].{,118}\.", text)} == {}
