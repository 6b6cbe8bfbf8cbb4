"""The command `scopemap` by its own door: its exit code, and the one sentence by which it refuses."""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import typer.main

from scopemap.cli.app import main

# Typer puts all commands and options together at every call, which takes longer than most of the commands tested.
PUT_TOGETHER_ONCE = cache(typer.main.get_command)


def call(*arguments: object) -> int:
    """Return the exit code of `scopemap ARGUMENTS`."""
    given = patch.object(sys, "argv", ["scopemap", *map(str, arguments)])
    with given, patch.object(typer.main, "get_command", PUT_TOGETHER_ONCE), pytest.raises(SystemExit) as caught:
        main()
    return caught.value.code if isinstance(caught.value.code, int) else int(caught.value.code is not None)


def exported(run: Path, to: str, out: Path, *more: object) -> Path:
    """Return `out`, to which `scopemap export` has written."""
    assert call("export", run, "--to", to, "--out", out, "--quiet", *more) == 0
    return out


def refused(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the only line that `scopemap ARGUMENTS` says, with exit code 1."""
    code, said = call(*arguments), capfd.readouterr()
    assert (code, said.err.count("\n"), said.out) == (1, 1, ""), (code, said)
    assert said.err.startswith("scopemap: ")
    return said.err


def said(provenance: dict[str, Any]) -> list[str]:
    """What a run says about itself, in words."""
    return [notice["text"] for notice in provenance["notices"]]


def warned(provenance: dict[str, Any]) -> list[str]:
    """What a run says about itself beyond its assumptions, in words."""
    return [notice["text"] for notice in provenance["notices"] if notice["level"] != "info"]
