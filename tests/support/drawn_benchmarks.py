"""SCARED, SCARED-C and Hamlyn with something to see: frames and truth of a phantom in the layouts of the data sets."""

from __future__ import annotations

import io
import json
from pathlib import Path

import av
import cv2
import numpy as np
import tifffile

from scopemap.engine.frame import Frame, Truth
from scopemap.engine.geometry.se3 import inverse
from scopemap.input.opening import open_sequence
from tests.support.drawn_scared import write_tar

Seen = list[tuple[Frame, Truth]]


def seen(phantom: Path) -> Seen:
    """Return the frames of a phantom at its own size, with their truth."""
    return [(frame, truth) for frame, truth in open_sequence(phantom) if truth is not None]


def as_scared(frames: Seen, folder: Path) -> Path:
    """Write a keyframe of SCARED as it is downloaded: a video of both views, archives of poses and points."""
    (folder / "data").mkdir(parents=True)
    height, width = frames[0][0].rgb.shape[:2]
    with av.open(str(folder / "data" / "rgb.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = width, 2 * height, "yuv420p", 8_000_000
        for frame, _ in frames:
            both = np.vstack([frame.rgb, np.zeros_like(frame.rgb)])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(both, format="rgb24")))
        container.mux(stream.encode())
    _write_matrices(folder / "endoscope_calibration.yaml", _matrices(frames))
    _write_truth(frames, folder, first=0, views=2)
    return folder


def as_scared_c(frames: Seen, folder: Path) -> Path:
    """Write a keyframe of SCARED-C: frames in an archive, numbered from 1; the camera is COLMAP's."""
    height, width = frames[0][0].rgb.shape[:2]
    folder.mkdir(parents=True)
    storage = cv2.FileStorage(str(folder / "intrinsics_colmap.yaml"), cv2.FILE_STORAGE_WRITE)
    K = frames[0][0].camera.matrix.copy()
    K[:2, 2] += 0.5
    storage.write("K", K)
    storage.write("image_width", width)
    storage.write("image_height", height)
    storage.release()
    pictures = {
        f"frame{n:06d}.png": cv2.imencode(".png", np.ascontiguousarray(frame.rgb[..., ::-1]))[1].tobytes()
        for n, (frame, _) in enumerate(frames, 1)
    }
    write_tar(folder / "data" / "rgb_frames.tar.gz", pictures)
    _write_truth(frames, folder, first=1, views=1)
    (folder / "frame_log.json").write_text(json.dumps({"included_frames": list(range(1, len(frames) + 1))}))
    return folder


def as_hamlyn(frames: Seen, root: Path, folder: str, calibration: str) -> Path:
    """Write a rectified sequence of Hamlyn: images, depth in whole millimetres, intrinsics in a tree of their own."""
    for n, (frame, truth) in enumerate(frames):
        for name, suffix, image in (
            ("image01", "jpg", frame.rgb[..., ::-1]),
            ("depth01", "png", np.nan_to_num(truth.depth_mm).round().astype(np.uint16)),
        ):
            (root / folder / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / folder / name / f"{n:010d}.{suffix}"), image)
    (root / calibration).mkdir(parents=True)
    np.savetxt(root / calibration / "intrinsics.txt", frames[0][0].camera.matrix)
    return root / folder


def _matrices(frames: Seen) -> dict[str, np.ndarray]:
    K, none = frames[0][0].camera.matrix, np.zeros((1, 5))
    return {"M1": K, "D1": none, "M2": K, "D2": none, "R": np.eye(3), "T": np.array([[-4.2], [0.0], [0.0]])}


def _write_matrices(file: Path, matrices: dict[str, np.ndarray]) -> None:
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
    for name, matrix in matrices.items():
        storage.write(name, matrix)
    storage.release()


def _write_truth(frames: Seen, folder: Path, *, first: int, views: int) -> None:
    poses, points = {}, {}
    for n, (frame, truth) in enumerate(frames, first):
        camera = {"KL": frame.camera.matrix.tolist(), "DL": [[0.0] * 5]}
        entry = {
            "camera-pose": inverse(truth.T_world_camera).tolist(),
            "camera-calibration": camera if views == 2 else "intrinsics_colmap.yaml",
            "timestamp": n * 40_000_000,
        }
        poses[f"frame_data{n:06d}.json"] = json.dumps(entry).encode()
        xyz = np.nan_to_num(frame.camera.rays * truth.depth_mm[..., None]).astype(np.float32)
        stream = io.BytesIO()
        tifffile.imwrite(stream, np.vstack([xyz] * views), photometric="rgb")
        points[f"scene_points{n:06d}.tiff"] = stream.getvalue()
    write_tar(folder / "data" / "frame_data.tar.gz", poses)
    write_tar(folder / "data" / "scene_points.tar.gz", points)
