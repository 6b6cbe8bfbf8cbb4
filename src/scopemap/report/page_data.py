"""What the report's page shows, as JSON: verdict, frames, poses, pictures, meshes, settings."""

from __future__ import annotations

import tomllib
from base64 import b64encode
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from pydantic import BaseModel, ValidationError

from scopemap.engine.errors import ScopemapError
from scopemap.engine.geometry.align import align_trajectories
from scopemap.input.trajectory.trajectory import Trajectory
from scopemap.report.frame_pictures import thinned
from scopemap.report.measured_by_hand import advice_by_reference, read_measurements
from scopemap.report.shown_maps import MapOnPage, opening_row, shown_map_numbers, shown_maps
from scopemap.report.shown_mesh import (
    FACES_OF_OTHERS,
    SeenFrame,
    base64_of,
    mesh_data,
    simplified,
    textured_surface,
)
from scopemap.report.video_parts import video_parts
from scopemap.result.evidence import notices_of, scale_source
from scopemap.result.frame_table import NOT_USED
from scopemap.result.input_part import part_of_input
from scopemap.result.losses import losses
from scopemap.result.reference import read_reference
from scopemap.result.result import Result
from scopemap.result.run_input import PLACES, places_of_input
from scopemap.result.submap_summaries import most_doubtful, submaps_in_time
from scopemap.result.summary import frames_per_s
from scopemap.result.verdict import gives_reason, verdict
from scopemap.result.wording import in_words

COVERAGE = "coverage"
_MOST_BYTES = 7_500_000
"""Of pictures, before base64, which makes them a third longer."""
_LOOKED_AT = 25
_DEPTH_WIDTH_PX = 160
_CURVES = {"inliers": "inlier_share", "agreement": "correlation", "scale": "depth_scale", "moving": "moving_share"}


@dataclass(frozen=True)
class _Picture:
    """A frame with a picture: its row, its files' contents, and its depth (h, w), mm, or None.

    depth : a PNG, red and green the upper and lower byte of the depth in the run's unit, 0 = unknown; empty: none.
    """

    row: int
    jpg: bytes
    mask: bytes
    depth: bytes
    depth_mm: np.ndarray | None


def shown_meshes(run: Result, most_faces: int) -> list[trimesh.Trimesh]:
    """Return the meshes of `shown_maps`, the result's first, with most faces.

    Others are simplified.
    """
    maps = shown_maps(run)
    most = [most_faces] + [min(most_faces, FACES_OF_OTHERS)] * (len(maps) - 1)
    return [simplified(one.mesh, faces) for one, faces in zip(maps, most, strict=True)]


