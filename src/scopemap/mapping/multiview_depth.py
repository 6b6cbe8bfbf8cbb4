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
from numba import njit

from scopemap.cameras.camera import PinholeCamera
from scopemap.flow.estimator import FlowEstimator
from scopemap.geometry.se3 import inverse

# Displacements in px per unit of ln depth that are aimed at: the median of all pixels, and that of the farthest fifth.
# Less is noise, more is hard to match.
_PARALLAX_PX, _FAR_PARALLAX_PX = (6.0, 14.0), (7.0,)
_MIN_PARALLAX_PX = 1.5
_FAR_PERCENTILE = 80
_MIN_OVERLAP = 0.5
# Frames before and after a keyframe among which its neighbours are sought, and the step of the pixels that tell.
_SEARCHED_FRAMES, _SAMPLED_EVERY = 150, 8
# Of flow along one axis; of one neighbour's ln depth (errors of poses are common to all pixels); of predicted ln depth.
_FLOW_SIGMA_PX, _VIEW_SIGMA, PRIOR_SIGMA = 0.3, 0.03, 0.3
# Above this median standard deviation tissue moves or poses are wrong: the predicted depth is better.
MAX_SIGMA = 0.08
_MAX_FLOW_PX, _MAX_LOG_FACTOR = 20.0, 0.5
_MIN_SPREAD = 4.0  # grey levels of normalised contrast, standard deviation
_CAUCHY, _ITERATIONS, _WARPS = 2.0, 4, 2
_CACHED_VIEWS = 24
# Standard deviations of Gaussian windows, px: of local contrast, of the disagreement's mean, of the result, and of
# the result where little is measured.
_CONTRAST_PX, _DISAGREEMENT_PX, _SMOOTHING_PX, _WIDE_PX = 6.0, 6.0, 2.0, 16.0
_MAX_CARRIED = 0.25  # larger differences between a frame's depth and its keyframe's are an occlusion


class StereoView(NamedTuple):
    """A frame for triangulation.

    contrast : (H, W, 3) uint8, grey values with normalised local contrast, from `normalised_contrast`. depth_mm :
    (H, W) float32, NaN = unknown or not usable. T_world_camera : (4, 4).
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


class _Projection(NamedTuple):
    """Pixels of a frame seen by another, each (H, W) float32.

    Position, px; depth there, mm; change of the position per unit of ln depth, px; whether it is usable.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    slope_x: np.ndarray
    slope_y: np.ndarray
    usable: np.ndarray


class _Estimate(NamedTuple):
    """One neighbour's ln factor of depth, its information (1 / variance, 0 = unknown), each (H, W) float32."""

    log_factor: np.ndarray
    information: np.ndarray


