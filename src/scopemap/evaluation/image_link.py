"""What the images alone tell of two consecutive frames: ORB matches, flow, and where the flow's ends look alike.

No depth enters, so that every method's depth is measured on the same points and pixels (`consistency.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape
from scopemap.evaluation.depth_change import looks_alike
from scopemap.evaluation.orb import Matches, OrbFeatures, match_features, orb_features


@dataclass(frozen=True)
class ImageLink:
    """What the images tell of a frame and the one before it; the same for every method.

    Attributes
    ----------
    matches : ORB matches between them.
    to_previous : (H, W, 2) px, pixel p of this frame is seen at p + to_previous(p) in the previous one; None: no flow.
    consistent : (H, W) bool, where that flow is trusted; None without flow.
    alike : (H, W) bool, where moreover both images have the same colour, as OPW wants it; None without flow.
    """

    matches: Matches
    to_previous: np.ndarray | None
    consistent: np.ndarray | None
    alike: np.ndarray | None


class ImageLinker:
    """Links each image to the one before it; keeps that one only."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera
        self._previous: tuple[np.ndarray, OrbFeatures] | None = None

    def link(
        self,
        rgb: np.ndarray,
        valid: np.ndarray,
        to_previous: np.ndarray | None = None,
        consistent: np.ndarray | None = None,
    ) -> ImageLink | None:
        """Return the link to the image of the call before, None at the first.

        Parameters
        ----------
        rgb : (H, W, 3) uint8; valid : (H, W) bool, True where it shows usable tissue.
        to_previous : (H, W, 2) px flow to the previous image, if known; the same source for all methods.
        consistent : (H, W) bool, where the flow passed its forward-backward check; None: not checked, all count.
        """
        size = (self._camera.height, self._camera.width)
        check_shape("rgb", rgb, (*size, 3))
        check_shape("valid", valid, size)
        previous, self._previous = self._previous, (rgb, orb_features(rgb, valid))
        if previous is None:
            return None
        matches = match_features(previous[1], self._previous[1], self._camera)
        if to_previous is None:
            return ImageLink(matches, None, None, None)
        check_shape("to_previous", to_previous, (*size, 2))
        trusted = np.ones(size, dtype=bool) if consistent is None else consistent
        check_shape("consistent", trusted, size)
        alike = trusted & looks_alike(previous[0], rgb, to_previous)
        return ImageLink(matches, to_previous, trusted, alike)
