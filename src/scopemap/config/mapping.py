"""Settings of mapping and fusion."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from scopemap.config.settings import Settings


class MappingSettings(Settings):
    """Adjustment of all keyframes together, once the last frame is tracked."""

    method: Literal["none", "full"] = Field(
        "full",
        description="none: poses as tracked, frame by frame; full: all keyframes adjusted at the end, where depth is "
        "predicted (measured depth tracks as well or better without)",
    )
    gaps: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (1, 2, 3, 5, 8), min_length=1, description="keyframes are linked to those so many before them"
    )
    cell_px: int = Field(16, ge=4, description="one point in each cell of that size")
    consistency_px: float = Field(1.0, gt=0, description="largest error of flow there and back")
    loop_landmarks: int = Field(
        25, ge=0, description="that must agree where a keyframe shows an old place; 0: no loops, no joining of maps"
    )
    depth_share: float = Field(0.15, gt=0, description="relative error that all depth has anyhow")
    scale_sigma: float = Field(0.1, gt=0, description="standard deviation of ln of a keyframe's depth scale")
    depth_step_sigma: float = Field(
        0.1, ge=0, description="how depth may be bent, ln from node to node of a coarse grid; 0: only scaled"
    )
    turn_sigma_deg: float = Field(3.0, gt=0, description="how far tracked turns between keyframes are trusted")
    way_sigma_share: float = Field(0.1, gt=0, description="the same of ways, over the mean depth")
    max_sigma_px: float = Field(
        0.8, gt=0, description="poses stay as tracked where points seen again stay farther off (robust deviation)"
    )
    max_depth_change: float = Field(
        0.3, gt=0, description="the same where points ask for more than that change of ln depth (their median)"
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
