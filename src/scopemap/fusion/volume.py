"""Volumetric fusion: posed depth frames in, one coloured surface out (METHOD section 3)."""

from __future__ import annotations

import math

import numpy as np
import trimesh

from scopemap.config import FusionSettings
from scopemap.frame import Frame
from scopemap.fusion.blocks import VoxelBlocks
from scopemap.fusion.surface import extract_surface
from scopemap.fusion.tsdf import (
    BLOCK,
    KEY_OFFSET,
    Grid,
    View,
    integrate_blocks,
    measure_surface,
    touched_blocks,
    unpack,
)
from scopemap.fusion.tsdf_parameters import Sizes, choose_sizes
from scopemap.geometry.se3 import inverse
from scopemap.geometry.uncertainty import depth_trust

# Below this cosine a slanted wall cannot be told from a depth edge, whatever the setting.
_LEAST_INCIDENCE = 0.05


class TsdfVolume:
    """An unbounded truncated signed distance field that grows with the frames fused into it.

    sizes : of voxels, truncation and reach; by default those of the settings, which must then name `voxel_mm`
    (`ValueError` otherwise).
    """

    def __init__(self, settings: FusionSettings, sizes: Sizes | None = None) -> None:
        self.settings = settings
        self.sizes = sizes or choose_sizes(settings)
        self._blocks = VoxelBlocks()

    @property
    def block_count(self) -> int:
        """Number of blocks of 8^3 voxels in memory, 12 KiB each."""
        return len(self._blocks)

    def integrate(self, frame: Frame) -> None:
        """Fuse the valid pixels of a frame up to `max_depth_mm`; a frame without any changes nothing.

        Pixels whose depth is less certain than the frame's median pixel (`frame.depth_sigma_mm`) count less.

        Raises `ValueError` for a frame without depth or pose, or with a pose that is not finite or out of reach.
        """
        depth_mm, T_world_camera = self._checked(frame)
        camera, settings, reach_mm = frame.camera, self.settings, self.sizes.max_depth_mm
        T_camera_world = inverse(T_world_camera)
        R, t = np.ascontiguousarray(T_camera_world[:3, :3]), T_camera_world[:3, 3].copy()
        view = View(R, t, float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
        steepest = max(settings.advanced.min_incidence, _LEAST_INCIDENCE)
        step = math.sqrt(1 / steepest**2 - 1) / min(camera.fx, camera.fy)
        grid = Grid(self.sizes.voxel_mm, self.sizes.truncation_mm, step)
        with np.errstate(invalid="ignore"):
            usable = frame.valid & (depth_mm > 0) & (depth_mm <= reach_mm)
        inverse_depth = np.divide(1.0, depth_mm, out=np.full(depth_mm.shape, np.nan, np.float32), where=usable)
        surface = measure_surface(inverse_depth, view, step, settings.advanced.min_incidence, reach_mm)
        trust = depth_trust(
            np.where(usable, depth_mm, np.nan), frame.depth_sigma_mm, settings.advanced.depth_sigma_share
        )
        surface = surface._replace(weight=surface.weight * np.minimum(trust, np.float32(1.0)))
        keys = np.unique(touched_blocks(surface.inverse_depth, view, grid))
        slots = self._blocks.slots(keys)
        integrate_blocks(self._blocks.voxels, slots, unpack(keys) * BLOCK, surface, frame.rgb, view, grid)

    def extract_mesh(self) -> trimesh.Trimesh:
        """Return the surface seen so far, world mm, vertex colours, normals towards the camera's side; may be empty."""
        return extract_surface(self._blocks, self.settings, self.sizes.voxel_mm)

    def _checked(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        for name in ("depth_mm", "T_world_camera"):
            if getattr(frame, name) is None:
                raise ValueError(f"fusing frame {frame.index}: it has no {name}; fuse tracked frames with depth only")
        depth_mm, T_world_camera = np.asarray(frame.depth_mm, np.float32), np.asarray(frame.T_world_camera, np.float64)
        reach_mm = (KEY_OFFSET - 1) * BLOCK * self.sizes.voxel_mm
        reach_mm -= 4 * self.sizes.max_depth_mm + self.sizes.truncation_mm
        if not np.all(np.abs(T_world_camera[:3]) <= reach_mm):
            raise ValueError(
                f"fusing frame {frame.index}: its pose is not finite or over {reach_mm:.0f} mm from the origin; "
                "leave out lost frames or use a larger voxel"
            )
        return depth_mm, T_world_camera
