"""Measures scopemap: plans, scoring, tables, baselines, phantoms, and research data sets.

>>> from scopemap_bench import PhantomSpec, write_phantom
>>> write_phantom(PhantomSpec("colon", frames=60), Path("phantom"))  # pictures, depth, camera, poses, surface
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scopemap_bench.phantom.spec import PhantomSpec
    from scopemap_bench.phantom.writer import write_phantom

__all__ = ["PhantomSpec", "write_phantom"]

_HOMES = {"PhantomSpec": "spec", "write_phantom": "writer"}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: commands must not wait for compilers."""
    if name not in _HOMES:
        raise AttributeError(f"module 'scopemap_bench' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f"scopemap_bench.phantom.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, for `dir` and `help`."""
    return sorted(__all__)
