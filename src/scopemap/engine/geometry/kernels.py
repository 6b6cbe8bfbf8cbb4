"""How kernels are compiled: once for each machine, kept on disk, and without the GIL.

Numba compiles a function for the types that it is first called with, and also what lets Python, C and other kernels
call it. The code for Python takes a fifth of the time, so functions that only kernels call go without.

Kernels are kept in a folder named after the text of all of them. A compiled kernel holds those that it calls, but numba
looks at its own file alone: it would run what another file said before, and cannot read a cache that names a type which
is gone.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba
from numba import njit

IS_CACHED = os.environ.get("NUMBA_CACHE_DIR") != ""
"""Whether there is a folder for compiled kernels; `scopemap/__init__.py` looks for one. Without any numba
would refuse to start."""

_ENGINE = Path(__file__).parents[1]
_OF_KERNELS = (b"kernel", b"NamedTuple")  # words of files with kernels, and with types that kernels take


def cache_folder(engine: Path = _ENGINE) -> Path:
    """Return the folder for compiled kernels: in `NUMBA_CACHE_DIR`, else beside this file, else in the user's cache."""
    digest = hashlib.sha256()
    for file in sorted(engine.rglob("*.py")):
        text = file.read_bytes()
        if any(word in text for word in _OF_KERNELS):
            digest.update(text)
    beside = engine / "geometry" / "__pycache__"
    users = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "numba"
    may_write = os.access(beside if beside.exists() else beside.parent, os.W_OK)
    named = os.environ.get("NUMBA_CACHE_DIR")
    return Path(named or (beside if may_write else users)) / f"kernels-{digest.hexdigest()[:16]}"


def use_cache(folder: Path) -> None:
    """Have numba keep compiled kernels in a folder; those of earlier versions beside the code are removed."""
    # Elsewhere they may be those of another installation.
    if folder.parent.name == "__pycache__":
        for earlier in folder.parent.glob("kernels-*"):
            if earlier != folder:
                shutil.rmtree(earlier, ignore_errors=True)
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]


if IS_CACHED:
    use_cache(cache_folder())

kernel: Callable[..., Any] = partial(njit, cache=IS_CACHED, nogil=True, error_model="numpy", no_cfunc_wrapper=True)
"""Decorator of a kernel: division by 0 gives an infinity or NaN, as in numpy."""

inner_kernel: Callable[..., Any] = partial(kernel, no_cpython_wrapper=True)
"""Decorator of a kernel that only kernels may call; Python would crash. Its `py_func` is plain Python."""
