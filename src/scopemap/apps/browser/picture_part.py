"""The video's own picture of the frame that is shown, in the scene in place of the surface, to click on."""

from __future__ import annotations

import numpy as np

from scopemap.apps.browser.frame_images import FrameImages
from scopemap.apps.browser.scene import quaternion
from scopemap.apps.browser.shown_result import ShownResult
from scopemap.engine.geometry.se3 import inverse, transform

_PICTURE = "/page/video_picture"
_BEHIND = 1.2
"""How far away the picture is, over the farthest of what the frame may see: marks on the surface are in front of it."""
_GONE = "The video is not where it was, and no picture of this frame was kept."


class PicturePart:
    """The switch between the surface and the picture.

    frame : the number of the frame whose picture is shown; None: the surface is.
    """

    def __init__(self, shown: ShownResult, images: FrameImages) -> None:
        self._shown, self._images, gui = shown, images, shown.window.gui
        self.frame: int | None = None
        self._far_mm = 1.0
        self._switch = shown.window.on(gui.add_checkbox("On the video's picture", False), lambda on: self._follow())
        self._switch.hint = "The frame as it was filmed, in place of the surface: a click is the place it shows"
        shown.follow(frame=self._follow)

    def ray(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the ray, origin and direction (3,), of a click: that of the frame's camera through the picture.

        A browser may look at the picture from elsewhere: its own ray meets the surface at another place. None beside
        the picture. Where the surface is shown, it is the click's own.
        """
        pose, camera = self._shown.pose, self._shown.whole.camera
        if self.frame is None or pose is None:
            return origin, direction
        start, along = transform(inverse(pose), origin[None])[0], pose[:3, :3].T @ direction
        if along[2] <= 0 or start[2] >= self._far_mm:
            return None
        place = start + (self._far_mm - start[2]) / along[2] * along
        pixel = camera.project(place[None])[0]
        inside = (pixel >= -0.5).all() and (pixel < [camera.width - 0.5, camera.height - 0.5]).all()
        return (pose[:3, 3], pose[:3, :3] @ place) if inside else None

    def _follow(self) -> None:
        """Show the picture of the frame that is shown, once it is read; or the surface again."""
        shown = self._shown
        if not self._switch.value or shown.pose is None:
            self._show_surface()
            if self._switch.value:
                shown.note("This frame has no pose in this submap: nothing can be measured in it.")
            return
        index = shown.index
        if index == self.frame:
            return
        self._show_surface()
        shown.window.job("reading the video", lambda: self._images.sharp(index), lambda rgb: self._show(index, rgb))

    def _show_surface(self) -> None:
        self.frame = None
        self._shown.window.scene.remove_by_name(_PICTURE)
        self._shown.show_model(shown=True)

    def _show(self, index: int, rgb: np.ndarray | None) -> None:
        shown, pose = self._shown, self._shown.pose
        if index != shown.index or pose is None or not self._switch.value:
            return
        if rgb is None:
            shown.note(_GONE)
            return
        self.frame, camera = index, shown.whole.camera
        points = shown.surface.vertices if not shown.surface.is_empty else shown.run.tracked["T_world_camera"][:, :3, 3]
        self._far_mm = far_mm = _BEHIND * max(
            float(transform(inverse(pose), points)[:, 2].max()), shown.surface.size_mm
        )
        # The middle of the first pixel is (0, 0), so that of the picture half a pixel less than half its size.
        middle = camera.unproject(np.array([(camera.width - 1) / 2, (camera.height - 1) / 2]))
        shown.window.scene.add_image(
            _PICTURE,
            rgb,
            camera.width / camera.fx * far_mm,
            camera.height / camera.fy * far_mm,
            cast_shadow=False,
            receive_shadow=False,
            wxyz=quaternion(pose),
            position=transform(pose, far_mm * middle[None])[0],
        )
        shown.show_model(shown=False)
        shown.look_from_frame()
