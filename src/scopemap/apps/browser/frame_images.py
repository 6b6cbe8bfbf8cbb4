"""What is shown of a frame: its picture, its depth, and the surface seen from its pose, in one image."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from scopemap.apps.browser.result_view import ResultView
from scopemap.apps.browser.surface_colours import is_albedo, looking_frames
from scopemap.engine.fusion.agreement import lit_like
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.input.decoding import read_decoded
from scopemap.report.depth_figures import colour_depth

_WIDTH = 640
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

    def all_of(self, index: int) -> tuple[np.ndarray, str]:
        """Return one image of a frame, (h, 640, 3) uint8, and what it shows, in words."""
        view, words = self._view, []
        camera = view.whole.camera
        found = self.picture(index)
        picture = None
        if found is not None:
            number, picture = found
            words.append("picture" if number == index else f"picture of frame {number}, the nearest that was kept")
        depth_mm = view.run.depth.read(index)
        small = []
        if depth_mm is not None:
            near, far = self.depth_range_mm
            small.append(colour_depth(depth_mm, near, far))
            unit = " mm" if view.whole.scale_known else ""
            words.append(f"depth (blue {near:.3g}{unit}, red {far:.3g}{unit})")
        if view.pose is not None and not view.surface.is_empty:
            small.append(self._rendered(index, view.pose, picture, depth_mm))
            words.append("surface seen from there")
        height = round(_WIDTH * camera.height / camera.width)
        rows = [cv2.resize(picture, (_WIDTH, height), interpolation=cv2.INTER_AREA)] if picture is not None else []
        if small:
            half = (_WIDTH // 2, height // 2)
            empty = [np.full((half[1], half[0], 3), _EMPTY, np.uint8)] * (2 - len(small))
            rows.append(np.hstack([*(cv2.resize(one, half) for one in small), *empty]))
        return (np.vstack(rows) if rows else np.full((8, _WIDTH, 3), _EMPTY, np.uint8)), "; ".join(words)

    def _rendered(
        self, index: int, pose: np.ndarray, picture: np.ndarray | None, depth_mm: np.ndarray | None
    ) -> np.ndarray:
        """Return the surface (H, W, 3) uint8 from a pose, lit as the lamp lights the picture where that is known."""
        camera = self._view.whole.camera
        seen = render_mesh(self._view.surface.at(index), camera, pose)
        if picture is not None and depth_mm is not None and is_albedo(self._view.run):
            rgb = cv2.resize(picture, (camera.width, camera.height))
            seen = lit_like(seen, camera, rgb, depth_mm)
        return np.where(np.isnan(seen.depth_mm)[..., None], np.array(_EMPTY, np.uint8), seen.rgb)
