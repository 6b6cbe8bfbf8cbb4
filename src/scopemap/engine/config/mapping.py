"""Settings of mapping and fusion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from scopemap.engine.config.settings import StageSettings, constants_of


@dataclass(frozen=True)
class MappingConstants:
    """Constants of bundle adjustment, loop closure and triangulation."""

    min_loop_inliers: int = 25  # of PnP, that a loop closure needs; 0: no loop closure, no map merging
    # Triangulate the depth of keyframes against frames around them, where the scene is rigid; all frames take it over.
    # False: depth as predicted, corrected at the keyframes' corners.
    triangulate_depth: bool = True
    keyframe_gaps: tuple[int, ...] = (1, 2, 3, 5, 8, 16, 32)  # a keyframe's corners are matched in those so many before
    # Keyframes that each new one is adjusted with, itself among them, before frames are tracked against it; 0: none.
    local_window: int = 5
    local_gaps: tuple[int, ...] = (1, 2)  # there a keyframe's corners are matched in those so many before
    global_adjustment: bool = True  # of all keyframes after the last frame
    # So many observations count as one: errors of flow are alike at neighbouring corners.
    correlated_observations: float = 4.0
    depth_sigma_share: float = 0.2  # standard deviation that every estimated depth has at least, over the depth
    scale_sigma: float = 0.1  # standard deviation of ln of a keyframe's depth scale
    depth_step_sigma: float = 0.1  # of ln depth between nodes of the depth correction field; 0: depth is only scaled
    rotation_sigma_deg: float = 3.0  # standard deviation of the tracked rotation between keyframes
    translation_sigma_share: float = 0.1  # of the tracked translation between keyframes, over the median depth
    max_sigma_px: float = 0.8  # robust, of adjusted reprojection errors; poses stay as tracked where it is larger
    other_starts: bool = True  # try other starts of the adjustment; False: the shape is taken for determined
    # Where a rigid scene leaves errors, try tissue that moves by one curve over time; False: poses stay as they are.
    moving_tissue: bool = True


MAPPING: dict[str, dict[str, Any]] = {
    "full": {},
    "none": {"local_window": 0, "global_adjustment": False},
    "no-windows": {"local_window": 0},
    "one-start": {"other_starts": False},
    "no-loops": {"min_loop_inliers": 0},
    "no-triangulation": {"triangulate_depth": False},
    "previous-keyframe-only": {"keyframe_gaps": (1,)},
    "local": {"triangulate_depth": False, "min_loop_inliers": 0, "global_adjustment": False},
    "fixed-depth": {"scale_sigma": 1e-3},
    "rigid": {"moving_tissue": False},
    "always-adjusted": {"max_sigma_px": 99.0, "other_starts": False, "moving_tissue": False},
}


class MappingSettings(StageSettings):
    """Bundle adjustment of all keyframes after the last frame, with loop closure and map merging."""

    METHODS = MAPPING
    method: str = Field(
        "full",
        description="none: poses as tracked, frame by frame; local: each keyframe adjusted as it comes, with those "
        "before it; full: all adjusted at the end. Where depth is predicted: measured depth tracks as well or better "
        "without",
    )
    constants: MappingConstants = constants_of(MappingConstants(), MAPPING)

    @property
    def at_end(self) -> bool:
        """Whether keyframes are adjusted after the last frame."""
        return self.constants.global_adjustment


@dataclass(frozen=True)
class FusionConstants:
    """Constants of fusion."""

    # Weight frames by quality, pixels by incidence, distance and uncertainty, voxels behind a surface less; False: 1.
    weighted: bool = True
    min_incidence: float = 0.1  # cosine of incidence below which a pixel is not fused
    depth_sigma_share: float = 0.2  # relative error that all depth has; more uncertain pixels weigh less; large: off
    truncation_share: float = 0.08  # of the pixel's depth, where that is larger than truncation_mm
    min_weight: float = 0.1  # voxels with less weight give no surface
    min_component_share: float = 0.02  # components with less than this share of the faces are removed
    free_space: bool = True  # leave out what other frames look through, where frames are fused after the last one


FUSION: dict[str, dict[str, Any]] = {
    "scopemap": {},
    "no-free-space": {"free_space": False},
    "unweighted": {"weighted": False, "min_incidence": 0.0, "truncation_share": 0.0, "min_weight": 0.0},
    "all-components": {"min_component_share": 0.0},
    "well-seen": {"min_weight": 0.5},
}


class FusionSettings(StageSettings):
    """Volumetric fusion. TSDF parameters that are not set follow the scene (`engine/fusion/surface_fusion.py`)."""

    METHODS = FUSION
    method: str = Field("scopemap", description="constants of fusion")
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
        description="albedo: without the lamp's fall-off, in one exposure for all frames; raw: of the video",
    )
    holes: Literal["small", "none", "watertight"] = Field(
        "small",
        description="holes of the mesh that are closed, with confidence 0; small: those within the surface with a "
        "border of up to 20 voxels' edges, not what no frame saw; watertight: all, what no frame saw in grey",
    )
    mesh_smooth: int = Field(0, ge=0, description="iterations of Taubin's filter on the mesh; 0: none")
    mesh_faces: int | None = Field(None, ge=4, description="simplify the mesh to about so many faces; default: not")
    constants: FusionConstants = constants_of(FusionConstants(), FUSION)
