"""States of tissue that moves: one surface, and how its points move to their places at the time of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from scopemap.engine.errors import reporting
from scopemap.engine.geometry.skinning import skin_of

TISSUE_MOTION = "tissue_motion.npz"
"""File of a result with the motion of its tissue."""
_LEAST_NODES = 5  # guard: a file with fewer cannot be skinned


@dataclass(frozen=True, eq=False)
class TissueStates:
    """Motion of tissue over the frames of a submap: curves over time move nodes, and with them the points near these.

    nodes : (N, 3) mm, world. modes : (L, N, 3) mm, displacement of the nodes where a curve is 1. index : (F,) int,
    numbers of the frames, increasing. time_s : (F,). curves : (F, L), their values at the frames. reference : (L,),
    those in the state of the surface, `mesh.ply`.
    """

    nodes: np.ndarray
    modes: np.ndarray
    index: np.ndarray
    time_s: np.ndarray
    curves: np.ndarray
    reference: np.ndarray

    def in_usual_state(self) -> TissueStates:
        """Return the states with the surface in the most usual one."""
        reference = self.curves[np.linalg.norm(self.curves - np.median(self.curves, 0), axis=1).argmin()]
        return TissueStates(self.nodes, self.modes, self.index, self.time_s, self.curves, reference)

    @property
    def reference_s(self) -> float:
        """Time of the first frame in whose state the surface is, s."""
        return float(self.time_s[np.abs(self.curves - self.reference).max(1).argmin()])

    def change(self, index: int) -> np.ndarray:
        """Return the change (L,) of the curves from the state of the surface to that of a frame."""
        at = [np.interp(index, self.index, curve) for curve in self.curves.T]
        return np.array(at) - self.reference

    def motion(self, points: np.ndarray) -> np.ndarray:
        """Return the displacement (L, P, 3) float32, mm, of points (P, 3) where a curve is 1."""
        return skin_of(self.nodes, points).displaced(self.modes).astype(np.float32)

    def moved(self, mesh: trimesh.Trimesh, index: int) -> trimesh.Trimesh:
        """Return the surface in the state of the frame with this number."""
        if not len(mesh.faces):
            return mesh  # trimesh cannot copy coloured vertices without a face
        moved = mesh.copy()
        moved.vertices = mesh.vertices + np.tensordot(self.change(index), self.motion(np.asarray(mesh.vertices)), 1)
        return moved

    def save(self, folder: Path) -> None:
        """Write FOLDER/tissue_motion.npz, with an array for each attribute. Raises `OSError`."""
        np.savez_compressed(folder / TISSUE_MOTION, **vars(self))

    @classmethod
    def read(cls, folder: Path) -> TissueStates | None:
        """Read FOLDER/tissue_motion.npz; None where there is none. Raises `InputError` where it is damaged."""
        file = folder / TISSUE_MOTION
        if not file.is_file():
            return None
        with reporting(f"cannot read {file}"), np.load(file, allow_pickle=False) as arrays:
            states = cls(*(arrays[name] for name in cls.__dataclass_fields__))
            (nodes, _), (curves,), count = states.nodes.shape, states.reference.shape, len(states.index)
            shapes = [(nodes, 3), (curves, nodes, 3), (count,), (count,), (count, curves), (curves,)]
            found = [np.shape(values) for values in vars(states).values()]
            if found != shapes or nodes < _LEAST_NODES or not all(np.isfinite(x).all() for x in vars(states).values()):
                raise ValueError(f"it is damaged: arrays of the shapes {found}")
            return states
