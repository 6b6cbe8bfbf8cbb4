"""A run's folder, read for its report."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.errors import InputError, reporting
from scopemap.io.decoding import read_decoded
from scopemap.reconstruction import COLUMNS, Reconstruction
from scopemap.report.frame_pictures import picture_file, pictured_frames, read_measures
from scopemap.trajectory.formats.folders import submap_folders
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap.trajectory.trajectory import OTHER_MAP as TRACKED_ELSEWHERE
from scopemap.trajectory.trajectory import ROTATION_ONLY, SKIPPED, Trajectory

LOST, OTHER_MAP, NOT_USED, ROTATED = -1, -2, -3, -4
"""Where a frame is if in no map that was kept: lost; in a map too short to be kept; skipped before tracking; lost but
for its rotation."""


@dataclass(frozen=True)
class KeptMap:
    """A submap of a run: the numbers of its frames (N,) and their poses (N, 4, 4), world mm, and its mesh."""

    indices: np.ndarray
    T_world_camera: np.ndarray
    mesh: trimesh.Trimesh


@dataclass(frozen=True)
class KeptRun:
    """A run: what its folder holds, or what is in memory.

    Attributes
    ----------
    folder : of the run; None in memory, where no pictures and depth are.
    provenance : its provenance.json. config : the text of its config.toml.
    rows : frames.csv, one per frame, skipped ones too. maps : the result first, then maps/1, maps/2, ...
    place : (N,) int64, for each row the number of its map in `maps`, or `LOST`, `ROTATED`, `OTHER_MAP` or `NOT_USED`.
    """

    folder: Path | None
    rows: list[dict[str, str]]
    maps: list[KeptMap]
    place: np.ndarray
    provenance: dict[str, Any] = field(default_factory=dict)
    config: str = ""

    @cached_property
    def indices(self) -> np.ndarray:
        """(N,) int64 numbers of the frames."""
        return np.array([int(row["index"]) for row in self.rows], dtype=np.int64)

    def column(self, name: str) -> np.ndarray:
        """Return a column of frames.csv as (N,) float64, NaN where it is empty."""
        return np.array([float(row.get(name) or "nan") for row in self.rows])

    def measures(self) -> tuple[np.ndarray, np.ndarray]:
        """Return sharpness and milliseconds of the frames, (N,) float64 each, NaN where they were not kept."""
        kept = {} if self.folder is None else read_measures(self.folder)
        found = np.array([kept.get(int(index), (np.nan, np.nan)) for index in self.indices]).reshape(-1, 2)
        return found[:, 0], found[:, 1]

    @cached_property
    def pictures(self) -> dict[int, Path]:
        """The files of the small pictures by the number of their frame, ascending."""
        if self.folder is None:
            return {}
        return {index: picture_file(self.folder, index) for index in pictured_frames(self.folder)}

    def depth_mm(self, index: int) -> np.ndarray | None:
        """Return the final depth of a frame, (H, W) float32, mm, NaN = unknown; None where none was kept."""
        if self.folder is None:
            return None
        folder = self.folder / "depth"
        file, description = folder / f"{index:06d}.png", folder / "depth.json"
        image = read_decoded(file) if description.is_file() else None
        if image is None:
            return None
        with reporting(f"cannot read {description}"):
            scale_mm = np.float32(json.loads(description.read_text(encoding="utf-8"))["scale_mm"])
        return np.where(image > 0, image * scale_mm, np.float32(np.nan))


def run_of(result: Reconstruction) -> KeptRun:
    """Return a result in memory in the form that reports are made from."""
    maps = []
    for one in (result, *result.others):
        known = one.trajectory.rows(one.trajectory.tracked)
        maps.append(KeptMap(known.indices, known.T_world_camera, one.mesh))
    outside = {"lost": LOST, ROTATION_ONLY: ROTATED, TRACKED_ELSEWHERE: OTHER_MAP}
    # A submap is the result of its own report, whatever its number.
    tracked = [record.T_world_camera is not None for record in result.records]
    elsewhere = [record.map or outside.get(record.track.status, 0) for record in result.records]
    places = np.where(tracked, 0, elsewhere)
    rows = [dict(zip(COLUMNS, record.row(), strict=True)) for record in result.records]
    return KeptRun(None, rows, maps, places.astype(np.int64), result.provenance)


def is_run(folder: Path) -> bool:
    """Return whether a folder holds a finished run with its camera: an imported trajectory has none."""
    if not all((folder / name).is_file() for name in ("frames.csv", "trajectory.tum", "provenance.json")):
        return False
    with reporting(f"cannot read the run in {folder}"):
        return "camera" in json.loads((folder / "provenance.json").read_text(encoding="utf-8"))


def read_run(folder: Path | str) -> KeptRun:
    """Read the folder of a run. Raises `InputError` where it holds none, or a damaged one."""
    folder = Path(folder)
    if not is_run(folder):
        needed = "frames.csv, trajectory.tum and a provenance.json that knows the camera are needed"
        raise InputError(f"no finished run in {folder}: {needed}")
    trajectory = read_trajectory(folder, kind="run")
    folders = submap_folders(folder)
    maps = [_kept_map(*pair) for pair in zip(folders, (trajectory, *trajectory.others), strict=True)]
    with reporting(f"cannot read the run in {folder}"):
        provenance = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
        with (folder / "frames.csv").open(newline="", encoding="utf-8") as table:
            rows = list(csv.DictReader(table))
        config = folder / "config.toml"
        text = config.read_text(encoding="utf-8") if config.is_file() else ""
        map_of = {int(index): number for number, kept in reversed(list(enumerate(maps))) for index in kept.indices}
        place = np.array([map_of.get(int(row["index"]), _outside(row)) for row in rows], dtype=np.int64)
    return KeptRun(folder, rows, maps, place, provenance, text)


def _kept_map(folder: Path, trajectory: Trajectory) -> KeptMap:
    tracked = trajectory.tracked
    poses, mesh = trajectory.T_world_camera[tracked], _read_mesh(folder / "mesh.ply")
    return KeptMap(trajectory.indices[tracked], poses, mesh)


def _read_mesh(file: Path) -> trimesh.Trimesh:
    """Return the mesh in a file with its vertices' attributes; an empty one where there is no file or no face."""
    if not file.is_file():
        return trimesh.Trimesh()
    with reporting(f"cannot read {file}"):
        mesh = trimesh.load(file, process=False)
        if not isinstance(mesh, trimesh.Trimesh):
            return trimesh.Trimesh()
        # trimesh leaves properties that it does not know in the raw table.
        vertices = mesh.metadata["_ply_raw"]["vertex"]["data"]
        for name in {"confidence", "moving"} & set(vertices.dtype.names):
            mesh.vertex_attributes[name] = np.array(vertices[name])
    return mesh


def _outside(row: Mapping[str, str]) -> int:
    """Return where a frame is that no kept map holds."""
    if row["status"] == SKIPPED:
        return NOT_USED
    if row["status"] == ROTATION_ONLY:
        return ROTATED
    return LOST if row["status"] == "lost" else OTHER_MAP
