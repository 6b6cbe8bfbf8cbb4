"""Layouts that hold the pictures: nerfstudio, COLMAP's text model, RGB-D as EndoGSLAM reads it, EndoNeRF's folder.

Pictures are the rectified frames, so the camera is a pinhole. nerfstudio and COLMAP count pixels from the corner of the
image, so principal points are half a pixel larger than here. Sources: docs.nerf.studio, data_conventions;
colmap.github.io/format.html; github.com/Loping151/EndoGSLAM, datasets/gradslam_datasets/c3vd.py, basedataset.py;
github.com/med-air/EndoNeRF, load_llff.py.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from scopemap.apps.export.trajectories import write_frame_numbers
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.mesh_files import ply_bytes
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.engine.geometry.se3 import inverse
from scopemap.input.decoding import write_image
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Unit
from scopemap.result.result import Result
from scopemap.runner.reread_frames import tracked_frames

_CENTRE_TO_CORNER_PX = 0.5
# A camera of OpenGL looks along -z with y up.
_T_OPENCV_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(run: Result, folder: Path) -> None:
    """Write `transforms.json`, `points.ply`, `images/`, `masks/` and `depth/`; poses and points in metres.

    Depth is float32, mm, 0 = unknown: nerfstudio multiplies it by 0.001, its default, and has metres. Depth is left out
    unless every frame has it, because nerfstudio takes all or none.
    """
    depth, names = (
        run.depth if _has_all_depth(run) else None,
        [f"{index:06d}" for index in run.tracked.trajectory.indices],
    )
    for frame in _with_images(run, folder, mask_ending=".png"):
        if depth is not None:
            (folder / "depth").mkdir(exist_ok=True)
            depth_mm = np.nan_to_num(_required(depth.read(frame.index), frame))
            np.save(folder / "depth" / f"{frame.index:06d}.npy", depth_mm.astype(np.float32))
    poses = run.tracked.trajectory.T_world_camera @ _T_OPENCV_OPENGL
    poses[:, :3, 3] /= MM_PER_UNIT["m"]
    frames: list[dict[str, Any]] = []
    for name, pose in zip(names, poses, strict=True):
        files = {"file_path": f"images/{name}.png", "mask_path": f"masks/{name}.png"}
        files |= {} if depth is None else {"depth_file_path": f"depth/{name}.npy"}
        frames.append(files | {"transform_matrix": pose.tolist()})
    camera = run.camera
    facts: dict[str, Any] = {"camera_model": "OPENCV", "w": camera.width, "h": camera.height}
    facts |= {"fl_x": camera.fx, "fl_y": camera.fy}
    facts |= {"cx": camera.cx + _CENTRE_TO_CORNER_PX, "cy": camera.cy + _CENTRE_TO_CORNER_PX}
    facts |= dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    points_mm, colours = np.asarray(run.mesh.vertices), vertex_colours(run.mesh)[:, :3]
    if len(points_mm):
        cloud = trimesh.Trimesh(points_mm / MM_PER_UNIT["m"], vertex_colors=colours, process=False)
        (folder / "points.ply").write_bytes(ply_bytes(cloud, ["unit: m; world of transforms.json", run.scale]))
        facts["ply_file_path"] = "points.ply"
    facts |= {"unit": "m", "scale": run.scale, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def write_colmap(run: Result, folder: Path, unit: Unit) -> None:
    """Write `sparse/0/cameras.txt`, `images.txt` and `points3D.txt`, and `images/` and `masks/` beside them.

    Points are the vertices of the mesh, without tracks. Masks are named as COLMAP's feature extraction looks for them.
    """
    for _ in _with_images(run, folder, mask_ending=".png.png"):
        pass
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    camera, per_unit = run.camera, MM_PER_UNIT[unit]
    about = f"# scopemap; unit: {unit}; {run.scale}\n"
    parameters = (camera.fx, camera.fy, camera.cx + _CENTRE_TO_CORNER_PX, camera.cy + _CENTRE_TO_CORNER_PX)
    row = " ".join(f"{number:.9g}" for number in parameters)
    (model / "cameras.txt").write_text(
        f"{about}# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY\n1 PINHOLE {camera.width} {camera.height} {row}\n"
    )
    T_camera_world = inverse(run.tracked.trajectory.T_world_camera)
    wxyz = np.roll(Rotation.from_matrix(T_camera_world[:, :3, :3]).as_quat(canonical=True), 1, axis=1)
    rows = np.column_stack([wxyz, T_camera_world[:, :3, 3] / per_unit])
    lines = [about, "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of observations, which is empty\n"]
    for number, (index, values) in enumerate(zip(run.tracked.trajectory.indices, rows, strict=True), start=1):
        lines.append(f"{number} {' '.join(f'{value:.12g}' for value in values)} 1 {index:06d}.png\n\n")
    (model / "images.txt").write_text("".join(lines))
    points_mm, colours = np.asarray(run.mesh.vertices), vertex_colours(run.mesh)[:, :3]
    table = np.column_stack([np.arange(1, len(points_mm) + 1), points_mm / per_unit, colours, np.zeros(len(points_mm))])
    with (model / "points3D.txt").open("w", encoding="utf-8") as file:
        file.write(f"{about}# POINT3D_ID X Y Z R G B ERROR, without a track\n")
        np.savetxt(file, table, fmt="%d %.9g %.9g %.9g %d %d %d %g")


def write_endogslam(run: Result, folder: Path) -> None:
    """Write `color/*.png`, `depth/*.tiff` (16 bit, 0 = unknown), `pose.txt` and `camera.yaml`, all in mm.

    `pose.txt` is C3VD's: camera-to-world, 16 numbers a line, transposed. `camera.yaml` has the `camera_params` of
    EndoGSLAM's configuration; `png_depth_scale` is levels per mm.
    """
    depth = run.depth
    if not _has_all_depth(run):
        raise InputError(f"{run.path}: not every tracked frame has its depth, which EndoGSLAM needs")
    for frame in tracked_frames(run):
        write_image(folder / "color" / f"{frame.index:06d}_color.png", frame.rgb[..., ::-1])
        levels = np.nan_to_num(_required(depth.read(frame.index), frame) / depth.scale_mm)
        write_image(folder / "depth" / f"{frame.index:06d}_depth.tiff", np.round(levels).astype(np.uint16))
    transposed = np.swapaxes(run.tracked.trajectory.T_world_camera, 1, 2).reshape(-1, 16)
    np.savetxt(folder / "pose.txt", transposed, fmt="%.12g", delimiter=",")
    write_frame_numbers(run, folder / "pose.txt")
    camera = run.camera
    values = {"image_height": camera.height, "image_width": camera.width, "fx": camera.fx, "fy": camera.fy}
    values |= {"cx": camera.cx, "cy": camera.cy, "png_depth_scale": 1 / depth.scale_mm, "crop_edge": 0}
    lines = [f"# unit: mm; {run.scale}", "dataset_name: 'c3vd'", "camera_params:"]
    lines += [f"  {name}: {value!r}" for name, value in values.items()]
    (folder / "camera.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_endonerf(run: Result, folder: Path) -> None:
    """Write `images/`, `depth/` (16 bit, whole mm, 0 = unknown), `masks/` (white: not tissue) and `poses_bounds.npy`.

    A row of the last is [R | t | height, width, focal length] by rows, camera-to-world with OpenCV axes, in mm, and the
    nearest and farthest depth. The layout knows one focal length and the principal point in the middle, so pictures,
    masks and depth are resampled to that; the first camera is the world, since its readers take other first rotations
    for LLFF's axes.
    """
    depth = run.depth
    if not _has_all_depth(run):
        raise InputError(f"{run.path}: not every tracked frame has its depth, which EndoNeRF needs")
    camera, size = run.camera, (run.camera.width, run.camera.height)
    stretch, middle = camera.fx / camera.fy, ((camera.width - 1) / 2, (camera.height - 1) / 2)
    centred = np.array([[1.0, 0.0, middle[0] - camera.cx], [0.0, stretch, middle[1] - stretch * camera.cy]])
    poses = inverse(run.tracked.trajectory.T_world_camera[0]) @ run.tracked.trajectory.T_world_camera
    pose_of = dict(zip(run.tracked.trajectory.indices.tolist(), poses, strict=True))
    rows = []
    for frame in tracked_frames(run):
        depth_mm = np.nan_to_num(_required(depth.read(frame.index), frame))
        levels = cv2.warpAffine(depth_mm, centred, size, flags=cv2.INTER_NEAREST)
        hidden = 1 - cv2.warpAffine(frame.valid.astype(np.uint8), centred, size, flags=cv2.INTER_NEAREST)
        picture = cv2.warpAffine(np.ascontiguousarray(frame.rgb[..., ::-1]), centred, size, flags=cv2.INTER_LINEAR)
        name = f"frame-{frame.index:06d}"
        write_image(folder / "images" / f"{name}.color.png", picture)
        write_image(folder / "depth" / f"{name}.depth.png", np.round(np.clip(levels, 0, 65535)).astype(np.uint16))
        write_image(folder / "masks" / f"{name}.mask.png", hidden * 255)
        known = depth_mm[depth_mm > 0]
        bounds = (known.min(), known.max()) if known.size else (np.nan, np.nan)
        of_camera = np.array([camera.height, camera.width, camera.fx])
        rows.append([*np.column_stack([pose_of[frame.index][:3], of_camera]).ravel(), *bounds])
    np.save(folder / "poses_bounds.npy", np.array(rows, dtype=np.float64))


def _with_images(run: Result, folder: Path, *, mask_ending: str) -> Iterator[Frame]:
    """Write `images/000000.png` and `masks/000000` + ending (white: usable) of each frame, and yield it."""
    for frame in tracked_frames(run):
        write_image(folder / "images" / f"{frame.index:06d}.png", frame.rgb[..., ::-1])
        write_image(folder / "masks" / f"{frame.index:06d}{mask_ending}", frame.valid.astype(np.uint8) * 255)
        yield frame


def _has_all_depth(run: Result) -> bool:
    """Return whether every tracked frame has its depth."""
    return run.depth.present and all(map(run.depth.has, run.tracked["index"].tolist()))


def _required(depth_mm: np.ndarray | None, frame: Frame) -> np.ndarray:
    if depth_mm is None:
        raise InputError(f"the depth of frame {frame.index} cannot be read")
    return depth_mm
