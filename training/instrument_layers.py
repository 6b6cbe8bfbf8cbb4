"""Instruments as a camera sees them, without tissue: layers that are put over many scenes, in one file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from training.buffers import camera_rays
from training.instrument_shapes import SHAFT, Parts, random_instruments
from training.marching import march_rays, surface
from training.scene import LAPAROSCOPY, Scene
from training.shapes import BOX, CENTRE, ROTATION, SIZE, shape_row
from training.viewpoint import random_camera

_FAR, _STEP = 4.0, 0.7
_LEAST_SHARE, _MOST_SHARE = 0.0008, 0.55
_TRIES = 30
_ARRAYS = ("pixel", "distance", "normal", "row", "along", "around")


@dataclass(frozen=True)
class Layer:
    """The instruments of one picture of H x W pixels, n of which show them; 1 = the tissue's median distance.

    pixel : (n,) int32, flat. distance : (n,) float32 along the ray. normal : (n, 3) float32, camera axes.
    row : (n,) uint8, from 1, which shape is seen there. along, around : (n,) float32, place on the shape: along its
        axis in its own radii, and around it in turns, -0.5..0.5.
    materials : (rows + 1, 2) int, (instrument, material) of each shape.
    camera : (7,) as in `Buffers.camera`.
    """

    pixel: np.ndarray
    distance: np.ndarray
    normal: np.ndarray
    row: np.ndarray
    along: np.ndarray
    around: np.ndarray
    materials: np.ndarray
    camera: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return int(self.camera[6]), int(self.camera[5])


def part_of(layer: Layer, top: int, left: int, size: tuple[int, int], stride: int) -> Layer:
    """Return every `stride`-th pixel of a layer from a pixel on, of size (height, width) in such pixels."""
    row, column = np.divmod(layer.pixel, layer.size[1])
    row, column = row - top, column - left
    kept = (row % stride == 0) & (column % stride == 0)
    row, column = row // stride, column // stride
    kept &= (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
    found = {name: getattr(layer, name)[kept] for name in _ARRAYS}
    found["pixel"] = (row * size[1] + column)[kept]
    camera = layer.camera.copy()
    camera[1:5] /= stride
    camera[5:] = size[1], size[0]
    return replace(layer, **found, camera=camera)


def render_layer(seed: int, index: int, width: int, height: int) -> Layer:
    """Return layer `index` of the set `seed`; the same arguments give the same layer."""
    rng = np.random.default_rng((seed, index, 5))
    layer = _rendered(rng, width, height)
    for _ in range(_TRIES):
        if _LEAST_SHARE < len(layer.pixel) / (width * height) < _MOST_SHARE:
            break
        layer = _rendered(rng, width, height)
    return layer


def _rendered(rng: np.random.Generator, width: int, height: int) -> Layer:
    camera = random_camera(rng, width, height)
    parts = random_instruments(camera, rng)
    rays, eye = camera_rays(camera), np.zeros(3)
    space = shape_row(BOX, eye, np.eye(3), (1e3, 1e3, 1e3, 0.0), solid=False)
    scene = Scene(LAPAROSCOPY, np.array([2.0]), 0, shapes=space[None], tools=np.array(parts.rows)).arrays()
    distance = march_rays(scene, eye, rays, _STEP, _FAR)
    normal, row = np.zeros_like(rays), np.zeros(distance.shape, np.uint8)
    surface(scene, eye, rays, distance, 1.0 / float(camera[1]), normal, row)
    pixel = np.flatnonzero((row > 0).ravel())
    row = row.ravel()[pixel]
    points = distance.ravel()[pixel, None] * rays.reshape(-1, 3)[pixel]
    along, around = _places(parts, row, points)
    return Layer(
        pixel.astype(np.int32),
        distance.ravel()[pixel].astype(np.float32),
        normal.reshape(-1, 3)[pixel].astype(np.float32),
        row,
        along,
        around,
        np.array([(0, SHAFT), *parts.materials]),
        camera,
    )


def _places(parts: Parts, row: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Place of points (n, 3) on the shapes that they are of: along the axis, in radii, and around it, in turns."""
    shapes = np.array(parts.rows)[row.astype(int) - 1]
    local = np.einsum(
        "nij,nj->ni", shapes[:, ROTATION : ROTATION + 9].reshape(-1, 3, 3), points - shapes[:, CENTRE : CENTRE + 3]
    )
    along = local[:, 0] / np.maximum(shapes[:, SIZE + 1], 1e-4)
    return along.astype(np.float32), (np.arctan2(local[:, 2], local[:, 1]) / (2 * np.pi)).astype(np.float32)


class LayerStore:
    """Layers: `len(store)`, `store[i]`."""

    def __init__(self, data: dict[str, np.ndarray]) -> None:
        self._data = data

    @classmethod
    def read(cls, file: Path) -> LayerStore:
        """Return the layers of a file."""
        with np.load(file) as data:
            return cls({name: data[name] for name in data.files})

    @classmethod
    def empty(cls) -> LayerStore:
        """Return no layers."""
        return cls({"camera": np.zeros((0, 7))})

    def __len__(self) -> int:
        """Return the number of layers."""
        return len(self._data["camera"])

    def __getitem__(self, index: int) -> Layer:
        """Return layer `index`."""
        data = self._data
        mine = slice(data["begin"][index], data["begin"][index + 1])
        rows = slice(data["first"][index], data["first"][index + 1])
        found = {name: data[name][mine] for name in _ARRAYS}
        found["normal"] = found["normal"].astype(np.float32) / 127
        for name in ("distance", "along", "around"):
            found[name] = found[name].astype(np.float32)
        return Layer(**found, materials=data["materials"][rows], camera=data["camera"][index])


def render_layers(
    file: Path, count: int, size: tuple[int, int], seed: int, progress: Callable[[int, int], None] | None = None
) -> LayerStore:
    """Return the layers 0..count-1 of the set `seed` of size (height, width), rendered where the file is missing."""
    if not file.is_file():
        layers = []
        for index in range(count):
            layers.append(render_layer(seed, index, size[1], size[0]))
            if progress is not None and ((index + 1) % 16 == 0 or index + 1 == count):
                progress(index + 1, count)
        _write(file, layers)
    return LayerStore.read(file)


def _write(file: Path, layers: list[Layer]) -> None:
    kinds = {"pixel": np.int32, "row": np.uint8, "normal": np.int8}
    data = {
        name: np.concatenate(
            [np.rint(127 * layer.normal) if name == "normal" else getattr(layer, name) for layer in layers]
        ).astype(kinds.get(name, np.float16))
        for name in _ARRAYS
    }
    data["begin"] = np.cumsum([0, *(len(layer.pixel) for layer in layers)])
    data["first"] = np.cumsum([0, *(len(layer.materials) for layer in layers)])
    data["materials"] = np.concatenate([layer.materials for layer in layers])
    data["camera"] = np.stack([layer.camera for layer in layers])
    file.parent.mkdir(parents=True, exist_ok=True)
    draft = file.with_suffix(".part.npz")
    np.savez(draft, **data)
    draft.replace(file)
