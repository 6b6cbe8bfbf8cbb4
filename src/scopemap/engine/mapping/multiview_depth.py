"""Multi-view depth: the depth of a keyframe, triangulated at every pixel against frames before and after it.

Poses are far more accurate than predicted depth. A neighbour, warped into the keyframe by pose and depth, differs from
it by a small flow; its part along the epipolar line measures the error of depth, its part across tests the poses and
the rigidity of the tissue. Estimates of several neighbours are combined by M-estimation, and what they disagree by is
the standard deviation: where they agree less than the predicted depth is uncertain, that depth stays.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache, partial
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.geometry.local_contrast import local_contrast, local_mean
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.mapping.triangulation import (
    VIEW_SIGMA,
    Intrinsics,
    add_comparison,
    combine,
    epipolar_error,
    parallax_px,
    project,
)
from scopemap.engine.notices import Notice

# Displacements in px per unit of ln depth that are aimed at: the median of all pixels, and that of the farthest fifth.
# Less is noise, more is hard to match.
_PARALLAX_PX = (10.0, 20.0)  # by hand
_FAR_PARALLAX_PX = (12.0,)  # by hand
_MIN_PARALLAX_PX = 1.5  # by hand
_FAR_PERCENTILE = 80  # by hand: the farthest fifth
# Frames before and after a keyframe among which its neighbours are sought, and the step of the pixels that tell.
_SEARCHED_FRAMES = 150  # by hand
_SAMPLED_EVERY = 8  # by hand, for time
# Standard deviations of flow along one axis, and of predicted ln depth.
_FLOW_SIGMA_PX = 0.3  # by hand
PRIOR_SIGMA = 0.3  # by hand: of predicted ln depth
# Above this median standard deviation the predicted depth is better. Below it each pixel takes what its own deviation
# allows: with .08 most keyframes of a still laparoscopy kept a depth that 4 % of its surface contradicted, with .2 3 %.
MAX_SIGMA = 0.2
_MAX_LOG_FACTOR = 0.5  # by hand: guard against wrong matches
_MIN_SPREAD = 4.0  # by hand: grey levels of normalised contrast, standard deviation
_WARPS = 2  # by hand: of each neighbour, the second from the depth that the first has found
# By hand: pixels of a row and a column are compared with keyframes; what depth is off by is smooth.
_PROPAGATED_EVERY = 2
# Keyframes to each side whose depth a frame takes over. With 1 the largest step of depth between frames was twice as
# large on cecum_t1_a and two phantoms (0.14 and 0.06 mm), and depth less accurate.
_REACH = 2
_CACHED_IMAGES = 24  # by hand, for memory: the result does not depend on it
# Standard deviations of Gaussian windows, px: of local contrast, of the disagreement's mean, of the result, and of
# the result where little is measured.
_CONTRAST_PX = 6.0  # by hand
_DISAGREEMENT_PX = 6.0  # by hand
_SMOOTHING_PX = 2.0  # by hand
_WIDE_PX = 16.0  # by hand


class PosedImage(NamedTuple):
    """A frame for triangulation.

    contrast : (H, W) uint8, grey values with normalised local contrast, from `normalised_contrast`. depth_mm : (H, W)
    float32, NaN = unknown or not usable. T_world_camera : (4, 4).
    """

    contrast: np.ndarray
    depth_mm: np.ndarray
    T_world_camera: np.ndarray


class TriangulatedDepth(NamedTuple):
    """Depth of a frame, each (H, W) float32.

    depth_mm : NaN where it was unknown or not usable. sigma : standard deviation of its ln. log_factor : ln of what the
    depth was multiplied by; continued where depth is not usable.
    """

    depth_mm: np.ndarray
    sigma: np.ndarray
    log_factor: np.ndarray


def normalised_contrast(rgb: np.ndarray) -> np.ndarray:
    """Return grey values (H, W) uint8 without local mean and contrast, so that lamp and exposure cancel."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    contrast = local_contrast(grey - local_mean(grey, _CONTRAST_PX), _CONTRAST_PX, unit=40.0, least=2.0)
    return np.clip(128 + contrast, 0, 255).astype(np.uint8)


