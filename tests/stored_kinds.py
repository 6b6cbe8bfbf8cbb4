"""How the made-up copy of every layout stores what a `Content` holds: `KINDS`, named as `WRITERS`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from drawn_colmap import CAMERA as COLMAP_CAMERA
from drawn_colmap import binary_images, text_images, write_model
from drawn_image_sets import SHEET_COLUMNS, SIM_HEADER, UNITY_HEADER, llff, write_xlsx
from drawn_scared import frame_json, write_tar
from drawn_scene import Content, quaternion
from drawn_video_sets import archive_of, write_models
from stored_containers import dicom_frames, dicom_video, recording
from stored_frames import (
    Put,
    archived_pictures,
    depth_buffers,
    depths,
    listed_depths,
    listed_pictures,
    movie,
    pictures,
    red_depths,
    scene_points,
)

from scopemap.engine.geometry.se3 import inverse
from scopemap.input.camera_files.writing import write_calibration

_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Kind:
    """One layout.

    puts : put all of a `Content` in the place of what a copy holds. pictures : what holds them. first : number of the
    first frame. scale : of the scene, where depth is stored in coarse steps. smaller : pictures by this factor.
    depth, poses : how they are stored. depth_unit_mm : mm per unit of depth files. stamps : whether time stamps are
    stored. listed : whether a list numbers the frames. lever : whether poses are another camera's.
    own_inside : whether another calibration is put inside, not beside the frames. told : what is found in a sound copy.
    """

    puts: tuple[Put, ...]
    pictures: Literal["files", "archive", "messages", "video"] = "files"
    first: int = 0
    scale: float = 1.0
    smaller: int = 1
    depth: Literal["fine", "coarse"] | None = None
    depth_unit_mm: float = 1.0
    poses: Literal["matrices", "quaternions"] | None = None
    stamps: bool = False
    listed: bool = False
    lever: bool = False
    own_inside: bool = False
    told: frozenset[str] = frozenset()


# ---- poses


def _damaged(file: Path, content: Content) -> None:
    if content.poses_damage is not None:
        file.write_bytes(content.poses_damage(file.read_bytes()))


def _table(name: str, row: Callable[[int, Content], list[float]], separator: str = " ", header: str = "") -> Put:
    """One row of numbers per pose, in order."""

    def put(folder: Path, content: Content) -> None:
        rows = [separator.join(f"{x:.12g}" for x in row(number, content)) for number in sorted(content.poses)]
        (folder / name).write_text("\n".join([header] * bool(header) + rows) + "\n")
        _damaged(folder / name, content)

    return put


def _unity(T: np.ndarray, units_per_mm: float) -> list[float]:
    """Position and quaternion in left-handed axes with y up."""
    mirrored = _MIRROR @ T @ _MIRROR
    return [*(mirrored[:3, 3] * units_per_mm), *quaternion(mirrored)]


def _stamped(T: np.ndarray, units_per_mm: float = 1.0) -> list[float]:
    return [*(T[:3, 3] * units_per_mm), *quaternion(T)]


def _pose_files(folder: Path, content: Content) -> None:
    for file in folder.glob("*.pose.txt"):
        file.unlink()
    for number, T in content.poses.items():
        stored = T.copy()
        stored[:3, 3] /= 1000
        np.savetxt(folder / f"frame-{number:06d}.pose.txt", stored)
    _damaged(folder / f"frame-{sorted(content.poses)[1]:06d}.pose.txt", content)


def _frame_data(calibration: str | None) -> Put:
    def put(folder: Path, content: Content) -> None:
        files = {}
        for number, T in content.poses.items():
            stamp = round(1e9 * (1_000_000 + content.times_s[number] * 1.07))
            entry = frame_json(number, calibration) | {"camera-pose": inverse(T).tolist(), "timestamp": stamp}
            files[f"frame_data{number:06d}.json"] = json.dumps(entry).encode()
        _damaged(write_tar(folder / "data" / "frame_data.tar.gz", files), content)

    return put


def _bounds(folder: Path, content: Content) -> None:
    rows = llff(np.stack([content.poses[number] for number in sorted(content.poses)]))
    np.save(folder / "poses_bounds.npy", rows)
    _damaged(folder / "poses_bounds.npy", content)


def _arrays(folder: Path, content: Content) -> None:
    """Depth in metres."""
    for file in folder.glob("stereo_depth/*.npy"):
        file.unlink()
    for number, depth_mm in content.depth_mm.items():
        np.save(folder / f"stereo_depth/{number:06d}.npy", (depth_mm / 1000).astype(np.float32))


def _unity_tables(folder: Path, content: Content) -> None:
    _table("../SavedPosition_S1.txt", lambda n, c: _unity(c.poses[n], 0.1)[:3])(folder, content)
    _table("../SavedRotationQuaternion_S1.txt", lambda n, c: _unity(c.poses[n], 0.1)[3:])(folder, content)


def _workbook(folder: Path, content: Content) -> None:
    rows = [[None, number, number, *_stamped(T, 1e-3)] for number, T in sorted(content.poses.items())]
    cells = [[None if isinstance(x, float) and np.isnan(x) else x for x in row] for row in rows]
    _damaged(write_xlsx(folder / "Poses" / "poses.xlsx", [[None, *SHEET_COLUMNS], *cells]), content)


def _world_to_camera(T: np.ndarray) -> tuple[float, ...]:
    """Quaternion, scalar first, and translation."""
    x, y, z, w = quaternion(inverse(T))
    return (w, x, y, z, *inverse(T)[:3, 3])


def _model_archive(folder: Path, content: Content) -> None:
    posed = [(f"out{number + 1}.png", 1, _world_to_camera(T)) for number, T in content.poses.items()]
    write_models(archive_of(folder), {0: binary_images(posed)})
    _damaged(archive_of(folder), content)


def _climb_reference(folder: Path, content: Content) -> None:
    posed = []
    for number, T in sorted(content.poses.items()):
        stored = T.copy()
        stored[:3, 3] /= 2  # scales.csv: 2 mm per unit
        posed.append((f"{number + 1:06d}.png", 1, _world_to_camera(stored)))
    file = folder / "results_txt" / "images.txt"
    file.write_text(text_images(posed))
    _damaged(file, content)


def _model(form: str) -> Put:
    def put(folder: Path, content: Content) -> None:
        posed = [(f"frame_{number}.png", 1, _world_to_camera(T)) for number, T in content.poses.items()]
        model = write_model(folder / "sparse/0", posed, {1: COLMAP_CAMERA}, form)
        _damaged(model / f"images.{form}", content)

    return put


_C3VD_POSES = _table("pose.txt", lambda n, c: c.poses[n].T.ravel().tolist(), ",")
_COARSE = frozenset({"depth-coarse"})

KINDS: dict[str, Kind] = {
    "images": Kind((pictures("{:03d}.png"),)),
    "video": Kind((movie(""),), pictures="video", stamps=True),
    "c3vd": Kind(
        (pictures("{}_color.png"), depths("{}_depth.tiff", 655.35), _C3VD_POSES),
        depth_unit_mm=100 / 65535,
        depth="fine",
        poses="matrices",
    ),
    "c3vd:v2": Kind(
        (pictures("rgb/{:04d}.png"), depths("depth/{:04d}_depth.tiff", 655.35), _C3VD_POSES),
        depth_unit_mm=100 / 65535,
        depth="fine",
        poses="matrices",
    ),
    "c3vd:endogslam": Kind(
        (pictures("color/{:04d}_color.png"), depths("depth/{:04d}_depth.tiff", 2.55, np.uint8), _C3VD_POSES),
        depth_unit_mm=100 / 255,
        depth="coarse",
        poses="matrices",
        told=_COARSE,
    ),
    "7-scenes": Kind(
        (pictures("frame-{:06d}.color.png"), depths("frame-{:06d}.depth.png", 1), _pose_files),
        scale=10,
        smaller=4,
        depth="coarse",
        poses="matrices",
        lever=True,
        told=_COARSE,
    ),
    "scared": Kind(
        (movie("data/rgb.mp4", stacked=True), scene_points(both=True), _frame_data(None)),
        pictures="video",
        depth="fine",
        poses="matrices",
        stamps=True,
    ),
    "scared-c": Kind(
        (archived_pictures, scene_points(both=False), _frame_data("intrinsics_colmap.yaml")),
        pictures="archive",
        first=1,
        depth="fine",
        poses="matrices",
        stamps=True,
    ),
    "hamlyn": Kind((pictures("image01/{:010d}.jpg"), depths("depth01/{:010d}.png", 1)), depth="coarse", told=_COARSE),
    "hamlyn-tracking": Kind(
        (pictures("color/{:010d}.jpg"), depths("depth/{:010d}.png", 1)), depth="coarse", told=_COARSE
    ),
    "endonerf": Kind(
        (pictures("images/frame-{}.color.png"), depths("depth/frame-{}.depth.png", 1), _bounds),
        scale=4,
        depth="coarse",
        poses="matrices",
        told=_COARSE,
    ),
    "serv-ct": Kind(
        (pictures("Left_rectified/{:03d}.png"), depths("Ground_truth_CT/DepthL/{:03d}.png", 256)),
        first=1,
        depth_unit_mm=1 / 256,
        depth="fine",
    ),
    "tum": Kind(
        (
            listed_pictures,
            listed_depths,
            _table("groundtruth.txt", lambda n, c: [c.times_s[n] - 0.004, *_stamped(c.poses[n], 1e-3)]),
        ),
        scale=7,
        depth_unit_mm=0.2,
        listed=True,
        depth="fine",
        poses="quaternions",
        stamps=True,
    ),
    "oneslam": Kind(
        (
            pictures("images/{:08d}.jpg"),
            depths("depths/{:08d}.png", 1000),
            _table("poses_gt.txt", lambda n, c: [n, *_stamped(c.poses[n])]),
        ),
        depth_unit_mm=1e-3,
        depth="fine",
        poses="quaternions",
    ),
    "simcol3d": Kind(
        (pictures("FrameBuffer_{:04d}.png"), depths("Depth_{:04d}.png", 65280 / 200), _unity_tables),
        depth_unit_mm=200 / 65280,
        depth="fine",
        poses="quaternions",
    ),
    "endoslam:unity": Kind(
        (
            pictures("Frames/image_{:04d}.png"),
            red_depths,
            _table(
                "Poses/colon_position_rotation.csv",
                lambda n, c: [*_unity(c.poses[n], 1e-3), c.times_s[n]],
                ",",
                UNITY_HEADER,
            ),
        ),
        scale=10,
        depth_unit_mm=10,
        depth="coarse",
        poses="quaternions",
        stamps=True,
        told=_COARSE,
    ),
    "endoslam:real": Kind((pictures("Frames/frame_{:06d}.jpg"), _workbook), first=60, poses="quaternions"),
    "stereomis": Kind(
        (
            movie("endoscope_part0001.mp4", stacked=True),
            _table("groundtruth.txt", lambda n, c: [n, *_stamped(c.poses[n], 1e-3)]),
        ),
        pictures="video",
        poses="quaternions",
    ),
    "stir": Kind((movie("frames/1200ms-1440ms-visible.mp4"),), pictures="video"),
    "d4d": Kind((pictures("left_images_rect/{:06d}.png"), _arrays), depth="fine"),
    "endomapper": Kind((movie("Seq_001.mov"), _model_archive), pictures="video", poses="quaternions"),
    "climb": Kind((movie("../Seq_001_a.mp4"), _climb_reference), pictures="video", poses="quaternions"),
    "endomapper-sim": Kind(
        (
            pictures("rgb/image_{:04d}.png"),
            depth_buffers,
            _table("trajectory.csv", lambda n, c: [*_unity(c.poses[n], 1e-2), c.times_s[n]], ";", SIM_HEADER),
        ),
        depth_unit_mm=100,
        depth="fine",
        poses="quaternions",
        stamps=True,
    ),
    "colmap:txt": Kind((pictures("images/frame_{}.png"), _model("txt")), first=1, poses="quaternions"),
    "colmap:bin": Kind((pictures("images/frame_{}.png"), _model("bin")), first=1, poses="quaternions"),
    "rosbag:bag": Kind((recording("bag"),), pictures="messages", own_inside=True, stamps=True),
    "rosbag:ros2": Kind(
        (recording("ros2"),), pictures="messages", own_inside=True, depth_unit_mm=1000, depth="fine", stamps=True
    ),
    "rosbag:mcap": Kind((recording("mcap"),), pictures="messages", own_inside=True, stamps=True),
    "dicom:video": Kind((dicom_video,), pictures="video", stamps=True),
    "dicom:frames": Kind((dicom_frames,), pictures="messages", stamps=True),
}


def put(kind: Kind, folder: Path, content: Content) -> dict[str, Path]:
    """Put all of `content` over the copy that a writer returned; return the options to open it with."""
    for one in kind.puts:
        one(folder, content)
    if content.own is None or kind.own_inside:
        return {}
    file = folder / "camera.yaml" if folder.is_dir() else folder.with_name("own.yaml")
    write_calibration(content.own[0], file, content.own[1])
    return {} if folder.is_dir() else {"camera": file}
