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
            "min_texture": 0.0,
            "min_sharpness": 0.0,
            "relocalisation_keyframes": 0,
            "new_map_after": 0,
            "corner_depth_sigma": 0.0,
            "min_keyframe_agreement": 0.0,
            "min_keyframe_motion": 0.0,
            "keyframe_patience": 0,
            "finest_level": 0,
            "depth_weight": 0.0,
            "min_correlation": -1.0,
            "start": "identity",
            "channels": "grey",
            "lamp_gamma": 0.0,
            "gain_bias": False,
        },
        "least-squares": {"huber": 1e6},
        "no-pose-checks": {"min_valid_share": 0.001, "min_texture": 0.0, "min_inlier_share": 0.0, "max_step": 1e6},
        "realtime": {"search_every": 3, "max_iterations": 15},
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
    min_texture: NonNegativeFloat = advanced(
        0.5,
        "from the 11th frame in a row with less texture on, a frame is lost without being looked at further; 0: off",
        "measured: noise has 0.32, a wall that is touched up to 0.45, tissue 0.65 and more",
    )
    min_sharpness: NonNegativeFloat = advanced(
        0.6,
        "a frame below this share of the recent frames' median sharpness is lost where it also fits its keyframe badly",
        "by hand, for smoke and blur",
    )
    relocalisation_keyframes: NonNegativeInt = advanced(
        10, "recent keyframes in which a lost camera is relocalised; 0: off", "by hand"
    )
    search_every: PositiveInt = advanced(
        1, "a camera that was lost for more than 5 frames is looked for in every n-th one", "by hand"
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
    min_keyframe_motion: NonNegativeFloat = advanced(
        0.01,
        "a camera that has moved less since the keyframe, rad and translation over depth, needs no other one: its "
        "views triangulate nothing, and their errors are alike; 0: off",
        "chosen on cecum_t1_a (C3VD): 0.02 left keyframes out where the camera is slow",
    )
    keyframe_patience: NonNegativeInt = advanced(
        3, "frames that a keyframe waits longer where the picture is not clear", "by hand"
    )
    levels: PositiveInt = advanced(5, "levels of the image pyramid, factor 0.5", "the paper's section WEMA-RTDL")
    finest_level: Annotated[int, Field(ge=0, le=3)] = advanced(1, "0: full working size, 1: half", _CHOSEN)
    max_iterations: PositiveInt = advanced(30, "steps per pyramid level", "by hand")
    huber: PositiveFloat = advanced(
        1.0, "threshold of Huber's loss (1964), in robust standard deviations (MAD)", _CHOSEN
    )
    depth_weight: NonNegativeFloat = advanced(
        1.0, "weight of the point-to-plane distance to the frame's measured depth; 0: off", "by hand"
    )
    min_inlier_share: Share = advanced(
        0.4, "a frame with a smaller share is lost", "measured: unrelated fine texture has 0.37"
    )
    min_correlation: Annotated[float, Field(ge=-1, le=1)] = advanced(
        0.15,
        "a frame that correlates less with its keyframe is lost; -1: off",
        "measured: well tracked clips have 0.3 and more, tissue without structure 0.1 and less",
    )
    max_step: PositiveFloat = advanced(0.5, "largest motion between frames: rad, and mm over mean depth", "by hand")
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
