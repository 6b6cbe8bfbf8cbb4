"""Presets: what differs from the defaults."""

from __future__ import annotations

from typing import Any

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": {
        "input.focal": "assume",
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
    },
    "realtime": {
        "networks.flow": "dis",
        "networks.perceptual": "structure",
        "tracking.advanced.max_iterations": 15,
        "fusion.voxel_mm": 1.5,
        "fusion.truncation_mm": 5.0,
        "fusion.max_depth_mm": 100.0,
        "fusion.every": 2,
        "mapping.method": "none",
    },
}
