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
from numpy.typing import ArrayLike
from scipy import ndimage

from scopemap.apps.measure.intervals import LogChanges
from scopemap.apps.measure.measure import WIDE, Known, KnownScale, Measure, known_scale
from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.errors import InputError, SettingsError, check_shape
from scopemap.engine.geometry.lesion_shape import LesionShape, lesion_shape
from scopemap.engine.geometry.rendering import render_mesh, vertex_colours
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.decoding import by_number, read_decoded, write_image
from scopemap.input.image_names import decimal_numbers
from scopemap.result.result import Result, opened

_OF_VIEWS = "the outline and what frames differ by"
_OF_RELIEF = "depth, which tells little of relief"
_FIGURES = {
    "diameter": ("largest diameter", 1, 0.04),
    "cross": ("diameter across it", 1, 0.12),
    "along": ("along the surface", 1, 0.12),
    "area": ("area", 2, 0.14),
}
"""Name, power of the unit, and the standard deviation, as a share of a length, that all frames have in common.

It is by phantoms (docs/measure.md): local errors of depth, and that lesions are not round.
"""
_LOWER = 0.1
_HIGHER = 0.7
"""A height is too large by no more than this share of the diameter, too small by no more than that: depth is smooth."""
_OUTLINE_PX = 0.5
_LEAST_FACING = 0.1
_EDGE_PX = 2
_LEAST_PX = 60
_MOST_FRAMES = 60
_IN_FRONT = 0.1
_LEAST_LEFT = 0.8
_MOST_DIFFERENCE = np.log(1.5)
_OUTLINE_BGR = (0, 255, 255)
_OUTLINE_POINTS = 60
_ROUNDED_S = 0.05  # a time that was read to a tenth of a second


@dataclass(frozen=True)
class MeasuredLesion:
    """What was measured of a lesion.

    scale : what its sizes rest on. masks : (H, W) bool in the frames that count. outline_mm : (N, 3), on the surface,
    world, by the one of them that sees it best.
    """

    measures: list[Measure]
    scale: str
    masks: dict[int, np.ndarray]
    outline_mm: np.ndarray


def measure_lesion(
    result: Result | Path | str,
    masks: Path | str | ArrayLike,
    frame: int | None = None,
    *,
    reference: ArrayLike | None = None,
    reference_frame: int | None = None,
    reference_mm: float | None = None,
) -> MeasuredLesion:
    """Return the sizes of a lesion on the surface of a result, from all frames together.

    `measures` are its sizes, `scale` what they rest on, `masks` the lesion by frame. result : opened, or its folder.
    masks : a folder of pictures numbered as frames, white is lesion; or of one `frame` a picture, a mask (H, W) bool,
    or the corners (N, 2) of an outline, px. reference : two pixels (2, 2) of `reference_frame`, by default `frame`,
    whose straight distance is the unit of what is returned, or is `reference_mm`; needed where the run's scale is
    unknown. Raises `InputError` where it is missing, where masks do not fit, and where no frame sees the whole lesion.
    """
    run, pair = opened(result).checked(with_poses=True), None if reference is None else np.asarray(reference, float)
    scale = known_scale(run, _known(pair, frame if reference_frame is None else reference_frame, reference_mm))
    given = Path(masks) if isinstance(masks, Path | str) else np.asarray(masks)
    of_frames = _masks_of_folder(run, given) if isinstance(given, Path) and given.is_dir() else None
    shown = carried_masks(run, *_mask_of_frame(run, given, frame)) if of_frames is None else of_frames
    shapes = {index: shape for index, mask in shown.items() if (shape := _shape(run, index, mask)) is not None}
    if not shapes:
        raise InputError(
            f"no frame of {run.folder} sees the whole lesion with its depth: it is cut off, smaller than {_LEAST_PX} "
            "pixels, or its depth is unknown"
        )
    own = shapes.get(frame) if of_frames is None and frame is not None else None
    if own is not None:  # a frame of another diameter shows a part of it
        shapes = {
            n: shape for n, shape in shapes.items() if abs(np.log(shape.diameter / own.diameter)) < _MOST_DIFFERENCE
        }
    found = []
    for figure, (name, power, common) in _FIGURES.items():
        value, sigma = _combined(shapes, shown, figure, common)
        changes = scale.from_views.times(LogChanges.of_own(sigma)).to_power(power)
        unit = scale.unit if power == 1 else scale.square
        found.append(Measure.of(name, value / scale.divisor**power, changes, unit, _OF_VIEWS))
    found.append(_height(shapes, found[0], scale))
    counted = {index: shown[index] for index in shapes}
    sizes_px = np.array([mask.sum() for mask in counted.values()])
    best = list(counted)[int((_facing(shapes) * sizes_px).argmax())]
    return MeasuredLesion(found, scale.words, counted, _outline(run, best, counted[best]))


