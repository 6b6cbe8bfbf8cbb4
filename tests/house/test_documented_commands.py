"""Commands and Python in the documents: all are understood, and those about the demonstration run on a small one."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import typer
import typer.main

from scopemap.apps.demo import demo as demonstration
from scopemap.cli.app import app
from scopemap_bench.scripts.demo_clip import SPEC, write_clip
from tests.support.documented import DOCUMENTS, blocks, commands
from tests.support.front_door import call

pytestmark = pytest.mark.slow

# ClickException, wherever typer has it.
REFUSED = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")
ABOUT_THE_DEMO = re.compile(r"scopemap-demo/")


def _parse(command: Any, arguments: list[str], parent: Any = None, name: str = "scopemap") -> None:
    """Parse arguments as the command line does, without running anything."""
    context = command.make_context(name, list(arguments), parent=parent)
    if hasattr(command, "resolve_command"):
        called, below, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        _parse(below, rest, context, called)


def test_what_is_not_understood_is_found() -> None:
    for wrong in (["run", "my.mp4", "--out", "result", "--fast"], ["run", "my.mp4"], ["models", "show"], ["walk"]):
        with pytest.raises(REFUSED):
            _parse(typer.main.get_command(app), wrong)


@pytest.mark.parametrize("document", [one for one in DOCUMENTS if commands(one)], ids=lambda path: path.name)
def test_commands_in_blocks_are_understood(document: Path) -> None:
    faults = []
    for arguments in commands(document):
        try:
            _parse(typer.main.get_command(app), arguments)
        except typer.Exit:  # --help
            continue
        except REFUSED as error:
            faults.append(f"scopemap {shlex.join(arguments)}: {error}")
    assert faults == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_options_of_commands_in_the_text_exist(document: Path) -> None:
    known_commands: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    text = re.sub(r"^```.*?^```", "", document.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for name, rest in re.findall(r"`scopemap ([a-z]+)([^`]*)`", text):
        assert name in known_commands, f"scopemap {name}"
        inner = getattr(known_commands[name], "commands", {}).values()
        known = {option for one in (known_commands[name], *inner) for param in one.params for option in param.opts}
        assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", rest)) <= known | {"--help"}, f"scopemap {name}{rest}"


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what `scopemap demo` makes in `scopemap-demo`, of 16 small frames."""
    folder = tmp_path_factory.mktemp("documents")
    demonstration.prepare_out(folder / "scopemap-demo", overwrite=False)
    clip = folder / "scopemap-demo/clip"
    write_clip(clip, replace(SPEC, frames=16, width=160, height=128))
    run = (clip / "colon.mp4", "--camera", clip / "camera.yaml", "--out", folder / "scopemap-demo/run", "--quiet")
    assert call("run", *run) == 0
    return folder


def test_commands_about_the_demonstration_run(small_demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(small_demo)
    called = [one for document in DOCUMENTS for one in commands(document) if ABOUT_THE_DEMO.search(" ".join(one))]
    assert {"inspect", "run", "evaluate", "export"} <= {arguments[0] for arguments in called}
    for arguments in called:
        assert call(*arguments) == 0, arguments


def test_python_about_the_demonstration_runs(small_demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(small_demo)
    written = [one for one in DOCUMENTS if one.name != "api.md"]  # that is generated, and has signatures
    shown = [block for one in written for block in blocks(one.read_text(encoding="utf-8"), "python")]
    for block in shown:
        compile(block, "document", "exec")
    about = [block for block in shown if ABOUT_THE_DEMO.search(block)]
    assert about
    for block in about:
        exec(compile(block, "document", "exec"), {})
