"""A run's folder, drawn: a camera flies through a coloured tube, is lost, and goes on in a second map."""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from PIL import Image

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.mesh_files import save_mesh
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap.engine.notices import of_input
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.trajectory.trajectory import write_tum
from scopemap.report.frame_pictures import FramePictures
from scopemap.result.depth_maps import DepthWriter
from scopemap.result.frame_table import ELSEWHERE, NOT_USED, ROTATED, FrameTable
from scopemap.result.frame_table import LOST as LOST_FRAME
from scopemap.result.result import Result
from scopemap.result.wording import facts_of_notices

CAMERA = PinholeCamera(60.0, 60.0, 39.5, 31.5, 80, 64)
IN_RESULT, IN_FIRST_MAP, FRAMES = 14, 7, 24
LOST = FRAMES - IN_RESULT - IN_FIRST_MAP
GOOD_SURFACE = {"frames": 9, "coverage_mean": 0.94, "coverage_least": 0.9, "depth_error": 0.01}


@dataclass(frozen=True)
class Shown:
    """What `FramePictures` looks at."""

    frame: Frame


def tube() -> trimesh.Trimesh:
    """A closed tube along z, its faces towards the inside, with dark and bright rings."""
    around, along = 48, 61
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(5.0, 85.0, along))
    wall = np.stack([10 * np.cos(angle), 10 * np.sin(angle), z], axis=-1).reshape(-1, 3)
    here = np.arange(around * (along - 1)).reshape(-1, around)
    beside, behind = np.roll(here, -1, axis=1), here + around
    faces = np.stack([here, behind, beside, beside, behind, np.roll(behind, -1, axis=1)], axis=-1).reshape(-1, 3)
    far = np.arange(around * (along - 1), around * along)
    lid = np.stack([far, np.full(around, len(wall)), np.roll(far, -1)], axis=-1)
    vertices = np.concatenate([wall, [[0.0, 0.0, 85.0]]])
    bright = (vertices[:, 2] // 8).astype(int) % 2
    colours = np.array([[110, 50, 40], [230, 180, 130]], np.uint8)[bright]
    confidence = {"confidence": np.linspace(0, 1, len(vertices)).astype(np.float32)}
    faces = np.concatenate([faces, lid])
    return trimesh.Trimesh(vertices, faces, vertex_colors=colours, vertex_attributes=confidence, process=False)


def textured_tube() -> trimesh.Trimesh:
    """The tube with a texture: green left of the middle, blue right of it; each triangle has vertices of its own."""
    mesh = tube()
    left = mesh.triangles_center[:, 0] < 0
    picture = np.full((64, 64, 3), [20, 60, 200], np.uint8)
    picture[:, :32] = [20, 160, 40]
    uv = np.repeat(np.where(left[:, None], [0.2, 0.7], [0.8, 0.3]), 3, axis=0)
    material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(picture))
    corners = np.asarray(mesh.faces).ravel()
    return trimesh.Trimesh(
        np.asarray(mesh.vertices)[corners],
        np.arange(len(corners)).reshape(-1, 3),
        vertex_normals=np.asarray(mesh.vertex_normals)[corners],
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )


def draw_textured_run(folder: Path) -> Path:
    """Write the run's folder, and let its surface have a texture."""
    draw_run(folder)
    save_mesh(tube(), glb_file=folder / "mesh.glb", textured=textured_tube())
    return folder


def pose_of(index: int) -> np.ndarray:
    """The camera-to-world pose of a frame."""
    return se3(so3_exp(np.array([0.0, 0.01 * index, 0.0])), np.array([0.01 * index**2, 0.0, float(index)]))


