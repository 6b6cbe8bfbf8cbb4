"""What can be seen of a run while it goes on: small files in the folder that it fills, each replaced at once.

DIR/.unfinished/view/  progress.json  picture.jpg (usable pixels, corners)  depth.jpg  map.npz (path, points)
                       coverage.png (of a live stream: what was not seen so far)
                       looked_at (touched by whoever looks)

Whoever looks reads them when it likes, so that nobody who looks can slow the run down. Where nobody looks,
progress.json alone is written. They go with the folder.
"""

from __future__ import annotations

import io
import json
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.result.result_folder import UNFINISHED, VIEW

_PROGRESS = "progress.json"
_PICTURE = "picture.jpg"
_DEPTH = "depth.jpg"
_MAP = "map.npz"
_COVERAGE = "coverage.png"
_LOOKED = "looked_at"


def view_folder(out: Path) -> Path:
    """Return where a run that writes to `out` keeps what can be seen of it."""
    return out / UNFINISHED / VIEW


@dataclass(frozen=True)
class RunProgress:
    """How far a run is.

    doing : what is done now, in words. done, total : frames; 0: not known. time_left : in words, or "". status : of the
    last frame, as `Track` has it, or "" before the first. reason : why it is lost. lost : frames lost so far. frame :
    number of the last frame, time_s : its time. submap : its number. adjusted : whether poses and points are those
    after the adjustment. points : of the surface that were seen so far, fewer are drawn; frames : that have a pose.
    written : counts what was drawn. facts : of a live stream, more in words by name.
    """

    doing: str = "preparing"
    done: int = 0
    total: int = 0
    time_left: str = ""
    status: str = ""
    reason: str = ""
    lost: int = 0
    frame: int = -1
    time_s: float = 0.0
    submap: int = 0
    adjusted: bool = False
    points: int = 0
    frames: int = 0
    written: int = 0
    facts: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SeenMap:
    """The current submap so far, in a world for the eye, mm.

    index : (N,) numbers of tracked frames. T_world_camera : (N, 4, 4) float32. keyframe : (N,) bool. points : (M, 3)
    float32, colours : (M, 3) uint8. earlier : (K, 3) float32, points of what was seen before tracking began anew, whose
    place beside the others is a guess. fov_rad, aspect : vertical field of view of the camera, width over height.
    """

    index: np.ndarray
    T_world_camera: np.ndarray
    keyframe: np.ndarray
    points: np.ndarray
    colours: np.ndarray
    earlier: np.ndarray
    fov_rad: float
    aspect: float


def look(folder: Path) -> None:
    """Have the run draw what can be seen: someone looks. Nothing happens where there is no run."""
    with suppress(OSError):
        (folder / _LOOKED).touch()


def last_look(folder: Path) -> int:
    """Return a number that is another one after each `look`; 0: no one has looked."""
    try:
        return (folder / _LOOKED).stat().st_mtime_ns
    except OSError:
        return 0


def write_progress(folder: Path, progress: RunProgress) -> None:
    """Write how far a run is; raises `OSError`."""
    _replace(folder / _PROGRESS, json.dumps(asdict(progress)).encode())


def write_pictures(folder: Path, picture: bytes, depth: bytes) -> None:
    """Write the last frame's picture and its depth in colours, JPEG; raises `OSError`."""
    _replace(folder / _PICTURE, picture)
    _replace(folder / _DEPTH, depth)


def write_coverage(folder: Path, drawn: bytes) -> None:
    """Write the map of what was not seen so far, PNG; raises `OSError`."""
    _replace(folder / _COVERAGE, drawn)


def write_map(folder: Path, seen: SeenMap) -> None:
    """Write what is shown of the surface; raises `OSError`."""
    held = io.BytesIO()
    np.savez(held, allow_pickle=False, **{name: np.asarray(value) for name, value in vars(seen).items()})
    _replace(folder / _MAP, held.getvalue())


def read_progress(folder: Path) -> RunProgress | None:
    """Return how far the run is; None where there is nothing to see, or no longer."""
    known = {one.name for one in fields(RunProgress)}
    try:
        values: dict[str, Any] = json.loads((folder / _PROGRESS).read_text(encoding="utf-8"))
        return RunProgress(**{name: value for name, value in values.items() if name in known})
    except (OSError, ValueError, TypeError, AttributeError):
        return None


def read_pictures(folder: Path) -> tuple[bytes, bytes] | None:
    """Return the last frame's picture and its depth in colours, JPEG; None where there are none."""
    try:
        return (folder / _PICTURE).read_bytes(), (folder / _DEPTH).read_bytes()
    except OSError:
        return None


def read_coverage(folder: Path) -> bytes | None:
    """Return the map of what was not seen so far, PNG; None where there is none."""
    try:
        return (folder / _COVERAGE).read_bytes()
    except OSError:
        return None


def read_map(folder: Path) -> SeenMap | None:
    """Return what is shown of the surface; None where there is nothing."""
    try:
        with np.load(folder / _MAP, allow_pickle=False) as held:
            arrays = {one.name: held[one.name] for one in fields(SeenMap)}
    except (OSError, ValueError, KeyError, EOFError):
        return None
    scalars = {name: float(arrays[name]) for name in ("fov_rad", "aspect")}
    return SeenMap(**(arrays | scalars))


def _replace(file: Path, content: bytes) -> None:
    part = file.with_name(f"{file.name}.part")
    part.write_bytes(content)
    part.replace(file)
