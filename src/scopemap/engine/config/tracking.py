"""Settings of tracking and of pose smoothing."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from scopemap.engine.config.settings import Methods, Share, StageSettings, advanced

# The clips on which the tracker was chosen, with their truth (BENCHMARK.md).
_CHOSEN = "chosen on cecum_t1_a (C3VD) and four phantoms"


class TrackingSettings(StageSettings):
    """Tracking against the keyframe: WEMA-RTDL of the paper."""

    METHODS: ClassVar[Methods] = {
        "scopemap": {},
        "paper": {
            "picture_checks": False,
            "relocalisation_keyframes": 0,
            "new_map_after": 0,
            "corner_depth_sigma": 0.0,
            "min_keyframe_agreement": 0.0,
            "keyframes_wait": False,
            "finest_level": 0,
            "depth_weight": 0.0,
            "start": "identity",
            "channels": "grey",
            "lamp_gamma": 0.0,
            "gain_bias": False,
        },
        "least-squares": {"huber": 1e6},
        "no-pose-checks": {"min_valid_share": 0.001, "pose_checks": False},
        "realtime": {"fast": True},
    }
    method: str = Field("scopemap", description="chooses advanced settings (below): scopemap, realtime, paper, ...")
    camera_at_rest: bool = Field(
        False,
        description="the camera does not move: poses stay the first one, every frame has a surface (surfaces/); "
        "mapping.method is none then",
    )
    keyframe_every: int = Field(
        10, ge=1, description="every n-th frame becomes a keyframe, once the camera has moved (the paper: 2)"
    )

    min_valid_share: Share = advanced(0.1, "a frame with a smaller usable overlap with its keyframe is lost", "by hand")
    picture_checks: bool = advanced(
        True,
        "a frame with little texture, an unsharp one, and one unlike its keyframe (correlation) is lost; false: not",
        "by hand; the paper has none",
    )
    pose_checks: bool = advanced(
        True,
        "a frame that few pixels fit, or whose pose is a jump, is lost; false: not checked, and texture neither",
        "by hand",
    )
    relocalisation_keyframes: NonNegativeInt = advanced(
        10, "recent keyframes in which a lost camera is relocalised; 0: off", "by hand"
    )
    new_map_after: NonNegativeInt = advanced(
        5, "sharp frames lost in a row after which a new map begins; 0: never", "by hand"
    )
    corner_depth_sigma: NonNegativeFloat = advanced(
        0.2, "relative standard deviation of predicted depth in reprojection errors; 0: no corners", "by hand"
    )
    min_keyframe_agreement: Share = advanced(
        0.7,
        "a frame becomes a keyframe early where its inlier share times overlap falls below this share of what it was "
        "for the keyframe's first frame; 0: off",
        "by hand; of 20 lost frames of the colonoscopy clip 1 remained",
    )
    keyframes_wait: bool = advanced(
        True,
        "a keyframe waits until the camera has moved, and up to three frames longer where the picture is not clear; "
        "false: it does not wait",
        "by hand; the paper has none",
    )
    fast: bool = advanced(
        False,
        "after more than 5 lost frames only every third one is looked for, and a pyramid level has half the steps",
        "by hand",
    )
    levels: PositiveInt = advanced(5, "levels of the image pyramid, factor 0.5", "the paper's section WEMA-RTDL")
    finest_level: Annotated[int, Field(ge=0, le=3)] = advanced(1, "0: full working size, 1: half", _CHOSEN)
    huber: PositiveFloat = advanced(
        1.0, "threshold of Huber's loss (1964), in robust standard deviations (MAD)", _CHOSEN
    )
    depth_weight: NonNegativeFloat = advanced(
        1.0, "weight of the point-to-plane distance to the frame's measured depth; 0: off", "by hand"
    )
    solver: Literal["dogleg", "gauss-newton"] = advanced(
        "dogleg", "minimiser of the photometric error", "the paper's section WEMA-RTDL, subsection Optimisation"
    )
    rotation_first: bool = advanced(
        True,
        "SO(3) only at the coarsest level",
        "the paper, Rotation-Translation Decoupling",
    )
    start: Literal["identity", "previous"] = advanced(
        "previous", "first guess: the keyframe's pose, or the previous frame's", "by hand"
    )
    channels: Literal["grey", "both"] = advanced(
        "both", "both: also grey values minus local mean over local deviation", _CHOSEN
    )
    lamp_gamma: NonNegativeFloat = advanced(
        0.35,
        "grey = (cosine / distance^2)^gamma; 0: off",
        "chosen on four phantoms over 0.45, which sRGB alone would give",
    )
    gain_bias: bool = advanced(True, "estimate gain and bias of each frame pair", _CHOSEN)


class SmoothingSettings(StageSettings):
    """WEMA: weighted mean of the last three poses, on the group (equation 13 of the paper)."""

    METHODS: ClassVar[Methods] = {"none": {}, "wema": {}}
    method: str = Field("none", description="wema: smooth poses")

    alpha: Share = advanced(0.6, "weight of pose i", "plausible, not searched; the paper gives none")
    beta: Share = advanced(0.3, "weight of pose i-1", "plausible, not searched; the paper gives none")
    gamma: Share = advanced(0.1, "weight of pose i-2", "plausible, not searched; the paper gives none")
    omega: PositiveFloat = advanced(
        0.1, "s = 1 - exp(-i omega); frames count from 0", "plausible, not searched; the paper gives none"
    )
    dynamic: bool = advanced(True, "false: s = 1 (the paper's ablation without DyEMA)", "the paper's section WEMA")

    @model_validator(mode="after")
    def _weights_sum_to_one(self) -> SmoothingSettings:
        total = self.alpha + self.beta + self.gamma
        if not math.isclose(total, 1.0, abs_tol=1e-6):
            raise ValueError(f"alpha + beta + gamma must be 1, their sum is {total:g}")
        return self
