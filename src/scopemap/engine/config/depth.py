"""Settings of depth, its consistency over time, and the networks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from scopemap.engine.config.settings import Settings, StageSettings, constants_of


@dataclass(frozen=True)
class DepthConstants:
    """Constants of the metric anchor and of shading depth."""

    reanchor_every: int = 0  # fit the metric anchor every n-th frame, best a multiple of keyframe_every; 0: once
    shading_exponent: float = 0.6  # distance = k * brightness^-exponent
    fit_shift: bool = True  # fit scale and shift to the anchor; False: the pseudo-stereo baseline
    # Pixels below this share of the largest disparity (the far end) are left out of the fit of the pseudo-stereo
    # baseline; 0: only those without disparity (the paper).
    disparity_floor: float = 0.1
    # Focal length that scales Depth Pro's depth: of the frames' camera, or the one that Depth Pro finds (the paper).
    depth_pro_focal: Literal["camera", "network"] = "camera"
    network_every: int = 1  # the network looks at every n-th frame; flow carries its depth to those between
    factor: float = 30.0  # anchor = factor: the nearest tissue of frame 1 is at 1000 mm / factor


DEPTH: dict[str, dict[str, Any]] = {
    "scopemap": {},
    "paper": {"fit_shift": False},
    "no-disparity-floor": {"disparity_floor": 0.0},
    "network-focal": {"depth_pro_focal": "network"},
    "factor-100": {"factor": 100.0},
    "factor-1000": {"factor": 1000.0},
    "reanchored": {"reanchor_every": 10},
    "realtime": {"network_every": 2},
}


class DepthSettings(StageSettings):
    """Where depth comes from and what fixes its scale."""

    METHODS = DEPTH
    method: str = Field("scopemap", description="constants of the metric anchor")
    backend: str = Field(
        "scopenet",
        description="scopenet | shading | depth-anything | depth-pro | files:FOLDER | stereo (of input.stereo=use)",
    )
    model: str = Field(
        "", description="weights of the network: hub id or folder, for scopenet a .onnx file; empty: the default"
    )
    anchor_model: str = Field("", description="weights of Depth Pro as anchor, hub id or folder; empty: the default")
    anchor: Literal["auto", "near-far", "depth-pro", "shading", "factor"] = Field(
        "auto",
        description="metric anchor in frame 1; auto: near-far where given, else the network's own mm, else shading",
    )
    near_far_mm: tuple[float, float] | None = Field(
        None, description="nearest and farthest tissue in frame 1, mm; replaces a preset's anchor by near-far"
    )
    shading_median_mm: float = Field(
        35.0, gt=0, description="anchor = shading: assumed median distance of tissue in frame 1, mm"
    )
    files_kind: Literal["auto", "disparity", "depth", "measured"] = Field(
        "auto",
        description="kind of depth files; auto: 8 bit is disparity, else measured; depth: predicted, scale may float",
    )
    files_scale_mm: float | None = Field(
        None, gt=0, le=1e6, description="mm per unit of depth files; unset: from the calibration, else 1"
    )
    max_depth_mm: float = Field(
        300.0, gt=0, description="predicted depth beyond this is unknown, unless near-far names a farther one, mm"
    )
    constants: DepthConstants = constants_of(DepthConstants(), DEPTH)

    @property
    def is_anchored(self) -> bool:
        """Whether a range, another estimator or a factor fixes the millimetres of frame 1, not the estimate itself."""
        return self.near_far_mm is not None or self.anchor not in ("auto", self.backend)


@dataclass(frozen=True)
class MapisConstants:
    """Constants of depth consistency."""

    # Scale of each frame's depth: robust: median ratio to the warped previous depth; none: 1; auto: robust for
    # predicted depth, none for measured.
    frame_scale: Literal["auto", "none", "robust"] = "auto"
    # Share of ln of that scale removed per frame where no pixel has a warped depth; decreases with the square of the
    # warped share; 0: off.
    scale_pull: float = 0.1
    sigma_fading: float = 0.3  # growth of the warped depth's variance per frame, share of its gap to the frame's
    filter_sigma_px: float = 2.0  # sigma_d of the bilateral filter; 0: off
    filter_sigma_mm: float = 2.0  # sigma_r of the bilateral filter
    consistency_px: float = 1.0  # largest forward-backward error of flow; inf: not checked (the paper)
    # refine-first: warp depth values unchanged, then track (the paper).
    order: Literal["track-first", "refine-first"] = "track-first"
    # Weight of the warped depth; auto: linear for predicted depth, none for measured.
    blend: Literal["auto", "none", "exponential", "linear", "constant", "paper-equation"] = "auto"
    tau: float = 0.15  # exponential blend: LPIPS distance at which the weight is 1/e
    constant_weight: float = 0.5  # constant blend: weight of the warped depth
    recursive: bool = True  # warp the refined previous depth; False: the raw one (the paper)
    compare_warped: bool = True  # perceptual distance to the warped previous image; False: as it is (the paper)
    perceptual_score: bool = False  # one perceptual score per pair instead of a map (the paper)


MAPIS: dict[str, dict[str, Any]] = {
    "scopemap": {},
    "paper": {
        **{"frame_scale": "none", "order": "refine-first", "blend": "linear"},
        **{"recursive": False, "compare_warped": False, "perceptual_score": True},
    },
    "no-flow-check": {"consistency_px": math.inf},
    "no-frame-scale": {"frame_scale": "none"},
    "no-blend": {"blend": "none"},
    "exponential-blend": {"blend": "exponential"},
    "constant-blend": {"blend": "constant"},
    "paper-equation": {"blend": "paper-equation"},
    "refine-first": {"order": "refine-first"},
}


class MapisSettings(StageSettings):
    """Depth consistency over time: MAPIS-Depth of the paper."""

    METHODS = MAPIS
    method: str = Field("scopemap", description="constants of depth consistency")
    constants: MapisConstants = constants_of(MapisConstants(), MAPIS)


class NetworkSettings(Settings):
    """Optical flow, features and perceptual distance."""

    flow: str = Field(
        "dis",
        description="flow from frame to frame: dis | raft-small | raft-large (both with the extra `networks` and their "
        "weights) | none",
    )
    keyframe_flow: str = Field(
        "dis",
        description="flow between keyframes and from the keyframe to the frame, the same names; none: no corners, "
        "and a back end without observations",
    )
    perceptual: Literal["lpips", "structure"] = Field(
        "structure",
        description="perceptual distance, structure: local structural similarity, no weights; lpips: AlexNet (with the "
        "extra `networks` and its weights)",
    )
    features: Literal["alike", "sift"] = Field(
        "alike",
        description="features for relocalisation, loop closure and map merging, alike: ALIKE-t, learned, part of the "
        "package; sift: OpenCV's",
    )
    device: str = Field(
        "auto",
        pattern=r"^(auto|cpu|cuda(:\d+)?|mps|xpu)$",
        description="where the networks of the extra `networks` run: auto | cpu | cuda; scopenet: on the CPU",
    )
