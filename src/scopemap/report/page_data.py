"""What the report's page shows, as JSON: verdict, frames, poses, pictures, meshes, settings."""

from __future__ import annotations

import tomllib
from base64 import b64encode
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import BaseModel, ValidationError

from scopemap.engine.errors import ScopemapError
from scopemap.engine.geometry.align import align_trajectories
from scopemap.input.trajectory.trajectory import Trajectory
from scopemap.report.facts import PicturedFrame, ReportFacts
from scopemap.report.measured_by_hand import advice_by_reference, earlier_references, read_measurements
from scopemap.report.plain_step import plain_step
from scopemap.report.shown_maps import MapOnPage, opening_row, shown_map_numbers
from scopemap.report.shown_mesh import SeenFrame, base64_of, mesh_data, textured_surface
from scopemap.report.video_parts import video_parts
from scopemap.result.evidence import notices_of, scale_source
from scopemap.result.input_part import part_of_input
from scopemap.result.losses import losses
from scopemap.result.reference import read_reference
from scopemap.result.result import Result
from scopemap.result.run_input import PLACES, places_of_input
from scopemap.result.summary import frames_per_s
from scopemap.result.verdict import gives_reason, verdict
from scopemap.result.wording import in_words

COVERAGE = "coverage"
_MOST_BYTES = 10_000_000
"""Of pictures, in base64."""
_LOOKED_AT = 25
_CURVES = {"inliers": "inlier_share", "agreement": "correlation", "scale": "depth_scale", "moving": "moving_share"}


