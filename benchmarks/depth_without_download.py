"""How good is depth without any download? Median-scaled error of the shading estimator on real frames.

    python benchmarks/depth_without_download.py --data ../shared/data

Frames are rectified to pinholes of 160x128 px; "wide" is trans_t1_a seen at 0.6 times the focal length, where depth and
distance along the ray differ most. The estimator's few constants were chosen on these very frames.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh

from scopemap.camera import PinholeCamera
from scopemap.config import DepthSettings
from scopemap.datasets.c3vd import C3vdFolder
from scopemap.depth.shading import ShadingDepth
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse, transform
from scopemap.rectification import Rectifier, working_camera

SIZE = (160, 128)
_DARK_LEVEL = 12
_CLIPPED_MM = 99.9
_ENDONERF_FOCAL_PX = 569.468
_INSTRUMENT_MARGIN_PX = 9

Estimator = Callable[[Frame], np.ndarray]


@dataclass(frozen=True)
class Score:
    """Median-scaled mean relative error, and share of pixels within a factor of 1.25."""

    abs_rel: float
    delta: float


def score(estimate: np.ndarray, truth_mm: np.ndarray) -> Score:
    """Return the score of one estimate (H, W) against the truth (H, W), over the pixels that both know."""
    known = np.isfinite(estimate) & np.isfinite(truth_mm)
    estimated, true = estimate[known], truth_mm[known]
    ratio = estimated * (np.median(true) / np.median(estimated)) / true
    return Score(float(np.mean(np.abs(ratio - 1))), float(np.mean(np.maximum(ratio, 1 / ratio) < 1.25)))


def c3vd_frames(folder: Path, zoom: float = 1.0, count: int | None = None) -> Iterator[tuple[C3vdFolder, Frame]]:
    """Yield rectified frames of a C3VD folder."""
    source = C3vdFolder(folder)
    assert source.camera is not None
    rectifier = Rectifier(source.camera, working_camera(source.camera, SIZE, zoom))
    for item in source.frames(slice(count)):
        rgb = rectifier.image(item.rgb)
        frame = Frame(item.index, item.time_s, rgb, rectifier.target, rectifier.valid & (rgb.max(-1) > _DARK_LEVEL))
        truth = source.truth(item.index)
        if truth is not None and truth.depth_mm is not None:
            frame = replace(frame, depth_mm=rectifier.nearest(truth.depth_mm))
        yield source, frame


def cecum(data: Path) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield frames 0 and 1 of cecum_t1_a with the true surface points that they see."""
    folder = data / "endoscopy" / "c3vd"
    for source, frame in c3vd_frames(folder / "cecum_t1_a", count=2):
        cloud = trimesh.load(folder / "cecum_t1_a_gt_clouds" / f"{frame.index:04d}_depth_pcd.ply")
        points = transform(inverse(source.poses[frame.index]), np.asarray(cloud.vertices))
        yield frame, _drawn(points[(points[:, 2] > 0) & (points[:, 2] <= _CLIPPED_MM)], frame.camera)


def trans(data: Path, zoom: float = 1.0) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield the ten frames of trans_t1_a with their exact depth."""
    for _, frame in c3vd_frames(data / "endoscopy" / "c3vd" / "trans_t1_a", zoom):
        assert frame.depth_mm is not None
        yield replace(frame, depth_mm=None), frame.depth_mm


def endonerf(data: Path, every: int = 6) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield frames of EndoNeRF pulling with their stereo depth, instruments left out."""
    folder = data / "endoscopy" / "endonerf" / "pulling_soft_tissues"
    camera = PinholeCamera(_ENDONERF_FOCAL_PX, _ENDONERF_FOCAL_PX, 319.5, 255.5, 640, 512).resized(*SIZE)
    for file in sorted((folder / "images").iterdir())[::every]:
        number = file.name.split(".")[0]
        rgb = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        # Some depth files have 16 bit, most 8: all are mm.
        depth_mm = cv2.imread(str(folder / "depth" / f"{number}.depth.png"), cv2.IMREAD_UNCHANGED)
        mask = cv2.imread(str(folder / "gt_masks" / f"{number}.mask.png"), cv2.IMREAD_GRAYSCALE)
        instrument = cv2.dilate(mask, np.ones((_INSTRUMENT_MARGIN_PX,) * 2, np.uint8)) > 0
        truth_mm = np.where((depth_mm > 0) & ~instrument, depth_mm, np.nan).astype(np.float32)
        rgb = cv2.resize(rgb, SIZE, interpolation=cv2.INTER_AREA)
        frame = Frame(int(number.split("-")[-1]), 0.0, rgb, camera, rgb.max(-1) > _DARK_LEVEL)
        yield frame, cv2.resize(truth_mm, SIZE, interpolation=cv2.INTER_NEAREST)


SCENES: dict[str, Callable[[Path], Iterator[tuple[Frame, np.ndarray]]]] = {
    "cecum clouds": cecum,
    "trans_t1_a": trans,
    "trans_t1_a wide": lambda data: trans(data, 0.6),
    "endonerf pulling": endonerf,
}


def shading(frame: Frame) -> np.ndarray:
    """Depth by shading, each frame on its own."""
    return ShadingDepth(DepthSettings()).estimate(frame).values


ESTIMATORS: dict[str, Estimator] = {
    "constant depth": lambda frame: np.ones(frame.valid.shape, np.float32),
    "shading as depth": lambda frame: shading(frame) * np.linalg.norm(frame.camera.rays, axis=-1),
    "shading x ray z": shading,
}


def measure(data: Path) -> dict[str, dict[str, Score]]:
    """Return the mean score over the frames by scene and estimator."""
    table: dict[str, dict[str, Score]] = {}
    for scene, pairs in SCENES.items():
        scores: dict[str, list[Score]] = {name: [] for name in ESTIMATORS}
        for frame, truth_mm in pairs(data):
            for name, estimator in ESTIMATORS.items():
                scores[name].append(score(estimator(frame), np.where(frame.valid, truth_mm, np.nan)))
        table[scene] = {
            name: Score(float(np.mean([s.abs_rel for s in found])), float(np.mean([s.delta for s in found])))
            for name, found in scores.items()
        }
    return table


def _drawn(points_mm: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Return the depth (H, W) of points (N, 3) in the camera, the nearest where several share a pixel, else NaN."""
    pixels = np.rint(camera.project(points_mm)).astype(int)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(-1)
    depth_mm = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    np.minimum.at(depth_mm, (pixels[inside, 1], pixels[inside, 0]), points_mm[inside, 2].astype(np.float32))
    return np.where(np.isfinite(depth_mm), depth_mm, np.nan)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the real data")
    table = measure(parser.parse_args().data)
    print("AbsRel / delta<1.25".ljust(20) + "".join(scene.rjust(18) for scene in table))
    for name in ESTIMATORS:
        cells = (f"{scores[name].abs_rel:.3f} / {scores[name].delta:.2f}" for scores in table.values())
        print(name.ljust(20) + "".join(cell.rjust(18) for cell in cells))
    return 0


if __name__ == "__main__":
    sys.exit(main())