def normalised_contrast(rgb: np.ndarray) -> np.ndarray:
    """Return grey values (H, W, 3) uint8 without local mean and contrast, so that lamp and exposure cancel."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    centred = grey - cv2.GaussianBlur(grey, (0, 0), _CONTRAST_PX)
    spread = np.sqrt(cv2.GaussianBlur(centred**2, (0, 0), _CONTRAST_PX))
    normalised = np.clip(128 + 40 * centred / (spread + 2), 0, 255).astype(np.uint8)
    return cv2.merge([normalised] * 3)


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
    far = points[:, 2] >= np.percentile(points[:, 2], _FAR_PERCENTILE)
    for side in ([number for number in order if number < index], [number for number in order if number > index]):
        motions = [inverse(T_world_camera[number]) @ T_world_camera[index] for number in side]
        parallax = np.array([_parallax_px(points, far, camera, T) for T in motions]).reshape(-1, 2)
        for kind, wanted in ((0, _PARALLAX_PX), (1, _FAR_PARALLAX_PX)):
            for parallax_px in wanted:
                offset = np.abs(np.log(np.maximum(parallax[:, kind], 1e-9) / parallax_px))
                offset[parallax[:, kind] < _MIN_PARALLAX_PX] = np.inf
                if np.isfinite(offset).any() and side[int(np.argmin(offset))] not in chosen:
                    chosen.append(side[int(np.argmin(offset))])
    return chosen


def triangulate_depth(
    view: StereoView, neighbours: Iterable[StereoView], camera: PinholeCamera, flow: FlowEstimator
) -> TriangulatedDepth | None:
    """Return the triangulated depth of a view; None where its neighbours disagree or are fewer than two."""
    neighbours, usable = list(neighbours), np.isfinite(view.depth_mm)
    total = np.zeros_like(view.depth_mm)
    for _ in range(_WARPS):
        start = view._replace(depth_mm=view.depth_mm * np.exp(total))
        estimates = [found for n in neighbours if (found := _estimate(start, n, camera, flow)).information.any()]
        if len(estimates) < 2:
            return None
        stacks = (np.stack(parts) for parts in zip(*estimates, strict=True))
        log_factor, information, scatter, compared = _combined(*stacks)
        share, few = _blurred(compared, _DISAGREEMENT_PX), np.float32(0.01)  # where few can be compared depth stays
        with np.errstate(divide="ignore"):
            variance = (_blurred(scatter, _DISAGREEMENT_PX) + few * PRIOR_SIGMA**2) / (share + few) + 1 / information
        if not np.sqrt(np.median(variance[usable])) <= MAX_SIGMA:
            return None
        shrunk = (total + log_factor) * PRIOR_SIGMA**2 / (PRIOR_SIGMA**2 + variance)
        total = _smoothed(shrunk, information)
    sigma = np.sqrt(1 / (1 / variance + PRIOR_SIGMA**-2))
    return TriangulatedDepth(view.depth_mm * np.exp(total), sigma.astype(np.float32), total)


def carry_depth(
    depth_mm: np.ndarray, keyframes: Sequence[tuple[np.ndarray, TriangulatedDepth]], camera: PinholeCamera
) -> TriangulatedDepth:
    """Return the depth of a frame, corrected by what was triangulated at keyframes near it.

    depth_mm : (H, W) float32, NaN = unknown. keyframes : T_keyframe_camera (4, 4) and depth of each, at least one.
    """
    everywhere = np.ones(depth_mm.shape, bool)
    total, information = np.zeros_like(depth_mm), np.zeros_like(depth_mm)
    for T, triangulated in keyframes:
        seen = _project(depth_mm, everywhere, T, camera.fx, camera.fy, camera.cx, camera.cy)
        at_mm, at_sigma = (
            cv2.remap(image, seen.x, seen.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
            for image in (triangulated.depth_mm, triangulated.sigma)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            log_factor = np.log(at_mm / seen.z)
            same = (seen.usable > 0) & (np.abs(log_factor) < _MAX_CARRIED)
        weight = np.where(same, 1 / (at_sigma**2 + np.float32(_VIEW_SIGMA**2)), np.float32(0))
        total += weight * np.where(same, log_factor, np.float32(0))
        information += weight
    mean = np.divide(total, information, out=np.zeros_like(total), where=information > 0)
    # Keyframes err alike: their mean is not more certain than one of them.
    sigma = 1 / np.sqrt(information / len(keyframes) + np.float32(PRIOR_SIGMA**-2))
    log_factor = _smoothed(mean, information)
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
        self._stereo_view = lru_cache(_CACHED_VIEWS)(partial(self._read, view))
        self._camera, self._flow = camera, flow
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="depth")
        self._found: dict[int, Future[TriangulatedDepth | None]] = {}
        self.triangulated = 0
        """Number of keyframes whose depth was triangulated."""

    def depth(self, index: int, depth_mm: np.ndarray) -> TriangulatedDepth | None:
        """Return the depth of a frame, (H, W) mm, corrected by the keyframes before and after it; None without any.

        Numbers must not decrease from call to call.
        """
        place = bisect_right(self.keyframes, index)
        is_keyframe = place > 0 and self.keyframes[place - 1] == index
        around = self.keyframes[max(place - 1 - is_keyframe, 0) : place + 1]
        for keyframe in [*around, *self.keyframes[place + 1 : place + 2]]:
            if keyframe not in self._found:
                self._found[keyframe] = self._worker.submit(self._triangulate, keyframe)
        for keyframe in [number for number in self._found if number < around[0]]:
            del self._found[keyframe]
        if is_keyframe and (own := self._found[index].result()) is not None:
            return own
        known = [(number, found) for number in around if (found := self._found[number].result()) is not None]
        T_camera_world = inverse(self._poses[index])
        relative = [(inverse(T_camera_world @ self._poses[number]), found) for number, found in known]
        return carry_depth(depth_mm, relative, self._camera) if relative else None

    def close(self) -> None:
        """Stop the thread."""
        self._worker.shutdown(cancel_futures=True)

    @property
    def description(self) -> str:
        """A note on how many keyframes were triangulated; complete after the last frame."""
        rest = "; the others keep the predicted depth: views disagree (moving tissue, uncertain poses) or are too few"
        text = f"depth: {self.triangulated} of {len(self.keyframes)} keyframes triangulated against frames around them"
        return text + (rest if self.triangulated < len(self.keyframes) else "")

    def _read(self, view: Callable[[int], tuple[np.ndarray, np.ndarray]], index: int) -> StereoView:
        rgb, depth_mm = view(index)
        return StereoView(normalised_contrast(rgb), depth_mm, self._poses[index])

    def _triangulate(self, keyframe: int) -> TriangulatedDepth | None:
        view = self._stereo_view(keyframe)
        place = bisect_left(self._order, keyframe)
        near = self._order[max(0, place - _SEARCHED_FRAMES) : place + 1 + _SEARCHED_FRAMES]
        chosen = choose_neighbours(keyframe, view.depth_mm, self._camera, {n: self._poses[n] for n in near})
        found = triangulate_depth(view, [self._stereo_view(number) for number in chosen], self._camera, self._flow)
        self.triangulated += found is not None
        return found


def _parallax_px(
    points: np.ndarray, far: np.ndarray, camera: PinholeCamera, T_other_camera: np.ndarray
) -> tuple[float, float]:
    """Return the median parallax, px per unit of ln depth, of the points (n, 3) and of the far ones.

    0 where too few of them are seen by the other camera.
    """
    moved = points @ T_other_camera[:3, :3].T
    seen = moved + T_other_camera[:3, 3]
    depth = np.maximum(seen[:, 2], 1e-3)
    x, y = seen[:, 0] / depth, seen[:, 1] / depth
    u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
    inside = (seen[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    slope = np.hypot(camera.fx * (moved[:, 0] - x * moved[:, 2]), camera.fy * (moved[:, 1] - y * moved[:, 2])) / depth
    seen_far = inside & far
    all_px = float(np.median(slope[inside])) if inside.sum() > _MIN_OVERLAP * len(points) else 0.0
    return all_px, float(np.median(slope[seen_far])) if seen_far.sum() > _MIN_OVERLAP * far.sum() else 0.0


def _estimate(view: StereoView, neighbour: StereoView, camera: PinholeCamera, flow: FlowEstimator) -> _Estimate:
    """Return what a neighbour tells of a view's depth."""
    T = inverse(neighbour.T_world_camera) @ view.T_world_camera
    seen = _project(view.depth_mm, np.isfinite(neighbour.depth_mm), T, camera.fx, camera.fy, camera.cx, camera.cy)
    warped = cv2.remap(neighbour.contrast, seen.x, seen.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    warped = np.where(seen.usable[..., None] > 0, warped, view.contrast)
    found = flow.estimate(view.contrast, warped)
    log_factor, slope, across = _epipolar(found, seen.x, seen.y, seen.slope_x, seen.slope_y, seen.usable)
    # A neighbourhood that moves across the epipolar lines moves along them as well.
    variance_px = np.float32(_FLOW_SIGMA_PX**2) + across + _blurred(across, _DISAGREEMENT_PX)
    information = slope / (variance_px + np.float32(_VIEW_SIGMA**2) * slope)
    # Flow of a picture without texture is what it started from.
    grey = view.contrast[..., 0].astype(np.float32)
    spread = _blurred(grey**2, _DISAGREEMENT_PX) - _blurred(grey, _DISAGREEMENT_PX) ** 2
    return _Estimate(log_factor, np.where(spread > _MIN_SPREAD**2, information, np.float32(0)))


@njit(cache=True, nogil=True, error_model="numpy")
def _project(
    depth_mm: np.ndarray, known: np.ndarray, T: np.ndarray, fx: float, fy: float, cx: float, cy: float
) -> _Projection:
    """Project a frame's pixels into another; usable: known depth, seen at least 1 px inside, at `known` pixels."""
    height, width = depth_mm.shape
    planes = np.zeros((6, height, width), np.float32)
    for row in range(height):
        for col in range(width):
            depth = depth_mm[row, col]
            planes[0, row, col] = planes[1, row, col] = -1e4
            if not depth > 0:
                continue
            rx, ry = (col - cx) / fx, (row - cy) / fy
            mx = depth * (T[0, 0] * rx + T[0, 1] * ry + T[0, 2])
            my = depth * (T[1, 0] * rx + T[1, 1] * ry + T[1, 2])
            mz = depth * (T[2, 0] * rx + T[2, 1] * ry + T[2, 2])
            z = mz + T[2, 3]
            if z <= 1e-3:
                continue
            x, y = (mx + T[0, 3]) / z, (my + T[1, 3]) / z
            u, v = fx * x + cx, fy * y + cy
            planes[0, row, col], planes[1, row, col], planes[2, row, col] = u, v, z
            planes[3, row, col], planes[4, row, col] = fx * (mx - x * mz) / z, fy * (my - y * mz) / z
            if 1 <= u <= width - 2 and 1 <= v <= height - 2 and known[int(v + 0.5), int(u + 0.5)]:
                planes[5, row, col] = 1.0
    return _Projection(planes[0], planes[1], planes[2], planes[3], planes[4], planes[5])


@njit(cache=True, nogil=True, error_model="numpy")
def _epipolar(
    flow: np.ndarray, x: np.ndarray, y: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, usable: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split the flow to a warped neighbour: ln factor of depth, squared slope (0 = unknown), squared offset across."""
    height, width = x.shape
    planes = np.zeros((3, height, width), np.float32)
    log_factor, squared, across = planes[0], planes[1], planes[2]
    for row in range(height):
        for col in range(width):
            du, dv = flow[row, col, 0], flow[row, col, 1]
            u, v = col + du, row + dv
            inside = 0 <= u < width - 1 and 0 <= v < height - 1
            if usable[row, col] == 0 or not inside or max(abs(du), abs(dv)) > _MAX_FLOW_PX:
                continue
            i, j = int(v), int(u)
            if usable[i, j] + usable[i, j + 1] + usable[i + 1, j] + usable[i + 1, j + 1] < 4:
                continue
            s, t = u - j, v - i
            dx = (1 - t) * ((1 - s) * x[i, j] + s * x[i, j + 1]) + t * ((1 - s) * x[i + 1, j] + s * x[i + 1, j + 1])
            dy = (1 - t) * ((1 - s) * y[i, j] + s * y[i, j + 1]) + t * ((1 - s) * y[i + 1, j] + s * y[i + 1, j + 1])
            dx, dy = dx - x[row, col], dy - y[row, col]
            gx, gy = slope_x[row, col], slope_y[row, col]
            length = gx * gx + gy * gy
            if length > 0:
                log_factor[row, col] = (gx * dx + gy * dy) / length
                across[row, col] = (gx * dy - gy * dx) ** 2 / length
                squared[row, col] = length
    return log_factor, squared, across


@njit(cache=True, nogil=True, error_model="numpy")
def _combined(log_factor: np.ndarray, information: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Combine (N, H, W) estimates by Cauchy's M-estimator.

    Returns ln factor, information, the variance of one estimate, and 1 where that is known, each (H, W) float32.
    """
    count, height, width = log_factor.shape
    planes = np.zeros((4, height, width), np.float32)
    mean, total, scatter, compared = planes[0], planes[1], planes[2], planes[3]
    for row in range(height):
        for col in range(width):
            value, weight, views = 0.0, 0.0, 0
            for step in range(_ITERATIONS + 1):
                sum_weight, sum_value = 0.0, 0.0
                for n in range(count):
                    w = information[n, row, col]
                    if step > 0:
                        w /= 1 + w * (log_factor[n, row, col] - value) ** 2 / _CAUCHY**2
                    sum_weight += w
                    sum_value += w * log_factor[n, row, col]
                if sum_weight <= 0:
                    break
                value, weight = sum_value / sum_weight, sum_weight
            if weight <= 0:
                continue
            sum_weight, spread = 0.0, 0.0
            for n in range(count):
                w = information[n, row, col]
                views += w > 0
                sum_weight += w
                spread += w * min((log_factor[n, row, col] - value) ** 2, 1.0)
            mean[row, col], total[row, col] = value, weight
            if views > 1:
                scatter[row, col], compared[row, col] = spread / sum_weight * views / (views - 1), 1.0
    return mean, total, scatter, compared


def _blurred(image: np.ndarray, sigma_px: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), sigma_px)


def _smoothed(log_factor: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Return the mean of ln factors (H, W) over a small window, weighted by information.

    Where the window holds little information it tends to the mean over a large one, and to 0 where that holds none.
    """
    weighted = (log_factor * information).astype(np.float32)
    wide = _wide_mean(weighted) / (_wide_mean(information) + np.float32(1e-3 * PRIOR_SIGMA**-2))
    prior = np.float32(PRIOR_SIGMA**-2)
    mean = (_blurred(weighted, _SMOOTHING_PX) + prior * wide) / (_blurred(information, _SMOOTHING_PX) + prior)
    return np.clip(mean, -_MAX_LOG_FACTOR, _MAX_LOG_FACTOR)


def _wide_mean(image: np.ndarray) -> np.ndarray:
    """Return the mean over a wide Gaussian window, computed at a quarter of the size."""
    height, width = image.shape
    small = cv2.resize(image, (max(width // 4, 1), max(height // 4, 1)), interpolation=cv2.INTER_AREA)
    return cv2.resize(_blurred(small, _WIDE_PX / 4), (width, height), interpolation=cv2.INTER_LINEAR)
