"""Sparse storage of voxel blocks: unbounded, growing with the surface that has been seen."""

from __future__ import annotations

import numpy as np

from scopemap.fusion.tsdf import BLOCK, Voxels, pack

_FIRST_CAPACITY = 256


class VoxelBlocks:
    """Blocks of 8^3 voxels found by the key of their block coordinate.

    Attributes
    ----------
    voxels : storage of at least `len(self) + 1` blocks; slot 0 is a block that nothing is ever written to.
    """

    def __init__(self) -> None:
        self.voxels = _zeros(_FIRST_CAPACITY)
        # A dict finds the few thousand blocks of a frame in under a millisecond; a compiled hash table gains nothing.
        self._slots: dict[int, int] = {}

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
            spare = _zeros(max(capacity // 2, len(index) + 1 - capacity))
            self.voxels = Voxels(*(np.concatenate(pair) for pair in zip(self.voxels, spare, strict=True)))
        return slots

    def dense(self, corner: np.ndarray, blocks: int) -> Voxels:
        """Return the cube of `blocks`^3 blocks from block coordinate `corner` (3,) on as dense arrays (8 blocks, ...).

        Where there is no block the weight is 0.
        """
        steps = range(blocks)
        x, y, z = (int(c) for c in corner)
        find = self._slots.get
        slots = np.array([find(pack.py_func(x + i, y + j, z + k), 0) for i in steps for j in steps for k in steps])
        return Voxels(*(_assemble(array[slots], blocks) for array in self.voxels))


def _zeros(blocks: int) -> Voxels:
    shape = (blocks, BLOCK, BLOCK, BLOCK)
    return Voxels(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros((*shape, 4), np.float32))


def _assemble(array: np.ndarray, blocks: int) -> np.ndarray:
    """Turn (blocks^3, 8, 8, 8, ...) into (8 blocks, 8 blocks, 8 blocks, ...)."""
    side, rest = blocks * BLOCK, array.shape[4:]
    cube = np.moveaxis(array.reshape(blocks, blocks, blocks, BLOCK, BLOCK, BLOCK, *rest), (3, 4, 5), (1, 3, 5))
    return cube.reshape(side, side, side, *rest)
