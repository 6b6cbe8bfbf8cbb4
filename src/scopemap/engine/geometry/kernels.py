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
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_origin, get_type_hints

import numba
import numpy as np
from llvmlite.binding import get_host_cpu_name
from numba import njit
from numba.core import types
from numba.core.dispatcher import Dispatcher

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

Float32_2d = Annotated[np.ndarray, numba.float32[:, ::1]]
Float32_3d = Annotated[np.ndarray, numba.float32[:, :, ::1]]
Float32_4d = Annotated[np.ndarray, numba.float32[:, :, :, ::1]]
Float32_5d = Annotated[np.ndarray, numba.float32[:, :, :, :, ::1]]
Float64_1d = Annotated[np.ndarray, numba.float64[::1]]
Float64_2d = Annotated[np.ndarray, numba.float64[:, ::1]]
Float64_3d = Annotated[np.ndarray, numba.float64[:, :, ::1]]
Int32_2d = Annotated[np.ndarray, numba.int32[:, ::1]]
Int64_1d = Annotated[np.ndarray, numba.int64[::1]]
Int64_2d = Annotated[np.ndarray, numba.int64[:, ::1]]
UInt8_2d = Annotated[np.ndarray, numba.uint8[:, ::1]]
UInt8_3d = Annotated[np.ndarray, numba.uint8[:, :, ::1]]
Bool_1d = Annotated[np.ndarray, numba.boolean[::1]]
Bool_2d = Annotated[np.ndarray, numba.boolean[:, ::1]]
Bool_3d = Annotated[np.ndarray, numba.boolean[:, :, ::1]]

KERNELS: list[Dispatcher] = []
"""Those of the modules that are imported."""

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def kernel(function: Callable[..., Any] | None = None, *, parallel: bool = False, cache: bool = IS_CACHED) -> Any:
    """Decorator of a kernel: division by 0 gives an infinity or NaN, as in numpy.

    Its parameters are of the array types above, numbers, or `NamedTuple`s of these: `compile_kernel` compiles it for
    them. Called with others it is compiled for those, too.
    """
    if function is None:
        return partial(kernel, parallel=parallel, cache=cache)
    KERNELS.append(compiled := njit(**_OPTIONS, parallel=parallel, cache=cache)(function))
    return compiled


inner_kernel: Callable[..., Any] = partial(njit, **_OPTIONS, cache=IS_CACHED, no_cpython_wrapper=True)
"""Decorator of a kernel that only kernels may call; Python would crash. Its `py_func` is plain Python."""


def compiled_mark() -> Path:
    """Return the file that is there where all kernels were compiled by this Python and numba for this processor."""
    folder, python = Path(numba.config.CACHE_DIR), f"py{sys.version_info.major}{sys.version_info.minor}"  # type: ignore[attr-defined]
    return folder / f"compiled-{python}-{numba.__version__}-{get_host_cpu_name()}"


def compile_kernel(kernel: Dispatcher) -> None:
    """Compile a kernel for the types of its parameters, or read it from the cache."""
    kernel.compile(tuple(_numba_type(hint) for hint in _hints(kernel.py_func)))


def _hints(of: Any) -> list[Any]:
    """Return the types of a function's parameters, or of a tuple's fields."""
    return [hint for name, hint in get_type_hints(of, include_extras=True).items() if name != "return"]


def _numba_type(hint: Any) -> Any:
    if get_origin(hint) is Annotated:
        return hint.__metadata__[0]
    if hasattr(hint, "_fields"):
        return types.BaseTuple.from_types([_numba_type(field) for field in _hints(hint)], hint)
    return {float: numba.float64, int: numba.int64, bool: numba.boolean}[hint]
