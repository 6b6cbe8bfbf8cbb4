"""Corners of a frame, matched by optical flow and aligned patches of local contrast (Lucas, Kanade; Bouguet 2001)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.engine.errors import check_shape
from scopemap.engine.flow.estimator import FlowEstimator, FlowPair
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.local_contrast import local_contrast, local_mean
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.geometry.warp import bilinear

_CORNER_BLOCK_PX = 5  # by hand: window of a corner's strength
_BORDER_PX = 3  # by hand: corners keep so far from what is masked
_CELL_PX = 12  # by hand: the strongest corner of each cell of that size
_CONSISTENCY_PX = 1.0  # by hand: largest forward-backward error of flow, the default of `mapis.consistency_px`
# Of the corners that flow between small images must match, now and on average over some frames: where flow matches few,
# that between the whole images gives keyframes more in common.
_SMALL_COVERAGE = 0.5  # by hand
_FRAMES_BEFORE = 10  # by hand
_EXPECTED_PX = 8  # by hand: between the pixels of a flow that is only a start
_START_COVERAGE = 0.3  # by hand: of the corners that must be matched for the flow to be the next frame's start
# Refinement.
_SURROUND_PX = 8.0  # by hand: of the local mean and contrast
_DARKEST = 8.0  # by hand: grey levels added to the mean
_CONTRAST = 50.0  # by hand: grey levels of one local standard deviation
_LEAST_CONTRAST = 0.02  # by hand: smaller contrast is noise
_LOW_RESOLUTION = 4  # by hand: at which the surround is computed: what it leaves out is as smooth
_LEAST_EIGENVALUE = 1e-4  # OpenCV's default, minEigThreshold
_MAX_STEP_PX = 1.5  # by hand: from where flow has it
_MAX_COMPOSED_STEP_PX = 3.0  # by hand: from where composed flows have it
_WARP_SMOOTHING_PX = 10.0  # by hand: of the flow by which patches are warped
_PATCH_CONSISTENCY_PX = 0.5  # by hand: largest forward-backward error


class _Search(NamedTuple):
    """How a patch is aligned: its side, most steps, the step that ends it, how often it is halved to begin with.

    most_difference : grey levels, mean over the patch, above which it is another one.
    """

    patch_px: int
    steps: int
    last_step_px: float
    halvings: int = 0
    most_difference: float = math.inf


# By hand. The difference is half a local deviation: patches of real clips differ by 20 at most, those of noise by 25.
_THOROUGH = _Search(15, 20, 0.01, halvings=1, most_difference=_CONTRAST / 2)
_BACK = _Search(15, 20, 0.01)  # by hand
_QUICK = _Search(11, 10, 0.03)  # a third of the time, and poses of the same error


@dataclass(frozen=True)
class Correspondences2D3D:
    """Points of a reference frame, and the pixels of the current frame where optical flow observes them.

    points_mm : (N, 3) float64, in the camera of the reference. pixels : (N, 2) float64 x, y in the current frame.
    coverage : share of the reference's corners that were matched, 0..1. reference : index of the reference frame.
    """

    points_mm: np.ndarray
    pixels: np.ndarray
    coverage: float
    reference: int

    def __post_init__(self) -> None:
        check_shape("Correspondences2D3D.points_mm", self.points_mm, (None, 3))
        check_shape("Correspondences2D3D.pixels", self.pixels, (len(self.points_mm), 2))


class KeyframeMatcher:
    """Matches the corners of a keyframe with depth in other frames, by forward-backward consistent flow."""

    _keyframe: Frame | None = None
    _flows: FlowPair | None = None

    def __init__(self, flow: FlowEstimator) -> None:
        self.flow, self._usual_coverage = flow, 1.0
        self._small = np.zeros((0, 0, 3), np.uint8)  # the keyframe's picture at the size that was matched last
        self._patterns = np.zeros((0, 0), np.uint8)
        self._corners = np.zeros((0, 2), dtype=int)
        self._points_mm = np.zeros((0, 3))

    def set_keyframe(
        self, keyframe: Frame | None, frame: Frame | None = None, T_frame_keyframe: np.ndarray | None = None
    ) -> None:
        """Detect the corners of a frame, None: no keyframe; flow is searched from `T_frame_keyframe` (4, 4) first."""
        same, self._keyframe, self._flows = keyframe is self._keyframe, keyframe, None
        if keyframe is not None and frame is not None and T_frame_keyframe is not None:
            self._flows = expected_flow(keyframe, T_frame_keyframe), expected_flow(frame, inverse(T_frame_keyframe))
        if keyframe is None or same:
            return
        assert keyframe.depth_mm is not None
        self._patterns, self._small = normalised_brightness(keyframe.rgb), keyframe.rgb
        self._corners = detect_corners(keyframe, _CELL_PX)
        depth_mm = keyframe.depth_mm[self._corners[:, 1], self._corners[:, 0]]
        rays = keyframe.camera.unproject(self._corners.astype(np.float64))
        self._points_mm = (rays * depth_mm[:, None]).astype(np.float64)

    def match(self, frame: Frame) -> Correspondences2D3D | None:
        """Return the corners of the keyframe that are matched in a frame; None where the keyframe has none."""
        if self._keyframe is None or not len(self._corners):
            return None
        size = frame.valid.shape[::-1]
        small, matched = small_flow_size(self.flow, size), np.zeros(0, int)
        if small != size and self._usual_coverage >= _SMALL_COVERAGE:
            matched, pixels = self._aligned_in(frame, *self._matched_in(frame, small))
        if len(matched) < _SMALL_COVERAGE * len(self._corners):
            matched, pixels = self._matched_in(frame, size)
        coverage = len(matched) / len(self._corners)
        self._usual_coverage += (coverage - self._usual_coverage) / _FRAMES_BEFORE
        if coverage < _START_COVERAGE:
            self._flows = None
        return Correspondences2D3D(self._points_mm[matched], pixels, coverage, self._keyframe.index)

    def _matched_in(self, frame: Frame, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return which corners (m,) flow between images of a size matches, and their pixels (m, 2) in the frame."""
        assert self._keyframe is not None
        height, width = frame.valid.shape
        start = None if self._flows is None else (flow_at(self._flows[0], size), flow_at(self._flows[1], size))
        if self._small.shape[1::-1] != size:
            self._small = resized(self._keyframe.rgb, size)
        self._flows = self.flow.estimate_checked(self._small, resized(frame.rgb, size), start)
        whole = (flow_at(self._flows[0], (width, height)), flow_at(self._flows[1], (width, height)))
        return match_corners(self._corners, whole, frame.valid, _CONSISTENCY_PX)

    def _aligned_in(self, frame: Frame, matched: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which of the matched corners have a similar patch in a frame, and their pixels there."""
        if not len(matched):
            return matched, pixels
        patterns = normalised_brightness(frame.rgb)
        there, found = _aligned(self._patterns, patterns, self._corners[matched], pixels, _QUICK)
        near = found & (np.linalg.norm(there - pixels, axis=1) <= _MAX_STEP_PX)
        return matched[near], there[near].astype(np.float64)


def expected_flow(frame: Frame, T_other_frame: np.ndarray) -> np.ndarray:
    """Return the flow (h, w, 2), in its own pixels, that a motion gives a frame's points; coarse."""
    assert frame.depth_mm is not None
    height, width = (side // _EXPECTED_PX for side in frame.valid.shape)
    u, v = np.meshgrid(*((np.arange(side) + 0.5) * _EXPECTED_PX - 0.5 for side in (width, height)))
    pixels = np.stack([u, v], -1)
    depth_mm = frame.depth_mm[_EXPECTED_PX // 2 :: _EXPECTED_PX, _EXPECTED_PX // 2 :: _EXPECTED_PX][:height, :width]
    moved = transform(T_other_frame, (frame.camera.unproject(pixels.reshape(-1, 2)) * depth_mm.reshape(-1, 1)))
    with np.errstate(invalid="ignore", divide="ignore"):
        flow = (frame.camera.project(moved) - pixels.reshape(-1, 2)) / _EXPECTED_PX
    flow[~(moved[:, 2] > 0) | ~np.isfinite(flow).all(1)] = np.nan
    if not np.isfinite(flow).any():
        return np.zeros((height, width, 2), np.float32)
    return np.where(np.isfinite(flow), flow, np.nanmedian(flow, 0)).reshape(height, width, 2).astype(np.float32)


def small_flow_size(flow: FlowEstimator, size: tuple[int, int]) -> tuple[int, int]:
    """Return the size (width, height) of images, `size` or smaller, between which flow starts to align patches."""
    downscale = 1 if flow.enough_px is None else max(1, max(size) // flow.enough_px)
    return size[0] // downscale, size[1] // downscale


def resized(rgb: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return an image (H, W, 3) uint8 at a size (width, height) not larger."""
    return rgb if size == rgb.shape[1::-1] else cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)


def flow_at(flow: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return flow between images of another size (width, height)."""
    height, width = flow.shape[:2]
    if size == (width, height):
        return flow
    # In rows of x and y: numpy takes four times as long over pairs.
    factors = np.tile(np.array([size[0] / width, size[1] / height], np.float32), size[0])
    rows = cv2.resize(flow, size).reshape(size[1], -1) * factors
    return rows.reshape(size[1], size[0], 2)


def detect_corners(frame: Frame, cell_px: int) -> np.ndarray:
    """Return pixels (n, 2) int x, y: the strongest corner with depth of each cell of `cell_px` x `cell_px`.

    The strength is the smaller eigenvalue of the structure tensor (Shi and Tomasi, CVPR 1994). Every whole cell with
    usable tissue gives one unless it is constant: edges and shading are used where corners are few.
    """
    assert frame.depth_mm is not None
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    # On brightness relative to its surround: distant tissue is dark, not without texture.
    level = local_mean(grey.astype(np.float32), _SURROUND_PX) + _DARKEST
    strength = cv2.cornerMinEigenVal(grey / level, _CORNER_BLOCK_PX)
    usable = usable_pixels(frame.valid & (frame.depth_mm > 0) & np.isfinite(frame.depth_mm))
    strength = np.where(usable, strength, -1.0)
    height, width = (side // cell_px * cell_px for side in strength.shape)
    cells: np.ndarray = strength[:height, :width].reshape(height // cell_px, cell_px, width // cell_px, cell_px)
    cells = cells.transpose(0, 2, 1, 3).reshape(-1, cell_px * cell_px)
    best = cells.argmax(1)
    row, column = np.divmod(np.arange(len(cells)), width // cell_px)
    pixels = np.column_stack([column * cell_px + best % cell_px, row * cell_px + best // cell_px])
    return pixels[cells.max(1) > 0]


def usable_pixels(valid: np.ndarray) -> np.ndarray:
    """Return where features may be, (H, W) bool: those at the edge of a mask or a highlight are not the tissue's."""
    border = np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(valid.astype(np.uint8), border, borderValue=0) > 0)


def match_corners(
    corners: np.ndarray, flows: tuple[np.ndarray, np.ndarray], valid: np.ndarray, consistency_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return which corners (m,) int are matched in another frame, and their pixels (m, 2) float64 there.

    corners : (n, 2) int x, y. flows : (H, W, 2) px to the other frame, and back. valid : (H, W) bool, its usable
    pixels. consistency_px : largest forward-backward error.
    """
    start = corners.astype(np.float32)
    pixel = start + flows[0][corners[:, 1], corners[:, 0]]
    backward = pixel + sample_flow(flows[1], pixel)
    height, width = valid.shape
    nearest = np.clip(np.rint(pixel).astype(int), 0, [width - 1, height - 1])
    inside = ((pixel >= 0) & (pixel <= [width - 1, height - 1])).all(1)
    good = inside & valid[nearest[:, 1], nearest[:, 0]]
    good &= np.linalg.norm(backward - start, axis=1) <= consistency_px
    matched = np.flatnonzero(good)
    return matched, pixel[matched].astype(np.float64)


def sample_flow(flow: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Return the flow (n, 2) at pixels (n, 2), bilinear; NaN outside."""
    inside = ((pixel >= 0) & (pixel <= [flow.shape[1] - 1, flow.shape[0] - 1])).all(axis=1, keepdims=True)
    return np.where(inside, bilinear(flow, np.where(inside, pixel, 0.0)), np.nan)


def normalised_brightness(rgb: np.ndarray) -> np.ndarray:
    """Return grey values (H, W) uint8 of an (H, W, 3) uint8 image, less their local mean, over their local contrast."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    relative = grey / (local_mean(grey, _SURROUND_PX, downscale=_LOW_RESOLUTION) + _DARKEST) - 1
    contrast = local_contrast(relative, _SURROUND_PX, unit=_CONTRAST, least=_LEAST_CONTRAST, downscale=_LOW_RESOLUTION)
    return np.clip(128 + contrast, 0, 255).astype(np.uint8)


def refined_corners(
    image_from: np.ndarray, image_to: np.ndarray, corners: np.ndarray, pixels: np.ndarray, flow: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which corners (m,) int have a similar patch in the other image, and their pixels (m, 2) float64 there.

    image_from, image_to : (H, W) uint8, `normalised_brightness`. corners : (n, 2) x, y in the first. pixels : (n, 2)
    in the second, as matched by flow (H, W, 2), px, from the first, which may be composed.
    """
    if not len(corners):
        return np.zeros(0, int), np.zeros((0, 2))
    # What comes nearer grows: a patch that is only shifted lags behind. The other image is warped by the smooth flow.
    x, y = np.meshgrid(*(np.arange(side, dtype=np.float32) for side in image_from.shape[::-1]))
    smooth = [local_mean(part, _WARP_SMOOTHING_PX, downscale=4) for part in cv2.split(flow)]
    seen = np.stack([smooth[0] + x, smooth[1] + y], -1)
    warped = cv2.remap(image_to, seen[..., 0], seen[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    start = corners + pixels - seen[corners[:, 1], corners[:, 0]]
    there, found = _aligned(image_from, warped, corners, start, _THOROUGH)
    back, found_back = _aligned(warped, image_from, there, corners, _BACK)
    good = found & found_back & (np.linalg.norm(there - start, axis=1) <= _MAX_COMPOSED_STEP_PX)
    kept = np.flatnonzero(good & (np.linalg.norm(back - corners, axis=1) <= _PATCH_CONSISTENCY_PX))
    return kept, bilinear(seen, there[kept].astype(np.float64))


def _aligned(
    image_from: np.ndarray, image_to: np.ndarray, places: np.ndarray, start: np.ndarray, search: _Search
) -> tuple[np.ndarray, np.ndarray]:
    """Where patches around places (n, 2) are in another image, searched from `start` (n, 2), and whether found (n,)."""
    first, last = (np.ascontiguousarray(p, np.float32).reshape(-1, 1, 2).copy() for p in (places, start))
    moved, status, difference = cv2.calcOpticalFlowPyrLK(
        image_from,
        image_to,
        first,
        last,
        winSize=(search.patch_px, search.patch_px),
        maxLevel=search.halvings,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, search.steps, search.last_step_px),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_LEAST_EIGENVALUE,
    )
    return moved.reshape(-1, 2), (status.ravel() > 0) & (difference.ravel() <= search.most_difference)
