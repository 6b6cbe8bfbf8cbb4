"""The video's own picture of the frame that is shown, in the scene in place of the surface, to click on."""

from __future__ import annotations

import numpy as np

from scopemap.apps.browser.frame_images import FrameImages
from scopemap.apps.browser.result_view import ResultView
from scopemap.apps.browser.scene import quaternion
from scopemap.engine.geometry.se3 import inverse, transform

_PICTURE = "/page/video_picture"
_BEHIND = 1.2
"""How far away the picture is, over the farthest of what the frame may see: marks on the surface are in front of it."""
_GONE = "The video is not where it was, and no picture of this frame was kept."


class PicturePart:
    """The switch between the surface and the picture.

    frame : the number of the frame whose picture is shown; None: the surface is.
    """

    def __init__(self, view: ResultView, images: FrameImages) -> None:
        self._view, self._images, gui = view, images, view.window.gui
        self.frame: int | None = None
        self._far_mm = 1.0
        self._switch = view.window.on(gui.add_checkbox("On the video's picture", False), lambda on: self._follow())
        self._switch.hint = "The frame as it was filmed, in place of the surface: a click is the place it shows"
        view.follow(frame=self._follow)

    def ray(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the ray, origin and direction (3,), of a click: that of the frame's camera through the picture.

        A browser may look at the picture from elsewhere: its own ray meets the surface at another place. None beside
        the picture. Where the surface is shown, it is the click's own.
        """
        pose, camera = self._view.pose, self._view.whole.camera
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
        view = self._view
        if not self._switch.value or view.pose is None:
            self._show_surface()
            if self._switch.value:
                view.note("This frame has no pose in this submap: nothing can be measured in it.")
            return
        index = view.index
        if index == self.frame:
            return
        self._show_surface()
        view.window.job("reading the video", lambda: self._images.sharp(index), lambda rgb: self._show(index, rgb))

    def _show_surface(self) -> None:
        self.frame = None
        self._view.window.scene.remove_by_name(_PICTURE)
        self._view.show_model(shown=True)

    def _show(self, index: int, rgb: np.ndarray | None) -> None:
        view, pose = self._view, self._view.pose
        if index != view.index or pose is None or not self._switch.value:
            return
        if rgb is None:
            view.note(_GONE)
            return
        self.frame, camera = index, view.whole.camera
        points = view.surface.vertices if not view.surface.is_empty else view.run.tracked["T_world_camera"][:, :3, 3]
        self._far_mm = far_mm = _BEHIND * max(float(transform(inverse(pose), points)[:, 2].max()), view.surface.size_mm)
        # The middle of the first pixel is (0, 0), so that of the picture half a pixel less than half its size.
        middle = camera.unproject(np.array([(camera.width - 1) / 2, (camera.height - 1) / 2]))
        view.window.scene.add_image(
            _PICTURE,
            rgb,
            camera.width / camera.fx * far_mm,
            camera.height / camera.fy * far_mm,
            cast_shadow=False,
            receive_shadow=False,
            wxyz=quaternion(pose),
            position=transform(pose, far_mm * middle[None])[0],
        )
        view.show_model(shown=False)
        view.look_from_frame()
