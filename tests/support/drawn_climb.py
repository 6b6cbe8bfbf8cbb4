"""CLiMB's layouts, drawn: references by COLMAP with their clips, runs of ours with submaps, trajectories as text."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.geometry.se3 import se3_exp
from scopemap.input.trajectory.trajectory import Trajectory
from tests.support.drawn_inputs import picture
from tests.support.drawn_video_sets import SCOPE_SIZE, write_frames, write_geometry
from tests.support.foreign_layouts import colmap_text
from tests.support.sample_trajectories import as_trajectory, write_run


def path_of(count: int, seed: int = 0) -> np.ndarray:
    """Camera-to-world poses (count, 4, 4), mm, along a bent path."""
    steps = np.random.default_rng(seed).normal([0, 0, 0, 0, 0, 0.5], [0.02] * 3 + [0.3] * 3, (count, 6))
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ se3_exp(step))
    return np.stack(poses)


def frames_of(poses: np.ndarray, first: int = 0) -> Trajectory:
    """Poses as frames `first`, `first` + 1, ..."""
    return replace(as_trajectory(poses), indices=np.arange(len(poses)) + first)


def write_reference(root: Path, poses: np.ndarray, clip: str = "Seq_001_a", scale: float | None = 2.0) -> Path:
    """Write the reference of a clip, image 000001.png the first, and its scale; return its folder."""
    folder = root / clip / "results_txt"
    folder.mkdir(parents=True)
    stored = poses.copy()
    stored[:, :3, 3] /= scale or 1.0
    names = [f"{number + 1:06d}.png" for number in range(len(poses))]
    (folder / "images.txt").write_text(colmap_text(stored, names, ["1.5 2.5 7"] * len(poses)))
    (folder / "points3D.txt").write_text("7 0 0 0 1 2 3 0.5\n")
    if scale is not None:
        row = f"{clip},points.ply,0,1,1.0,2.0,{scale},centroid"
        (root / "scales.csv").write_text(
            f"sequence,points_ply,idx0,idx1,dist_units,target_mm,scale_to_target,center_mode\n{row}\n"
        )
    return folder.parent


def write_clip(root: Path, pictures: list[np.ndarray] | None = None) -> Path:
    """Write a reference with its clip beside it and EndoMapper's calibration; return the folder of the reference."""
    shown = pictures or [picture(number, SCOPE_SIZE) for number in range(6)]
    folder = write_reference(root, path_of(len(shown)))
    write_frames(root / "Seq_001_a.mp4", shown, rate=50)
    (folder / "Seq_001_info.json").write_text(json.dumps({"endoscope_number": 1}))
    write_geometry(root)
    return folder


def write_finished_run(folder: Path, *submaps: Trajectory, clip: str = "Seq_001_a") -> Path:
    """Write the files of a finished run that an export reads; the submaps after the first are in maps/."""
    for number, submap in enumerate(submaps):
        (folder / "maps").mkdir(parents=True, exist_ok=True)
        write_run(folder / f"maps/{number}" if number else folder, submap)
    facts = {
        "input": f"videos/{clip}.mp4",
        "seconds": {"prepare": 1.5, "track": 3.0, "back end": 2.0, "fuse": 1.25, "total": 10.0},
    }
    (folder / "provenance.json").write_text(json.dumps(facts))
    return folder


def submap_text(poses: np.ndarray, frames: list[int]) -> str:
    """A submap's file as the challenge describes it, with two columns more."""
    lines = ["# timestamp, name_image, tx, ty, tz, qw, qx, qy, qz, frame_state, track_state"]
    for pose, frame in zip(poses, frames, strict=True):
        wxyz = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
        lines.append(", ".join(map(str, [frame / 50, f"{frame:06d}.png", *pose[:3, 3], *wxyz, 2, 1])))
    return "\n".join(lines) + "\n"


def write_foreign_run(folder: Path, *submaps: tuple[np.ndarray, list[int]]) -> Path:
    """Write poses with their frames, from 1, as maps 0, 1, ... of a submission's run."""
    (folder / "camera_trajectory").mkdir(parents=True)
    for number, (poses, frames) in enumerate(submaps):
        (folder / "camera_trajectory" / f"cam_traj_map_{number:03d}.txt").write_text(submap_text(poses, frames))
    return folder
