"""Settings of tracking and of pose smoothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from scopemap.engine.config.settings import Methods, Share, StageSettings, advanced

# The clips on which the tracker was chosen, with their truth (BENCHMARK.md).
_CHOSEN = "chosen on cecum_t1_a (C3VD) and four phantoms"


@dataclass(frozen=True)
class Photometry:
    """What photometric alignment compares, and where it starts.

    normalised : also grey values minus local mean over local deviation. lamp_gamma : grey = (cosine /
    distance^2)^gamma; 0: off. gain_bias : estimate gain and bias of each frame pair. depth_weight : weight of the
    point-to-plane distance to the frame's measured depth; 0: off. from_previous : the first guess is the previous
    frame's pose, else the keyframe's.
    """

    normalised: bool
    lamp_gamma: float
    gain_bias: bool
    depth_weight: float
    from_previous: bool


PHOTOMETRIES = {
    # The channels, gain and bias were chosen on cecum_t1_a (C3VD) and four phantoms; gamma on four phantoms over 0.45,
    # which sRGB alone would give. The rest is by hand.
    "scopemap": Photometry(True, 0.35, True, 1.0, True),
    # arXiv 2508.11282, section WEMA-RTDL: grey values alone, from the keyframe's pose.
    "paper": Photometry(False, 0.0, False, 0.0, False),
}


class TrackingSettings(StageSettings):
    """Tracking against the keyframe: WEMA-RTDL of the paper."""

    METHODS: ClassVar[Methods] = {
        "scopemap": {},
        "paper": {
            "checks": "poses",
            "relocalisation_keyframes": 0,
            "new_map_after": 0,
            "corner_depth_sigma": 0.0,
            "min_keyframe_agreement": 0.0,
            "keyframes_wait": False,
            "finest_level": 0,
            "photometric": "paper",
        },
        "least-squares": {"huber": 1e6},
        "no-pose-checks": {"min_valid_share": 0.001, "checks": "none"},
        "realtime": {"fast": True},
    }
    method: str = Field("scopemap", description="chooses advanced settings (below): scopemap, realtime, paper, ...")
    camera_at_rest: bool | None = Field(
        None,
        description="the camera does not move: poses stay the first one, every frame has a surface (surfaces/); "
        "mapping.method is none then; default: where the data set states it",
    )
    keyframe_every: int = Field(
        10, ge=1, description="every n-th frame becomes a keyframe, once the camera has moved (the paper: 2)"
    )

    min_valid_share: Share = advanced(0.1, "a frame with a smaller usable overlap with its keyframe is lost", "by hand")
    checks: Literal["all", "poses", "none"] = advanced(
        "all",
        "which frames are lost, poses: those that few pixels fit, or whose pose is a jump; all: also those with little "
        "texture, unsharp ones, and those unlike their keyframe (correlation); none: neither",
        "by hand; the paper has none",
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
    solver: Literal["dogleg", "gauss-newton"] = advanced(
        "dogleg", "minimiser of the photometric error", "the paper's section WEMA-RTDL, subsection Optimisation"
    )
    rotation_first: bool = advanced(
        True,
        "SO(3) only at the coarsest level",
        "the paper, Rotation-Translation Decoupling",
    )
    photometric: Literal["scopemap", "paper"] = advanced(
        "scopemap",
        "what photometric alignment compares, paper: grey values, from the keyframe's pose on; scopemap: also locally "
        "normalised values, with the lamp's fall-off, gain and bias, and measured depth, from the previous pose on",
        _CHOSEN,
    )

    @property
    def photometry(self) -> Photometry:
        """What photometric alignment compares, and where it starts."""
        return PHOTOMETRIES[self.photometric]

    @property
    def picture_checks(self) -> bool:
        """Whether a frame with little texture, an unsharp one, and one unlike its keyframe is lost."""
        return self.checks == "all"

    @property
    def pose_checks(self) -> bool:
        """Whether a frame that few pixels fit, or whose pose is a jump, is lost."""
        return self.checks != "none"


class SmoothingSettings(StageSettings):
    """WEMA: weighted mean of the last three poses, on the group (equation 13 of the paper)."""

    METHODS: ClassVar[Methods] = {"none": {}, "wema": {}}
    method: str = Field("none", description="wema: smooth poses")

    dynamic: bool = advanced(True, "false: s = 1 (the paper's ablation without DyEMA)", "the paper's section WEMA")
