"""The result of a run, and the folder it is written to.

out/  trajectory.tum  mesh.ply  mesh.glb  camera.yaml  source_camera.yaml  frames.csv  config.toml  provenance.json
      depth/000000.png (16 bit, depth/depth.json has the scale)  depth_sigma/000000.png (8 bit, relative)
      depth_preview/000000.jpg (colours)
      maps/1 (the same for submaps that are not merged), ...
"""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.config import Config
from scopemap.errors import InputError, reporting
from scopemap.frame import Frame
from scopemap.fusion.mesh_files import save_mesh
from scopemap.io.decoding import read_decoded, write_encoded
from scopemap.io.frame_choice import SkippedFrame
from scopemap.notices import Notice
from scopemap.odometry import Step
from scopemap.tracking.track import Track
from scopemap.trajectory.trajectory import OTHER_MAP, ROTATION_ONLY, SKIPPED, TRACKED, Trajectory, write_tum

DEPTH_SCALE_MM = 0.01
"""The finest unit of depth/*.png; the largest depth is then 655 mm."""

_LARGEST_UNIT = 65534
_FEW_FRAMES = 5
_PREVIEW_SHARES = (0.01, 0.99)  # of all known depth, at the ends of the colours
# Standard deviations in 8 bits: shares of depth from 0.1 % to 180 % in steps of 3 %; 0 = unknown.
_LEAST_SIGMA, _SIGMA_STEP = 0.001, 1.03
COLUMNS = [
    *("index", "time_s", "name", "status", "reason", "map", "keyframe", "residual", "inlier_share", "correlation"),
    *("overlap", "iterations"),
    *("depth_scale", "warped_share", "usable", "sharpness", "motion", "quality", "cause", "orientation"),
    *("moving_share", "moving_x", "moving_y"),
]
"""The columns of frames.csv."""


@dataclass(frozen=True)
class FrameRecord:
    """One row of frames.csv: the results for a frame besides its images.

    T_world_camera : (4, 4), or None where the frame has no pose in this submap: `track.status` is then "lost" or
        "other-map". depth_scale : MAPIS' factor of its depth, times the back end's.
    map : number of the submap it was tracked in, 0 for the result and N for `maps/N`; None where it is lost, in a
        submap too small to be saved, or not sorted yet. cause : why it is lost, by `causes_of_loss`. orientation :
        (3, 3) rotation to the world of a frame that is lost but for it: `track.status` is then "rotation-only".
    """

    index: int
    time_s: float
    name: str
    track: Track
    T_world_camera: np.ndarray | None
    depth_scale: float
    warped_share: float
    map: int | None = None
    cause: str = ""
    orientation: np.ndarray | None = None

    @property
    def pose(self) -> np.ndarray:
        """T_world_camera (4, 4), NaN where it is not known: all of it, or the position alone."""
        if self.T_world_camera is not None:
            return self.T_world_camera
        T = np.full((4, 4), np.nan)
        if self.orientation is not None:
            T[:3, :3] = self.orientation
        return T

    @classmethod
    def of(cls, step: Step) -> FrameRecord:
        """Return the record of a step, as tracked."""
        frame, track = step.frame, step.track
        scale, share = step.refined.scale, step.refined.warped_share
        return cls(frame.index, frame.time_s, frame.name, track, frame.T_world_camera, scale, share)

    def row(self) -> list[str]:
        """Return the columns of frames.csv as text."""
        track = self.track
        numbers = (track.residual, track.inlier_share, track.correlation, track.overlap)
        seen = (track.usable, track.sharpness, track.motion, track.quality)
        number = "" if self.map is None else str(self.map)
        return [
            *(str(self.index), f"{self.time_s:.6f}", self.name, track.status, track.reason),
            *(number, str(track.keyframe)),
            *("" if np.isnan(number) else f"{number:.5g}" for number in numbers),
            *(str(track.iterations), f"{self.depth_scale:.5g}", f"{self.warped_share:.3f}"),
            *("" if np.isnan(value) else f"{value:.4g}" for value in seen),
            self.cause,
            "" if self.orientation is None else _quaternion(self.orientation),
            *("" if np.isnan(number) else f"{number:.3f}" for number in track.moving),
        ]


def _quaternion(R: np.ndarray) -> str:
    return " ".join(f"{number:.6f}" for number in Rotation.from_matrix(R).as_quat(canonical=True))


def _skipped_row(frame: SkippedFrame) -> list[str]:
    """Return the columns of frames.csv as text for a frame that was not used."""
    known = [str(frame.index), f"{frame.time_s:.6f}", frame.name, SKIPPED, frame.reason]
    return known + [""] * (len(COLUMNS) - len(known))


def frame_counts(records: list[FrameRecord]) -> dict[str, int]:
    """Return how many frames there are, are tracked in this submap, lost, of these with a rotation, and tracked in
    another submap.
    """
    status: Counter[str] = Counter(record.track.status for record in records)
    tracked = sum(status[name] for name in TRACKED)
    lost = {"lost": status["lost"] + status[ROTATION_ONLY], "rotation_only": status[ROTATION_ONLY]}
    return {"frames": len(records), "tracked": tracked} | lost | {"in_other_maps": status[OTHER_MAP]}