def _outline(run: Result, index: int, mask: np.ndarray) -> np.ndarray:
    """Return points (N, 3) of the surface, world mm, around what a mask (H, W) bool of a frame shows."""
    contours = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    pixels = max(contours, key=len)[:, 0]
    pixels = pixels[:: -(-len(pixels) // _OUTLINE_POINTS)]
    pose = run.tracked.trajectory.T_world_camera[run.tracked.trajectory.indices == index][0]
    depth_mm = render_mesh(run.mesh_at(index), run.camera, pose).depth_mm[pixels[:, 1], pixels[:, 0]]
    known = np.isfinite(depth_mm)
    return transform(pose, run.camera.unproject(pixels[known]) * depth_mm[known, None])


def _known(reference: np.ndarray | None, frame: int | None, length_mm: float | None) -> Known | None:
    if reference is None and length_mm is None:
        return None
    if reference is None or frame is None:
        raise SettingsError("a reference needs its two points, or a mask, and its frame: give them")
    return Known(frame, reference, length_mm)


def _masks_of_folder(run: Result, folder: Path) -> dict[int, np.ndarray]:
    """Return the masks (H, W) bool of the frames that have a pose, by the number of the frame."""
    tracked = set(run.tracked.trajectory.indices.tolist())
    found = sorted(file for file in folder.iterdir() if not file.name.startswith("."))
    if decimal_numbers(found) is not None:
        raise InputError(
            f"names of masks in {folder} end in decimal numbers, such as {found[0].name}, which are times, not numbers "
            "of frames; name each by its frame (the column index of frames.csv)"
        )
    files = by_number(found)
    masks = {index: _read_mask(run, file) for index, file in files.items() if index in tracked}
    if not masks:
        raise InputError(f"no mask in {folder} has the number of a frame of the result {run.path}")
    return masks


def _mask_of_frame(run: Result, mask: Path | np.ndarray, frame: int | None) -> tuple[int, np.ndarray]:
    """Return a frame's number and its mask (H, W) bool, by a picture, a mask, or corners (N, 2)."""
    if frame is None:
        raise SettingsError("a mask or an outline of a lesion needs its frame: give both")
    if frame not in run.tracked.trajectory.indices:
        raise InputError(f"frame {frame}, of which the lesion's mask is, has no pose in {run.path}")
    if isinstance(mask, Path):
        return frame, _read_mask(run, mask)
    size = run.camera.height, run.camera.width
    if mask.dtype == bool:
        check_shape("mask", mask, size)
        return frame, mask
    if len(mask) < 3:
        raise SettingsError(f"the outline of a lesion has {len(mask)} corners: three or more are needed")
    return frame, cv2.fillPoly(np.zeros(size, np.uint8), [np.rint(mask).astype(np.int32)], 1) > 0


def _read_mask(run: Result, file: Path) -> np.ndarray:
    """Return a mask (H, W) bool of the rectified picture; one of the input's picture is rectified."""
    picture, camera = read_decoded(file), run.camera
    if picture is None:
        raise InputError(f"cannot read the mask {file}: it is no image, or damaged")
    mask = (picture if picture.ndim == 2 else picture[..., :3].max(-1)) > 127
    height, width = mask.shape
    if (width, height) == (camera.width, camera.height):
        return mask
    source = run.source_camera_file
    if source is None:
        raise InputError(
            f"the mask {file} has {width}x{height} px, the frames of the run {camera.width}x{camera.height}"
        )
    calibration = read_calibration(source, (width, height), "scale")
    return Rectifier(calibration.camera, camera).nearest(mask.astype(np.uint8)) > 0


def frame_at(folder: Path, second: float) -> int:
    """Return the number of the frame with a pose that is shown at a time, s, of the video; `InputError` for none."""
    trajectory = Result(folder).checked(with_poses=True).tracked.trajectory
    times_s = trajectory.times_s
    nearest = int(np.abs(times_s - second).argmin())
    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if abs(times_s[nearest] - second) > max(step_s, _ROUNDED_S):
        where = f"its frames with a pose are from {times_s[0]:.2f} to {times_s[-1]:.2f} s, the nearest is"
        raise InputError(
            f"no frame with a pose is at {second:g} s in the result {folder}: {where} frame "
            f"{trajectory.indices[nearest]} at {times_s[nearest]:.2f} s"
        )
    return int(trajectory.indices[nearest])


def shaft_width(folder: Path, file: Path) -> np.ndarray:
    """Return two pixels (2, 2) as far apart as an instrument's shaft is wide, beside its tip, from a mask of it.

    The tip is the end of the mask that is farther from the picture's border.
    """
    mask = _read_mask(Result(folder).checked(with_poses=True), file)
    pixels = np.argwhere(mask)[:, ::-1].astype(float)
    if len(pixels) < _LEAST_PX:
        raise InputError(f"the mask {file} shows no shaft: it has {len(pixels)} pixels")
    middle = pixels.mean(axis=0)
    along, across = np.linalg.svd(pixels - middle, full_matrices=False)[2]
    place = (pixels - middle) @ along
    ends = middle + np.outer([place.min(), place.max()], along)
    from_border = np.minimum(ends, [mask.shape[1], mask.shape[0]] - ends).min(axis=1)
    along, place = (along, place) if from_border[1] >= from_border[0] else (-along, -place)
    width = len(pixels) / np.ptp(place)
    part = np.abs(place - (place.max() - width)) < 0.5 * width
    width = part.sum() / np.ptp(place[part])
    centre = middle + along * place[part].mean() + across * ((pixels - middle)[part] @ across).mean()
    return centre + np.outer([-0.5, 0.5], width * across)


def carried_masks(run: Result, frame: int, mask: np.ndarray) -> dict[int, np.ndarray]:
    """Return the masks (H, W) bool of what a mask of one frame shows, by number, in all frames of its segment that see
    it.
    """
    own = run.tracked.only(run.tracked["segment"] == run.segment_at(frame)) if len(run.segments) > 1 else run.tracked
    poses = dict(zip(own.trajectory.indices.tolist(), own.trajectory.T_world_camera, strict=True))
    surface = _marked(run, frame, mask, poses[frame])
    middle = np.asarray(surface.vertices)[vertex_colours(surface)[:, 0] > 127].mean(axis=0)
    pixels = {n: run.camera.project(transform(inverse(pose), middle[None]))[0] for n, pose in poses.items()}
    size = np.array([run.camera.width, run.camera.height])
    near = [n for n, pixel in pixels.items() if n != frame and np.isfinite(pixel).all() and (pixel >= 0).all()]
    near = [n for n in near if (pixels[n] < size).all()]
    masks = {frame: mask}
    for index in near[:: -(-len(near) // _MOST_FRAMES) or 1]:
        seen = render_mesh(surface, run.camera, poses[index])
        depth_mm = run.depth.read(index)
        if depth_mm is None:
            continue
        there = seen.rgb[..., 0] > 127
        clear = there & ~(depth_mm < (1 - _IN_FRONT) * seen.depth_mm)
        if there.any() and clear.sum() >= _LEAST_LEFT * there.sum():
            masks[index] = _largest_part(there)
    return dict(sorted(masks.items()))


def _largest_part(mask: np.ndarray) -> np.ndarray:
    """Return the largest connected part of a mask (H, W) bool: beside a gap of the surface lies what is behind."""
    _, parts, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return np.asarray(parts == 1 + facts[1:, cv2.CC_STAT_AREA].argmax())


def _marked(run: Result, frame: int, mask: np.ndarray, pose: np.ndarray) -> trimesh.Trimesh:
    """Return the surface, its vertices white where a frame sees them inside a mask, black elsewhere."""
    mesh = run.surface(run.segment_at(frame))
    seen = render_mesh(mesh, run.camera, pose).depth_mm
    points = transform(inverse(pose), np.asarray(mesh.vertices))
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = run.camera.project(points).astype(np.float32)
    u, v = np.nan_to_num(pixels, nan=-9).clip(-9, 1e4).T
    level = ndimage.map_coordinates(mask.astype(np.float32), [v, u], order=1)
    there = ndimage.map_coordinates(seen, [v, u], order=0, cval=np.nan)
    level[~(points[:, 2] < (1 + _IN_FRONT / 2) * there) | (points[:, 2] <= 0)] = 0
    if not (level > 0.5).any():
        raise InputError(
            f"no surface where frame {frame} shows the lesion: its mask cannot be transferred to other frames"
        )
    colours = np.repeat(np.rint(255 * level).astype(np.uint8)[:, None], 3, axis=1)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)


def _shape(run: Result, index: int, mask: np.ndarray) -> LesionShape | None:
    """Return the sizes of a lesion in a frame; None where it is cut off, too small, or its depth unknown."""
    depth_mm = run.depth.read(index)
    inner = mask[_EDGE_PX:-_EDGE_PX, _EDGE_PX:-_EDGE_PX]
    if depth_mm is None or inner.sum() < mask.sum() or mask.sum() < _LEAST_PX:
        return None
    return lesion_shape(mask, depth_mm, run.camera)


def _combined(
    shapes: dict[int, LesionShape], masks: dict[int, np.ndarray], figure: str, common: float
) -> tuple[float, float]:
    """Return a figure by all frames, and its relative standard deviation (of a length) without that of the scale."""
    power = _FIGURES[figure][1]
    values = np.array([getattr(shape, figure) for shape in shapes.values()])
    width_px = np.array([2 * np.sqrt(masks[index].sum() / np.pi) for index in shapes])
    outline = np.sqrt(2) * _OUTLINE_PX / width_px
    apart = np.array([shape.sigma for shape in shapes.values()])
    weights = _facing(shapes) ** 2 / (outline**2 + apart**2 + common**2)
    value = _weighted_median(values, weights)
    spread = 1.48 * _weighted_median(np.abs(np.log(values / value)), weights) / power
    return value, float(np.sqrt(spread**2 + np.average(outline**2 + apart**2, weights=weights) + common**2))


def _height(shapes: dict[int, LesionShape], diameter: Measure, scale: KnownScale) -> Measure:
    """Return the height by all frames that know it, 0 where none does; its interval is by the diameter."""
    values = np.array([shape.height for shape in shapes.values()])
    known = np.isfinite(values)
    value = _weighted_median(values[known], _facing(shapes)[known] ** 2) / scale.divisor if known.any() else 0.0
    value = max(value, 0.0)
    low, high = max(value - _LOWER * diameter.high, 0.0), value + _HIGHER * diameter.high
    return Measure("height", value, low, high, diameter.unit, _OF_RELIEF if high > WIDE * low else "")


def _facing(shapes: dict[int, LesionShape]) -> np.ndarray:
    """Return the cosines (N,) at which the frames see the wall, at least 0.1, also where it is unknown."""
    return np.nan_to_num([shape.facing for shape in shapes.values()]).clip(_LEAST_FACING, 1)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(0.5 * weights.sum(), share, values[order]))


def write_outlines(run: Path, masks: dict[int, np.ndarray], folder: Path) -> None:
    """Write the frames' pictures that a run kept with the outlines of masks (H, W) bool on them, as JPEG."""
    exported = Result(run).checked(with_poses=True)
    for index, mask in masks.items():
        picture = read_decoded(exported.picture_file(index))
        if picture is not None:
            size = picture.shape[1::-1]
            shown = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            outlines = cv2.findContours(shown, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
            write_image(folder / f"{index:06d}.jpg", cv2.drawContours(picture.copy(), outlines, -1, _OUTLINE_BGR, 1))
