"""OpenIGTLink: poses, pictures and the surface for 3D Slicer, PLUS and whatever else speaks it, by pyigtl (extra igtl).

    CameraToWorld   TRANSFORM  takes a point in the camera (x right, y down, z forward, mm) to the world in RAS, mm
    Image_Camera    IMAGE      the picture on the plane z = 10 mm of the camera: put it under CameraToWorld
    Surface_World   POLYDATA   the surface so far, RAS, mm
    Status          STRING     "tracking", or "lost: " and the reason

RAS is (-x, -y, z) of scopemap's world, as in `scopemap export --axes ras`: right, anterior and superior are true for a
patient on the back, seen from the feet by an upright camera that looks towards the head.
"""

from __future__ import annotations

import signal
from typing import Any

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import InputError

RAS_FROM_WORLD = np.diag([-1.0, -1.0, 1.0, 1.0])
PLANE_MM = 10.0
"""Distance from the camera at which the picture is put."""

_MOST_WAITING = 4  # messages; a client that is slower than the frames gets fewer of them


class IgtlServer:
    """Sends to one client at localhost; `InputError` without pyigtl or port. To be made in the main thread."""

    def __init__(self, port: int) -> None:
        try:
            import pyigtl
        except ImportError:
            raise InputError("sending by OpenIGTLink needs pyigtl: pip install -e '.[igtl]'") from None
        self._messages: Any = pyigtl.messages
        # pyigtl takes the signals; how a run ends is decided elsewhere.
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            self._server = pyigtl.OpenIGTLinkServer(port=port, local_server=True)
        except OSError as error:
            raise InputError(f"cannot send on port {port}: {error.strerror or error}; choose another one") from None
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)

    @property
    def connected(self) -> bool:
        """Whether there is a client."""
        return bool(self._server.is_connected())

    def send_frame(self, rgb: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray | None, lost: str) -> None:
        """Send a picture (H, W, 3) uint8 of a camera, its pose (4, 4) mm, and why it is lost, "" where it is not."""
        if T_world_camera is not None:
            matrix = RAS_FROM_WORLD @ T_world_camera
            self._send(self._messages.TransformMessage(matrix, device_name="CameraToWorld"))
        scale = PLANE_MM / np.array([camera.fx, camera.fy])
        placed = np.diag([*scale, 1.0, 1.0])
        placed[:3, 3] = -camera.cx * scale[0], -camera.cy * scale[1], PLANE_MM
        image = np.ascontiguousarray(rgb[None])
        self._send(self._messages.ImageMessage(image, placed, "ras", device_name="Image_Camera"))
        status = f"lost: {lost}" if lost else "tracking"
        self._send(self._messages.StringMessage(status, device_name="Status"))

    def send_surface(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Send triangles (F, 3) of vertices (V, 3), world mm."""
        points = (vertices @ RAS_FROM_WORLD[:3, :3]).astype(np.float32)
        polygons = np.insert(np.asarray(faces, np.uint32), 0, 3, axis=1).ravel()
        self._send(self._messages.PolyDataMessage(points=points, polygons=polygons, device_name="Surface_World"))

    def close(self) -> None:
        """End the connection."""
        self._server.stop()

    def _send(self, message: Any) -> None:
        if self.connected and len(self._server.outgoing_messages) < _MOST_WAITING:
            self._server.send_message(message, wait=False)
