"""Presets: what differs from the defaults."""

from __future__ import annotations

from typing import Any

_PAPER: dict[str, Any] = {
    "input.skip_duplicates": False,
    "mask.method": "no-overlays",
    "depth.method": "paper",
    "depth.backend": "depth-anything",
    "depth.anchor": "depth-pro",
    "mapis.method": "paper",
    "networks.flow": "raft-large",
    "networks.perceptual": "lpips",
    "tracking.method": "paper",
    "tracking.camera_at_rest": False,
    "tracking.keyframe_every": 2,
    "smoothing.method": "wema",
    "mapping.method": "none",
    "fusion.every": 1,
    "fusion.voxel_mm": 1.0,
    "fusion.truncation_mm": 5.0,
    "fusion.max_depth_mm": 100.0,
    "fusion.colours": "raw",
    "fusion.holes": "none",
}
# What the text does not have and can be turned off (docs/method.md lists both): `paper` with these values.
_BEYOND_PAPER: dict[str, Any] = {
    "input.longest_side_px": 0,
    "mask.method": "no-overlays+no-field-of-view+no-highlights+no-exposure",
    "mask.files": "none",
    "mask.instruments": "off",
    "depth.method": "paper+no-disparity-floor+network-focal",
    "depth.model": "LiheYoung/depth-anything-small-hf",
    "depth.max_depth_mm": 10000.0,
    "mapis.method": "paper+no-flow-check",
    "tracking.method": "paper+least-squares+no-pose-checks",
    "fusion.method": "unweighted+all-components",
    "fusion.max_depth_mm": 300.0,
}

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": _PAPER,
    "paper-strict": _PAPER | _BEYOND_PAPER,
    "realtime": {
        "depth.method": "realtime",
        "tracking.method": "realtime",
        "mapping.method": "realtime",
    },
}
