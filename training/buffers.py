"""What a camera sees of a scene before any light, and how many such frames are kept on disk.

A store is a folder of memory-mapped arrays, one row a frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from scopemap.engine.errors import InputError

NOISE_PERIODS = (24.0, 12.0, 6.0, 3.0, 1.5, 14.0, 7.0, 16.0)
_LOG_STEP = 7.0 / 65534.0
_META = 16
_ARRAYS = {
    "log_distance": (np.uint16, ()),
    "normal": (np.int8, (3,)),
    "noise": (np.int8, (8,)),
    "part": (np.uint8, ()),
    "lit": (np.uint8, (2,)),
}


@dataclass(frozen=True)
class Buffers:
    """One frame before any light: geometry, noise to paint with, and what of each lamp's light arrives.

    log_distance : (H, W) float32, ln of the distance along the ray in mm, about 2..400 mm; NaN where nothing was hit.
    normal : (H, W, 3) float32 unit vectors, camera axes (x right, y down, z ahead), towards the camera; else 0.
    noise : (H, W, 8) float32, -1..1, standard deviation 0.27: smooth noise in space at the hits, of the periods
        `NOISE_PERIODS` times `scale_mm`. 0-4 mottling, 5-6 vessels (where |noise| is about 0), 7 wetness. Channels 1-6
        fade to 0 where a pixel is too coarse to show them.
    part : (H, W) uint8, 0 main wall or floor, 1-6 other organs, polyps, flaps, 7 instrument; 0 where nothing.
    lit : (H, W, 2) float32, 0..1, share of each lamp's light that arrives (shadows; not distance nor angle).
    lamps_mm : (2, 3) float32, positions of the lamps in camera axes; of an absent second lamp NaN (its `lit` is 0).
    camera : (7,) float32, model (0 pinhole, 1 equidistant fisheye), fx, fy, cx, cy, width, height in pixels; the centre
        of the top left pixel is (0, 0).
    scale_mm : mm per scene unit.
    kind : of scene, see `scene.KINDS`.
    """

    log_distance: np.ndarray
    normal: np.ndarray
    noise: np.ndarray
    part: np.ndarray
    lit: np.ndarray
    lamps_mm: np.ndarray
    camera: np.ndarray
    scale_mm: float
    kind: int

    @cached_property
    def rays(self) -> np.ndarray:
        """Unit rays (H, W, 3) float32 in camera axes."""
        return camera_rays(self.camera).astype(np.float32)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.log_distance.shape
        return height, width


def camera_rays(camera: np.ndarray) -> np.ndarray:
    """Return the unit rays (H, W, 3) float64, camera axes, of a camera (7,) as `Buffers.camera` describes it."""
    model, fx, fy, cx, cy, width, height = (float(c) for c in camera)
    x = ((np.arange(int(width)) - cx) / fx)[None, :]
    y = ((np.arange(int(height)) - cy) / fy)[:, None]
    x, y = np.broadcast_arrays(x, y)
    if model == 0:
        rays = np.stack([x, y, np.ones_like(x)], -1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    angle = np.hypot(x, y)
    side = np.sinc(angle / np.pi)
    return np.stack([x * side, y * side, np.cos(angle)], -1)


def thinned(buffers: Buffers, stride: int) -> Buffers:
    """Return every `stride`-th pixel of a frame, with the camera that sees just these."""
    if stride == 1:
        return buffers
    images = {name: getattr(buffers, name)[::stride, ::stride] for name in _ARRAYS}
    height, width = images["part"].shape
    model, fx, fy, cx, cy, _, _ = buffers.camera
    camera = np.array([model, fx / stride, fy / stride, cx / stride, cy / stride, width, height], np.float32)
    return replace(buffers, camera=camera, **images)


def cropped(buffers: Buffers, top: int, left: int, size: tuple[int, int]) -> Buffers:
    """Return the part of a frame from a pixel on, of size (height, width), with the camera that sees just this."""
    part = np.s_[top : top + size[0], left : left + size[1]]
    camera = buffers.camera - np.array([0, 0, 0, left, top, 0, 0], np.float32)
    camera[5:] = size[1], size[0]
    return replace(buffers, camera=camera, **{name: getattr(buffers, name)[part] for name in _ARRAYS})


def encode(buffers: Buffers) -> dict[str, np.ndarray]:
    """Return the arrays of one row of a store, by name."""
    known = np.isfinite(buffers.log_distance)
    log = np.where(known, 1.0 + np.nan_to_num(buffers.log_distance) / _LOG_STEP, 0.0)
    meta = np.zeros(_META, np.float32)
    meta[0], meta[1] = buffers.kind, buffers.scale_mm
    meta[2:9], meta[9:15] = buffers.camera, buffers.lamps_mm.ravel()
    return {
        "log_distance": np.clip(np.rint(log), 0, 65535).astype(np.uint16),
        "normal": np.rint(127 * buffers.normal).astype(np.int8),
        "noise": np.rint(127 * np.clip(buffers.noise, -1, 1)).astype(np.int8),
        "part": buffers.part.astype(np.uint8),
        "lit": np.rint(255 * np.clip(buffers.lit, 0, 1)).astype(np.uint8),
        "meta": meta,
    }


def decode(row: dict[str, np.ndarray]) -> Buffers:
    """Return the frame of one row of a store; normals are made unit again."""
    code, meta = row["log_distance"], row["meta"]
    log = np.where(code == 0, np.nan, (code.astype(np.float32) - 1.0) * np.float32(_LOG_STEP)).astype(np.float32)
    normal = row["normal"].astype(np.float32)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return Buffers(
        log_distance=log,
        normal=normal / np.maximum(length, 1e-6),
        noise=row["noise"].astype(np.float32) / np.float32(127.0),
        part=np.array(row["part"]),
        lit=row["lit"].astype(np.float32) / np.float32(255.0),
        lamps_mm=np.array(meta[9:15]).reshape(2, 3),
        camera=np.array(meta[2:9]),
        scale_mm=float(meta[1]),
        kind=int(meta[0]),
    )


@dataclass(frozen=True)
class Store:
    """Frames on disk, opened as memory maps: `len(store)`, `store[i]`. Rows that are not yet rendered raise.

    arrays : by name, each with a row a frame.
    done : (N,) bool, which rows are rendered.
    """

    arrays: dict[str, np.ndarray]
    done: np.ndarray

    def __len__(self) -> int:
        """Return the number of frames, rendered or not."""
        return len(self.done)

    def __getitem__(self, index: int) -> Buffers:
        """Return frame `index`; raises IndexError outside, InputError where it is not rendered yet."""
        if not self.done[index]:
            raise InputError(f"reading frame {index} of a store: it is not rendered yet; run render_store again.")
        return decode({name: array[index] for name, array in self.arrays.items()})

    def put(self, index: int, buffers: Buffers) -> None:
        """Write frame `index` (of a store opened for writing) and mark it as rendered."""
        for name, value in encode(buffers).items():
            self.arrays[name][index] = value
        self.done[index] = True


def create_store(folder: Path, count: int, size: tuple[int, int]) -> Store:
    """Return a store for `count` frames of size (height, width), made new or, if it is there, opened for writing."""
    folder = Path(folder)
    if (folder / "done.npy").exists():
        store = open_store(folder, mode="r+")
        have = (len(store), *store.arrays["part"].shape[1:])
        if have != (count, *size):
            raise InputError(f"opening the store {folder}: it holds {have}, not {(count, *size)}; use another folder")
        return store
    folder.mkdir(parents=True, exist_ok=True)
    shapes = {name: (count, *size, *rest) for name, (_, rest) in _ARRAYS.items()} | {"meta": (count, _META)}
    kinds = {name: kind for name, (kind, _) in _ARRAYS.items()} | {"meta": np.float32}
    for name, shape in shapes.items():
        np.lib.format.open_memmap(folder / f"{name}.npy", mode="w+", dtype=kinds[name], shape=shape)
    # Last: a store is one only if all its arrays are there.
    np.save(folder / "done.npy", np.zeros(count, bool))
    return open_store(folder, mode="r+")


def open_store(folder: Path | str, *, mode: Literal["r", "r+"] = "r") -> Store:
    """Return the store in a folder; mode "r" reads, "r+" writes. Raises InputError where there is none."""
    folder = Path(folder)
    if not (folder / "done.npy").exists():
        raise InputError(f"opening the store {folder}: no done.npy there; render one with training.render.")
    names = (*_ARRAYS, "meta")
    arrays = {name: np.load(folder / f"{name}.npy", mmap_mode=mode) for name in names}
    return Store(arrays=arrays, done=np.load(folder / "done.npy", mmap_mode=mode))
