"""Calibration boards as a known camera sees them: rays meet the board's plane, several to a pixel."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from scopemap.apps.calibrate.targets import CharucoBoard, Checkerboard
from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, OpenCvCamera

SIZE = (320, 240)
CHECKERBOARD = Checkerboard(9, 6, 3.0)
CHARUCO = CharucoBoard(8, 6, 3.0, 2.2)
PINHOLE = OpenCvCamera(PinholeCamera(265.0, 268.0, 163.0, 116.5, *SIZE), (-0.25, 0.08, 0.001, -0.0015))
FISHEYE = FisheyeCamera(PinholeCamera(140.0, 141.0, 157.5, 122.0, *SIZE), (-0.03, -0.012, 0.004, -0.0008))
_PX_PER_MM = 12
_RIM_MM = 2


def texture(board: Checkerboard | CharucoBoard) -> np.ndarray:
    """The board's print, float32 grey, with a white rim."""
    if isinstance(board, CharucoBoard):
        size = (round(board.columns * board.square_mm * _PX_PER_MM), round(board.rows * board.square_mm * _PX_PER_MM))
        black = board.layout.generateImage(size) == 0
    else:
        rows, columns = np.indices((board.rows + 1, board.columns + 1))
        black = np.kron((rows + columns) % 2 == 0, np.ones((round(board.square_mm * _PX_PER_MM),) * 2, dtype=bool))
    return np.pad(np.where(black, 30, 210).astype(np.float32), _RIM_MM * _PX_PER_MM, constant_values=210)


class Studio:
    """Takes pictures of a board with a camera; `samples` rays a side make a pixel."""

    def __init__(self, camera: CameraModel, board: Checkerboard | CharucoBoard, samples: int = 2) -> None:
        self.camera, self.board, self.print, self.samples = camera, board, texture(board), samples
        steps = (np.arange(samples) + 0.5) / samples - 0.5
        u = (np.arange(camera.width)[:, None] + steps).ravel()
        v = (np.arange(camera.height)[:, None] + steps).ravel()
        self.rays = camera.unproject(np.stack(np.meshgrid(u, v), -1))

    def shot(self, T_camera_board: np.ndarray, seed: int = 0, blur_px: float = 0.6, noise: float = 2.0) -> np.ndarray:
        """(h, w, 3) uint8; the board's origin is the rim of its first square."""
        R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
        with np.errstate(all="ignore"):
            distance = (R[:, 2] @ t) / (self.rays @ R[:, 2])
            points = np.where(distance > 0, distance, np.nan)[..., None] * self.rays - t
        x, y = ((points @ R[:, k] + _RIM_MM) * _PX_PER_MM - 0.5 for k in (0, 1))
        outside = ~(np.isfinite(x) & np.isfinite(y))
        x, y = (np.where(outside, -1e6, a).clip(-1e6, 1e6).astype(np.float32) for a in (x, y))
        seen = cv2.remap(self.print, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=90.0)
        h, w = self.camera.height, self.camera.width
        picture = seen.reshape(h, self.samples, w, self.samples).mean(axis=(1, 3))
        picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
        picture += np.random.default_rng(seed).normal(0, noise, picture.shape)
        return np.repeat(picture.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)

    def poses(self, count: int, seed: int = 0, distance_mm: float | None = None) -> Iterable[np.ndarray]:
        """Boards before the camera: tilted, turned, towards every part of the picture."""
        rng = np.random.default_rng(seed)
        h, w = np.array(self.print.shape) / _PX_PER_MM - 2 * _RIM_MM
        if distance_mm is None:
            distance_mm = 1.8 * w * self.camera.central.fx / self.camera.width
        for i in range(count):
            tilt = rng.uniform(-0.6, 0.6, 2)
            R = cv2.Rodrigues(np.array([*tilt, rng.uniform(-0.3, 0.3)]))[0]
            place = np.array([(i % 4) / 3, (i // 4 % 3) / 2]) - 0.5
            aim = (np.array([0.5, 0.5]) + 0.42 * place) * [self.camera.width, self.camera.height]
            ray = self.camera.unproject(aim)
            T = np.eye(4)
            T[:3, :3] = R
            T[:3, 3] = ray / np.linalg.norm(ray) * distance_mm * rng.uniform(0.85, 1.2) - R @ [w / 2, h / 2, 0]
            yield T

    def corners_px(self, T_camera_board: np.ndarray, bow_mm: float = 0.0) -> np.ndarray:
        """Where a checkerboard's corners truly are in the picture; its middle bows by `bow_mm`."""
        assert isinstance(self.board, Checkerboard)
        points = self.board.corners_mm + self.board.square_mm * np.array([1, 1, 0])
        radius = np.linalg.norm(points - points.mean(axis=0), axis=1)
        points[:, 2] += bow_mm * (1 - (radius / radius.max()) ** 2)
        return self.camera.project(points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])
