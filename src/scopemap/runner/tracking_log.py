"""The tracking log: what was decided of each frame, on disk, from which a killed run is resumed.

Together with the frames of the store and the rows of the table of frames it gives the steps of the run once more, and
`replay` brings the stages of a pipeline to where they were after these.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.depth.mapis import RefinedDepth
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.geometry.warp import resampled
from scopemap.engine.mapping.correction import KeyframeCorrection, KeyframeStep
from scopemap.engine.mapping.depth_correction import COLUMNS, LEVELS, ROWS, DepthCorrectionField
from scopemap.engine.odometry import Step
from scopemap.engine.pipeline import Pipeline
from scopemap.engine.preprocessing import with_unknown_depth
from scopemap.engine.tracking.causes import LossCause
from scopemap.engine.tracking.track import KeyframeDecision, Track
from scopemap.result.frame_table import FrameTable

_LOGGED = np.dtype(
    [
        ("index", np.int64),
        ("T_world_camera", np.float64, (4, 4)),  # as tracked: that of the table is smoothed
        ("depth_scale", np.float64),  # of the frame
        ("scale", np.float64),  # of MAPIS-Depth
        ("measured", bool),
        ("keyframe", "U9"),  # kind of the decision
        ("promotes_previous", bool),
        ("is_moved", bool),
        ("T_camera_arrived", np.float64, (4, 4)),
        ("log_scale", np.float64),
        ("has_field", bool),
        ("field", np.float64, (ROWS, COLUMNS, LEVELS)),
        ("nearest_farthest", np.float64, (2,)),
    ]
)


class TrackingLog:
    """Takes the steps of a run, in order, and returns them in another process; store : has the frames."""

    def __init__(self, store: FrameStore) -> None:
        self._store, self._rows = store, store.lasting_table("tracking_log", _LOGGED)

    def take(self, step: Step) -> None:
        """Put what was decided of a frame in. Raises `InputError` where the folder is full or read-only."""
        row, track = np.zeros(1, _LOGGED), step.track
        row["index"], row["T_world_camera"], row["measured"] = track.index, track.T_world_camera, step.measured
        row["depth_scale"], row["scale"] = step.frame.depth_scale, step.refined.scale
        row["keyframe"], row["promotes_previous"] = track.decision.kind, track.decision.promotes_previous
        if step.moved is not None:
            row["is_moved"], row["T_camera_arrived"] = True, step.moved.T_camera_arrived
            row["log_scale"], field = step.moved.after
            if field is not None:
                row["has_field"], row["field"] = True, field.values
                row["nearest_farthest"] = field.nearest, field.farthest
        self._rows.append(row)

    def steps(self, frames: FrameTable, camera: PinholeCamera) -> Iterator[Step]:
        """Yield the steps so far, frames as stored; of `step.moved` what came `before` is not known.

        frames : the table of these steps. camera : of the frames; those that were skipped come without a usable pixel.
        """
        for logged, row in zip(self._rows.read(), frames.rows, strict=True):
            stored, name = row["index"] in self._store, str(row["name"])
            frame = self._store.frame(int(row["index"])) if stored else _blank(row, camera)
            frame = replace(frame, name=name, depth_scale=float(logged["depth_scale"]))
            depth_mm = np.asarray(frame.depth_mm)
            sigma_mm = np.full_like(depth_mm, np.nan) if frame.depth_sigma_mm is None else frame.depth_sigma_mm
            refined = RefinedDepth(depth_mm, float(logged["scale"]), float(row["warped_share"]), sigma_mm)
            track = _track(logged, row, frame.nonrigidity)
            yield Step(frame, track, depth_mm, refined, not stored, bool(logged["measured"]), _moved(logged))


def replay(pipeline: Pipeline, records: Mapping[str, dict[str, Any]], steps: Iterable[Step]) -> Iterator[Step]:
    """Bring the stages of a new pipeline to where those of a killed run were after all of its steps; yield these.

    records : of all stages, made after the last step. Nothing is estimated, tracked or adjusted again; the mapper and
    what is fused at once are made anew from the frames.
    """
    for name, stage in pipeline.stages.items():
        stage.resume(records[name])
    preprocessing, odometry, step = pipeline.preprocessing, pipeline.odometry, None
    for step in steps:
        preprocessing.pass_over(step.frame.index)
        odometry.replay(step)
        pipeline.fusion.replay(step.frame, step.track.map)
        yield step
    if step is not None:
        frame = odometry.undone(step)
        small, sigma_mm = preprocessing.downscaled(frame), frame.depth_sigma_mm
        sigma_mm = None if sigma_mm is None else resampled(sigma_mm, small.camera)
        small = replace(small, depth_mm=resampled(np.asarray(frame.depth_mm), small.camera), depth_sigma_mm=sigma_mm)
        if not step.skipped:
            pipeline.matching.resume_after(small)
        odometry.resume_after(step.track, small)


def _blank(row: np.void, camera: PinholeCamera) -> Frame:
    size = camera.height, camera.width
    blank = Frame(int(row["index"]), float(row["time_s"]), np.zeros((*size, 3), np.uint8), camera, np.zeros(size, bool))
    return replace(with_unknown_depth(blank), quality=float(row["quality"]))


def _track(logged: np.void, row: np.void, nonrigidity: np.ndarray | None) -> Track:
    same = ("residual", "inlier_share", "correlation", "overlap", "usable", "sharpness", "motion", "quality")
    return Track(
        int(row["index"]),
        row["status"].item(),
        str(row["reason"]),
        logged["T_world_camera"].copy(),
        int(row["keyframe"]),
        iterations=int(row["iterations"]),
        map=int(row["map"]),
        cause=LossCause(row["cause"]),
        relocalised=bool(row["relocalised"]),
        rotation=None if np.isnan(row["rotation"]).any() else row["rotation"].copy(),
        nonrigidity=nonrigidity,
        decision=KeyframeDecision(logged["keyframe"].item(), "", bool(logged["promotes_previous"])),
        **{name: float(row[name]) for name in same},
    )


def _moved(logged: np.void) -> KeyframeStep | None:
    if not logged["is_moved"]:
        return None
    field = None
    if logged["has_field"]:
        field = DepthCorrectionField(logged["field"].copy(), *logged["nearest_farthest"].tolist())
    after = KeyframeCorrection(float(logged["log_scale"]), field)
    return KeyframeStep(logged["T_camera_arrived"].copy(), after=after)
