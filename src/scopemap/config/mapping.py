"""Settings of mapping and fusion."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from scopemap.config.settings import Settings


class MappingSettings(Settings):
    """Back end: bundle adjustment of all keyframes, loop closure and map merging after the last frame."""

    method: Literal["none", "full"] = Field(
        "full",
        description="none: poses as tracked; full: bundle adjustment after the last frame where depth is predicted "
        "(measured depth tracks as well or better without)",
    )
    gaps: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (1, 2, 3, 5, 8), min_length=1, description="a keyframe is matched with the keyframes this many before it"
    )
    cell_px: int = Field(16, ge=4, description="one point per cell of this size, px")
    consistency_px: float = Field(1.0, gt=0, description="largest forward-backward error of flow, px")
    min_loop_inliers: int = Field(
        25, ge=0, description="PnP inliers that a loop closure needs at least; 0: no loop closure, no map merging"
    )
    depth_share: float = Field(0.15, gt=0, description="minimum relative standard deviation of depth")
    scale_sigma: float = Field(0.1, gt=0, description="standard deviation of ln of a keyframe's depth scale")
    depth_step_sigma: float = Field(
        0.1,
        ge=0,
        description="standard deviation of ln depth between nodes of the depth correction field; 0: scale only",
    )
    rotation_sigma_deg: float = Field(3.0, gt=0, description="standard deviation of rotations between keyframes")
    translation_sigma_share: float = Field(
        0.1, gt=0, description="standard deviation of translations between keyframes over the mean depth"
    )
    max_sigma_px: float = Field(
        0.8,
        gt=0,
        description="poses stay as tracked where the adjusted reprojection error (MAD) exceeds this, px",
    )
    max_depth_change: float = Field(
        0.3, gt=0, description="poses stay as tracked where the median change of ln depth exceeds this"
    )


class FusionAdvanced(Settings):
    """Constants of fusion."""

    min_incidence: float = Field(0.1, ge=0, le=1, description="cosine of incidence below which a pixel is not fused")
    depth_sigma_share: float = Field(
        0.2, gt=0, description="relative error that all depth has; more uncertain pixels weigh less; large: off"
    )
    min_weight: float = Field(1.5, ge=0, description="voxels with less weight give no surface")
    min_component_share: float = Field(
        0.02, ge=0, le=1, description="components with less than this share of the faces are removed"
    )


class FusionSettings(Settings):
    """Volumetric fusion. TSDF parameters that are not set follow the scene: see `scopemap.fusion.volume`."""

    enabled: bool = Field(True, description="false: no mesh")
    voxel_mm: float | None = Field(
        None, ge=0.01, description="voxel size, mm; default: 1/60 of the clip's median depth"
    )
    truncation_mm: float | None = Field(None, ge=0.05, description="truncation of the TSDF, mm; default: 5 voxels")
    max_depth_mm: float | None = Field(
        None, gt=0, description="depth beyond this is not fused, mm; default: 200 voxels"
    )
    every: int = Field(1, ge=1, description="fuse every n-th tracked frame")
    advanced: FusionAdvanced = FusionAdvanced()
