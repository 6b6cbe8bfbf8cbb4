"""Compiled kernels where neither the installation nor the user's cache can be written: containers, clusters."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from numba import config, njit

from scopemap.engine.geometry.kernels import cache_folder, use_cache
from scopemap.result.summary import compiling_words
from scopemap.runner.run import compiling_s

_READ_ONLY = """
import os
os.access = lambda *_: False
import scopemap
from numba.core import caching
from numba.core.dispatcher import Dispatcher
assert Dispatcher.enable_caching.__module__ == "numba.core.dispatcher"
for kind in (caching.InTreeCacheLocator, caching.UserWideCacheLocator):
    kind.from_function = classmethod(lambda *_: None)
import numpy as np
from scopemap.engine.geometry import warp
print(os.environ["NUMBA_CACHE_DIR"])
"""


def _import(before: str = "", **environment: str) -> str:
    """Import kernels where the usual folders are read-only, after the code `before`; return where they are cached."""
    known = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-c", before + _READ_ONLY]
    ran = subprocess.run(command, env=known | environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.strip()


@pytest.mark.skipif(os.name != "posix", reason="users and permissions are those of POSIX systems")
def test_kernels_are_cached_in_a_private_folder_where_the_usual_ones_are_read_only(tmp_path: Path) -> None:
    chosen = Path(_import(TMPDIR=str(tmp_path)))
    assert chosen.parent == tmp_path
    assert chosen.stat().st_mode & 0o777 == 0o700
    # Another user who may write there could put code into it.
    chosen.chmod(0o777)
    assert _import(TMPDIR=str(tmp_path)) != str(chosen)


@pytest.mark.skipif(os.name != "posix", reason="users and permissions are those of POSIX systems")
def test_without_any_folder_nothing_is_cached_and_all_works() -> None:
    code = "from pathlib import Path\nPath.mkdir = lambda *_, **__: (_ for _ in ()).throw(OSError(30, 'read-only'))\n"
    assert _import(code) == ""


def test_kernels_of_another_text_are_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    kernel, other = tmp_path / "geometry" / "warp.py", tmp_path / "frame.py"
    kernel.parent.mkdir()
    kernel.write_text("@kernel\ndef warp(): ...\n", encoding="utf-8")
    before = cache_folder(tmp_path)
    other.write_text("x = 1\n", encoding="utf-8")
    assert cache_folder(tmp_path) == before
    kernel.write_text("@kernel\ndef warp(a): ...\n", encoding="utf-8")
    after = cache_folder(tmp_path)
    assert (after.parent, after != before) == (before.parent, True)
    for folder in (before, after):
        folder.mkdir(parents=True)
    use_cache(after)
    assert [folder.name for folder in before.parent.iterdir()] == [after.name]
    assert after == Path(config.CACHE_DIR)


def test_the_summary_names_what_compiling_took(monkeypatch: pytest.MonkeyPatch) -> None:
    before_s, before = compiling_s(), time.perf_counter()
    assert njit(lambda x: x + 1)(1) == 2
    assert 0 < compiling_s() - before_s < time.perf_counter() - before
    assert compiling_words(0.0) == ""
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/cache")
    assert compiling_words(11.04) == " (without 11.0 s of compiling kernels, once)"
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    assert "in every run: set NUMBA_CACHE_DIR" in compiling_words(11.0)
