"""Settings of tracking and of pose smoothing."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from scopemap.config.settings import Settings


class TrackingSettings(Settings):
    """Tracking against the keyframe (METHOD section WEMA-RTDL)."""

    keyframe_every: int = Field(
        10, ge=1, description="every n-th frame becomes a keyframe (the paper's first alpha: 2)"
    )
    keyframe_agreement: float = Field(
        0.7,
        ge=0,
        le=1,
        description="a frame becomes a keyframe before its turn where it agrees with the last one in less than this "
        "share of what the first one tracked against it did: a fast camera must not lose it; 0: off",
    )
    levels: int = Field(5, ge=1, description="pyramid levels, factor 0.5")
    finest_level: int = Field(1, ge=0, description="0: full working size, 1: half")
    min_side_px: int = Field(16, ge=4, description="no level with a shorter side than this")
    rotation_first: bool = Field(True, description="SO(3) only at the coarsest level")
    solver: Literal["dogleg", "gauss-newton"] = "dogleg"
    max_iterations: int = Field(30, ge=1, description="steps per level")
    radius: float = Field(0.1, gt=0, description="rho, first trust radius: rad, and translation over mean depth")
    huber: float = Field(1.0, gt=0, description="Huber threshold in robust standard deviations (MAD)")
    channels: Literal["grey", "normalised", "both"] = Field(
        "both",
        description="what is compared: grey values, or grey values minus local mean over local deviation, or both",
    )
    normalise_sigma_px: float = Field(2.0, gt=0, description="width of the local mean, px at each level")
    grey_share: float = Field(0.3, gt=0, description="weight of the grey channel against the normalised one")
    lamp_gamma: float = Field(
        0.35,
        ge=0,
        description="grey = (cosine / distance^2)^gamma; sRGB alone: 0.45; 0.35 did better; 0: off",
    )
    depth_sigma_share: float = Field(
        0.05, gt=0, description="relative error that all depth has anyhow: more uncertain pixels count less; large: off"
    )
    depth_share: float = Field(
        1.0,
        ge=0,
        description="weight of the distance to the frame's own depth where that is measured, point to plane; 0: off",
    )
    least_depth_sigma: float = Field(
        1e-3, gt=0, description="least standard deviation of that distance, share of the keyframe's mean depth"
    )
    gain_bias: bool = Field(True, description="estimate gain and bias of each frame pair")
    flow_contradiction: float = Field(
        2.0,
        ge=0,
        description="flow from the frame before decides where a pose errs against it by more than this many times what "
        "the best motion does, and a pixel; only where MAPIS links frames, as it does for predicted depth; 0: off",
    )
    flow_least_share: float = Field(
        0.1, ge=0, le=1, description="flow has no say where less of a frame is linked to the one before it"
    )
    least_detail: float = Field(
        0.6, ge=0, description="a frame that shows less of the usual detail, and agrees badly, is lost; 0: off"
    )
    doubtful_inlier_share: float = Field(0.6, ge=0, le=1, description="less than that agrees badly")
    remembered_keyframes: int = Field(10, ge=0, description="among which a lost camera is looked for; 0: off")
    new_map_after: int = Field(5, ge=0, description="so many clear frames lost in a row, a new map begins; 0: never")
    least_landmarks: int = Field(20, ge=6, description="that must agree on where the camera was found again")
    corner_depth_share: float = Field(
        0.2,
        ge=0,
        description="relative error of predicted depth, for corners of the keyframe that flow follows; 0: off",
    )
    start: Literal["identity", "previous", "velocity"] = Field("previous", description="first guess of a frame")
    min_inlier_share: float = Field(0.4, ge=0, le=1, description="a frame below is lost; unrelated fine texture: 0.37")
    min_correlation: float = Field(0.15, ge=-1, le=1, description="with the keyframe; a frame below is lost; -1: off")
    min_valid_share: float = Field(0.1, ge=0, le=1, description="a frame with less usable overlap is lost")
    max_step: float = Field(0.5, gt=0, description="largest jump between frames: rad, and mm over mean depth")


class SmoothingSettings(Settings):
    """WEMA: weighted mean of the last three poses, on the group (METHOD section WEMA)."""

    method: Literal["none", "wema"] = "none"
    alpha: float = Field(0.6, ge=0, le=1, description="weight of pose i")
    beta: float = Field(0.3, ge=0, le=1, description="weight of pose i-1")
    gamma: float = Field(0.1, ge=0, le=1, description="weight of pose i-2")
    omega: float = Field(0.1, gt=0, description="s = 1 - exp(-i omega); frames count from 0")
    dynamic: bool = Field(True, description="False: s = 1 (the paper's ablation without DyEMA)")

    @model_validator(mode="after")
    def _weights_sum_to_one(self) -> SmoothingSettings:
        total = self.alpha + self.beta + self.gamma
        if abs(total - 1.0) > 1e-6:
            raise ValueError(f"alpha + beta + gamma must be 1, got {total:g}")
        return self
