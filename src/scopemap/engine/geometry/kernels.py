"""How kernels are compiled: once for each machine, kept on disk, and without the GIL.

Numba compiles a function for the types that it is first called with, and also what lets Python, C and other kernels
call it. The code for Python takes a fifth of the time, so functions that only kernels call go without. A cached kernel
is compiled again when its own file has changed, not when this one has.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any

from numba import njit

IS_CACHED = os.environ.get("NUMBA_CACHE_DIR") != ""
"""Whether there is a folder for compiled kernels; `scopemap/__init__.py` looks for one. Without any numba
would refuse to start."""

kernel: Callable[..., Any] = partial(njit, cache=IS_CACHED, nogil=True, error_model="numpy", no_cfunc_wrapper=True)
"""Decorator of a kernel: division by 0 gives an infinity or NaN, as in numpy."""

inner_kernel: Callable[..., Any] = partial(kernel, no_cpython_wrapper=True)
"""Decorator of a kernel that only kernels may call; Python would crash. Its `py_func` is plain Python."""
