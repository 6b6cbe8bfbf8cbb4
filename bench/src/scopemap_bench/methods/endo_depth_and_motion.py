"""The tracker of Endo-Depth-and-Motion, re-derived: our own tracker with the parts taken off that it does not have.

Recasens, Lamarca, Facil, Montiel and Civera, "Endo-Depth-and-Motion: reconstruction and tracking in endoscopic videos
using depth networks and photometric constraints", RA-L 2021, arXiv 2103.16525. No code of that project was used.

Its abstract: pseudo-RGBD frames, tracked by photometric residuals. METHOD (arXiv 2508.11282 read closely, which grew
out of it) adds: the residual is lifted with the keyframe's depth, Gauss-Newton, rotation before the whole motion, and
a keyframe every 2 frames. It was measured elsewhere with two scales and a robust error, which are followed here.

Ours to choose, where neither gives a value: Huber's threshold (1.345 robust standard deviations, the usual one for 95 %
efficiency), the start of each alignment (no motion against the keyframe), the steps per scale (at most 30), and a
scale of half the working size for the rotation, then the working size for the motion. Grey values are compared as
they are: no gain, no bias, no lamp, no local normalisation. The method has no verdict on its result: a frame is lost
only where the image or its overlap with the keyframe is nearly empty, or the result is not finite.
"""

from __future__ import annotations

from scopemap.config.tracking import TrackingConstants, TrackingSettings
from scopemap.tracking.track import FrameTracker
from scopemap.tracking.tracker import Tracker

SETTINGS = TrackingSettings(
    keyframe_every=2,
    constants=TrackingConstants(
        min_sharpness=0.0,
        relocalisation_keyframes=0,
        search_every=1,
        new_map_after=0,
        corner_depth_sigma=0.0,
        min_keyframe_agreement=0.0,
        levels=2,
        finest_level=0,
        max_iterations=30,
        huber=1.345,
        depth_weight=0.0,
        min_inlier_share=0.0,
        min_correlation=-1.0,
        max_step=1e9,  # never reached
        solver="gauss-newton",
        rotation_first=True,
        start="identity",
        channels="grey",
        lamp_gamma=0.0,
        gain_bias=False,
    ),
)
"""Settings of our tracker for this method; all others have no effect or only detect empty images."""


def create_endo_depth_and_motion() -> FrameTracker:
    """Return a tracker after Endo-Depth-and-Motion's paper; the benchmark gives it plain depth."""
    return Tracker(SETTINGS)
