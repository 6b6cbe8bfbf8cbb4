"""Settings that earlier versions had, and what takes their place: a `config.toml` of theirs names them."""

from __future__ import annotations

from typing import Final

REMOVED: Final[dict[str, str]] = {
    "depth.reanchor_every": "",
    "mapping.moving_tissue": "",
    **{
        f"mask.{part.replace('-', '_')}": f"mask.method=no-{part}"
        for part in ("field-of-view", "highlights", "overlays", "exposure")
    },
    "fusion.weighted": "fusion.method=unweighted",
    "fusion.free_space": "fusion.method=no-free-space",
    **dict.fromkeys(("tracking.picture_checks", "tracking.pose_checks"), "tracking.checks"),
    **{
        f"tracking.{name}": "tracking.photometric"
        for name in ("start", "channels", "lamp_gamma", "gain_bias", "depth_weight")
    },
    **dict.fromkeys(("depth.fit_shift", "depth.disparity_floor"), "depth.fit"),
    **{f"mapis.{name}": "mapis.previous" for name in ("recursive", "compare_warped", "perceptual_score")},
    # Of the rest nobody chose a value: they are constants, with their last defaults.
    **{f"smoothing.{name}": "" for name in ("alpha", "beta", "gamma", "omega")},
    **{f"mapis.{name}": "" for name in ("filter_sigma_mm", "scale_pull", "sigma_fading", "tau", "constant_weight")},
    **{
        f"mapping.{name}": ""
        for name in (
            *("keyframe_gaps", "local_gaps", "correlated_observations", "depth_sigma_share", "scale_sigma"),
            *("rotation_sigma_deg", "translation_sigma_share"),
        )
    },
    **{
        f"tracking.{name}": ""
        for name in (
            *("min_texture", "min_sharpness", "min_correlation", "min_inlier_share", "max_step", "min_keyframe_motion"),
            *("keyframe_patience", "search_every", "max_iterations"),
        )
    },
    **{f"fusion.{name}": "" for name in ("min_incidence", "depth_sigma_share", "truncation_share", "min_weight")},
    **dict.fromkeys(("depth.shading_exponent", "mask.dark_level", "mask.files_grow_px"), ""),
}
"""By its dotted name, the setting that took its place, with the value where that is one; "" where none did."""