def drawn_result(name: str = "video.mp4", **facts: Any) -> Result:
    """The run in memory; `facts` replace those of its provenance."""
    provenance = {
        "input": name,
        "dataset": "video",
        "frames": FRAMES,
        "camera": {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        | {"source": "calibration file camera.yaml"},
        "estimators": {"depth": "scopenet", "flow": "dis"},
        "scale": {"known": False, "source": "scopenet's own scale"},
        "notices": facts_of_notices(of_input(["a note"], ["a warning"])),
        "seconds": {"total": 3.0},
        "versions": {"scopemap": "0.1.0"},
        "surface": GOOD_SURFACE,
    } | facts
    # The pictures are drawn without a lamp.
    config, mesh, second = Config.load(settings={"fusion.colours": "raw"}), tube(), range(IN_RESULT + LOST, FRAMES)
    other = Result.in_memory(CAMERA, FrameTable.of(_row(index, 1) for index in second), mesh, config, provenance)
    frames = FrameTable.of(_row(index, 0) for index in range(FRAMES))
    return changed(Result.in_memory(CAMERA, frames, mesh, config, provenance), others=[other])


def changed(result: Result, **parts: Any) -> Result:
    """The result with parts replaced, by their names."""
    found = copy(result)
    for name, part in parts.items():
        setattr(found, name, part)
    return found


def placed_frames(place: list[int], **columns: list[Any]) -> FrameTable:
    """Frames at 10 a second by the number of their submap, or `LOST`, ...; and further columns of theirs."""
    outside = {LOST_FRAME: "lost", ELSEWHERE: "other-map", NOT_USED: "skipped", ROTATED: "rotation-only", 0: "ok"}
    rows = [
        {"index": n, "time_s": n / 10, "map": max(number, -1), "status": outside.get(number, "other-map")}
        | {name: values[n] for name, values in columns.items()}
        for n, number in enumerate(place)
    ]
    return FrameTable.of(rows)


def draw_run(folder: Path, *, pictures: bool = True, name: str = "video.mp4", **facts: Any) -> Path:
    """Write the run's folder with its frames' pictures; `facts` replace those of its provenance."""
    mesh, kept, write = tube(), FramePictures(), DepthWriter(folder)
    for index in range(FRAMES):
        seen = render_mesh(mesh, CAMERA, pose_of(index))
        valid = np.isfinite(seen.depth_mm)
        valid[:, :4] = False
        frame = Frame(index, index / 25, seen.rgb, CAMERA, valid, seen.depth_mm, pose_of(index))
        write(frame)
        kept(Shown(frame))
    if pictures:
        kept.save(folder)
    drawn_result(name, **facts).save(folder)
    return folder


def draw_run_of_frames(root: Path) -> Path:
    """Write the run's folder, and the folder of pictures that it is of, both under `root`."""
    frames, mesh = root / "frames", tube()
    frames.mkdir()
    write_calibration(CAMERA, frames / "camera.yaml")
    for index in range(FRAMES):
        cv2.imwrite(str(frames / f"{index:06d}.png"), render_mesh(mesh, CAMERA, pose_of(index)).rgb[..., ::-1])
    return draw_run(root / "result", name=str(frames))


def write_placed(folder: Path, placed: Iterable[tuple[Frame, np.ndarray, np.ndarray]]) -> Path:
    """Write frames with their depth (H, W), mm, and poses (4, 4): what of a result is needed to place its depth."""
    folder.mkdir(exist_ok=True)
    writer, rows = DepthWriter(folder), []
    for frame, depth_mm, T_world_camera in placed:
        writer(replace(frame, depth_mm=depth_mm.astype(np.float32)))
        known = {"index": frame.index, "time_s": frame.time_s, "status": "ok", "T_world_camera": T_world_camera}
        rows.append(known)
    writer.finish(scale_known=True)
    table = FrameTable.of(rows)
    table.write(folder / "frames.csv")
    write_tum(folder / "trajectory.tum", table.trajectory)
    return folder


def _row(index: int, number: int) -> dict[str, Any]:
    """The row of a frame in the table of the submap with this number."""
    place = -1 if IN_RESULT <= index < IN_RESULT + LOST else int(index >= IN_RESULT)
    lost, here = {"status": "lost", "reason": "too blurred"}, {"status": "ok" if index else "initial"}
    facts = lost if place < 0 else here if place == number else {"status": "other-map"}
    if place == number:
        facts["T_world_camera"] = pose_of(index)  # type: ignore[assignment]
    figures = {"residual": 0.5, "inlier_share": 0.8 - 0.01 * index, "correlation": 0.9, "overlap": 0.9, "iterations": 3}
    depth = {"depth_scale": 1 + 0.01 * index, "warped_share": 0.5}
    return {"index": index, "time_s": index / 25, "map": place, "keyframe": 0} | facts | figures | depth
