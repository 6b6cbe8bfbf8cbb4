"""Follows the corners of a keyframe into the frames after it."""

from __future__ import annotations

import numpy as np

from scopemap.flow.corners import corners, followed
from scopemap.flow.estimator import FlowEstimator
from scopemap.frame import Correspondences2D3D, Frame

_CELL_PX = 12


class CornerFollower:
    """Finds the corners of one frame, a keyframe with depth, in others, by flow there and back."""

    def __init__(self, flow: FlowEstimator, consistency_px: float) -> None:
        self._flow, self._consistency_px = flow, consistency_px
        self._keyframe: Frame | None = None
        self._places = np.zeros((0, 2), dtype=int)
        self._points_mm = np.zeros((0, 3))

    def start(self, keyframe: Frame) -> None:
        """Take the corners of a frame with depth; those of the one before are forgotten."""
        assert keyframe.depth_mm is not None
        self._keyframe, self._places = keyframe, corners(keyframe, _CELL_PX)
        depth_mm = keyframe.depth_mm[self._places[:, 1], self._places[:, 0]]
        self._points_mm = keyframe.camera.unproject(self._places.astype(np.float64)) * depth_mm[:, None]

    def find(self, frame: Frame) -> Correspondences2D3D | None:
        """Return the corners that flow finds in a frame; None where there is nothing to follow."""
        if self._keyframe is None or not len(self._places):
            return None
        flows = self._flow.estimate_both(self._keyframe.rgb, frame.rgb)
        number, pixels = followed(self._places, flows, frame.valid, self._consistency_px)
        share = len(number) / len(self._places)
        return Correspondences2D3D(self._points_mm[number].astype(np.float64), pixels, share, self._keyframe.index)
