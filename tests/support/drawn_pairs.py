"""Stereo pairs drawn by code: what two cameras see of a plane, calibrations of a pair, a phantom of two views."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import yaml

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.engine.cameras.rectification import StereoPair
from scopemap.engine.geometry.se3 import inverse, se3_exp
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom
from tests.support.drawn_inputs import save

WIDTH, HEIGHT, BASELINE_MM = 320, 256, 4.0
LEFT = PinholeCamera(300.0, 300.0, 159.5, 127.5, WIDTH, HEIGHT)
LENS = (-0.15, 0.03, 0.001, -0.001)
# The right camera has another focal length and a lens; it is turned, up and forward a little.
BENT = OpenCvCamera(replace(LEFT, fx=310.0, fy=312.0, cx=165.0, cy=120.0), LENS)
T_BENT = inverse(se3_exp(np.array([0.01, 0.02, -0.015, BASELINE_MM, 0.1, -0.2])))
_TEXTURE_MM = 0.05
_TEXTURE = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (3000, 3000)).astype(np.float32), (0, 0), 5)
_TEXTURE = 128 + 45 * _TEXTURE / _TEXTURE.std()


def beside(T_mm: float = BASELINE_MM) -> np.ndarray:
    """T_right_left of a camera to the right, mm."""
    T_right_left = np.eye(4)
    T_right_left[0, 3] = -T_mm
    return T_right_left


def plane_depth_mm(camera: CameraModel, T_camera_left: np.ndarray, plane: tuple[np.ndarray, float]) -> np.ndarray:
    """Depth (h, w) along a camera's axis of the plane n . X = d, of the left camera."""
    normal, distance_mm = plane
    T_left_camera = inverse(T_camera_left)
    turned = T_left_camera[:3, :3].T @ normal
    return (distance_mm - normal @ T_left_camera[:3, 3]) / (_rays(camera) @ turned)


def view(camera: CameraModel, T_camera_left: np.ndarray, plane: tuple[np.ndarray, float]) -> np.ndarray:
    """What a camera sees of a plane with a texture, (h, w, 3) uint8."""
    points = _rays(camera) * plane_depth_mm(camera, T_camera_left, plane)[..., None]
    T = inverse(T_camera_left)
    x, y = np.moveaxis((points @ T[:3, :3].T + T[:3, 3])[..., :2].astype(np.float32) / _TEXTURE_MM + 1500, -1, 0)
    grey = cv2.remap(_TEXTURE, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_CUBIC)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, -1)


def _rays(camera: CameraModel) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.unproject(np.stack([u, v], -1).astype(float))


def write_opencv(file: Path, pair: StereoPair, names: str = "K1 D1 K2 D2 R T", unit_mm: float = 1.0) -> Path:
    """As OpenCV's FileStorage writes it, YAML or XML by the name; `names`: which of it, under which names."""
    lens = np.array([LENS]) if isinstance(pair.right, OpenCvCamera) else np.zeros((1, 5))
    T = pair.T_right_left
    values = [
        pair.left.central.matrix,
        np.zeros((1, 5)),
        pair.right.central.matrix,
        lens,
        T[:3, :3],
        T[:3, 3:] / unit_mm,
    ]
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(names.split(), values, strict=False):
        if name != "-":
            storage.write(name, value)
    storage.release()
    return file


def write_scared(file: Path, pair: StereoPair) -> Path:
    """A `frame_data*.json` of SCARED."""
    named = {"KL": pair.left.central.matrix, "KR": pair.right.central.matrix, "DL": np.zeros((1, 5)), "DR": [LENS]}
    named |= {"R": pair.T_right_left[:3, :3], "T": pair.T_right_left[:3, 3:]}
    lists = {name: np.asarray(value).tolist() for name, value in named.items()}
    file.write_text(json.dumps({"camera-calibration": lists, "timestamp": 1}))
    return file


def write_kalibr(file: Path, pair: StereoPair) -> Path:
    """A camchain, in m."""
    T = pair.T_right_left.copy()
    T[:3, 3] /= 1000
    chain = {
        name: {
            "camera_model": "pinhole",
            "intrinsics": [camera.central.fx, camera.central.fy, camera.central.cx, camera.central.cy],
            "distortion_model": "radtan",
            "distortion_coeffs": lens,
            "resolution": [WIDTH, HEIGHT],
        }
        for name, camera, lens in (("cam0", pair.left, [0.0] * 4), ("cam1", pair.right, list(LENS)))
    }
    chain["cam1"]["T_cn_cnm1"] = T.tolist()
    file.write_text(yaml.safe_dump(chain))
    return file


def write_stereo_phantom(folder: Path, spec: PhantomSpec, baseline_mm: float = BASELINE_MM) -> Path:
    """`views`, both side by side, the left one as in `truth`, and `pair.yaml`; the lamp is at each camera."""
    write_phantom(spec, folder / "truth")
    left = prepare(spec)
    right = replace(left, poses=left.poses @ inverse(beside(baseline_mm)))
    (folder / "views").mkdir()
    for index in range(len(left.poses)):
        save(folder / "views" / f"{index:04d}.png", np.hstack([render_frame(p, index)[0] for p in (left, right)]))
    pair = StereoPair(spec.camera, spec.camera, beside(baseline_mm), "")
    write_opencv(folder / "pair.yaml", pair)
    return folder
