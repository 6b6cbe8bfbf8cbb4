"""Voxel blocks of a TSDF by their coordinate: made where a frame needs them, halved, and read as dense fields."""

from __future__ import annotations

import numpy as np

from scopemap.engine.fusion.tsdf import BLOCK, Voxels, pack, unpack

_FIRST_CAPACITY = 256  # by hand: blocks; doubles when it is full


class VoxelBlocks:
    """Blocks of 8^3 voxels by the key of their coordinate; slot 0 of `voxels` is always an empty block."""

    def __init__(self) -> None:
        self.voxels = _zeros(_FIRST_CAPACITY)
        # A dict finds the few thousand blocks of a frame in under a millisecond; a compiled hash table gains nothing.
        self._slots = dict[int, int]()

    def __len__(self) -> int:
        return len(self._slots)

    def keys(self) -> np.ndarray:
        """Return the (N,) int64 keys of all blocks, in the order in which they were made."""
        return np.fromiter(self._slots, np.int64, len(self._slots))

    def slots(self, keys: np.ndarray) -> np.ndarray:
        """Return the (N,) int64 slots of `keys` (N,) int64; blocks that are not there yet are made, empty."""
        index = self._slots
        slots = np.array([index.setdefault(key, len(index) + 1) for key in keys.tolist()], dtype=np.int64)
        capacity = len(self.voxels.weight)
        if len(index) >= capacity:
            larger = max(capacity * 5 // 4, len(index) + 1)
            for array in self.voxels:
                # In place, so that a large volume is not in memory twice; the new blocks are zero.
                array.resize((larger, *array.shape[1:]), refcheck=False)
        return slots

    def halve(self) -> None:
        """Keep every second voxel along each axis: the field as voxels of twice the size hold it."""
        coordinates = unpack(self.keys())
        # In the order in which they were made, as ever.
        keys = np.asarray(pack.py_func(*(coordinates >> 1).T))
        old, (self.voxels, self._slots) = self.voxels, (_zeros(_FIRST_CAPACITY), {})
        slots = self.slots(keys)
        for octant in np.ndindex(2, 2, 2):
            some = np.flatnonzero((coordinates & 1 == octant).all(1))
            there = tuple(slice(BLOCK // 2 * half, BLOCK // 2 * (half + 1)) for half in octant)
            for array, finer in zip(self.voxels, old, strict=True):
                array[slots[some], there[0], there[1], there[2]] = finer[some + 1, ::2, ::2, ::2]

    def find(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the (N,) int64 slots of the blocks at (N, 3) int64 block coordinates; 0 where there is no block."""
        keys = np.asarray(pack.py_func(*coordinates.T))
        return np.array([self._slots.get(key, 0) for key in keys.tolist()], dtype=np.int64)

    def box(self, first: np.ndarray, shape: np.ndarray) -> np.ndarray:
        """Return the slots (l, m, n) int64 of a box of this shape from coordinate `first` (3,) on; 0: no block."""
        return self.find(first + np.argwhere(np.ones(shape))).reshape(shape)


def dense(voxels: np.ndarray) -> np.ndarray:
    """Turn the voxels of a box of blocks, (l, m, n, 8, 8, 8, ...), into (8 l, 8 m, 8 n, ...)."""
    (i, j, k), rest = voxels.shape[:3], voxels.shape[6:]
    return np.moveaxis(voxels, (3, 4, 5), (1, 3, 5)).reshape(BLOCK * i, BLOCK * j, BLOCK * k, *rest)


def _zeros(blocks: int) -> Voxels:
    shape = (blocks, BLOCK, BLOCK, BLOCK)
    return Voxels(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros((*shape, 4), np.float32))
