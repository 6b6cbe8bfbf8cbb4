"""Sizes of a lesion that masks show in frames of a run: diameters, area, height, each from all frames together.

One mask is carried to the other frames by the surface: its vertices get the mask's value where its frame sees them,
and each frame sees their rendering, unless something is in front. Frames weigh by how well they see the lesion. Their
errors have much in common, for depth errs alike in all of them: what is common stays in the interval however many there
are.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh

from scopemap.actions.export.exported_run import ExportedRun, read_exported, write_image
from scopemap.actions.measure import Known, Measure, known_scale
from scopemap.cameras.formats.reading import read_calibration
from scopemap.cameras.rectification import Rectifier
from scopemap.errors import InputError
from scopemap.geometry.lesion_shape import FIGURES, view_shape
from scopemap.geometry.rendering import render_mesh
from scopemap.geometry.se3 import inverse, transform
from scopemap.io.decoding import by_number, read_decoded
from scopemap.report.measured_surface import drawn

_NAMES = {
    "diameter": "largest diameter",
    "cross": "diameter across it",
    "along": "along the surface",
    "area": "area",
    "height": "height",
}
_POWERS = {"area": 2}
_LOCAL_ERROR = {"diameter": 0.05, "cross": 0.07, "along": 0.10, "area": 0.08, "height": 0.25}
"""Standard deviation, as a share (of the square root of an area), that all frames have in common; by phantoms."""
_OUTLINE_PX, _COMMON = 1.0, 0.5
_EDGE_PX, _LEAST_PX, _MOST_FRAMES = 2, 60, 60
_IN_FRONT, _LEAST_LEFT = 0.1, 0.8
_FIRST_ROW = 30  # of the drawn numbers, after those of the scale
_OUTLINE_BGR = (0, 255, 255)


@dataclass(frozen=True)
class Lesion:
    """Where a lesion is: `masks`, a folder of pictures numbered as frames, or one picture, or corners (N, 2), px.

    frame : that a picture or corners are of; None for a folder. A pixel belongs to the lesion where it is not 0.
    """

    masks: Path | np.ndarray
    frame: int | None = None


@dataclass(frozen=True)
class MeasuredLesion:
    """What was measured of a lesion, what its scale rests on, and its masks (H, W) bool in the frames that count."""

    measures: list[Measure]
    scale: str
    masks: dict[int, np.ndarray]


def measure_lesion(folder: Path, lesion: Lesion, known: Known | None = None) -> MeasuredLesion:
    """Return the sizes of a lesion on the surface of a run.

    known : what gives the scale; needed where the run does not know it. Raises `InputError` where it is missing, where
    masks do not fit, and where no frame sees the whole lesion.
    """
    run = read_exported(folder)
    scale = known_scale(run, known)
    given = _given_masks(run, lesion)
    masks = given if lesion.frame is None else carried_masks(run, lesion.frame, given[lesion.frame])
    views = {index: view for index, mask in masks.items() if (view := _view(run, index, mask))}
    if not views:
        raise InputError(
            f"no frame of {folder} sees the whole lesion with its depth: it is cut off, smaller than {_LEAST_PX} pixels, "
            "or its depth is unknown"
        )
    found = []
    for row, figure in enumerate(FIGURES, start=_FIRST_ROW):
        power = _POWERS.get(figure, 1)
        combined = _combined(run, views, masks, figure)
        if combined is not None:
            value, sigma = combined
            draws = (
                np.exp(power * sigma * drawn(row, 1, scale.sizes["draws"])[0]) * (scale.draws / scale.focal) ** power
            )
            unit = scale.unit if power == 1 else scale.square
            found.append(Measure.of(_NAMES[figure], value / scale.divisor**power, draws, unit, scale.sizes))
    return MeasuredLesion(found, scale.words, {index: masks[index] for index in views})


def _given_masks(run: ExportedRun, lesion: Lesion) -> dict[int, np.ndarray]:
    """Return the masks (H, W) bool as they were given, by the number of the frame."""
    camera, indices = run.camera, set(run.trajectory.indices.tolist())
    if lesion.frame is not None:
        if lesion.frame not in indices:
            raise InputError(f"frame {lesion.frame}, of which the lesion's mask is, has no pose in {run.path}")
        if isinstance(lesion.masks, Path):
            return {lesion.frame: _read_mask(run, lesion.masks)}
        mask = np.zeros((camera.height, camera.width), np.uint8)
        cv2.fillPoly(mask, [np.rint(lesion.masks).astype(np.int32)], 1)
        return {lesion.frame: mask > 0}
    assert isinstance(lesion.masks, Path)
    files = by_number(file for file in lesion.masks.iterdir() if not file.name.startswith("."))
    masks = {index: _read_mask(run, file) for index, file in files.items() if index in indices}
    if not masks:
        raise InputError(f"no mask in {lesion.masks} has the number of a frame of the result {run.path}")
    return masks


def _read_mask(run: ExportedRun, file: Path) -> np.ndarray:
    """Return a mask (H, W) bool of the rectified picture; one of the input's picture is rectified."""
    picture, camera = read_decoded(file), run.camera
    if picture is None:
        raise InputError(f"cannot read the mask {file}: it is no image, or damaged")
    mask = (picture if picture.ndim == 2 else picture[..., :3].max(-1)) > 127
    height, width = mask.shape
    if (width, height) == (camera.width, camera.height):
        return mask
    source = run.source_camera_file
    if source is None or (calibration := read_calibration(source, (width, height), "scale")).camera.width != width:
        raise InputError(
            f"the mask {file} has {width}x{height} px, the frames of the run {camera.width}x{camera.height}"
        )
    return Rectifier(calibration.camera, camera).nearest(mask.astype(np.uint8)) > 0


