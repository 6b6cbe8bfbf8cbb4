"""Settings of depth, its consistency over time, and the networks."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator

from scopemap.config.settings import Settings


class DepthSettings(Settings):
    """Where depth comes from and what fixes its scale."""

    backend: str = Field("scopenet", description="scopenet | shading | depth-anything | depth-pro | files:FOLDER")
    model: str = Field(
        "",
        description="weights of the networks: hub id or local folder, for scopenet a .safetensors file; empty: pinned",
    )
    anchor: Literal["auto", "near-far", "depth-pro", "shading", "factor"] = Field(
        "auto", description="metric anchor of frame 1; auto: near-far if given, else the depth's own mm, else shading"
    )
    factor: float = Field(
        30.0,
        gt=0,
        description="anchor = factor: nearest tissue of frame 1 at 1000 mm over this (an ablation)",
    )
    reanchor_every: int = Field(
        0,
        ge=0,
        description="ask a metric anchor again every n-th frame (best a multiple of keyframe_every, with "
        "keyframe_agreement 0); 0: once",
    )
    near_far_mm: tuple[float, float] | None = Field(None, description="nearest and farthest tissue in frame 1, mm")
    fit_shift: bool = Field(True, description="fit scale and shift to the anchor; False: the paper's baseline only")
    files_kind: Literal["auto", "disparity", "depth", "measured"] = Field(
        "auto", description="auto: 8 bit is disparity, else measured depth; depth: predicted, its scale may float"
    )
    files_scale_mm: float | None = Field(None, gt=0, description="mm per unit of depth files; None: found or assumed")
    shading_median_mm: float = Field(35.0, gt=0, description="stated prior: median distance of tissue in frame 1, mm")
    shading_exponent: float = Field(0.6, gt=0, le=1, description="distance = k * brightness^-exponent")
    max_depth_mm: float = Field(
        300.0, gt=0, description="depth beyond this is unknown, unless measured or stated by near-far"
    )
    exponent: float | Literal["fit"] = Field(
        1.0,
        description="range of predicted depth about its median: distance^exponent; fit: from the flow, before the run",
    )
    exponent_frames: int = Field(80, ge=2, description="exponent = fit: how many frames at the start are looked at")

    @field_validator("exponent", mode="before")
    @classmethod
    def _number_or_fit(cls, value: Any) -> Any:
        """Refuse with one sentence; of a union pydantic would name every part."""
        try:
            possible = value == "fit" or 0.25 <= float(value) <= 4
        except (TypeError, ValueError):
            possible = False
        if not possible:
            raise ValueError("must be 'fit' or a number from 0.25 to 4")
        return value


class MapisSettings(Settings):
    """Depth consistency over time (METHOD section MAPIS-Depth)."""

    order: Literal["track-first", "refine-first"] = Field(
        "track-first", description="refine-first is the paper's: warp values as they are, then track"
    )
    frame_scale: Literal["auto", "none", "robust"] = Field(
        "auto", description="robust scale of each frame against the warped previous depth; auto: not for measured depth"
    )
    scale_pull: float = Field(
        0.1,
        ge=0,
        le=1,
        description="share of ln of that scale that is given up at a frame of which next to nothing is linked to the "
        "one before it; less, by the square, where more of what is usable is linked; 0: off",
    )
    blend: Literal["auto", "none", "exponential", "linear", "constant", "paper-equation"] = Field(
        "auto", description="weight of the warped depth; auto: linear, none for measured depth"
    )
    tau: float = Field(0.15, gt=0, description="LPIPS distance at which the exponential weight falls to 1/e")
    constant_weight: float = Field(0.5, ge=0, le=1, description="weight of the warped depth with blend = constant")
    sigma_fading: float = Field(
        0.3,
        ge=0,
        le=1,
        description="variance that warped depth gains per frame, share of what it lies below the frame's",
    )
    recursive: bool = Field(True, description="warp the refined previous depth; False: the unrefined, as the paper")
    compare_warped: bool = Field(True, description="LPIPS of the warped previous image; False: of the images as are")
    perceptual_score: bool = Field(False, description="one LPIPS score per pair instead of the map")
    filter_sigma_px: float = Field(2.0, ge=0, description="sigma_d of the bilateral filter, px; 0: off")
    filter_sigma_mm: float = Field(2.0, gt=0, description="sigma_r of the bilateral filter, mm")
    consistency_px: float = Field(1.0, gt=0, description="largest forward-backward flow error, px")


class NetworkSettings(Settings):
    """Optical flow and perceptual distance."""

    flow: str = Field(
        "auto",
        description="flow from frame to frame: raft-small | raft-large | dis | none | auto: raft-small where its "
        "weights are present, else dis",
    )
    keyframe_flow: str = Field(
        "dis",
        description="flow between keyframes (back end) and from the keyframe to the frame (corners), the same names; "
        "none: no corners, and a back end without observations",
    )
    perceptual: Literal["auto", "lpips", "structure"] = Field(
        "auto",
        description="perceptual distance, lpips: AlexNet; structure: local structural similarity, no weights; auto: "
        "lpips where its weights are present, else structure",
    )
    device: str = Field("auto", description="where networks run: auto | cpu | cuda")
