"""What the pages draw in the scene: paths, frusta, surfaces; where browsers look at it from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

PATH_COLOUR = (70, 110, 200)
_MOST_POSITIONS = 2000
_BACK_SHARE = 0.9
# Inside of a tube, and all of a colon.
_NEAR_MM = 0.2
_FAR_MM = 20_000.0


def quaternion(pose: np.ndarray) -> np.ndarray:
    """Return the rotation of a pose (4, 4) as viser has it, w first."""
    return np.asarray(Rotation.from_matrix(np.asarray(pose, float)[:3, :3]).as_quat(scalar_first=True))


def draw_path(scene: Any, name: str, positions: np.ndarray, colour: tuple[int, int, int] = PATH_COLOUR) -> None:
    """Draw a line through positions (N, 3), of at most 2,000 of them; none where there are fewer than two."""
    kept = positions[:: -(-len(positions) // _MOST_POSITIONS)] if len(positions) else positions
    if len(kept) < 2:
        return
    parts = np.stack([kept[:-1], kept[1:]], axis=1).astype(np.float32)
    scene.add_line_segments(name, parts, colour, thickness=2.0, thickness_units="screen")


def look_at(window: BrowserWindow, pose: np.ndarray, points: np.ndarray) -> None:
    """Let all browsers look at points (N, 3) from behind a camera's pose (4, 4), also those that come later."""
    low, high = np.percentile(points, [5, 95], axis=0)
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
    pose = np.asarray(pose, float)
    behind = pose[:3, 3] - _BACK_SHARE * size * pose[:3, 2] - 0.3 * size * pose[:3, 1]
    look_from(window, behind, centre, -pose[:3, 1])


def look_from(window: BrowserWindow, position: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
    """Let all browsers look from a position at a target (3,), also those that come later."""
    first = window.server.initial_camera
    for camera in (first, *(client.camera for client in window.server.get_clients().values())):
        if camera is first:
            camera.up = tuple(up)
        else:
            camera.up_direction = tuple(up)
        camera.near, camera.far = _NEAR_MM, _FAR_MM
        camera.position, camera.look_at = tuple(position), tuple(target)
