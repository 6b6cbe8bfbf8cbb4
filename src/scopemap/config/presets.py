"""Presets: what differs from the defaults."""

from __future__ import annotations

from typing import Any

_PAPER: dict[str, Any] = {
    "input.skip_duplicates": False,
    "mask.overlays": False,
    "depth.backend": "depth-anything",
    "depth.anchor": "depth-pro",
    "depth.paper.fit_shift": False,
    "mapis.paper.order": "refine-first",
    "mapis.advanced.frame_scale": "none",
    "mapis.paper.blend": "linear",
    "mapis.paper.recursive": False,
    "mapis.paper.compare_warped": False,
    "mapis.paper.perceptual_score": True,
    "networks.flow": "raft-large",
    "networks.perceptual": "lpips",
    "tracking.keyframe_every": 2,
    "tracking.advanced.min_keyframe_agreement": 0.0,
    "tracking.advanced.finest_level": 0,
    "tracking.paper.channels": "grey",
    "tracking.paper.lamp_gamma": 0.0,
    "tracking.paper.gain_bias": False,
    "tracking.advanced.depth_weight": 0.0,
    "tracking.advanced.corner_depth_sigma": 0.0,
    "tracking.min_sharpness": 0.0,
    "tracking.advanced.min_correlation": -1.0,
    "tracking.relocalisation_keyframes": 0,
    "tracking.new_map_after": 0,
    "tracking.paper.start": "identity",
    "smoothing.method": "wema",
    "mapping.method": "none",
    "fusion.voxel_mm": 1.0,
    "fusion.truncation_mm": 5.0,
    "fusion.max_depth_mm": 100.0,
    "fusion.colours": "raw",
    "fusion.holes": "none",
}
# What the text does not have and can be turned off (docs/method.md lists both): `paper` with these values.
_BEYOND_PAPER: dict[str, Any] = {
    "input.longest_side_px": 0,
    "mask.field_of_view": False,
    "mask.highlights": False,
    "mask.files": "none",
    "mask.advanced.exposure": False,
    "depth.model": "LiheYoung/depth-anything-small-hf",
    "depth.max_depth_mm": 10000.0,
    "depth.paper.disparity_floor": 0.0,
    "depth.paper.depth_pro_focal": "network",
    "mapis.advanced.consistency_px": 1e6,
    "tracking.min_valid_share": 0.001,
    "tracking.advanced.huber": 1e6,
    "tracking.advanced.min_inlier_share": 0.0,
    "tracking.advanced.max_step": 1e6,
    "fusion.max_depth_mm": 300.0,
    "fusion.advanced.weighted": False,
    "fusion.advanced.min_incidence": 0.0,
    "fusion.advanced.truncation_share": 0.0,
    "fusion.advanced.min_weight": 0.0,
    "fusion.advanced.min_component_share": 0.0,
}

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": _PAPER,
    "paper-strict": _PAPER | _BEYOND_PAPER,
    "realtime": {
        "tracking.search_every": 3,
        "tracking.advanced.max_iterations": 15,
        "fusion.voxel_mm": 1.5,
        "fusion.truncation_mm": 5.0,
        "fusion.max_depth_mm": 100.0,
        "fusion.every": 2,
        "mapping.method": "none",
    },
}
