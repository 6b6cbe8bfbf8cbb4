"""What is shown of a frame: its picture, its depth, and the surface seen from its pose, in one image."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from scopemap.apps.browser.marks import CLICKED
from scopemap.apps.browser.shown_result import ShownResult
from scopemap.apps.browser.surface_colours import is_albedo, looking_frames
from scopemap.engine.errors import InputError
from scopemap.engine.fusion.agreement import lit_like
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.input.decoding import read_decoded
from scopemap.report.depth_figures import colour_depth
from scopemap.runner.reread_frames import sharp_picture

_WIDTH = 1440
_HEIGHT = 240
_LETTERS = 0.6
_CAPTION_PX = 24
_MARK_PX = 12
_EMPTY = (58, 66, 76)
_PERCENTILES = (2, 98)
_MOST_SHARP = 12
"""Pictures at the video's resolution that are kept: 6 MB each of a large video."""


class FrameImages:
    """Images of the frames of a result, as `ShownResult` shows it."""

    def __init__(self, shown: ShownResult) -> None:
        self._shown = shown
        self._reread: dict[int, np.ndarray] = {}

    @cached_property
    def depth_range_mm(self) -> tuple[float, float]:
        """Depth at the ends of the colours: red, blue."""
        depths = [frame.depth_mm[::4, ::4].ravel() for frame in looking_frames(self._shown.whole)]
        known = np.concatenate([*depths, np.empty(0, np.float32)])
        known = known[np.isfinite(known)]
        near, far = np.percentile(known, _PERCENTILES) if len(known) else (1.0, 100.0)
        return float(near), float(max(far, 1.2 * near))

    def picture(self, index: int) -> tuple[int, np.ndarray] | None:
        """Return the picture (h, w, 3) uint8 of a frame, or that of the nearest one that has one, and its number."""
        if index in self._reread:
            return index, self._reread[index]
        whole = self._shown.whole
        if not whole.pictured:
            return None
        nearest = min(whole.pictured, key=lambda number: abs(number - index))
        found = read_decoded(whole.picture_file(nearest))
        return None if found is None else (nearest, np.ascontiguousarray(found[..., :3][..., ::-1]))

    def sharp(self, index: int) -> np.ndarray | None:
        """Return the picture (h, w, 3) uint8 of a frame at the video's resolution, which takes time and is kept.

        Where the input is gone, that which the run kept of this frame; None for none.
        """
        if index not in self._reread:
            try:
                found = sharp_picture(self._shown.whole.folder, index)
            except InputError:
                found = None
            if found is None:
                kept = self.picture(index)
                return kept[1] if kept is not None and kept[0] == index else None
            self._reread = dict([*self._reread.items(), (index, found)][-_MOST_SHARP:])
        return self._reread[index]

    def all_of(self, index: int, mark: np.ndarray | None = None) -> np.ndarray:
        """Return one image of a frame, (h, 1440, 3) uint8: its picture, its depth and the surface from there.

        Each says what it is. mark : pixel (2,) that is marked in all of them.
        """
        shown, camera = self._shown, self._shown.whole.camera
        found, depth_mm, parts = self.picture(index), shown.run.depth.read(index), []
        picture = None if found is None else found[1]
        if found is not None:
            is_own = found[0] == index
            parts.append(("picture" if is_own else f"picture of frame {found[0]}", found[1], is_own))
        if depth_mm is not None:
            near, far = self.depth_range_mm
            words = depth_words(near, far, scale_known=shown.whole.scale_known)
            parts.append((words, colour_depth(depth_mm, near, far), True))
        if shown.pose is not None and not shown.surface.is_empty:
            parts.append(("surface", self._rendered(shown.pose, picture, depth_mm), True))
        if not parts:
            return np.full((8, _WIDTH, 3), _EMPTY, np.uint8)
        # Beside each other, so high that there is room for three.
        height = min(_HEIGHT, round(_WIDTH / 3 * camera.height / camera.width))
        size = round(height * camera.width / camera.height), height
        tiles = [_tile(image, size, words, mark if is_own else None, camera.width) for words, image, is_own in parts]
        out = np.full((_HEIGHT, _WIDTH, 3), _EMPTY, np.uint8)
        left = (_WIDTH - len(tiles) * size[0]) // 2
        for number, tile in enumerate(tiles):
            out[: size[1], left + number * size[0] : left + (number + 1) * size[0]] = tile
        return out

    def _rendered(self, pose: np.ndarray, picture: np.ndarray | None, depth_mm: np.ndarray | None) -> np.ndarray:
        """Return the surface (H, W, 3) uint8 from a pose, lit as the lamp lights the picture where that is known."""
        camera = self._shown.whole.camera
        seen = render_mesh(self._shown.surface.mesh, camera, pose)
        if picture is not None and depth_mm is not None and is_albedo(self._shown.run):
            rgb = cv2.resize(picture, (camera.width, camera.height))
            seen = lit_like(seen, camera, rgb, depth_mm)
        return np.where(np.isnan(seen.depth_mm)[..., None], np.array(_EMPTY, np.uint8), seen.rgb)


def depth_words(near_mm: float, far_mm: float, *, scale_known: bool) -> str:
    """Return what the colours of depth mean, in mm, or where the scale is unknown in multiples of the nearest depth."""
    if scale_known:
        return f"depth {near_mm:.2g} to {far_mm:.2g} mm, near red"
    return f"depth, far is {far_mm / near_mm:.2g} times near, near red"


def _tile(image: np.ndarray, size: tuple[int, int], words: str, mark: np.ndarray | None, width: int) -> np.ndarray:
    """Return an image in a size (width, height), its caption below, with a ring at a pixel of a picture so wide."""
    out = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
    low = size[1] - _CAPTION_PX
    out[low:] = out[low:] // 3
    at = (8, size[1] - 7)
    cv2.putText(out, words, at, cv2.FONT_HERSHEY_SIMPLEX, _LETTERS, (255, 255, 255), 2, cv2.LINE_AA)
    if mark is not None:
        place = np.round((np.asarray(mark) + 0.5) * size[0] / width).astype(int).tolist()
        cv2.circle(out, place, _MARK_PX, (255, 255, 255), 5, cv2.LINE_AA)
        cv2.circle(out, place, _MARK_PX, CLICKED, 3, cv2.LINE_AA)
    return out
