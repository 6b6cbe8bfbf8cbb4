"""The result of a run, and the folder it is written to.

out/  trajectory.tum  mesh.ply  mesh.glb  camera.yaml  source_camera.yaml  frames.csv  config.toml  provenance.json
      depth/000000.png (16 bit, depth/depth.json has the scale)  depth_sigma/000000.png (8 bit, relative)
      maps/1 (the same for submaps that are not merged), ...
"""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.config import Config
from scopemap.errors import InputError, reporting
from scopemap.frame import Frame
from scopemap.fusion.mesh_files import save_mesh
from scopemap.io.frame_choice import SkippedFrame
from scopemap.mapping.submaps import Submap
from scopemap.pipeline import Step
from scopemap.tracking.track import Track
from scopemap.trajectory.trajectory import SKIPPED, Trajectory, write_tum

DEPTH_SCALE_MM = 0.01
"""The finest unit of depth/*.png; the largest depth is then 655 mm."""

_LARGEST_UNIT = 65534
# Standard deviations in 8 bits: shares of depth from 0.1 % to 180 % in steps of 3 %; 0 = unknown.
_LEAST_SIGMA, _SIGMA_STEP = 0.001, 1.03
_COLUMNS = [
    *("index", "time_s", "name", "status", "reason", "keyframe", "residual", "inlier_share", "correlation"),
    *("overlap", "iterations"),
    *("depth_scale", "warped_share"),
]
_OWN_FILES = (
    *("trajectory.tum", "mesh.ply", "mesh.glb", "camera.yaml", "source_camera.yaml", "frames.csv"),
    *("config.toml", "provenance.json"),
)
_OWN_FOLDERS = ("depth", "depth_sigma", "pictures", "maps", "against_video")
# Files by which a run's folder is recognised: the first is written last, the second first.
_MARKS = ("provenance.json", "depth/depth.json")


@dataclass(frozen=True)
class FrameRecord:
    """One row of frames.csv: the results for a frame besides its images.

    `depth_scale` is MAPIS' factor of its depth, times the back end's.
    """

    index: int
    time_s: float
    name: str
    track: Track
    T_world_camera: np.ndarray
    depth_scale: float
    warped_share: float

    @classmethod
    def of(cls, step: Step) -> FrameRecord:
        """Return the record of a step; a lost frame's pose is the last one known."""
        frame, track = step.frame, step.track
        T_world_camera = track.T_world_camera if frame.T_world_camera is None else frame.T_world_camera
        scale, share = step.refined.scale, step.refined.warped_share
        return cls(frame.index, frame.time_s, frame.name, track, T_world_camera, scale, share)

    def row(self) -> list[str]:
        """Return the columns of frames.csv as text."""
        track = self.track
        numbers = (track.residual, track.inlier_share, track.correlation, track.overlap)
        return [
            *(str(self.index), f"{self.time_s:.6f}", self.name, track.status, track.reason, str(track.keyframe)),
            *("" if np.isnan(number) else f"{number:.5g}" for number in numbers),
            *(str(track.iterations), f"{self.depth_scale:.5g}", f"{self.warped_share:.3f}"),
        ]


def _skipped_row(frame: SkippedFrame) -> list[str]:
    """Return the columns of frames.csv as text for a frame that was not used."""
    known = [str(frame.index), f"{frame.time_s:.6f}", frame.name, SKIPPED, frame.reason]
    return known + [""] * (len(_COLUMNS) - len(known))


def records_of(submap: Submap, records: list[FrameRecord]) -> list[FrameRecord]:
    """Return the records with corrected poses and scales; frames of other submaps are lost in this one.

    A lost frame repeats the last tracked pose; those before the first tracked frame repeat the first.
    """
    first = next(record for record in records if record.index in submap.frames)
    last, out, started = _corrected(submap, first).T_world_camera, list[FrameRecord](), False
    for record in records:
        track = record.track
        if record.index not in submap.frames:
            reason = track.reason if track.status == "lost" else "tracked in another submap"
            record = replace(record, track=replace(track, status="lost", reason=reason), T_world_camera=last)
        else:
            if track.status == "initial" and started:
                record = replace(record, track=replace(track, status="ok", reason="first frame of a merged map"))
            record, started = _corrected(submap, record), True
            last = record.T_world_camera
        out.append(record)
    return out


