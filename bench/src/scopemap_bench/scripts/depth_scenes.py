"""Real frames for measuring depth: four scenes with true depth, seen by rectified pinholes of any size.

"wide" is trans_t1_a seen at 0.6 times the focal length, where depth and distance along the ray differ most. What does
not count is taken out of the truth: dark surround, depth clipped by the data set, instruments with a margin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
import trimesh

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.rectification import Rectifier, working_camera
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse, transform
from scopemap_bench.datasets.c3vd import C3vdFolder

Size: TypeAlias = tuple[int, int]
"""Width and height, px."""

_DARK_LEVEL = 12
_CLIPPED_MM = 99.9
_ENDONERF_FOCAL_PX = 569.468
_INSTRUMENT_MARGIN_PX = 9
_TRUTH_EVERY = 6


def c3vd_frames(
    folder: Path, size: Size, zoom: float = 1.0, count: int | None = None
) -> Iterator[tuple[C3vdFolder, Frame]]:
    """Yield rectified frames of a C3VD folder, with their true depth where it has any."""
    source = C3vdFolder(folder)
    assert source.camera is not None
    rectifier = Rectifier(source.camera, working_camera(source.camera, size, zoom))
    for item in source.frames(slice(count)):
        rgb = rectifier.image(item.rgb)
        frame = Frame(item.index, item.time_s, rgb, rectifier.target, rectifier.valid & (rgb.max(-1) > _DARK_LEVEL))
        truth = source.truth(item.index)
        if truth is not None and truth.depth_mm is not None:
            frame = replace(frame, depth_mm=rectifier.nearest(truth.depth_mm))
        yield source, frame


def cecum(data: Path, size: Size) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield frames 0 and 1 of cecum_t1_a with the true surface points that they see."""
    folder = data / "endoscopy" / "c3vd"
    for source, frame in c3vd_frames(folder / "cecum_t1_a", size, count=2):
        cloud = trimesh.load(folder / "cecum_t1_a_gt_clouds" / f"{frame.index:04d}_depth_pcd.ply")
        points = transform(inverse(source.poses[frame.index]), np.asarray(cloud.vertices))
        depth_mm = drawn(points[(points[:, 2] > 0) & (points[:, 2] <= _CLIPPED_MM)], frame.camera)
        yield frame, np.where(frame.valid, depth_mm, np.nan)


def trans(data: Path, size: Size, zoom: float = 1.0) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield the ten frames of trans_t1_a with their exact depth."""
    for _, frame in c3vd_frames(data / "endoscopy" / "c3vd" / "trans_t1_a", size, zoom):
        assert frame.depth_mm is not None
        yield replace(frame, depth_mm=None), np.where(frame.valid, frame.depth_mm, np.nan)


def endonerf(data: Path, size: Size) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield frames of EndoNeRF pulling with their stereo depth, instruments left out. The camera is at rest."""
    folder = data / "endoscopy" / "endonerf" / "pulling_soft_tissues"
    camera = PinholeCamera(_ENDONERF_FOCAL_PX, _ENDONERF_FOCAL_PX, 319.5, 255.5, 640, 512).resized(*size)
    for file in sorted((folder / "images").iterdir())[::_TRUTH_EVERY]:
        number = file.name.split(".")[0]
        rgb = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        # Some depth files have 16 bit, most 8: all are mm.
        depth_mm = cv2.imread(str(folder / "depth" / f"{number}.depth.png"), cv2.IMREAD_UNCHANGED)
        mask = cv2.imread(str(folder / "gt_masks" / f"{number}.mask.png"), cv2.IMREAD_GRAYSCALE)
        instrument = cv2.dilate(mask, np.ones((_INSTRUMENT_MARGIN_PX,) * 2, np.uint8)) > 0
        truth_mm = np.where((depth_mm > 0) & ~instrument, depth_mm, np.nan).astype(np.float32)
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        frame = Frame(int(number.split("-")[-1]), 0.0, rgb, camera, rgb.max(-1) > _DARK_LEVEL)
        yield frame, np.where(frame.valid, cv2.resize(truth_mm, size, interpolation=cv2.INTER_NEAREST), np.nan)


SCENES: dict[str, Callable[[Path, Size], Iterator[tuple[Frame, np.ndarray]]]] = {
    "cecum clouds": cecum,
    "trans_t1_a": trans,
    "trans_t1_a wide": lambda data, size: trans(data, size, 0.6),
    "endonerf pulling": endonerf,
}
"""By name: (frame, true depth (H, W) mm, NaN = unknown or not to be counted)."""


def drawn(points_mm: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Return the depth (H, W) of points (N, 3) in the camera, the nearest where several share a pixel, else NaN."""
    pixels = np.rint(camera.project(points_mm)).astype(int)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(-1)
    depth_mm = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    np.minimum.at(depth_mm, (pixels[inside, 1], pixels[inside, 0]), points_mm[inside, 2].astype(np.float32))
    return np.where(np.isfinite(depth_mm), depth_mm, np.nan)
