"""scopemap: from a monocular endoscope video to camera poses and a tissue surface.

>>> from scopemap import Config, evaluate_poses, open_sequence, read_trajectory, reconstruct
>>> sequence = open_sequence("video.mp4", camera="calibration.yaml", frames="0:500")  # the camera where it is known
>>> result = reconstruct(sequence, Config.load("default"), out="result")  # or reconstruct("video.mp4")
>>> print(result, result.trajectory.path_length_mm)  # the verdict; poses camera to world, mm
>>> result.mesh.export("surface.stl")
>>> print(evaluate_poses(result.trajectory, read_trajectory("truth.txt"), "sim3")["ate_rmse_mm"])

A result is opened again by `Result("result")`. `coverage` says what was not seen of it, `measure` and `measure_lesion`
how large something is, `locate` where another video is. `Reconstructor` takes frames one at a time. The command line is
`scopemap`; docs/ has the rest. Phantoms with exact truth: `from scopemap_bench import PhantomSpec, write_phantom`.
"""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Networks share the cores with the tracker. Threads that wait for each other must sleep then: spinning, torch's were
# seen to take seventeen times as long for a flow while something else ran. Read when the network library is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# The stages have threads of their own. OpenBLAS's would compete with them (a run took 1.3 times the time), and
# sum in another order: results would depend on their number. It is read when numpy is loaded and holds for the whole
# process, so it is set here, for `reconstruct` to return what `scopemap run` does, and not where it is too late.
if "numpy" not in sys.modules:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Nothing may leave the machine: these libraries send telemetry unless that is set before they are imported.
_off = os.environ.get("ORT_DISABLE_TELEMETRY", "").lower() in ("1", "true", "yes", "on")
if "onnxruntime" in sys.modules and not _off:
    _advice = "import scopemap first, or set ORT_DISABLE_TELEMETRY=1"
    warnings.warn(f"onnxruntime was imported before scopemap and may send telemetry: {_advice}", stacklevel=2)
for _switch in ("ORT_DISABLE_TELEMETRY", "HF_HUB_DISABLE_TELEMETRY"):
    os.environ[_switch] = "1"
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"


def _may_write(folder: Path) -> bool:
    """Return whether a folder may be written, or made."""
    there = next((place for place in (folder, *folder.parents) if place.exists()), folder)
    return os.access(there, os.W_OK | os.X_OK)


def _private_folder() -> str:
    """Return a temporary folder that only this user can have written to; "" where there is none."""
    import tempfile

    for place in (tempfile.gettempdir(), "/dev/shm"):  # noqa: S108 - whose folder it is, is looked at below
        folder = Path(place) / f"scopemap-kernels-{os.getuid()}"
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            found = folder.lstat()
        except OSError:
            continue
        # Kernels are code: in a folder of someone else they would be theirs.
        if found.st_uid == os.getuid() and found.st_mode & 0o170077 == 0o040000:
            return str(folder)
    return ""


def _choose_kernel_cache() -> None:
    """Name a folder for compiled kernels where numba's own cannot be written: it would refuse to start.

    Without any it is named "", `kernels.py` caches nothing, and each process compiles its kernels.
    """
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    named = os.environ.get("NUMBA_CACHE_DIR")
    usual = [
        Path(__file__).parent / "engine" / "geometry" / "__pycache__",
        Path(caches) / "numba",
    ]
    if named:
        usual.append(Path(named))
    if os.name != "posix" or any(_may_write(folder) for folder in usual):
        if named == "":  # numba takes it for unset, `kernels.py` for no folder
            del os.environ["NUMBA_CACHE_DIR"]
        return
    try:
        chosen = _private_folder()
    except OSError:  # there is no folder for temporary files either
        chosen = ""
    os.environ["NUMBA_CACHE_DIR"] = chosen


_choose_kernel_cache()

if TYPE_CHECKING:
    __version__: str

    from scopemap.apps.coverage.coverage import coverage
    from scopemap.apps.locate.locate import locate
    from scopemap.apps.measure.lesion import measure_lesion
    from scopemap.apps.measure.measure import measure
    from scopemap.engine.config import Config
    from scopemap.engine.depth.custom import CustomDepth
    from scopemap.engine.errors import ScopemapError
    from scopemap.engine.frame import Frame
    from scopemap.evaluation.doubts import evaluate_poses
    from scopemap.input.opening import open_sequence
    from scopemap.input.trajectory.trajectory import Trajectory
    from scopemap.result.result import Result
    from scopemap.result.trajectories import read_trajectory
    from scopemap.runner.reconstruct import reconstruct
    from scopemap.runner.reconstructor import Reconstructor

__all__ = [
    "Config",
    "CustomDepth",
    "Frame",
    "Reconstructor",
    "Result",
    "ScopemapError",
    "Trajectory",
    "__version__",
    "coverage",
    "evaluate_poses",
    "locate",
    "measure",
    "measure_lesion",
    "open_sequence",
    "read_trajectory",
    "reconstruct",
]

_HOMES = {
    "Config": "engine.config",
    "Frame": "engine.frame",
    "CustomDepth": "engine.depth.custom",
    "Reconstructor": "runner.reconstructor",
    "Result": "result.result",
    "ScopemapError": "engine.errors",
    "Trajectory": "input.trajectory.trajectory",
    "coverage": "apps.coverage.coverage",
    "evaluate_poses": "evaluation.doubts",
    "locate": "apps.locate.locate",
    "measure": "apps.measure.measure",
    "measure_lesion": "apps.measure.lesion",
    "open_sequence": "input.opening",
    "read_trajectory": "result.trajectories",
    "reconstruct": "runner.reconstruct",
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


def __dir__() -> list[str]:
    """Return the public names: by them `dir`, `help` and completion show what is imported only when asked for."""
    return sorted(__all__)
