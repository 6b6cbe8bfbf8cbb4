"""Compiled kernels: ahead of a run, and where neither installation nor cache can be written: containers, clusters."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numba import config, njit

import scopemap
from scopemap.engine.geometry.kernels import KERNELS, Float32_2d, cache_folder, compile_kernel, kernel, use_cache
from scopemap.result.summary import compiling_words
from scopemap.runner import kernels, preparation
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


class Pair(NamedTuple):
    """What a kernel takes."""

    image: Float32_2d
    factor: float


@kernel
def _total(pair: Pair, count: int) -> float:
    return pair.image[0, 0] * pair.factor + count


KERNELS.remove(_total)


def test_kernels_are_compiled_for_the_types_of_their_parameters() -> None:
    compile_kernel(_total)
    assert _total(Pair(np.full((1, 1), 2, np.float32), 3.0), 4) == 10.0
    assert len(_total.signatures) == 1
    # Every second column: another type, for which it is compiled, too.
    assert _total(Pair(np.full((2, 4), 2, np.float32)[:, ::2], 3.0), 4) == 10.0
    assert len(_total.signatures) == 2


def test_kernels_are_compiled_where_no_mark_says_that_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark, done, said = tmp_path / "compiled", [], list[str]()
    monkeypatch.setattr(preparation, "compiled_mark", lambda: mark)
    monkeypatch.setattr(kernels, "compile_kernels", lambda: done.append(mark.touch()))
    for _ in range(2):
        preparation.compile_once(lambda _, call: call(), lambda doing, *_: said.append(doing))
    assert (len(done), said) == (1, ["compiling kernels, once"])


@pytest.mark.parametrize("executable", [sys.executable, "/opt/viewer/Viewer"])
def test_a_run_goes_on_where_no_process_can_be_started(
    executable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = list[str]()

    def refuse(command: list[str], **_: object) -> None:
        started.append(command[0])
        raise OSError("no process may be started")

    monkeypatch.setattr(kernels, "compiled_mark", lambda: tmp_path / "compiled")
    monkeypatch.setattr(sys, "executable", executable)
    monkeypatch.setattr(kernels.subprocess, "Popen", refuse)
    kernels.compile_kernels()
    assert started == ([executable] if "python" in executable else [])
    assert not (tmp_path / "compiled").exists()


_RUNS = """
import sys
from pathlib import Path
from scopemap.engine.config import Config
from scopemap.input.opening import open_sequence
from scopemap.engine.geometry.kernels import compiled_mark
from scopemap.runner.kernels import compile_kernels
from scopemap.runner.reconstruct import reconstruct
from scopemap.runner.run import compiling_s
compiling_s()
compile_kernels()
assert compiled_mark().exists()
for source in sys.argv[1:]:
    video, frames = source.rsplit("@", 1)
    reconstruct(open_sequence(Path(video), frames=slice(*map(int, frames.split(":")))), Config.load("default"))
    print(compiling_s())
"""


@pytest.mark.slow
@pytest.mark.real
def test_runs_compile_nothing_after_all_kernels_were(real_data: Path, tmp_path: Path) -> None:
    videos, demo = real_data / "endoscopy" / "video", Path(scopemap.__file__).parent / "apps" / "demo" / "clip"
    clips = demo / "colon.mp4", videos / "laparoscopy_rvim.mp4", videos / "colonoscopy_nflba_03.mp4"
    command = [sys.executable, "-c", _RUNS, *(f"{clip}@30:90" for clip in clips)]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split() == ["0.0"] * len(clips)
