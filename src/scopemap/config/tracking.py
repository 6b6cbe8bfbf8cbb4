"""Settings of tracking and of pose smoothing."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from scopemap.config.settings import Settings


class TrackingAdvanced(Settings):
    """Thresholds and resolution of tracking."""

    corner_depth_sigma: float = Field(
        0.2, ge=0, description="relative standard deviation of predicted depth in reprojection errors; 0: no corners"
    )
    min_keyframe_agreement: float = Field(
        0.7,
        ge=0,
        le=1,
        description="a frame becomes a keyframe early where its inlier share times overlap falls below this share of "
        "what it was for the keyframe's first frame; 0: off",
    )
    levels: int = Field(5, ge=1, description="pyramid levels, factor 0.5")
    finest_level: int = Field(1, ge=0, description="0: full working size, 1: half")
    max_iterations: int = Field(30, ge=1, description="steps per pyramid level")
    huber: float = Field(1.0, gt=0, description="Huber threshold in robust standard deviations (MAD)")
    depth_weight: float = Field(
        1.0, ge=0, description="weight of the point-to-plane distance to the frame's measured depth; 0: off"
    )
    min_inlier_share: float = Field(
        0.4, ge=0, le=1, description="a frame with a smaller share is lost; unrelated fine texture: 0.37"
    )
    min_correlation: float = Field(
        0.15, ge=-1, le=1, description="a frame that correlates less with its keyframe is lost; -1: off"
    )
    max_step: float = Field(0.5, gt=0, description="largest motion between frames: rad, and mm over mean depth")


class TrackingPaper(Settings):
    """Parts of the photometric alignment that the paper's preset and its ablations replace."""

    solver: Literal["dogleg", "gauss-newton"] = Field("dogleg", description="minimiser of the photometric error")
    rotation_first: bool = Field(True, description="SO(3) only at the coarsest level")
    start: Literal["identity", "previous"] = Field(
        "previous", description="first guess of a frame: the keyframe's pose, or the previous frame's"
    )
    channels: Literal["grey", "both"] = Field(
        "both", description="grey values alone, or also grey values minus local mean over local deviation"
    )
    lamp_gamma: float = Field(
        0.35, ge=0, description="grey = (cosine / distance^2)^gamma; sRGB alone: 0.45; 0.35 was better; 0: off"
    )
    gain_bias: bool = Field(True, description="estimate gain and bias of each frame pair")


class TrackingSettings(Settings):
    """Tracking against the keyframe (METHOD section WEMA-RTDL)."""

    camera_at_rest: bool = Field(
        False,
        description="the camera is known not to move: poses stay the first one, motion is the tissue's, and every "
        "frame has a surface of its own (surfaces/)",
    )
    keyframe_every: int = Field(10, ge=1, description="every n-th frame becomes a keyframe (the paper: 2)")
    min_valid_share: float = Field(0.1, ge=0, le=1, description="a frame with a smaller usable overlap is lost")
    min_sharpness: float = Field(
        0.6,
        ge=0,
        description="a frame below this share of the recent frames' median sharpness is lost where it also fits its "
        "keyframe badly; 0: off",
    )
    relocalisation_keyframes: int = Field(
        10, ge=0, description="number of recent keyframes in which a lost camera is relocalised; 0: off"
    )
    search_every: int = Field(
        1, ge=1, description="a camera that has been lost for more than 5 frames is looked for in every n-th frame"
    )
    new_map_after: int = Field(5, ge=0, description="sharp frames lost in a row after which a new map begins; 0: never")
    advanced: TrackingAdvanced = TrackingAdvanced()
    paper: TrackingPaper = TrackingPaper()


class SmoothingSettings(Settings):
    """WEMA: weighted mean of the last three poses, on the group (METHOD section WEMA)."""

    method: Literal["none", "wema"] = Field("none", description="wema: smooth poses; none: off, the others are inert")
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