def page_data(facts: ReportFacts, *, name: str = "", share: float = 1.0) -> dict[str, Any]:
    """Return what the page shows of a run.

    name : by default that of the input. share : of the page's size that is the run's.
    """
    run, maps = facts.run, facts.maps
    pictures = _within_budget([_picture_data(facts, frame) for frame in facts.frames], share * _MOST_BYTES)
    source = str(run.provenance.get("input", ""))
    return {
        "name": name or Path(source).name or source,
        # Where it was tells a reader nothing: a video that was sent to the window was in a temporary place.
        "input": Path(source).name if Path(source).is_absolute() else source,
        **by_hand_data(run),
        "titles": [one.facts for one in maps],
        "scale_known": run.scale_known,
        "scale_source": scale_source(run.provenance),
        "notes": _notes(run),
        "frames_per_s": frames_per_s(run),
        "camera": {key: getattr(run.camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        "frames": _frames(run, maps),
        "opens_at": opening_row(run),
        "depth_range": facts.depth_range_mm,
        "pictures": pictures,
        "depth_unit_mm": float(np.float32(run.depth.scale_mm)),
        "coverage": _coverage(run),
        "maps": _maps(facts, {one["row"] for one in pictures}),
        "losses": [
            {"row": loss.first, "when": loss.when, "frames": loss.frames, "cause": loss.cause, "advice": loss.advice}
            for loss in losses(run.frames)
        ],
        "used_part": part_of_input(run.provenance),
        "parts": [asdict(part) for part in video_parts(run)],
        "not_shown_maps": len(run.submaps) - len({id(one.result) for one in maps}),
        "albedo": tomllib.loads(run.config_text).get("fusion", {}).get("colours") != "raw",
        "truth": _truth(run),
        "config": run.config_text,
        "provenance": {name: value for name, value in run.provenance.items() if name not in (*PLACES, "input")},
    }


def by_hand_data(run: Result) -> dict[str, Any]:
    """Return what of `page_data` changes with what is measured by hand: that, and the verdict with what sizes are.

    `by_earlier_reference`: rows of the measurements whose reference was changed or forgotten.
    """
    found, kept = verdict(run), read_measurements(run.folder)
    advice = advice_by_reference(found.advice, kept)
    reasons = [asdict(reason) | {"plain_step": plain_step(reason.next_step)} for reason in found.reasons]
    shown = asdict(found) | {"word": found.word, "advice": advice, "reasons": reasons}
    earlier = [number for number, is_so in enumerate(earlier_references(run, kept, kept)) if is_so]
    return {"verdict": shown, "measurements": kept, "by_earlier_reference": earlier}


def _notes(run: Result) -> list[str]:
    """Return the notices of a run that are no reasons of its verdict, in words."""
    found = notices_of(run.provenance)
    return [in_words(one, scale_known=run.scale_known) for one in found if not gives_reason(one.code)]


def _frames(run: Result, maps: list[MapOnPage]) -> dict[str, Any]:
    """Return the columns of all frames; a pose is (3, 4), row by row, NaN where there is none."""
    frames, in_map = run.frames, run.frames.submap
    poses = np.full((len(frames), 3, 4), np.nan)
    for number, submap in enumerate(run.submaps):
        pose_of = _pose_of(submap)
        for row in np.flatnonzero(in_map == number):
            poses[row] = pose_of[int(frames["index"][row])][:3]
    curves = {name: frames[column] for name, column in _CURVES.items()}
    # A lost frame has no scale of its own.
    curves["scale"] = np.where(np.isnan(poses[:, 0, 0]), np.nan, curves["scale"])
    measures = [run.measures.get(index, (np.nan, np.nan)) for index in frames["index"].tolist()]
    curves["sharpness"], curves["ms"] = np.array(measures).reshape(-1, 2).T
    # The different reasons why frames are not in a map, and for each frame the number of its own, or -1.
    reasons = np.where(in_map < 0, frames["reason"], "")
    different = sorted({reason for reason in reasons if reason})
    number_of = {reason: number for number, reason in enumerate(different)} | {"": -1}
    causes = sorted(set(frames["cause"].tolist()))
    return {
        "count": len(frames),
        "causes": causes,
        "cause": base64_of(np.searchsorted(causes, frames["cause"]), "i1"),
        "index": base64_of(frames["index"], "i4"),
        "time_s": base64_of(frames["time_s"], "f4"),
        "place": base64_of(shown_map_numbers(run, maps), "i2"),
        "pose": base64_of(poses, "f8"),
        "curves": {name: base64_of(values, "f4") for name, values in curves.items()},
        "reasons": different,
        "reason": base64_of(np.array([number_of[reason] for reason in reasons]), "i2"),
    }


def _coverage(run: Result) -> dict[str, Any] | None:
    """Return what `scopemap coverage` wrote beside the result, and its map as PNG; None: nothing, or it is damaged."""
    folder = run.folder / COVERAGE
    try:
        found = _CoverageData.model_validate_json((folder / "coverage.json").read_bytes())
        picture = (folder / "map.png").read_bytes()
    except (OSError, ValidationError):
        return None
    return found.model_dump() | {"map": b64encode(picture).decode()}


class _NotSeen(BaseModel):
    start: float
    end: float
    share: float
    area: float


class _Spot(BaseModel):
    area: float
    along: float
    clock: float | None
    position_mm: tuple[float, float, float]
    frame: int
    time_s: float


class _CoverageData(BaseModel):
    kind: str
    unit: str
    statement: str
    total: _NotSeen
    blind_spots: list[_Spot]


def _pose_of(submap: Result) -> dict[int, np.ndarray]:
    frames = submap.frames.only(submap.frames.tracked)
    return dict(zip(frames["index"].tolist(), frames["T_world_camera"], strict=True))


def _within_budget(pictures: list[dict[str, Any]], most_bytes: float) -> list[dict[str, Any]]:
    """Leave every second picture out until the others fit on the page."""
    sizes = [sum(len(part) for part in one.values() if isinstance(part, str)) for one in pictures]
    while len(pictures) > 1 and sum(sizes) > most_bytes:
        pictures, sizes = pictures[::2], sizes[::2]
    return pictures


def _picture_data(facts: ReportFacts, frame: PicturedFrame) -> dict[str, Any]:
    """Return a frame's files; depth: red and green are the upper and lower byte of the run's unit, 0 = unknown."""
    files = {"jpg": frame.jpg, "mask": frame.mask, "depth": b""}
    if frame.depth_mm is not None:
        units = np.nan_to_num(np.round(frame.depth_mm / facts.run.depth.scale_mm)).astype(np.uint16)
        coded = np.dstack([np.zeros_like(units), units & 255, units >> 8]).astype(np.uint8)
        files["depth"] = cv2.imencode(".png", coded)[1].tobytes()
    return {"row": frame.row} | {name: b64encode(content).decode() for name, content in files.items()}


def _maps(facts: ReportFacts, rows: set[int]) -> list[dict[str, Any]]:
    """Return the meshes of the maps, the result first, each with its place in time and what is said of its inliers.

    rows : of the frames whose pictures are on the page.
    """
    run, found = facts.run, []
    turn = {one.number: k for k, one in enumerate(facts.submaps)}
    in_map = shown_map_numbers(run, facts.maps)
    for number, (one, mesh) in enumerate(zip(facts.maps, facts.meshes, strict=True)):
        pose_of = _pose_of(one.result)
        looking = [(f.index, f.depth_mm) for f in facts.frames if f.row in rows and in_map[f.row] == number]
        known = [(index, depth_mm) for index, depth_mm in looking if depth_mm is not None]
        known = known[:: max(1, -(-len(known) // _LOOKED_AT))]
        seen = [SeenFrame(pose_of[index], depth_mm) for index, depth_mm in known]
        textured = textured_surface(one.result, one.segment, mesh)
        data = mesh_data(mesh, seen, run.camera, textured)
        counts = {"frames": int((in_map == number).sum()), "all_faces": len(one.mesh.faces)}
        found.append(data | counts | {"turn": turn.get(number, number), "inliers": facts.inliers.get(number, "")})
    return found


def _truth(run: Result) -> dict[str, Any] | None:
    """Return the true camera positions of the result's frames, moved and scaled onto it; None where none are known."""
    frames = run.frames.only(run.frames.tracked)
    try:
        reference = next((read_reference(place) for place in places_of_input(run.folder) if place.is_dir()), None)
        return None if reference is None else _aligned(reference, frames["index"], frames["T_world_camera"])
    except ScopemapError:  # no poses, or too few or too straight a path to be aligned
        return None


def _aligned(reference: Trajectory, indices: np.ndarray, T_world_camera: np.ndarray) -> dict[str, Any] | None:
    """Return positions and the error of the estimate as a share of the path's length."""
    common, of_truth, of_estimate = np.intersect1d(reference.indices, indices, return_indices=True)
    if len(common) < 3:
        return None
    estimate = T_world_camera[of_estimate]
    moved, _ = align_trajectories(reference.T_world_camera[of_truth], estimate, "sim3")
    error = np.linalg.norm(moved[:, :3, 3] - estimate[:, :3, 3], axis=1)
    length = float(np.linalg.norm(np.diff(moved[:, :3, 3], axis=0), axis=1).sum())
    return {
        "positions": base64_of(moved[:, :3, 3], "f4"),
        "error_share": float(np.sqrt((error**2).mean())) / max(length, 1e-9),
    }
