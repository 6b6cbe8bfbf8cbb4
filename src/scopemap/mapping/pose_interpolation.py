"""From corrected keyframes to every frame: those on the way from one to the next take a share of both corrections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from scopemap.geometry.align import Similarity
from scopemap.geometry.se3 import inverse, mean_near, rotation_angle_rad
from scopemap.mapping.depth_correction import DepthGrid

_AT_REST = 1e-6  # rad


class TrackedPose(NamedTuple):
    """How a frame was tracked.

    map : number of its map. keyframe : number of the frame that it was aligned to. T_world_camera : (4, 4), its pose in
    that map's world. segment : the same number for all frames between which the camera was not lost.
    """

    map: int
    keyframe: int
    T_world_camera: np.ndarray
    segment: int = 0


@dataclass(frozen=True)
class Correction:
    """What the adjustment changed.

    Attributes
    ----------
    index : (K,) int, numbers of the keyframes' frames, increasing. T_world_world : (K, 4, 4), takes the common world as
    tracked, near a keyframe, to the adjusted one. log_scale : (K,) ln of the factor of a keyframe's depth. sigma_px :
    robust standard deviation of the reprojection errors; NaN where nothing was observed twice. refused : why nothing is
    changed, "" where it is. loops : accepted loop closures. grids : (K,) what the depth of each pixel is multiplied by
    besides; (): nothing. S_common_map : by number of each merged map, Sim(3) from its world to the common one.
    tracked : by number of the frame, how it was tracked, where that is known. depth_mm : typical depth, the unit of
    translations beside rotations in rad.
    """

    index: np.ndarray
    T_world_world: np.ndarray
    log_scale: np.ndarray
    sigma_px: float = float("nan")
    refused: str = ""
    loops: int = 0
    grids: tuple[DepthGrid, ...] = ()
    S_common_map: Mapping[int, Similarity] = field(default_factory=dict)
    tracked: Mapping[int, TrackedPose] = field(default_factory=dict)
    depth_mm: float = 1.0

    @property
    def description(self) -> str:
        """One sentence for the provenance: what was adjusted, and what of it did not agree."""
        if not np.isfinite(self.sigma_px):
            return f"back end: nothing linked the {len(self.index)} keyframes; poses are as tracked"
        if self.refused:
            return (
                f"back end: poses are as tracked; even adjusted, {self.refused}: tissue that moves by itself, or "
                "another focal length"
            )
        turn_deg = np.degrees(rotation_angle_rad(self.T_world_world[:, :3, :3]).max())
        closed = f", {self.loops} loops closed" if self.loops else ""
        closed += f", {len(self.S_common_map)} maps joined" if len(self.S_common_map) > 1 else ""
        return (
            f"back end: {len(self.index)} keyframes adjusted, turned by up to {turn_deg:.1f} deg{closed}; points seen "
            f"again lie {self.sigma_px:.2f} px from where they should{self._bent()}"
        )

    def pose(self, index: int, T_world_camera: np.ndarray) -> np.ndarray:
        """Return the corrected pose (4, 4) of the frame with this number."""
        before, after, share = self._between(index)
        T_world_camera = self._world(index).transform_poses(T_world_camera)
        poses = [self.T_world_world[k] @ T_world_camera for k in (before, after)]
        return mean_near(poses[0], [poses[1]], [share])

    def depth_factor(self, index: int) -> float:
        """Return what all depth of the frame with this number is to be multiplied by, before what its grids ask for."""
        before, after, share = self._between(index)
        log_scale = (1 - share) * self.log_scale[before] + share * self.log_scale[after]
        return float(np.exp(log_scale)) * self._world(index).scale

    def depth_factors(self, index: int, depth_mm: np.ndarray) -> np.ndarray:
        """Return what each pixel's depth (H, W) mm is to be multiplied by, float32; NaN where depth is unknown."""
        factor = np.float32(self.depth_factor(index))
        if not self.grids:
            return np.full(depth_mm.shape, factor, np.float32)
        before, after, share = self._between(index)
        depth_mm = depth_mm * np.float32(self._world(index).scale)
        log = self.grids[before].log_factor(depth_mm)
        if after != before:
            log = (1 - share) * log + share * self.grids[after].log_factor(depth_mm)
        return factor * np.exp(log.astype(np.float32))

    def _world(self, index: int) -> Similarity:
        """How the world of a frame's map lies in the common one."""
        tracked = self.tracked.get(index)
        return self.S_common_map.get(0 if tracked is None else tracked.map, Similarity.identity())

    def _bent(self) -> str:
        """How far the grids go, for the description; nothing where there are none."""
        if not self.grids:
            return ""
        typical = np.median([np.abs(grid.values).mean() for grid in self.grids])
        return f"; depth corrected by {100 * np.expm1(typical):.0f} % on average"

    def _between(self, index: int) -> tuple[int, int, float]:
        """Numbers of the two keyframes that a frame moves with, and its share of the second's correction.

        A frame moves with the keyframe that it was aligned to, and more and more with the next one, if that was aligned
        to the same: as much as the camera had moved by then. (Where a recording was cut that is all at once, and what
        is wrong with the jump is wrong from there on.) Where the camera was lost between them, or found again by an
        older keyframe, what is wrong with that is wrong from there on, too: with all that was aligned to the same.
        """
        after = int(np.searchsorted(self.index, index))
        if after < len(self.index) and self.index[after] == index:
            return after, after, 0.0
        own = self._reference(index)
        if own is not None:
            if after == len(self.index) or not self._alike(index, int(self.index[after])):
                return own, own, 0.0
            if own != after - 1 or self._lost_between(int(self.index[own]), index):
                return after, after, 0.0
        if after == 0 or after == len(self.index):
            nearest = min(after, len(self.index) - 1)
            return nearest, nearest, 0.0
        return after - 1, after, self._share(index, after - 1, after)

    def _share(self, index: int, before: int, after: int) -> float:
        """How far a frame is on the way from one keyframe to the next, by motion; by time where that is not known."""
        frames = (int(self.index[before]), index, int(self.index[after]))
        if all(frame in self.tracked for frame in frames):
            first, own, last = (self._world(f).transform_poses(self.tracked[f].T_world_camera) for f in frames)
            there, onwards = self._motion(first, own), self._motion(own, last)
            if there + onwards > _AT_REST:
                return there / (there + onwards)
        return (index - frames[0]) / (frames[2] - frames[0])

    def _motion(self, T_world_one: np.ndarray, T_world_other: np.ndarray) -> float:
        T = inverse(T_world_one) @ T_world_other
        return float(np.hypot(rotation_angle_rad(T[:3, :3]), np.linalg.norm(T[:3, 3]) / self.depth_mm))

    def _alike(self, index: int, keyframe: int) -> bool:
        """Whether a frame and a later keyframe were aligned to the same, and the camera was not lost between them."""
        same = self._reference(index) == self._reference(keyframe)
        return same and not self._lost_between(index, keyframe)

    def _lost_between(self, one: int, other: int) -> bool:
        return (
            one in self.tracked and other in self.tracked and self.tracked[one].segment != self.tracked[other].segment
        )

    def _reference(self, index: int) -> int | None:
        """Number of the keyframe that a frame was aligned to, where that is known."""
        tracked = self.tracked.get(index)
        place = 0 if tracked is None else int(np.searchsorted(self.index, tracked.keyframe))
        known = tracked is not None and place < len(self.index) and self.index[place] == tracked.keyframe
        return place if known else None


def unchanged(index: np.ndarray, sigma_px: float, refused: str) -> Correction:
    """Return the correction of keyframes (K,) that leaves every frame as it is, and says why."""
    count = len(index)
    return Correction(index, np.stack([np.eye(4)] * count), np.zeros(count), sigma_px, refused=refused)
