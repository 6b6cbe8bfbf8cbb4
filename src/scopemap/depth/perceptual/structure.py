"""Local structural similarity (Wang et al., IEEE TIP 2004) as a distance: light, no weights."""

from __future__ import annotations

from importlib.metadata import version

import cv2
import numpy as np
from skimage.metrics import structural_similarity

from scopemap.depth.perceptual.distance import PerceptualResult
from scopemap.errors import check_shape


class StructureDistance:
    """One minus the structural similarity of the grey values in 7 x 7 px, clipped to 0..1."""

    name = "structure"

    def compare(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> PerceptualResult:
        """Compare two (H, W, 3) uint8 images of one size, 7 px or more on each side."""
        check_shape("rgb_a", rgb_a, (None, None, 3))
        check_shape("rgb_b", rgb_b, rgb_a.shape)
        grey_a, grey_b = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) for rgb in (rgb_a, rgb_b))
        _, similarity = structural_similarity(grey_a, grey_b, full=True, data_range=255.0)
        distance = np.clip(1.0 - similarity, 0.0, 1.0).astype(np.float32)
        return PerceptualResult(distance, float(distance.mean(dtype=np.float64)))

    def provenance(self) -> dict[str, str]:
        """Return the name and scikit-image's version."""
        return {"perceptual": self.name, "scikit-image": version("scikit-image")}
