"""Settings of mapping and fusion."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from scopemap.config.settings import Settings


class MappingAdvanced(Settings):
    """Constants of bundle adjustment."""

    keyframe_gaps: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (1, 2, 3, 5, 8), min_length=1, description="a keyframe's corners are tracked to the keyframes so many before it"
    )
    correlated_observations: float = Field(
        4.0, ge=1, description="so many observations count as one: errors of flow are alike at neighbouring corners"
    )
    depth_sigma_share: float = Field(
        0.2, gt=0, description="standard deviation that every estimated depth has at least, over the depth"
    )
    scale_sigma: float = Field(0.1, gt=0, description="standard deviation of ln of a keyframe's depth scale")
    depth_step_sigma: float = Field(
        0.1, ge=0, description="sigma of ln depth between nodes of the depth correction field; 0: depth is only scaled"
    )
    rotation_sigma_deg: float = Field(
        3.0, gt=0, description="standard deviation of the tracked rotation between keyframes, deg"
    )
    translation_sigma_share: float = Field(
        0.1, gt=0, description="standard deviation of the tracked translation between keyframes, over the median depth"
    )
    max_sigma_px: float = Field(
        0.8,
        gt=0,
        description="poses stay as tracked where the robust sigma of adjusted reprojection errors is larger, px",
    )
    max_depth_change: float = Field(
        0.3, gt=0, description="poses stay as tracked where the median change of ln depth is larger"
    )


class MappingSettings(Settings):
    """Bundle adjustment of all keyframes after the last frame, with loop closure and map merging."""

    method: Literal["none", "full"] = Field(
        "full",
        description="none: poses as tracked, frame by frame; full: all keyframes adjusted at the end, where depth is "
        "predicted (measured depth tracks as well or better without)",
    )
    min_loop_inliers: int = Field(
        25, ge=0, description="PnP inliers that a loop closure needs at least; 0: no loop closure, no map merging"
    )
    triangulate_depth: bool = Field(
        True,
        description="triangulate the depth of keyframes against frames around them, where method is full and the scene "
        "is rigid; all frames take it over; false: depth as predicted, corrected at the keyframes' corners",
    )
    advanced: MappingAdvanced = MappingAdvanced()


class FusionAdvanced(Settings):
    """Constants of fusion."""

    weighted: bool = Field(
        True,
        description="weight frames by quality, pixels by incidence, distance and uncertainty, voxels behind a surface "
        "less; False: 1",
    )
    min_incidence: float = Field(0.1, ge=0, le=1, description="cosine of incidence below which a pixel is not fused")
    depth_sigma_share: float = Field(
        0.2, gt=0, description="relative error that all depth has; more uncertain pixels weigh less; large: off"
    )
    truncation_share: float = Field(
        0.08,
        ge=0,
        le=1,
        description="truncation as a share of the pixel's depth, where that is larger than truncation_mm",
    )
    min_weight: float = Field(0.1, ge=0, description="voxels with less weight give no surface")
    min_component_share: float = Field(
        0.02, ge=0, le=1, description="components with less than this share of the faces are removed"
    )


class FusionSettings(Settings):
    """Volumetric fusion. TSDF parameters that are not set follow the scene: see `scopemap.fusion.surface_fusion`."""

    enabled: bool = Field(True, description="false: no mesh")
    voxel_mm: float | None = Field(
        None, ge=0.01, le=1000, description="voxel size, mm; default: 1/60 of the clip's median depth"
    )
    truncation_mm: float | None = Field(
        None, ge=0.05, le=1e4, description="truncation of the TSDF, mm; default: 5 voxels"
    )
    max_depth_mm: float | None = Field(
        None, gt=0, le=1e6, description="depth beyond this is not fused, mm; default: 200 voxels"
    )
    every: int = Field(1, ge=1, description="fuse every n-th tracked frame")
    surface_at_s: float | None = Field(
        None,
        description="the surface as seen at this second, by the time stamps, where tissue moves on its own "
        "(moving_share in frames.csv); default: the mean of all frames there, too",
    )
    colours: Literal["albedo", "raw"] = Field(
        "albedo",
        description="colours of the mesh; albedo: the tissue's, without the lamp's fall-off, in one exposure for all "
        "frames; raw: the video's",
    )
    holes: Literal["small", "none", "watertight"] = Field(
        "small",
        description="holes of the mesh that are closed; small: those within the surface with a border of up to 20 "
        "voxels' edges, their new vertices with confidence 0; what no frame saw stays open; watertight: all, smoothly, "
        "what no frame saw grey and with confidence 0",
    )
    mesh_smooth: int = Field(0, ge=0, description="iterations of Taubin's filter on the mesh; 0: none")
    mesh_faces: int | None = Field(
        None, ge=4, description="simplify the mesh to about so many faces; default: as fusion gives it"
    )
    advanced: FusionAdvanced = FusionAdvanced()