def choose_neighbours(
    index: int, depth_mm: np.ndarray, camera: PinholeCamera, T_world_camera: Mapping[int, np.ndarray]
) -> list[int]:
    """Return the numbers of the frames that triangulate a frame's depth best: up to three before, three after it.

    index : of the frame. depth_mm : (H, W), NaN = unknown. T_world_camera : (4, 4) poses by number, of this frame, too.
    """
    points = (camera.rays * depth_mm[..., None])[::_SAMPLED_EVERY, ::_SAMPLED_EVERY].reshape(-1, 3)
    points = points[np.isfinite(points[:, 2])]
    if not len(points):
        return []
    order, chosen = sorted(T_world_camera), list[int]()
    far, size = points[:, 2] >= np.percentile(points[:, 2], _FAR_PERCENTILE), np.array([camera.width, camera.height])
    for side in ([number for number in order if number < index], [number for number in order if number > index]):
        poses = np.array([T_world_camera[number] for number in side]).reshape(-1, 4, 4)
        motions = inverse(poses) @ T_world_camera[index]
        parallax = parallax_px(points, far, motions, _intrinsics(camera), size)
        for kind, wanted in ((0, _PARALLAX_PX), (1, _FAR_PARALLAX_PX)):
            for wanted_px in wanted:
                offset = np.abs(np.log(np.maximum(parallax[:, kind], 1e-9) / wanted_px))
                offset[parallax[:, kind] < _MIN_PARALLAX_PX] = np.inf
                if np.isfinite(offset).any() and side[int(np.argmin(offset))] not in chosen:
                    chosen.append(side[int(np.argmin(offset))])
    return chosen


def triangulate_depth(
    image: PosedImage, neighbours: Iterable[PosedImage], camera: PinholeCamera, flow: FlowEstimator
) -> TriangulatedDepth | None:
    """Return the triangulated depth of an image; None where its neighbours disagree or are fewer than two."""
    neighbours, total, textured = list(neighbours), np.zeros_like(image.depth_mm), _textured(image.contrast)
    for _ in range(_WARPS):
        start = image._replace(depth_mm=image.depth_mm * np.exp(total))
        estimates = _estimates(start, textured, neighbours, camera, flow)
        if len(estimates) < 2:
            return None
        log_factor, information, scatter, compared = combine(*(np.stack(part) for part in zip(*estimates, strict=True)))
        known, few = _around(compared), np.float32(0.01)  # where few can be compared depth stays
        with np.errstate(divide="ignore"):
            variance = (_around(scatter) + few * PRIOR_SIGMA**2) / (known + few) + 1 / information
        if not np.sqrt(np.median(variance[np.isfinite(image.depth_mm)])) <= MAX_SIGMA:
            return None
        shrunk = (total + log_factor) * PRIOR_SIGMA**2 / (PRIOR_SIGMA**2 + variance)
        total = _smoothed(shrunk, information)
    sigma = np.sqrt(1 / (1 / variance + PRIOR_SIGMA**-2))
    return TriangulatedDepth(image.depth_mm * np.exp(total), sigma.astype(np.float32), total)


