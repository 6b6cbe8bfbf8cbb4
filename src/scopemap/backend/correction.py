"""From corrected keyframes to every frame: those between two keyframes take a share of both corrections."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scopemap.backend.depth_grid import DepthGrid
from scopemap.frame import Frame
from scopemap.geometry.se3 import mean_near, rotation_angle_rad


@dataclass(frozen=True)
class Correction:
    """What the adjustment changed.

    Attributes
    ----------
    index : (K,) int, numbers of the keyframes' frames, increasing. T_world_world : (K, 4, 4), takes the world as
    tracked around a keyframe to the adjusted one. log_scale : (K,) ln of the factor of a keyframe's depth.
    sigma_px : robust standard deviation of what remains between keyframes, px; NaN where nothing linked them.
    refused : why nothing is changed, "" where it is. loops : pairs of keyframes, far apart in time,
    that were found to show the same place. grids : K of them, by what more the depth of each place is to be multiplied;
    none: nothing more.
    """

    index: np.ndarray
    T_world_world: np.ndarray
    log_scale: np.ndarray
    sigma_px: float = float("nan")
    refused: str = ""
    loops: int = 0
    grids: tuple[DepthGrid, ...] = ()

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
        return (
            f"back end: {len(self.index)} keyframes adjusted, turned by up to {turn_deg:.1f} deg{closed}; points seen "
            f"again lie {self.sigma_px:.2f} px from where they should{self._bent()}"
        )

    def pose(self, index: int, T_world_camera: np.ndarray) -> np.ndarray:
        """Return the corrected pose (4, 4) of the frame with this number."""
        before, after, share = self._between(index)
        poses = [self.T_world_world[k] @ T_world_camera for k in (before, after)]
        return mean_near(poses[0], [poses[1]], [share])

    def frame(self, frame: Frame) -> Frame:
        """Return a tracked frame with its pose and its depth corrected."""
        if frame.T_world_camera is None:
            raise ValueError("a frame to be corrected needs a pose")
        pose = self.pose(frame.index, frame.T_world_camera)
        if frame.depth_mm is None:
            return replace(frame, T_world_camera=pose)
        factors, sigma_mm = self.depth_factors(frame.index, frame.depth_mm), frame.depth_sigma_mm
        return replace(
            frame,
            T_world_camera=pose,
            depth_mm=frame.depth_mm * factors,
            depth_sigma_mm=None if sigma_mm is None else sigma_mm * factors,
        )

    def depth_factor(self, index: int) -> float:
        """Return what all depth of the frame with this number is to be multiplied by, before what its grids ask for."""
        before, after, share = self._between(index)
        return float(np.exp((1 - share) * self.log_scale[before] + share * self.log_scale[after]))

    def depth_factors(self, index: int, depth_mm: np.ndarray) -> np.ndarray:
        """Return what each pixel's depth (H, W) mm is to be multiplied by, float32; NaN where depth is unknown."""
        factor = np.float32(self.depth_factor(index))
        if not self.grids:
            return np.full(depth_mm.shape, factor, np.float32)
        before, after, share = self._between(index)
        log = self.grids[before].log_factor(depth_mm)
        if after != before:
            log = (1 - share) * log + share * self.grids[after].log_factor(depth_mm)
        return factor * np.exp(log.astype(np.float32))

    def _bent(self) -> str:
        """How far the grids go, for the description; nothing where there are none."""
        if not self.grids:
            return ""
        typical = np.median([np.abs(grid.values).mean() for grid in self.grids])
        return f"; depth corrected by {100 * np.expm1(typical):.0f} % on average"

    def _between(self, index: int) -> tuple[int, int, float]:
        """Numbers of the keyframes around a frame, and how far along it lies; outside all, the nearest one twice."""
        after = int(np.searchsorted(self.index, index))
        if after == 0 or after == len(self.index):
            nearest = min(after, len(self.index) - 1)
            return nearest, nearest, 0.0
        before = after - 1
        share = (index - self.index[before]) / (self.index[after] - self.index[before])
        return before, after, float(share)


def unchanged(index: np.ndarray, sigma_px: float, refused: str) -> Correction:
    """Return the correction of keyframes (K,) that leaves every frame as it is, and says why."""
    count = len(index)
    return Correction(index, np.stack([np.eye(4)] * count), np.zeros(count), sigma_px, refused=refused)
