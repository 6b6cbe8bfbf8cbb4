"""scopemap: from a monocular endoscope video to camera poses and a tissue surface.

>>> from scopemap import Config, open_sequence, reconstruct
>>> result = reconstruct(open_sequence("video.mp4"), Config(), out="result")
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

# Networks share the cores with the tracker. Threads that wait for each other must sleep then: spinning, torch's were
# seen to take seventeen times as long for a flow while something else ran. Read when the network library is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    __version__: str

    from scopemap.config import Config
    from scopemap.errors import ScopemapError
    from scopemap.frame import Frame, Truth
    from scopemap.io.opening import open_sequence
    from scopemap.reconstruction import Reconstruction
    from scopemap.runner import reconstruct
    from scopemap.trajectory.formats.opening import read_trajectory
    from scopemap.trajectory.trajectory import Trajectory

__all__ = [
    "Config",
    "Frame",
    "Reconstruction",
    "ScopemapError",
    "Trajectory",
    "Truth",
    "__version__",
    "open_sequence",
    "read_trajectory",
    "reconstruct",
]

_HOMES = {
    "Config": "config",
    "Frame": "frame",
    "Reconstruction": "reconstruction",
    "ScopemapError": "errors",
    "Trajectory": "trajectory.trajectory",
    "Truth": "frame",
    "open_sequence": "io.opening",
    "read_trajectory": "trajectory.formats.opening",
    "reconstruct": "runner",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: `scopemap --help` must not wait for compilers and networks."""
    if name == "__version__":
        from importlib.metadata import version

        return version("scopemap")
    if name not in _HOMES:
        raise AttributeError(f"module 'scopemap' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f"scopemap.{_HOMES[name]}"), name)
