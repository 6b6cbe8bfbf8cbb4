"""Tissue that moves against its truth: its shape over time, and how far points of it are from where they truly went.

Both are after one Sim(3) for the whole run, fitted to its depth maps, each placed by its pose, and the tissue then.
A motion of all tissue against the camera counts as an error of displacement, though no view determines it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.align import Similarity, umeyama
from scopemap.engine.geometry.se3 import transform
from scopemap.engine.mapping.tissue_states import TissueStates
from scopemap.result.depth_maps import DepthReader
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.reread_frames import open_truth
from scopemap_bench.datasets.d4d import D4dClip, End
from scopemap_bench.phantom.writer import DISPLACEMENT

_MOVED_MM = 1.0
_FITS = 3
_OUTLIER = 3.0


@dataclass(frozen=True)
class ShapeOverTime:
    """median_mm : median distance of placed depth maps from the true tissue, each at its time, after `S_truth_run`."""

    median_mm: float
    S_truth_run: Similarity


@dataclass(frozen=True)
class DisplacementError:
    """Distance of points from their true places, by the estimated displacement since the first time.

    median_mm : over points and times with a true displacement of more than 1 mm, all where there is none. rms_mm : over
    all. still_mm, still_rms_mm : the same of an estimate in which nothing moves.
    """

    median_mm: float
    rms_mm: float
    still_mm: float
    still_rms_mm: float


def shape_over_time(run: Path, source: Path, every: int = 10, pixels: int = 8) -> ShapeOverTime:
    """Compare every so many frames' depth maps of a run, a grid of so many pixels, with a data set's depth and poses.

    The fit leaves out what is farther off than three medians. Raises `AlignmentError` without frames in common.
    """
    paths = [read_trajectory(folder).T_world_camera for folder in (run, source)]
    depth = DepthReader(run)
    clouds: tuple[list[np.ndarray], list[np.ndarray]] = ([np.zeros((0, 3))], [np.zeros((0, 3))])
    for frame, truth in open_truth(run, source):
        estimated_mm = depth.read(frame.index)
        if frame.index % every or truth is None or truth.depth_mm is None or estimated_mm is None:
            continue
        row, column = np.mgrid[: frame.camera.height : pixels, : frame.camera.width : pixels].reshape(2, -1)
        depths = [depth_mm[row, column] for depth_mm in (estimated_mm, truth.depth_mm)]
        known = frame.valid[row, column] & np.isfinite(depths[0]) & (depths[1] > 0)
        rays = frame.camera.unproject(np.column_stack([column, row])[known].astype(float))
        for points, depth_mm, T in zip(clouds, depths, paths, strict=True):
            points.append(transform(T[frame.index], depth_mm[known, None] * rays))
    found, true = (np.concatenate(points) for points in clouds)
    kept = np.isfinite(found).all(1)
    for _ in range(_FITS):
        aligned = umeyama(found[kept], true[kept], with_scale=True)
        far = np.linalg.norm(aligned.transform_points(found) - true, axis=1)
        median = float(np.nanmedian(far))
        kept = far < _OUTLIER * median
    return ShapeOverTime(median, aligned)


def displacement_error(run: Path, source: Path, S_truth_run: Similarity, every: int = 10) -> DisplacementError:
    """Compare a run's motion of tissue, none where it has none, with the phantom's at every so many frames."""
    true_mm = np.load(source / DISPLACEMENT)["positions_mm"][::every].astype(float)
    times_s = np.array([frame.time_s for frame, _ in open_truth(run, source)])[::every]
    moved = estimated_displacement(run, S_truth_run.inverse().transform_points(true_mm[0]), times_s)
    estimated = S_truth_run.scale * (moved - moved[0]) @ S_truth_run.R.T
    true = true_mm - true_mm[0]
    size, error = (np.linalg.norm(x, axis=-1)[np.isfinite(true).all(-1)] for x in (true, true - estimated))
    counted = size > _MOVED_MM if (size > _MOVED_MM).any() else np.ones(size.shape, bool)
    medians = [float(np.median(x[counted])) for x in (error, size)]
    rms = [float(np.sqrt(np.mean(x**2))) for x in (error, size)]
    return DisplacementError(medians[0], rms[0], medians[1], rms[1])


def structured_light_errors(run: Path, clip: Path) -> dict[str, float]:
    """Compare a run's depth with the structured light before and after the deformation of a clip of D4D.

    before_mm, after_mm : median differences, after one scale for both, the median ratio. still_mm : of the light after
    from that before, pixel by pixel. Raises `InputError` without the light or the depth.
    """
    sequence, depth = open_truth(run, clip), DepthReader(run)
    source = sequence.source
    assert isinstance(source, D4dClip)
    found, true = [], []
    ends: dict[End, int] = {"start": source.numbers[0], "end": source.numbers[-1]}
    for end, index in ends.items():
        light_mm, estimated_mm = source.structured_light_mm(end), depth.read(index)
        if light_mm is None or estimated_mm is None:
            raise InputError(f"{clip if light_mm is None else run} has no depth of frame {index} to compare")
        true.append(sequence.depth_rectifier.nearest(light_mm))
        found.append(estimated_mm)
    scale = np.nanmedian(np.stack(true) / np.stack(found))
    before, after = (float(np.nanmedian(np.abs(scale * f - t))) for f, t in zip(found, true, strict=True))
    return {"before_mm": before, "after_mm": after, "still_mm": float(np.nanmedian(np.abs(true[1] - true[0])))}


def estimated_displacement(run: Path, points: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Return the displacement (T, P, 3) mm of points (P, 3), in a run's world, at times (T,) s; 0 without a motion."""
    states = TissueStates.read(run)
    if states is None:
        return np.zeros((len(times_s), *points.shape))
    strength = np.stack([np.interp(times_s, states.time_s, curve) for curve in states.curves.T], 1)
    return np.tensordot(strength, states.motion(points), 1)
