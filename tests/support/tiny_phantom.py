"""A phantom of few and small frames, with its true depth, for tests of the whole way."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from scopemap.engine.config import Config
from scopemap.engine.geometry.se3 import inverse
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import write_phantom

FRAMES = 9
SIZE = (160, 128)


def write_tiny(folder: Path, events: str = "", frames: int = FRAMES) -> Path:
    for name, content in _drawn(events, frames).items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
    return folder


@cache
def _drawn(events: str, frames: int) -> dict[str, bytes]:
    """The files of a phantom, drawn once in a process: a second and a half, and about a megabyte."""
    spec = PhantomSpec(frames=frames, width=SIZE[0], height=SIZE[1], seed=3, events=parse_events(events))
    with TemporaryDirectory() as name:
        folder = Path(name) / "phantom"
        write_phantom(spec, folder)
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def with_true_depth(folder: Path, preset: str = "default", **changes: object) -> Config:
    """Settings that take the depth of `folder`; `tracking__keyframe_every=2` is tracking.keyframe_every=2."""
    given = {key.replace("__", "."): value for key, value in changes.items()}
    return Config.load(preset, settings={"depth.backend": f"files:{folder}", **given})  # type: ignore[arg-type]


def true_poses(folder: Path, first: int = 0) -> np.ndarray:
    """Poses (N, 4, 4) relative to that of frame `first`."""
    poses = read_trajectory(folder).T_world_camera
    return inverse(poses[first]) @ poses


def only_images(folder: Path, target: Path) -> Path:
    """The colour images of a phantom and nothing that tells of truth or camera."""
    target.mkdir()
    for file in sorted(folder.glob("*_color.png")):
        (target / file.name.replace("_color", "")).write_bytes(file.read_bytes())
    return target


def write_black(folder: Path, frames: int = 4) -> Path:
    folder.mkdir()
    for index in range(frames):
        cv2.imwrite(str(folder / f"{index:04d}.png"), np.full((SIZE[1], SIZE[0], 3), 2, np.uint8))
    return folder