def _corrected(submap: Submap, record: FrameRecord) -> FrameRecord:
    if submap.correction is None:
        return record
    pose = submap.correction.pose(record.index, record.T_world_camera)
    scale = record.depth_scale * submap.correction.depth_factor(record.index)
    return replace(record, T_world_camera=pose, depth_scale=scale)


@dataclass(frozen=True)
class Reconstruction:
    """The result of a run.

    Attributes
    ----------
    camera : working camera of all frames. records : one per frame, lost frames included.
    mesh : world mm, vertex colours; may be empty. config : the resolved settings.
    provenance : what the result depends on and what was assumed: input, camera, scale, weights, versions, machine,
        time.
    source_camera : the camera of the input's images before rectification; None where it is not kept. With it
        `camera.source_pixel` gives the pixel before rectification.
    skipped : frames that were read and not used.
    focal_sigma_px : standard deviation of the focal length of `camera` where it is an estimate, or None.
    others : the other submaps, each with its own world and scale, since their relative pose is unknown; most
        frames first.
    """

    camera: PinholeCamera
    records: list[FrameRecord]
    mesh: trimesh.Trimesh
    config: Config
    provenance: dict[str, Any] = field(default_factory=dict)
    source_camera: CameraModel | None = None
    skipped: list[SkippedFrame] = field(default_factory=list)
    focal_sigma_px: float | None = None
    others: list[Reconstruction] = field(default_factory=list)

    @property
    def trajectory(self) -> Trajectory:
        """The poses with their status; a lost frame repeats the last tracked pose."""
        records = self.records
        return Trajectory(
            np.array([record.index for record in records], dtype=np.int64),
            np.array([record.time_s for record in records]),
            np.stack([record.T_world_camera for record in records]),
            np.array([record.track.status for record in records]),
        )

    @property
    def lost(self) -> list[FrameRecord]:
        """The records of the frames that could not be tracked."""
        return [record for record in self.records if record.track.status == "lost"]

    def save(self, folder: Path) -> None:
        """Write everything but the depth maps, which a `DepthWriter` writes frame by frame.

        Raises `InputError` where the folder cannot be written.
        """
        folder = Path(folder)
        for number, other in enumerate(self.others, 1):
            other.save(folder / "maps" / str(number))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_tum(folder / "trajectory.tum", self.trajectory)
            save_mesh(self.mesh, folder / "mesh.ply", folder / "mesh.glb")
            sigma_px = self.focal_sigma_px
            write_calibration(self.camera, folder / "camera.yaml", focal_sigma_px=sigma_px)
            if (source := self.source_camera) is not None:
                sigma_px = None if sigma_px is None else sigma_px * source.central.fx / self.camera.fx
                write_calibration(source, folder / "source_camera.yaml", focal_sigma_px=sigma_px)
            rows = [*map(FrameRecord.row, self.records), *map(_skipped_row, self.skipped)]
            with (folder / "frames.csv").open("w", newline="", encoding="utf-8") as file:
                csv.writer(file).writerows([_COLUMNS, *sorted(rows, key=lambda row: int(row[0]))])
            (folder / "config.toml").write_text(self.config.toml(), encoding="utf-8")
            provenance = json.dumps(self.provenance, indent=2) + "\n"
            (folder / "provenance.json").write_text(provenance, encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot write the result to {folder}: {error.strerror or error}") from None


class DepthWriter:
    """Writes the depth of each frame as 16-bit PNG, 0 = unknown, named by the frame's number.

    Beside it the standard deviation of frames that have one, as 8-bit PNG: 0.001 * 1.03^(v - 1) of the depth.

    largest_mm : depth that must be representable; it makes the unit coarser than `DEPTH_SCALE_MM` where necessary.
    Raises `InputError` where nothing can be written.
    """

    def __init__(self, folder: Path, largest_mm: float = 0.0) -> None:
        self._folder, self._sigma_folder = (Path(folder) / name for name in ("depth", "depth_sigma"))
        self._scale_mm = _unit_for(largest_mm)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            description = json.dumps({"scale_mm": self._scale_mm, "unknown": 0}) + "\n"
            (self._folder / "depth.json").write_text(description, encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot write depth to {self._folder}: {error.strerror or error}") from None

    def __call__(self, frame: Frame) -> None:
        """Write the depth of a frame, and its standard deviation where it has one."""
        depth_mm = np.asarray(frame.depth_mm)
        units = np.nan_to_num(depth_mm / self._scale_mm, nan=0.0)
        image = np.where(units < _LARGEST_UNIT + 1, np.round(units), 0).astype(np.uint16)
        _write_png(self._folder / f"{frame.index:06d}.png", image)
        if frame.depth_sigma_mm is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                code = 1 + np.log(frame.depth_sigma_mm / depth_mm / _LEAST_SIGMA) / np.log(_SIGMA_STEP)
            levels = np.where(np.isnan(code), 0, np.clip(np.round(code), 1, 255)).astype(np.uint8)
            with reporting(f"cannot write to {self._sigma_folder}"):
                self._sigma_folder.mkdir(exist_ok=True)
            _write_png(self._sigma_folder / f"{frame.index:06d}.png", levels)


def _write_png(file: Path, image: np.ndarray) -> None:
    try:
        written = cv2.imwrite(str(file), image)
    except cv2.error:
        written = False
    if not written:
        raise InputError(f"cannot write {file}: the disk is full or the folder may not be written")


class DepthReader:
    """Reads back the depth of a run's folder.

    Raises `InputError` where depth/depth.json is there but cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._sigma_folder = (Path(folder) / name for name in ("depth", "depth_sigma"))
        description = self._folder / "depth.json"
        self.present = description.is_file()
        """Whether the run kept its depth."""
        try:
            self._scale_mm = float(json.loads(description.read_text())["scale_mm"]) if self.present else 0.0
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"cannot read {description}: {error}") from None

    def read(self, index: int) -> np.ndarray | None:
        """Return depth (H, W) float32, mm, NaN = unknown, of the frame with this number; None where none was kept."""
        image = _read_png(self._folder / f"{index:06d}.png")
        if image is None:
            return None
        return np.where(image > 0, image * np.float32(self._scale_mm), np.float32(np.nan))

    def read_sigma(self, index: int) -> np.ndarray | None:
        """Return the standard deviation of `read`, to 1.5 %, in the same form; None where none was kept."""
        depth_mm, levels = self.read(index), _read_png(self._sigma_folder / f"{index:06d}.png")
        if depth_mm is None or levels is None:
            return None
        share = _LEAST_SIGMA * _SIGMA_STEP ** (levels.astype(np.float32) - 1)
        return np.where(levels > 0, share * depth_mm, np.float32(np.nan)).astype(np.float32)


def _read_png(file: Path) -> np.ndarray | None:
    return cv2.imread(str(file), cv2.IMREAD_UNCHANGED) if file.is_file() else None


def _unit_for(largest_mm: float) -> float:
    """Return the smallest of 0.01, 0.02, 0.05, 0.1, ... mm with which the largest depth is representable."""
    least = max(largest_mm / _LARGEST_UNIT, DEPTH_SCALE_MM) * (1 - 1e-6)
    power = 10.0 ** math.floor(math.log10(least))
    return next(round(digit * power, 12) for digit in (1, 2, 5, 10) if digit * power >= least)


def prepare_folder(folder: Path, *, overwrite: bool) -> None:
    """Make an empty folder for a run; with `overwrite` an earlier run's files in it are removed, nothing else.

    Raises `InputError` if a file has that name, or if the folder to overwrite holds no run.
    """
    folder = Path(folder)
    try:
        _make_empty(folder, overwrite=overwrite)
    except OSError as error:
        raise InputError(f"cannot write a run to {folder}: {error.strerror or error}") from None


def _make_empty(folder: Path, *, overwrite: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"cannot write a run to {folder}: a file has that name")
    if folder.is_dir() and any(folder.iterdir()):
        if not overwrite:
            raise InputError(f"cannot write a run to {folder}: it is not empty; name another folder or use --overwrite")
        if not any((folder / mark).is_file() for mark in _MARKS):
            raise InputError(f"will not overwrite {folder}: it holds no run; name another folder")
        for name in _OWN_FILES:
            (folder / name).unlink(missing_ok=True)
        for name in _OWN_FOLDERS:
            shutil.rmtree(folder / name, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"cannot write a run to {folder}: the folder is read-only; name another one")
