"""ALIKE-t: learned local features (Zhao et al., arXiv 2112.02906), an ONNX graph (BSD-3, `alike.LICENSE.txt`)."""

from __future__ import annotations

from collections import deque
from functools import lru_cache
from importlib import resources

import cv2
import numpy as np
import onnxruntime

from scopemap.engine.errors import WeightsError
from scopemap.engine.flow.corners import usable_pixels
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.local_contrast import local_mean
from scopemap.engine.geometry.warp import bilinear
from scopemap.engine.models.device import open_network, runtime_of
from scopemap.engine.models.weights import sha256_of
from scopemap.engine.tracking.features import Features, points_at

STRIDE = 32  # of the network: both sides of its input are multiples
_NETWORK = "alike.onnx"
_MAPS = ["map1", "map2", "map3", "map4"]
_MAX_FEATURES = 1000  # by hand: twice those of SIFT: where tissue is bare, the weaker half holds a third of the matches
_RADIUS_PX = 2  # ALIKE's: of the surroundings of which a keypoint has the highest score
_TEMPERATURE = 0.1  # ALIKE's: of the soft argmax
# Local brightness that pictures are brought to, its width as a share of the picture's, and what is added to the dark.
_EVEN_LEVEL = 110.0  # by hand
_EVEN_SHARE = 1 / 16  # by hand
_DARKEST = 8.0  # by hand: grey levels
_LOW_RESOLUTION = 4  # by hand, for time: what it leaves out is as smooth
_MOST_KEPT = 32  # by hand: the keyframes in which a lost camera is searched among them


class AlikeFeatures:
    """ALIKE-t's keypoints and descriptors (64), matched as mutual nearest neighbours.

    Those of the last pictures are kept: tracking, relocalisation and loop closure ask for the same ones.
    device : as `open_network` takes it.
    """

    name, descriptor_size, max_ratio = "alike", 64, 1.0

    def __init__(self, device: str = "auto") -> None:
        self._device = device
        self._kept: deque[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = deque(maxlen=_MOST_KEPT)

    def detect(self, frame: Frame) -> Features:
        """Return at most 1000 features in the usable pixels of a frame, with depth if known; raises `WeightsError`."""
        pixels, descriptors = self._described(frame.rgb, frame.valid)
        return Features(pixels, descriptors, points_at(pixels, frame.depth_mm, frame.camera), max_ratio=self.max_ratio)

    def _described(self, rgb: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (N, 2) x, y and the descriptors (N, 64) of a picture."""
        for picture, usable, pixels, descriptors in tuple(self._kept):
            if picture is rgb and np.array_equal(usable, valid):
                return pixels, descriptors
        height, width = valid.shape
        scores, maps, head = network_answer(evenly_lit(rgb), self._device)
        pixels = _keypoints(scores[:height, :width], usable_pixels(valid))
        descriptors = descriptors_at(pixels, maps, head)
        self._kept.append((rgb, valid, pixels, descriptors))
        return pixels, descriptors

    def provenance(self) -> dict[str, str]:
        """Return the name, the network's hash, and the runtime; raises as `open_network` does for the device."""
        with resources.as_file(resources.files(__package__) / _NETWORK) as file:
            sha256 = sha256_of(file) if file.is_file() else ""
        facts = {"features": self.name, f"sha256 {_NETWORK}": sha256 or "missing"}
        return facts | ({"runtime": runtime_of(_network(self._device))} if sha256 else {})


def evenly_lit(rgb: np.ndarray) -> np.ndarray:
    """Return a picture (H, W, 3) uint8 over its local brightness: a dark lumen matches the bright tissue it becomes."""
    width = rgb.shape[1]
    brightest = cv2.max(cv2.max(rgb[..., 0], rgb[..., 1]), rgb[..., 2])
    sigma_px = _LOW_RESOLUTION * max(_EVEN_SHARE * (width // _LOW_RESOLUTION), 1.0)
    local = local_mean(brightest, sigma_px, downscale=_LOW_RESOLUTION)
    return np.clip(rgb * (_EVEN_LEVEL / (local + _DARKEST))[..., None], 0, 255).astype(np.uint8)


def network_answer(rgb: np.ndarray, device: str = "auto") -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Return the network's scores, features and head for a picture (H, W, 3) uint8 of any size.

    Scores (H', W') float32, 0..1, and features (16, H'/n, W'/n) at four scales n, of the picture continued at its right
    and lower side to multiples of `STRIDE`; and the descriptor's head (64, 64).
    """
    height, width = rgb.shape[:2]
    padded = np.pad(rgb, ((0, -height % STRIDE), (0, -width % STRIDE), (0, 0)), mode="edge")
    planes = np.ascontiguousarray(padded.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
    scores, head, *maps = _network(device).run(["scores", "head", *_MAPS], {"rgb": planes})
    return scores[0, 0], [features[0] for features in maps], head


def descriptors_at(pixels: np.ndarray, maps: list[np.ndarray], head: np.ndarray) -> np.ndarray:
    """Return the descriptors (N, 64) float32 of length 1 at pixels (N, 2) x, y, of what `network_answer` returned."""
    height, width = maps[0].shape[1:]
    parts = []
    for features in maps:
        # The corners of all scales lie on each other, as in the network's training.
        last = np.array([features.shape[2] - 1, features.shape[1] - 1])
        parts.append(bilinear(np.moveaxis(features, 0, -1), pixels * last / [width - 1, height - 1]))
    descriptors = np.concatenate(parts, 1) @ head.T
    return (descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)).astype(np.float32)


def _keypoints(scores: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) float64 x, y of the highest local maxima of scores (H, W) among the usable pixels."""
    side = 2 * _RADIUS_PX + 1
    highest = cv2.dilate(scores, np.ones((side, side), np.uint8)) == scores
    rows, columns = np.nonzero(highest & usable)
    chosen = np.argsort(-scores[rows, columns], kind="stable")[:_MAX_FEATURES]
    rows, columns = rows[chosen], columns[chosen]
    # Usable pixels are far enough from the border.
    around = np.arange(-_RADIUS_PX, _RADIUS_PX + 1)
    near = scores[rows[:, None, None] + around[:, None], columns[:, None, None] + around]
    weight = np.exp((near - scores[rows, columns][:, None, None]) / _TEMPERATURE)
    weight /= weight.sum((1, 2), keepdims=True)
    shift = np.column_stack([weight.sum(1) @ around, weight.sum(2) @ around])
    return np.column_stack([columns, rows]) + shift.astype(np.float64)


@lru_cache(maxsize=1)
def _network(device: str) -> onnxruntime.InferenceSession:
    file = resources.files(__package__) / _NETWORK
    try:
        return open_network(file.read_bytes(), device=device)
    except FileNotFoundError:
        raise WeightsError(
            f"loading ALIKE-t: this installation lacks {file}, which the package comes with; install it again, or "
            "choose networks.features=sift"
        ) from None
