"""Settings of mapping and fusion."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat

from scopemap.engine.config.settings import Methods, Share, StageSettings, advanced


class MappingSettings(StageSettings):
    """Bundle adjustment of all keyframes after the last frame, with loop closure and map merging."""

    METHODS: ClassVar[Methods] = {
        "full": {},
        "none": {"local_window": 0, "global_adjustment": False},
        "local": {"triangulate_depth": False, "min_loop_inliers": 0, "global_adjustment": False},
        "realtime": {"triangulate_depth": False, "min_loop_inliers": 0},
    }
    method: str = Field(
        "full",
        description="none: poses as tracked, frame by frame; local: each keyframe adjusted as it comes, with those "
        "before it; realtime: all adjusted at the end, too; full: with loop closure and depth of several views. Where "
        "depth is predicted: measured depth tracks as well or better without",
    )

    min_loop_inliers: NonNegativeInt = advanced(
        25,
        "inliers of PnP that a loop closure needs; 0: no loop closure, no map merging, no tracking backwards",
        "by hand",
    )
    triangulate_depth: bool = advanced(
        True,
        "triangulate the depth of keyframes against frames around them, where the scene is rigid; all frames take it "
        "over; false: depth as predicted, corrected at the keyframes' corners",
        "by hand: adjusted poses are far more accurate than depth",
    )
    local_window: NonNegativeInt = advanced(
        5,
        "keyframes that each new one is adjusted with, itself among them, before frames are tracked against it; 0: off",
        "by hand",
    )
    global_adjustment: bool = advanced(True, "adjust all keyframes after the last frame", "by hand; the paper has none")
    depth_step_sigma: NonNegativeFloat = advanced(
        0.1,
        "standard deviation of ln depth between nodes of the depth correction field; 0: depth is only scaled",
        "by hand",
    )
    max_sigma_px: PositiveFloat = advanced(
        0.8,
        "poses stay as tracked where the robust standard deviation of adjusted reprojection errors is larger",
        "by hand",
    )
    other_starts: bool = advanced(
        True,
        "try other starts of the adjustment; false: the shape is taken for determined",
        "by hand: the bas-relief ambiguity",
    )

    @property
    def adjusts(self) -> bool:
        """Whether keyframes are adjusted at all, as they come or after the last frame."""
        return self.local_window > 0 or self.global_adjustment


class FusionSettings(StageSettings):
    """Volumetric fusion. TSDF parameters that are not set follow the scene (`engine/fusion/surface_fusion.py`)."""

    METHODS: ClassVar[Methods] = {
        "scopemap": {},
        "no-free-space": {},
        "unweighted": {},
        "all-components": {"min_component_share": 0.0},
    }
    method: str = Field(
        "scopemap",
        description="scopemap: frames are weighted by quality, pixels by incidence, distance and uncertainty, voxels "
        "behind a surface less, grazing pixels and voxels of little weight are left out, truncation is farther where "
        "depth is larger, and what other frames look through is left out where frames are fused after the last one; "
        "unweighted: without the weights and all that; no-free-space: with what others look through; all-components",
    )
    enabled: bool = Field(True, description="false: no mesh")
    voxel_mm: float | None = Field(
        None, ge=0.01, le=1000, description="voxel size, mm; default: 1/60 of the clip's median depth"
    )
    truncation_mm: float | None = Field(
        None, ge=0.05, le=1e4, description="truncation of the TSDF, mm; default: 5 voxels"
    )
    max_depth_mm: float | None = Field(
        None,
        gt=0,
        le=1e6,
        description="depth beyond this is not fused, mm; default: 200 voxels, or 3.3 times a median depth beyond that",
    )
    every: int = Field(0, ge=0, description="fuse every n-th tracked frame; 0: those that show tissue anew")
    colours: Literal["texture", "albedo", "raw"] = Field(
        "texture",
        description="albedo: without the lamp's fall-off, in one exposure for all frames; texture: as albedo, and "
        "mesh.glb shows pieces of the video's frames; raw: of the video",
    )
    holes: Literal["small", "none", "watertight"] = Field(
        "small",
        description="holes of the mesh that are closed, with confidence 0; small: those within the surface with a "
        "border of up to 20 voxels' edges, not what no frame saw, and borders are smoothed; none: the mesh as it "
        "was fused; watertight: all, what no frame saw in grey",
    )
    mesh_smooth: int = Field(0, ge=0, description="iterations of Taubin's filter on the mesh; 0: none")
    mesh_faces: int | None = Field(None, ge=4, description="simplify the mesh to about so many faces; default: not")

    min_component_share: Share = advanced(
        0.02, "components with less than this share of the faces are removed", "by hand"
    )

    @property
    def weighted(self) -> bool:
        """Whether frames, pixels and voxels have weights (Curless and Levoy 1996)."""
        return not self.has("unweighted")

    @property
    def without_light(self) -> bool:
        """Whether colours are the tissue's own, without the lamp's fall-off (`fusion/albedo.py`)."""
        return self.colours != "raw"

    @property
    def free_space(self) -> bool:
        """Whether what other frames look through is left out, where frames are fused after the last one."""
        return not self.has("no-free-space")