def page_data(run: Result, meshes: list[trimesh.Trimesh], *, name: str = "", share: float = 1.0) -> dict[str, Any]:
    """Return what the page shows of a run.

    meshes : from `shown_meshes`. name : by default that of the input. share : of the page's size that is the run's.
    """
    camera, pictures = run.camera, _within_budget(_pictures(run), share * _MOST_BYTES)
    near_mm, far_mm = _depth_range([p.depth_mm for p in pictures if p.depth_mm is not None])
    source = str(run.provenance.get("input", ""))
    maps = shown_maps(run)
    return {
        "name": name or Path(source).name or source,
        "input": source,
        **by_hand_data(run),
        "titles": [one.facts for one in maps],
        "scale_known": run.scale_known,
        "scale_source": scale_source(run.provenance),
        "notes": [in_words(one) for one in notices_of(run.provenance) if not gives_reason(one.code)],
        "frames_per_s": frames_per_s(run),
        "camera": {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        "frames": _frames(run, maps),
        "opens_at": opening_row(run),
        "depth_range": [near_mm, far_mm],
        "pictures": [_picture_data(p) for p in pictures],
        "depth_unit_mm": float(np.float32(run.depth.scale_mm)),
        "coverage": _coverage(run),
        "maps": _maps(run, maps, meshes, pictures),
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
        "provenance": {name: value for name, value in run.provenance.items() if name not in PLACES},
    }


def by_hand_data(run: Result) -> dict[str, Any]:
    """Return what of `page_data` changes with what is measured by hand: that, and the verdict with what sizes are."""
    found, kept = verdict(run), read_measurements(run.folder)
    advice = advice_by_reference(found.advice, kept)
    return {"verdict": asdict(found) | {"word": found.word, "advice": advice}, "measurements": kept}


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
        found = _Covered.model_validate_json((folder / "coverage.json").read_bytes())
        picture = (folder / "map.png").read_bytes()
    except (OSError, ValidationError):
        return None
    return found.model_dump() | {"map": b64encode(picture).decode()}


class _NotSeen(BaseModel):
    share: float
    low: float
    high: float
    area: float


class _Spot(BaseModel):
    area: float
    along: float
    clock: float | None
    position_mm: tuple[float, float, float]
    frame: int
    time_s: float


class _Covered(BaseModel):
    kind: str
    unit: str
    caution: str = ""
    total: _NotSeen
    blind_spots: list[_Spot]


def _pose_of(submap: Result) -> dict[int, np.ndarray]:
    frames = submap.frames.only(submap.frames.tracked)
    return dict(zip(frames["index"].tolist(), frames["T_world_camera"], strict=True))


def _pictures(run: Result) -> list[_Picture]:
    rows = np.flatnonzero(run.frames.submap != NOT_USED)
    used, found = dict(zip(run.frames["index"][rows].tolist(), rows.tolist(), strict=True)), []
    for index in run.pictured:
        picture, mask = run.picture_file(index), run.mask_file(index)
        if index in used and mask.is_file():
            depth, depth_mm = _depth_picture(run, index)
            found.append(_Picture(used[index], picture.read_bytes(), mask.read_bytes(), depth, depth_mm))
    return found


def _depth_picture(run: Result, index: int) -> tuple[bytes, np.ndarray | None]:
    """Return a frame's depth as `_Picture` has it, every n-th pixel, at most 160 in a row."""
    depth_mm = run.depth.read(index)
    if depth_mm is None:
        return b"", None
    depth_mm = thinned(depth_mm, _DEPTH_WIDTH_PX)
    units = np.nan_to_num(np.round(depth_mm / run.depth.scale_mm)).astype(np.uint16)
    coded = np.dstack([units >> 8, units & 255, np.zeros_like(units)]).astype(np.uint8)
    return cv2.imencode(".png", coded[..., ::-1])[1].tobytes(), depth_mm


def _within_budget(pictures: list[_Picture], most_bytes: float) -> list[_Picture]:
    """Leave every second picture out until the others fit on the page."""
    sizes = [len(p.jpg) + len(p.mask) + len(p.depth) for p in pictures]
    while len(pictures) > 1 and sum(sizes) > most_bytes:
        pictures, sizes = pictures[::2], sizes[::2]
    return pictures


def _depth_range(depths_mm: list[np.ndarray]) -> tuple[float, float]:
    """Return the 1st and 99th percentile of all depths, mm, one range for the whole run."""
    known = [depth_mm[np.isfinite(depth_mm)][::7] for depth_mm in depths_mm]
    some = np.concatenate([*known, np.empty(0, np.float32)])
    if not some.size:
        return 1.0, 100.0
    near_mm, far_mm = (float(value) for value in np.percentile(some, [1, 99]))
    return round(near_mm, 3), round(max(far_mm, 1.2 * near_mm), 3)


def _picture_data(picture: _Picture) -> dict[str, Any]:
    files = {"jpg": picture.jpg, "mask": picture.mask, "depth": picture.depth}
    return {"row": picture.row} | {name: b64encode(content).decode() for name, content in files.items()}


def _maps(
    run: Result, maps: list[MapOnPage], meshes: list[trimesh.Trimesh], pictures: list[_Picture]
) -> list[dict[str, Any]]:
    """Return the meshes of the maps, the result first, each with its place in time and what is said of its inliers."""
    found, submaps = [], submaps_in_time(run.frames)
    turn, worst = {one.number: k for k, one in enumerate(submaps)}, most_doubtful(submaps)
    inliers = {one.number: one.inliers + ", most doubtful" * (one is worst) for one in submaps}
    in_map, indices = shown_map_numbers(run, maps), run.frames["index"].tolist()
    for number, (one, mesh) in enumerate(zip(maps, meshes, strict=False)):
        pose_of = _pose_of(one.result)
        looking = [p for p in pictures if in_map[p.row] == number and p.depth_mm is not None]
        looking = looking[:: max(1, -(-len(looking) // _LOOKED_AT))]
        seen = [SeenFrame(pose_of[indices[p.row]], p.depth_mm) for p in looking if p.depth_mm is not None]
        textured = textured_surface(one.result, one.segment, mesh)
        data = mesh_data(mesh, seen, run.camera, textured)
        facts = {"frames": int((in_map == number).sum()), "all_faces": len(one.mesh.faces)}
        found.append(data | facts | {"turn": turn.get(number, number), "inliers": inliers.get(number, "")})
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