def carried_masks(run: ExportedRun, frame: int, mask: np.ndarray) -> dict[int, np.ndarray]:
    """Return the masks (H, W) bool of what a mask of one frame shows, in all frames that see it, by number."""
    poses = dict(zip(run.trajectory.indices.tolist(), run.trajectory.T_world_camera, strict=True))
    surface = _marked(run, frame, mask, poses[frame])
    middle = np.asarray(surface.vertices)[np.asarray(surface.visual.vertex_colors)[:, 0] > 127].mean(axis=0)
    pixels = {n: run.camera.project(transform(inverse(pose), middle[None]))[0] for n, pose in poses.items()}
    size = np.array([run.camera.width, run.camera.height])
    near = [n for n, pixel in pixels.items() if n != frame and np.isfinite(pixel).all() and (0 <= pixel).all()]
    near = [n for n in near if (pixels[n] < size).all()]
    masks = {frame: mask}
    for index in near[:: -(-len(near) // _MOST_FRAMES) or 1]:
        seen = render_mesh(_at(run, surface, index), run.camera, poses[index])
        depth_mm = run.depth.read(index)
        if depth_mm is None:
            continue
        there = seen.rgb[..., 0] > 127
        clear = there & ~(depth_mm < (1 - _IN_FRONT) * seen.depth_mm)
        if there.any() and clear.sum() >= _LEAST_LEFT * there.sum():
            masks[index] = there
    return dict(sorted(masks.items()))


def _at(run: ExportedRun, mesh: trimesh.Trimesh, index: int) -> trimesh.Trimesh:
    return mesh if run.states is None else run.states.moved(mesh, index)


def _marked(run: ExportedRun, frame: int, mask: np.ndarray, pose: np.ndarray) -> trimesh.Trimesh:
    """Return the surface, its vertices white where a frame sees them inside a mask, black elsewhere."""
    mesh = run.mesh
    seen = render_mesh(_at(run, mesh, frame), run.camera, pose).depth_mm
    points = transform(inverse(pose), np.asarray(_at(run, mesh, frame).vertices))
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = run.camera.project(points).astype(np.float32)
    u, v = np.nan_to_num(pixels, nan=-9).clip(-9, 1e4).T
    level = cv2.remap(mask.astype(np.float32), u, v, cv2.INTER_LINEAR).ravel()
    there = cv2.remap(seen, u, v, cv2.INTER_NEAREST).ravel()
    level[~(points[:, 2] < (1 + _IN_FRONT / 2) * there) | (points[:, 2] <= 0)] = 0
    if not (level > 0.5).any():
        raise InputError(f"no surface where frame {frame} shows the lesion: a mask there can be carried nowhere")
    colours = np.repeat(np.rint(255 * level).astype(np.uint8)[:, None], 3, axis=1)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)


def _view(run: ExportedRun, index: int, mask: np.ndarray) -> dict[str, float]:
    """Return the figures of a lesion in a frame; {} where it is cut off, too small, or its depth unknown."""
    depth_mm = run.depth.read(index)
    inner = np.zeros(mask.shape, bool)
    inner[_EDGE_PX:-_EDGE_PX, _EDGE_PX:-_EDGE_PX] = True
    if depth_mm is None or (mask & ~inner).any() or mask.sum() < _LEAST_PX:
        return {}
    return view_shape(mask, depth_mm, run.camera)


def _combined(
    run: ExportedRun, views: dict[int, dict[str, float]], masks: dict[int, np.ndarray], figure: str
) -> tuple[float, float] | None:
    """Return a figure by all frames, and its relative standard deviation without the scale's; None: it is unknown."""
    power = _POWERS.get(figure, 1)
    known = {n: view for n, view in views.items() if np.isfinite(view[figure]) and view[figure] > 0}
    if not known:
        return None
    values = np.array([view[figure] for view in known.values()])
    width_px = np.array([2 * np.sqrt(masks[n].sum() / np.pi) for n in known])
    facing = np.array([np.nan_to_num(view["facing"], nan=0.5) for view in known.values()]).clip(0.05, 1)
    outline = np.sqrt(2) * _OUTLINE_PX / width_px
    weights = facing**2 / (outline**2 + _LOCAL_ERROR[figure] ** 2)
    value = _weighted_median(values, weights)
    spread = 1.48 * _weighted_median(np.abs(np.log(values / value)), weights) / power
    effective = weights.sum() ** 2 / (weights**2).sum()
    own = spread**2 * (_COMMON + (1 - _COMMON) / effective)
    common = np.average(outline**2, weights=weights) + _LOCAL_ERROR[figure] ** 2
    return value, float(np.sqrt(own + common))


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(0.5 * weights.sum(), share, values[order]))


def write_outlines(run: Path, masks: dict[int, np.ndarray], folder: Path) -> None:
    """Write the frames' pictures that a run kept with the outlines of masks (H, W) bool on them, as JPEG."""
    exported = read_exported(run)
    for index, mask in masks.items():
        picture = read_decoded(exported.picture_file(index))
        if picture is not None:
            size = picture.shape[1::-1]
            shown = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            outlines = cv2.findContours(shown, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
            write_image(folder / f"{index:06d}.jpg", cv2.drawContours(picture.copy(), outlines, -1, _OUTLINE_BGR, 1))
