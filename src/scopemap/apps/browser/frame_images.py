"""What is shown of a frame: its picture, its depth, and the surface seen from its pose, in one image."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from scopemap.apps.browser.marks import CLICKED
from scopemap.apps.browser.result_view import ResultView
from scopemap.apps.browser.surface_colours import is_albedo, looking_frames
from scopemap.engine.fusion.agreement import lit_like
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.input.decoding import read_decoded
from scopemap.report.depth_figures import colour_depth

_WIDTH = 960
_LETTERS = 0.85
_CAPTION_PX = 32
_MARK_PX = 14
_EMPTY = (58, 66, 76)
_PERCENTILES = (2, 98)


class FrameImages:
    """Images of the frames of a result, as `ResultView` shows it."""

    def __init__(self, view: ResultView) -> None:
        self._view = view
        self._reread: dict[int, np.ndarray] = {}

    @cached_property
    def depth_range_mm(self) -> tuple[float, float]:
        """Depth at the ends of the colours: blue, red."""
        depths = [frame.depth_mm[::4, ::4].ravel() for frame in looking_frames(self._view.whole)]
        known = np.concatenate([*depths, np.empty(0, np.float32)])
        known = known[np.isfinite(known)]
        near, far = np.percentile(known, _PERCENTILES) if len(known) else (1.0, 100.0)
        return float(near), float(max(far, 1.2 * near))

    def picture(self, index: int) -> tuple[int, np.ndarray] | None:
        """Return the picture (h, w, 3) uint8 of a frame, or that of the nearest one that has one, and its number."""
        if index in self._reread:
            return index, self._reread[index]
        whole = self._view.whole
        if not whole.pictured:
            return None
        nearest = min(whole.pictured, key=lambda number: abs(number - index))
        found = read_decoded(whole.picture_file(nearest))
        return None if found is None else (nearest, np.ascontiguousarray(found[..., :3][..., ::-1]))

    def keep(self, index: int, rgb: np.ndarray) -> None:
        """Keep the picture of a frame that was read again from the input."""
        self._reread[index] = rgb

    def all_of(self, index: int, mark: np.ndarray | None = None) -> np.ndarray:
        """Return one image of a frame, (h, 960, 3) uint8: its picture, beside it its depth and the surface from there.

        Each says what it is. mark : pixel (2,) that is marked in all of them.
        """
        view, camera = self._view, self._view.whole.camera
        found, depth_mm, parts = self.picture(index), view.run.depth.read(index), []
        picture = None if found is None else found[1]
        if found is not None:
            is_own = found[0] == index
            parts.append(("picture" if is_own else f"picture of frame {found[0]}", found[1], is_own))
        if depth_mm is not None:
            near, far = self.depth_range_mm
            unit = " mm" if view.whole.scale_known else ""
            parts.append((f"depth {near:.2g}-{far:.2g}{unit}", colour_depth(depth_mm, near, far), True))
        if view.pose is not None and not view.surface.is_empty:
            parts.append(("surface", self._rendered(view.pose, picture, depth_mm), True))
        if not parts:
            return np.full((8, _WIDTH, 3), _EMPTY, np.uint8)
        # One large at the left, two of half its size at the right.
        size = (_WIDTH * 2 // 3, round(_WIDTH * 2 / 3 * camera.height / camera.width))
        half = (_WIDTH - size[0], size[1] // 2)
        tiles = [
            _tile(image, size if number == 0 else half, words, mark if is_own else None, camera.width)
            for number, (words, image, is_own) in enumerate(parts)
        ]
        tiles += [np.full((half[1], half[0], 3), _EMPTY, np.uint8)] * (3 - len(tiles))
        out = np.full((size[1], _WIDTH, 3), _EMPTY, np.uint8)
        out[:, : size[0]] = tiles[0]
        out[: half[1], size[0] :], out[half[1] : 2 * half[1], size[0] :] = tiles[1], tiles[2]
        return out

    def _rendered(self, pose: np.ndarray, picture: np.ndarray | None, depth_mm: np.ndarray | None) -> np.ndarray:
        """Return the surface (H, W, 3) uint8 from a pose, lit as the lamp lights the picture where that is known."""
        camera = self._view.whole.camera
        seen = render_mesh(self._view.surface.mesh, camera, pose)
        if picture is not None and depth_mm is not None and is_albedo(self._view.run):
            rgb = cv2.resize(picture, (camera.width, camera.height))
            seen = lit_like(seen, camera, rgb, depth_mm)
        return np.where(np.isnan(seen.depth_mm)[..., None], np.array(_EMPTY, np.uint8), seen.rgb)


def _tile(image: np.ndarray, size: tuple[int, int], words: str, mark: np.ndarray | None, width: int) -> np.ndarray:
    """Return an image in a size (width, height), its caption below, with a ring at a pixel of a picture so wide."""
    out = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
    low = size[1] - _CAPTION_PX
    out[low:] = out[low:] // 3
    at = (8, size[1] - 9)
    cv2.putText(out, words, at, cv2.FONT_HERSHEY_SIMPLEX, _LETTERS, (255, 255, 255), 2, cv2.LINE_AA)
    if mark is not None:
        place = np.round((np.asarray(mark) + 0.5) * size[0] / width).astype(int).tolist()
        cv2.circle(out, place, _MARK_PX, (255, 255, 255), 5, cv2.LINE_AA)
        cv2.circle(out, place, _MARK_PX, CLICKED, 3, cv2.LINE_AA)
    return out