def notices_of_frames(records: list[FrameRecord], interrupted_at: int | None) -> list[Notice]:
    """Return a notice where the run was interrupted, by the last frame's number, and one where few are tracked."""
    tracked = frame_counts(records)["tracked"]
    found = []
    if interrupted_at is not None:
        found.append(Notice("input-interrupted", {"frame": interrupted_at}))
    if tracked < _FEW_FRAMES:
        found.append(Notice("frames-few", {"frames": tracked}))
    return found


def scale_words(scale: dict[str, Any]) -> str:
    """Return what is known of a result's scale in words, from "scale" of its provenance; "" where that is empty."""
    if not scale:
        return ""
    if scale["known"]:
        return f"scale: {scale['source']}"
    return f"scale unknown ({scale['source']}): sizes are a guess, compare shapes"


class ResultView(Protocol):
    """How a result shows itself."""

    def sentence(self, result: Reconstruction) -> str:
        """Return the result in one line."""

    def html(self, result: Reconstruction) -> str:
        """Return the result for a notebook."""


VIEWS: list[ResultView] = []
"""The last one shows results; the reports add one (`scopemap.report.notebook`), since a result knows no page."""


@dataclass(frozen=True)
class Reconstruction:
    """The result of a run.

    Attributes
    ----------
    camera : working camera of all frames. records : one per frame, also of frames that are lost or in `others`.
    mesh : world mm, vertex colours; may be empty. config : the resolved settings.
    provenance : what the result depends on and what was assumed: input, camera, scale, weights, versions, machine,
        time.
    source_camera : the camera of the input's images before rectification; None where it is not kept. With it
        `camera.source_pixel` gives the pixel before rectification.
    skipped : frames that were read and not used.
    focal_sigma_px : standard deviation of the focal length of `camera` where it is an estimate, or None.
    others : the other submaps, with the records of their own frames, each with its own world and scale, since their
        relative pose is unknown; most frames first, as in maps/1, maps/2, ...
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

    def __repr__(self) -> str:
        if VIEWS:
            return VIEWS[-1].sentence(self)
        counts = frame_counts(self.records)
        return (
            f"<Reconstruction, {counts['tracked']} of {counts['frames']} frames tracked, {len(self.mesh.faces)} faces>"
        )

    def _repr_html_(self) -> str | None:
        return VIEWS[-1].html(self) if VIEWS else None

    @property
    def trajectory(self) -> Trajectory:
        """The poses with their status; NaN where a frame is lost or in another submap."""
        records = self.records
        return Trajectory(
            np.array([record.index for record in records], dtype=np.int64),
            np.array([record.time_s for record in records]),
            np.stack([record.pose for record in records]),
            np.array([record.track.status for record in records]),
        )

    @property
    def lost(self) -> list[FrameRecord]:
        """The records of the frames that could not be tracked; those of other submaps are not among them."""
        return [record for record in self.records if record.track.status in ("lost", ROTATION_ONLY)]

    def save(self, folder: Path) -> None:
        """Write everything but the depth maps, which a `DepthWriter` writes frame by frame.

        Raises `InputError` where the folder cannot be written.
        """
        folder = Path(folder)
        for number, other in enumerate(self.others, 1):
            other.save(folder / "maps" / str(number))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            scale = scale_words(self.provenance.get("scale", {}))
            write_tum(folder / "trajectory.tum", self.trajectory, comment=scale)
            save_mesh(self.mesh, folder / "mesh.ply", folder / "mesh.glb", comment=scale)
            sigma_px = self.focal_sigma_px
            write_calibration(self.camera, folder / "camera.yaml", focal_sigma_px=sigma_px)
            if (source := self.source_camera) is not None:
                sigma_px = None if sigma_px is None else sigma_px * source.central.fx / self.camera.fx
                write_calibration(source, folder / "source_camera.yaml", focal_sigma_px=sigma_px)
            rows = [*map(FrameRecord.row, self.records), *map(_skipped_row, self.skipped)]
            # A file's name may hold bytes that are no UTF-8.
            with (folder / "frames.csv").open("w", newline="", encoding="utf-8", errors="replace") as file:
                csv.writer(file).writerows([COLUMNS, *sorted(rows, key=lambda row: int(row[0]))])
            (folder / "config.toml").write_text(self.config.toml(), encoding="utf-8")
            provenance = json.dumps(self.provenance, indent=2) + "\n"
            (folder / "provenance.json").write_text(provenance, encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot write the result to {folder}: {error.strerror or error}") from None


class DepthWriter:
    """Writes the depth of each frame as 16-bit PNG, 0 = unknown, named by the frame's number.

    Beside it the standard deviation of frames that have one, as 8-bit PNG: 0.001 * 1.03^(v - 1) of the depth. `finish`
    adds pictures to look at, in colours over one range for all frames.

    largest_mm : depth that must be representable; it makes the unit coarser than `DEPTH_SCALE_MM` where necessary.
    Raises `InputError` where nothing can be written.
    """

    NOT_IN_CHECKPOINT = ("_folder", "_sigma_folder", "_preview_folder")
    """Not in a checkpoint: a run may go on under another name of its folder."""

    def __init__(self, folder: Path, largest_mm: float = 0.0) -> None:
        names = ("depth", "depth_sigma", "depth_preview")
        self._folder, self._sigma_folder, self._preview_folder = (Path(folder) / name for name in names)
        self._scale_mm = _unit_for(largest_mm)
        self._written: list[str] = []
        self._histogram = np.zeros(_LARGEST_UNIT + 2, np.int64)  # of every 16th pixel, by unit
        self._describe({})

    def __call__(self, frame: Frame) -> None:
        """Write the depth of a frame, and its standard deviation where it has one."""
        depth_mm = np.asarray(frame.depth_mm)
        units = np.nan_to_num(depth_mm / self._scale_mm, nan=0.0)
        image = np.where(units < _LARGEST_UNIT + 1, np.round(units), 0).astype(np.uint16)
        _write_picture(self._folder / f"{frame.index:06d}.png", image)
        self._written.append(f"{frame.index:06d}")
        self._histogram += np.bincount(image[::4, ::4].ravel(), minlength=len(self._histogram))
        if frame.depth_sigma_mm is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                code = 1 + np.log(frame.depth_sigma_mm / depth_mm / _LEAST_SIGMA) / np.log(_SIGMA_STEP)
            levels = np.where(np.isnan(code), 0, np.clip(np.round(code), 1, 255)).astype(np.uint8)
            with reporting(f"cannot write to {self._sigma_folder}"):
                self._sigma_folder.mkdir(exist_ok=True)
            _write_picture(self._sigma_folder / f"{frame.index:06d}.png", levels)

    def finish(self, *, scale_known: bool) -> None:
        """Write a JPEG of each frame's depth: turbo over its logarithm from red (near) to blue (far), the same range
        for all frames.

        Unknown depth is black. depth.json then states the range, and whether the millimetres are known or a guess.
        """
        seen = np.cumsum(self._histogram[1:])
        near, far = (1 + int(np.searchsorted(seen, share * seen[-1])) for share in _PREVIEW_SHARES)
        far = max(far, near + 1)
        facts: dict[str, Any] = {"scale_known": scale_known}
        if seen[-1]:
            with reporting(f"cannot write to {self._preview_folder}"):
                self._preview_folder.mkdir(exist_ok=True)
            # Level 0 is unknown, 1 the far end of the colours.
            colours = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_TURBO)
            colours[0] = 0
            unit = np.arange(_LARGEST_UNIT + 2).clip(1)
            level = np.clip(255 - 254 * np.log(unit / near) / np.log(far / near), 1, 255).astype(np.uint8)
            level[0] = 0
            for name in dict.fromkeys(self._written):
                levels = level[read_decoded(self._folder / f"{name}.png")]
                _write_picture(self._preview_folder / f"{name}.jpg", cv2.applyColorMap(levels, colours))
            range_mm = [round(unit * self._scale_mm, 4) for unit in (near, far)]
            facts |= {
                "preview_mm": range_mm,
                "preview_colours": "turbo over the logarithm, red = near, blue = far, black = unknown",
            }
        self._describe(facts)

    def _describe(self, facts: dict[str, Any]) -> None:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            description = json.dumps({"scale_mm": self._scale_mm, "unknown": 0} | facts) + "\n"
            (self._folder / "depth.json").write_text(description, encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot write depth to {self._folder}: {error.strerror or error}") from None


def _write_picture(file: Path, image: np.ndarray) -> None:
    try:
        write_encoded(file, image)
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror or error}") from None


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
            self.scale_mm = float(json.loads(description.read_text())["scale_mm"]) if self.present else 0.0
            """Millimetres per unit of the files; 0 where there are none."""
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"cannot read {description}: {error}") from None

    def read(self, index: int) -> np.ndarray | None:
        """Return depth (H, W) float32, mm, NaN = unknown, of the frame with this number; None where none was kept."""
        image = read_decoded(self._folder / f"{index:06d}.png")
        if image is None:
            return None
        return np.where(image > 0, image * np.float32(self.scale_mm), np.float32(np.nan))

    def read_sigma(self, index: int) -> np.ndarray | None:
        """Return the standard deviation of `read`, to 1.5 %, in the same form; None where none was kept."""
        depth_mm, levels = self.read(index), read_decoded(self._sigma_folder / f"{index:06d}.png")
        if depth_mm is None or levels is None:
            return None
        share = _LEAST_SIGMA * _SIGMA_STEP ** (levels.astype(np.float32) - 1)
        return np.where(levels > 0, share * depth_mm, np.float32(np.nan)).astype(np.float32)


def _unit_for(largest_mm: float) -> float:
    """Return the smallest of 0.01, 0.02, 0.05, 0.1, ... mm with which the largest depth is representable."""
    least = max(largest_mm / _LARGEST_UNIT, DEPTH_SCALE_MM) * (1 - 1e-6)
    power = 10.0 ** math.floor(math.log10(least))
    return next(round(digit * power, 12) for digit in (1, 2, 5, 10) if digit * power >= least)
