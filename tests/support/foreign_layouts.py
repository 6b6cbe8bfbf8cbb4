"""How other people's systems lay out a camera's path: writers for tests, each in its own convention and unit."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.geometry.se3 import se3_exp
from scopemap.input.trajectory.trajectory import Trajectory

MM_PER = {"mm": 1.0, "m": 1000.0}


def moving_camera(count: int = 20, seed: int = 0) -> np.ndarray:
    """Return camera-to-world poses (N, 4, 4), mm, that start at the identity, turn by tens of degrees and move."""
    twists = np.random.default_rng(seed).normal(size=(count, 6)) * ([0.3] * 3 + [20] * 3)
    twists[0] = 0
    return np.stack([se3_exp(twist) for twist in twists])


def assert_is(found: Trajectory, T_world_camera: np.ndarray, indices: list[int], atol: float = 1e-6) -> None:
    assert found.has_indices
    assert found.indices.tolist() == indices
    np.testing.assert_allclose(found.T_world_camera, T_world_camera, atol=atol)
    # The check can fail: neither the inverse poses nor transposed rotations pass it.
    assert np.abs(np.linalg.inv(found.T_world_camera) - T_world_camera).max() > 1
    assert np.abs(np.swapaxes(found.T_world_camera[:, :3, :3], 1, 2) - T_world_camera[:, :3, :3]).max() > 0.1


def scared_documents(poses: np.ndarray, indices: list[int], step: float | None = 40.0, **more: object) -> dict:
    """Return {file name: JSON text}: world-to-camera, time stamps `step` apart per frame from an odd origin."""
    documents = {}
    for pose, index in zip(poses, indices, strict=True):
        document = {
            "camera-pose": np.linalg.inv(pose).tolist(),
            "camera-calibration": {"KL": np.eye(3).tolist()},
        } | more
        if step is not None:
            document["timestamp"] = 7.0 * step + index * step
        documents[f"frame_data{index:06d}.json"] = json.dumps(document)
    return documents


def write_files(folder: Path, documents: dict[str, str]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in documents.items():
        (folder / name).write_text(text)
    return folder


def write_tar(path: Path, documents: dict[str, str], mode: str = "w:gz") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(path, mode) as archive:
        for name, text in documents.items():
            member = tarfile.TarInfo(name)
            member.size = len(text.encode())
            archive.addfile(member, io.BytesIO(text.encode()))
    return path


def splatam_arrays(poses: np.ndarray, unit: str = "mm", seed: int = 0) -> dict[str, np.ndarray]:
    """Return the arrays of `params.npz`: world-to-camera, float32, quaternions with the scalar first and any length."""
    w2c = np.linalg.inv(poses)
    wxyz = np.roll(Rotation.from_matrix(w2c[:, :3, :3]).as_quat(), 1, axis=1)
    lengths = np.random.default_rng(seed).uniform(0.5, 3.0, size=(len(poses), 1))
    return {
        "cam_unnorm_rots": (wxyz * lengths).T[None].astype(np.float32),
        "cam_trans": (w2c[:, :3, 3] / MM_PER[unit]).T[None].astype(np.float32),
        "means3D": np.zeros((7, 3), np.float32),
        "w2c": np.eye(4, dtype=np.float32),
        "org_width": np.array(675),
        "gt_w2c_all_frames": w2c.astype(np.float32),
        "keyframe_time_indices": np.array([0, 7]),
    }


def write_splatam(folder: Path, arrays: dict[str, np.ndarray], config: str | None = None) -> Path:
    folder.mkdir(exist_ok=True)
    np.savez(folder / "params.npz", **arrays)
    if config is not None:
        (folder / "config.py").write_text(f"import os\nconfig = dict(seed=0, data=dict(end=-1, {config}))\n")
    return folder


def oneslam_text(poses: np.ndarray, indices: list[int]) -> str:
    rows = ["# frame_index tx ty tz qx qy qz qw"]
    for pose, index in zip(poses, indices, strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(" ".join(str(value) for value in (index, *pose[:3, 3], *quaternion)))
    return "\n".join(rows) + "\n"


def log_text(matrices: np.ndarray, first: Callable[[int], str] = lambda i: f"{i} {i} {i + 1}") -> str:
    """Return what Open3D writes: eight decimals, a space between numbers."""
    return "".join(
        first(i) + "\n" + "".join(" ".join(f"{x:.8f}" for x in row) + "\n" for row in T) for i, T in enumerate(matrices)
    )


def scaled(poses: np.ndarray, unit: str) -> np.ndarray:
    poses = poses.copy()
    poses[:, :3, 3] /= MM_PER[unit]
    return poses


def colmap_text(poses: np.ndarray, names: list[str], points: list[str]) -> str:
    """Return `images.txt`: world-to-camera, quaternion with the scalar first, a line of points below each image."""
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for number, (pose, name, point) in enumerate(zip(np.linalg.inv(poses), names, points, strict=True), start=1):
        wxyz = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
        lines += [" ".join(map(str, (number, *wxyz, *pose[:3, 3], 1, name))), point]
    return "\n".join(lines) + "\n"