def propagate_depth(
    depth_mm: np.ndarray, keyframes: Sequence[tuple[np.ndarray, TriangulatedDepth, float]], camera: PinholeCamera
) -> TriangulatedDepth:
    """Return a frame's depth (H, W) mm, NaN = unknown, corrected by the depth of keyframes.

    keyframes : T_keyframe_camera (4, 4), depth, and weight of each. The weights add up to 1: keyframes err alike, so
    that their mean is not more certain than one of them.
    """
    height, width = depth_mm.shape
    total = np.zeros((2, -(-height // _PROPAGATED_EVERY), -(-width // _PROPAGATED_EVERY)), np.float32)
    for T, keyframe, weight in keyframes:
        add_comparison(total, depth_mm, T, _intrinsics(camera), keyframe.depth_mm, keyframe.sigma, weight)
    weighted, information = total
    mean = np.divide(weighted, information, out=np.zeros_like(weighted), where=information > 0)
    sigma = 1 / np.sqrt(information + np.float32(PRIOR_SIGMA**-2))
    log_factor = _smoothed(mean, information, 1 / _PROPAGATED_EVERY)
    log_factor, sigma = (_between(image, depth_mm.shape) for image in (log_factor, sigma))
    return TriangulatedDepth(depth_mm * np.exp(log_factor), sigma, log_factor)


class KeyframeDepths:
    """Depth of the keyframes of a submap, triangulated in a thread of its own, one keyframe ahead.

    view : returns picture (H, W, 3) uint8 and depth (H, W) mm of a frame by its number, from any thread; NaN = unknown
    or not usable. T_world_camera : (4, 4) pose of each frame by number. keyframes : numbers, increasing. flow : not to
    be used by another thread meanwhile.
    """

    def __init__(
        self,
        view: Callable[[int], tuple[np.ndarray, np.ndarray]],
        T_world_camera: Mapping[int, np.ndarray],
        keyframes: Sequence[int],
        camera: PinholeCamera,
        flow: FlowEstimator,
    ) -> None:
        self._poses, self._order, self.keyframes = T_world_camera, sorted(T_world_camera), list(keyframes)
        self._posed_image = lru_cache(_CACHED_IMAGES)(partial(self._read, view))
        self._camera, self._flow = camera, flow
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="depth")
        self._found: dict[int, Future[TriangulatedDepth | None]] = {}
        self.triangulated = 0
        """Number of keyframes whose depth was triangulated."""

    def depth(self, index: int, depth_mm: np.ndarray) -> TriangulatedDepth | None:
        """Return the depth of a frame, numbers not falling, (H, W) mm, corrected by keyframes around; or None."""
        place = bisect_right(self.keyframes, index)
        first, end = max(place - _REACH, 0), place + _REACH
        for keyframe in self.keyframes[first : end + 1]:
            if keyframe not in self._found:
                self._found[keyframe] = self._worker.submit(self._triangulate, keyframe)
        for keyframe in [number for number in self._found if number < self.keyframes[first]]:
            del self._found[keyframe]
        weights = self._weights(index, self.keyframes[first:end])
        known = [(n, found, weight) for n, weight in weights if (found := self._found[n].result()) is not None]
        total = sum(weight for _, _, weight in known)
        T_camera_world = inverse(self._poses[index])
        relative = [(inverse(T_camera_world @ self._poses[n]), found, weight / total) for n, found, weight in known]
        return propagate_depth(depth_mm, relative, self._camera) if relative else None

    def close(self) -> None:
        """Stop the thread."""
        self._worker.shutdown(cancel_futures=True)

    @property
    def notice(self) -> Notice:
        """How many keyframes were triangulated; complete after the last frame."""
        return Notice("depth-triangulated", {"triangulated": self.triangulated, "keyframes": len(self.keyframes)})

    def _read(self, view: Callable[[int], tuple[np.ndarray, np.ndarray]], index: int) -> PosedImage:
        rgb, depth_mm = view(index)
        return PosedImage(normalised_contrast(rgb), depth_mm, self._poses[index])

    def _weights(self, index: int, keyframes: Sequence[int]) -> list[tuple[int, float]]:
        """Return the keyframes that count in the depth of a frame, and how much: a tent over their order.

        It moves on with the frames. Were a keyframe to count alone at its own frame, depth would step there, to it and
        back.
        """
        place = np.interp(index, self.keyframes, np.arange(len(self.keyframes)))
        far = np.abs(np.searchsorted(self.keyframes, keyframes) - place)
        return [(n, float(1 - d / _REACH)) for n, d in zip(keyframes, far, strict=True) if d < _REACH]

    def _triangulate(self, keyframe: int) -> TriangulatedDepth | None:
        image = self._posed_image(keyframe)
        place = bisect_left(self._order, keyframe)
        near = self._order[max(0, place - _SEARCHED_FRAMES) : place + 1 + _SEARCHED_FRAMES]
        chosen = choose_neighbours(keyframe, image.depth_mm, self._camera, {n: self._poses[n] for n in near})
        found = triangulate_depth(image, map(self._posed_image, chosen), self._camera, self._flow)
        self.triangulated += found is not None
        return found


def _textured(contrast: np.ndarray) -> np.ndarray:
    """Return where a picture has texture, (H, W) bool: elsewhere flow is what it started from."""
    grey = contrast.astype(np.float32)
    found: np.ndarray = _around(grey**2) - _around(grey) ** 2 > _MIN_SPREAD**2
    return found


def _estimates(
    image: PosedImage,
    textured: np.ndarray,
    neighbours: Sequence[PosedImage],
    camera: PinholeCamera,
    flow: FlowEstimator,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return each neighbour's ln factor of an image's depth, and its information, 0 = unknown, (H, W) float32."""
    picture, found = cv2.merge([image.contrast] * 3), []
    for neighbour in neighbours:
        T = inverse(neighbour.T_world_camera) @ image.T_world_camera
        seen = project(image.depth_mm, np.isfinite(neighbour.depth_mm), T, _intrinsics(camera))
        warped = cv2.remap(neighbour.contrast, seen.x, seen.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        warped = np.where(seen.usable > 0, warped, image.contrast)
        log_factor, slope, across = epipolar_error(flow.estimate_small(picture, cv2.merge([warped] * 3)), seen)
        # A neighbourhood that moves across the epipolar lines moves along them as well.
        variance_px = np.float32(_FLOW_SIGMA_PX**2) + across + _around(across)
        information = slope / (variance_px + np.float32(VIEW_SIGMA**2) * slope)
        if (information := np.where(textured, information, np.float32(0))).any():
            found.append((log_factor, information))
    return found


def _intrinsics(camera: PinholeCamera) -> Intrinsics:
    return Intrinsics(float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))


def _between(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an image of every n-th pixel of a row and a column, interpolated at all pixels of `shape` (H, W)."""
    at = np.diag([1 / _PROPAGATED_EVERY, 1 / _PROPAGATED_EVERY, 1.0])[:2]
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, at, shape[::-1], flags=how, borderMode=cv2.BORDER_REPLICATE)


def _around(image: np.ndarray) -> np.ndarray:
    return local_mean(image, _DISAGREEMENT_PX, downscale=2)


def _blurred(image: np.ndarray, sigma_px: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), sigma_px)


def _smoothed(log_factor: np.ndarray, information: np.ndarray, share: float = 1.0) -> np.ndarray:
    """Return the mean of ln factors (H, W) over a small window, weighted by information.

    Where the window holds little information it tends to the mean over a large one, and to 0 where that holds none.
    share : size of the images over that of the picture.
    """
    weighted = (log_factor * information).astype(np.float32)
    wide = _wide_mean(weighted, share) / (_wide_mean(information, share) + np.float32(1e-3 * PRIOR_SIGMA**-2))
    prior, window_px = np.float32(PRIOR_SIGMA**-2), share * _SMOOTHING_PX
    mean = (_blurred(weighted, window_px) + prior * wide) / (_blurred(information, window_px) + prior)
    return np.clip(mean, -_MAX_LOG_FACTOR, _MAX_LOG_FACTOR)


def _wide_mean(image: np.ndarray, share: float) -> np.ndarray:
    """Return the mean over a wide Gaussian window, computed at a quarter of the picture's size."""
    (height, width), step = image.shape, max(1, round(4 * share))
    small = cv2.resize(image, (max(width // step, 1), max(height // step, 1)), interpolation=cv2.INTER_AREA)
    return cv2.resize(_blurred(small, _WIDE_PX / 4), (width, height), interpolation=cv2.INTER_LINEAR)
