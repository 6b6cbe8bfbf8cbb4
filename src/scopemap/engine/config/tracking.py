"""Settings of tracking and of pose smoothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from scopemap.engine.config.settings import StageSettings, constants_of


@dataclass(frozen=True)
class TrackingConstants:
    """Constants of tracking."""

    min_valid_share: float = 0.1  # a frame with a smaller usable overlap is lost
    # From the 11th frame in a row with less texture on, as `tracking.pyramid.texture` has it, a frame is lost without
    # being looked at further: noise has 0.32, a wall that is touched up to 0.45. 0: off.
    min_texture: float = 0.5
    # A frame below this share of the recent frames' median sharpness is lost where it also fits its keyframe badly.
    min_sharpness: float = 0.6
    relocalisation_keyframes: int = 10  # recent ones in which a lost camera is relocalised; 0: off
    search_every: int = 1  # a camera that was lost for more than 5 frames is looked for in every n-th one
    new_map_after: int = 5  # sharp frames lost in a row; 0: never
    corner_depth_sigma: float = 0.2  # relative, of predicted depth in reprojection errors; 0: no corners
    # A frame becomes a keyframe early where its inlier share times overlap falls below this share of what it was for
    # the keyframe's first frame; 0: off.
    min_keyframe_agreement: float = 0.7
    # A camera that has moved less since the keyframe, rad and translation over depth, needs no other one: its views
    # triangulate nothing, and their errors are alike. 0: off.
    min_keyframe_motion: float = 0.01
    keyframe_patience: int = 3  # frames that a keyframe waits longer where the picture is not clear
    levels: int = 5  # of the pyramid, factor 0.5
    finest_level: int = 1  # 0: full working size, 1: half
    max_iterations: int = 30  # per pyramid level
    huber: float = 1.0  # threshold in robust standard deviations (MAD)
    depth_weight: float = 1.0  # of the point-to-plane distance to the frame's measured depth; 0: off
    min_inlier_share: float = 0.4  # a frame with a smaller share is lost; unrelated fine texture: 0.37
    min_correlation: float = 0.15  # a frame that correlates less with its keyframe is lost; -1: off
    max_step: float = 0.5  # largest motion between frames: rad, and mm over mean depth
    solver: Literal["dogleg", "gauss-newton"] = "dogleg"  # of the photometric error
    rotation_first: bool = True  # SO(3) only at the coarsest level
    start: Literal["identity", "previous"] = "previous"  # first guess: the keyframe's pose, or the previous frame's
    channels: Literal["grey", "both"] = "both"  # both: also grey values minus local mean over local deviation
    lamp_gamma: float = 0.35  # grey = (cosine / distance^2)^gamma; sRGB alone: 0.45; 0.35 was better; 0: off
    gain_bias: bool = True  # estimate gain and bias of each frame pair


TRACKING: dict[str, dict[str, Any]] = {
    "scopemap": {},
    "paper": {
        **{"min_sharpness": 0.0, "relocalisation_keyframes": 0, "new_map_after": 0, "corner_depth_sigma": 0.0},
        **{"min_keyframe_agreement": 0.0, "finest_level": 0, "depth_weight": 0.0, "min_correlation": -1.0},
        **{"min_keyframe_motion": 0.0, "keyframe_patience": 0, "min_texture": 0.0},
        **{"start": "identity", "channels": "grey", "lamp_gamma": 0.0, "gain_bias": False},
    },
    "least-squares": {"huber": 1e6},
    "no-pose-checks": {"min_valid_share": 0.001, "min_texture": 0.0, "min_inlier_share": 0.0, "max_step": 1e6},
    "realtime": {"search_every": 3, "max_iterations": 15},
    "no-corners": {"corner_depth_sigma": 0.0},
    "no-early-keyframes": {"min_keyframe_agreement": 0.0},
    "no-depth-distance": {"depth_weight": 0.0},
    "grey-only": {"channels": "grey"},
    "no-lamp": {"lamp_gamma": 0.0},
    "no-gain-bias": {"gain_bias": False},
    "no-rotation-stage": {"rotation_first": False},
    "gauss-newton": {"solver": "gauss-newton"},
    "full-resolution": {"finest_level": 0},
}


class TrackingSettings(StageSettings):
    """Tracking against the keyframe: WEMA-RTDL of the paper."""

    METHODS = TRACKING
    method: str = Field("scopemap", description="constants of tracking")
    camera_at_rest: bool = Field(
        False, description="the camera does not move: poses stay the first one, every frame has a surface (surfaces/)"
    )
    keyframe_every: int = Field(
        10, ge=1, description="every n-th frame becomes a keyframe, once the camera has moved (the paper: 2)"
    )
    constants: TrackingConstants = constants_of(TrackingConstants(), TRACKING)


@dataclass(frozen=True)
class SmoothingConstants:
    """Constants of WEMA."""

    alpha: float = 0.6  # weights of the poses i, i-1 and i-2; their sum is 1
    beta: float = 0.3
    gamma: float = 0.1
    omega: float = 0.1  # s = 1 - exp(-i omega); frames count from 0
    dynamic: bool = True  # False: s = 1 (the paper's ablation without DyEMA)


SMOOTHING: dict[str, dict[str, Any]] = {"none": {}, "wema": {}, "wema-constant": {"dynamic": False}}


class SmoothingSettings(StageSettings):
    """WEMA: weighted mean of the last three poses, on the group (equation 13 of the paper)."""

    METHODS = SMOOTHING
    method: str = Field("none", description="wema: smooth poses; wema-constant: with weights that do not change")
    constants: SmoothingConstants = constants_of(SmoothingConstants(), SMOOTHING)
