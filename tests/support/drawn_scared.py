"""SCARED and SCARED-C keyframes drawn by code: a tilted plane before a camera that moves and turns, in small images."""

from __future__ import annotations

import gzip
import io
import json
import tarfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import tifffile

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.engine.geometry.se3 import inverse, se3_exp

WIDTH, HEIGHT = 64, 48
CAMERA = OpenCvCamera(PinholeCamera(60.0, 61.0, 30.0, 25.0, WIDTH, HEIGHT), (-0.2, 0.05, 0.002, -0.003, 0.01))
RATE_HZ = 25
PLANE = np.array([0.2, -0.1, 1.0]), 60.0  # points X with n . X = d, mm
Files = dict[str, bytes]


def true_pose(number: int) -> np.ndarray:
    """Camera to world, mm: moves and turns, so that its inverse is another pose."""
    return se3_exp(np.array([0.04, -0.06, 0.1, 3.0, -2.0, 1.5]) * number)


def red_in(rgb: np.ndarray) -> int:
    """The number that a drawn left view carries as its level of red."""
    return round((float(rgb[..., 0].mean()) - 60) / 8)


def left_view(number: int) -> np.ndarray:
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[..., 0] = 60 + 8 * number
    return picture


def write_stereo_video(file: Path, frames: int) -> Path:
    """Left views, red, above right views, blue."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=RATE_HZ)
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = WIDTH, 2 * HEIGHT, "yuv420p", 1
        stream.bit_rate = 2_000_000
        for i in range(frames):
            right = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
            right[..., 2] = 220
            picture = np.vstack([left_view(i), right])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return file


def true_depth_mm(T_world_camera: np.ndarray, camera: OpenCvCamera | PinholeCamera = CAMERA) -> np.ndarray:
    """Depth (h, w) of the plane along the camera's axis, in its distorted image."""
    normal, distance_mm = PLANE
    return (distance_mm - normal @ T_world_camera[:3, 3]) / (rays(camera) @ T_world_camera[:3, :3].T @ normal)


def rays(camera: OpenCvCamera | PinholeCamera = CAMERA) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.unproject(np.stack([u, v], -1).astype(float))


@cache
def scene_points(number: int, both: bool = True) -> bytes:
    """X, Y, Z per pixel as tifffile writes them; holes of each kind in the first columns; the right view is far off."""
    left = (rays() * true_depth_mm(true_pose(number))[..., None]).astype(np.float32)
    left[:, 0], left[:, 1], left[:, 2], left[:, 3] = 0, np.nan, np.inf, -left[:, 3]
    stream = io.BytesIO()
    tifffile.imwrite(stream, np.vstack([left, left + 500]) if both else left, photometric="rgb")
    return stream.getvalue()


def frame_json(number: int, calibration: Any = None, stamp_unit_s: float = 1e-9) -> dict[str, Any]:
    lens = {"KL": CAMERA.central.matrix.tolist(), "DL": [list(CAMERA.distortion)]}
    return {
        "camera-pose": inverse(true_pose(number)).tolist(),
        "camera-calibration": lens if calibration is None else calibration,
        "timestamp": round((1_000_000 + number / 20) / stamp_unit_s),
    }


def write_tar(file: Path, files: Files) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    data = stream.getvalue()
    file.write_bytes(data if file.suffix == ".tar" else gzip.compress(data, 1))
    return file


def write_loose(folder: Path, files: Files) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def write_stereo_calibration(file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
    other = CAMERA.central.matrix + 2
    for name, matrix in (("M1", CAMERA.central.matrix), ("M2", other)):
        storage.write(name, matrix)
    for name in ("D1", "D2"):
        storage.write(name, np.array([CAMERA.distortion]) * (1 if name == "D1" else 2))
    storage.write("R", np.eye(3))
    storage.write("T", np.array([[-4.2], [0.0], [0.0]]))
    storage.release()


def json_files(numbers: range | list[int], change: Callable[[int, dict[str, Any]], Any] | None = None) -> Files:
    entries = {number: frame_json(number) for number in numbers}
    changed = {n: entry if change is None else change(n, entry) for n, entry in entries.items()}
    return {
        f"frame_data{n:06d}.json": entry if isinstance(entry, bytes) else json.dumps(entry).encode()
        for n, entry in changed.items()
    }


def point_files(numbers: range | list[int], both: bool = True) -> Files:
    return {f"scene_points{number:06d}.tiff": scene_points(number, both) for number in numbers}


def write_scared(folder: Path, count: int = 4) -> Path:
    """A keyframe as it is downloaded."""
    write_stereo_calibration(folder / "endoscope_calibration.yaml")
    write_stereo_video(folder / "data" / "rgb.mp4", count)
    write_tar(folder / "data" / "frame_data.tar.gz", json_files(range(count)))
    write_tar(folder / "data" / "scene_points.tar.gz", point_files(range(count)))
    cv2.imwrite(str(folder / "Left_Image.png"), left_view(0)[..., ::-1])
    return folder


def write_scared_c(folder: Path, numbers: list[int]) -> Path:
    """A keyframe of SCARED-C: frames count from 1 and have gaps."""
    storage_file = folder / "intrinsics_colmap.yaml"
    folder.mkdir(parents=True)
    storage = cv2.FileStorage(str(storage_file), cv2.FILE_STORAGE_WRITE)
    storage.write("K", CAMERA.central.matrix)
    storage.write("image_width", WIDTH)
    storage.write("image_height", HEIGHT)
    storage.release()
    pictures = {
        f"frame{n:06d}.png": cv2.imencode(".png", np.ascontiguousarray(left_view(n)[..., ::-1]))[1].tobytes()
        for n in numbers
    }
    write_tar(folder / "data" / "rgb_frames.tar.gz", pictures)
    named = json_files(numbers, lambda n, entry: entry | {"camera-calibration": "intrinsics_colmap.yaml"})
    write_tar(folder / "data" / "frame_data.tar.gz", named)
    write_tar(folder / "data" / "scene_points.tar.gz", point_files(numbers, both=False))
    (folder / "frame_log.json").write_text(json.dumps({"key": "1_1", "included_frames": numbers}))
    return folder
