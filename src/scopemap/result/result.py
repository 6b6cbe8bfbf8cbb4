"""`Result`: what a run found, read from its folder part by part, or held in memory until it is saved.

out/  trajectory.tum  mesh.ply  mesh.glb  camera.yaml  source_camera.yaml  frames.csv  config.toml  provenance.json
      depth/000000.png (16 bit, depth/depth.json has the scale)  depth_sigma/000000.png (8 bit, relative)
      depth_preview/000000.jpg (colours)  mesh_over_time.glb (of several segments)
      maps/1 (the same for submaps that are not merged), ...
"""

from __future__ import annotations

import csv
import html
import json
import warnings
from base64 import b64encode
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.config import Config
from scopemap.engine.errors import InputError, reporting
from scopemap.engine.fusion.mesh_files import read_mesh, read_textured, save_mesh
from scopemap.engine.notices import Level
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.trajectory.trajectory import Trajectory, write_tum
from scopemap.result.depth_maps import DepthReader
from scopemap.result.frame_table import NOT_USED, FrameTable
from scopemap.result.result_folder import SUMMARY_PICTURE
from scopemap.result.surface_segments import SurfaceSegment, read_segments, save_segments, surface_file
from scopemap.result.trajectory_folders import read_frames, submap_folders
from scopemap.result.wording import LEVEL_WORDS, scale_words

_SCALE_NOT_STATED = "scale unknown (the run does not state it): compare shapes, not sizes"
_MOST_PX = 1 << 15
_SHOWN_SETTINGS = 3


class StatedVerdict(NamedTuple):
    """The verdict on a result as its run stated it: the level, and the codes of its reasons, the worst first."""

    level: Level
    codes: tuple[str, ...]


class Result:
    """The result of a run, or one of its submaps, `maps/N`.

    >>> result = Result("result")  # a folder; parts are read when they are asked for, or `InputError`
    >>> result.trajectory.T_world_camera, result.mesh, result.depth.read(12), result.verdict

    `reconstruct(..., out=...)` returns it from the folder that it wrote. Without `out`, and from a `Reconstructor`, it
    is held in memory, where `path` is None, until `save` writes it.

    path : the folder. input_path : where the input of the run is now; None: it is looked for where it was.
    """

    path: Path | None

    def __init__(self, path: Path | str, input_path: Path | None = None) -> None:
        self.path, self.input_path = Path(path), input_path

    @classmethod
    def in_memory(
        cls,
        camera: PinholeCamera,
        frames: FrameTable,
        mesh: trimesh.Trimesh,
        config: Config,
        provenance: dict[str, Any] | None = None,
        *,
        source_camera: CameraModel | None = None,
    ) -> Result:
        """Return a result that is in no folder yet, without other submaps; the parameters are its attributes."""
        result = cls.__new__(cls)
        result.path, result.input_path = None, None
        # A cached property takes what is here for what it has read.
        result.__dict__ |= {
            "camera": camera,
            "frames": frames,
            "mesh": mesh,
            "config": config,
            "provenance": {} if provenance is None else provenance,
            "source_camera": source_camera,
        } | {"others": [], "segments": [], "textured": None}
        return result

    def with_segments(self, segments: list[SurfaceSegment], surfaces: list[trimesh.Trimesh]) -> Result:
        """Return this result in memory with its segments and the surface of each."""
        self.__dict__ |= {"segments": [*segments], "_surfaces": dict(enumerate(surfaces))}
        return self

    @property
    def folder(self) -> Path:
        """Its folder. Raises `InputError` where it is in memory alone."""
        if self.path is None:
            raise InputError("the result is in memory alone: give `reconstruct` a folder, out=, which keeps depth")
        return self.path

    @property
    def is_finished(self) -> bool:
        """Whether the folder holds a finished run with its camera: an imported trajectory has none."""
        needed = ("frames.csv", "trajectory.tum", "provenance.json")
        return all((self.folder / name).is_file() for name in needed) and "camera" in self.provenance

    def checked(self, *, with_poses: bool = False) -> Result:
        """Return this result, its table read.

        Raises `InputError` where the folder holds no finished run, or a damaged one; `with_poses`: or no tracked frame.
        """
        if not self.is_finished:
            needed = "frames.csv, trajectory.tum and a provenance.json that knows the camera are needed"
            raise InputError(f"no finished run in {self.path}: {needed}")
        if not self.frames.tracked.any() and with_poses:
            raise InputError(f"{self.path}: no frame was tracked")
        return self

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """What it depends on and what was assumed: input, camera, scale, weights, versions, notices; {} : not known."""
        file = self.folder / "provenance.json"
        if not file.is_file():
            return {}
        with reporting(f"cannot read {file}"):
            return dict(json.loads(file.read_text(encoding="utf-8")))

    @property
    def config_text(self) -> str:
        """The content of config.toml; "" where there is none."""
        file = self.folder / "config.toml"
        with reporting(f"cannot read {file}"):
            return file.read_text(encoding="utf-8") if file.is_file() else ""

    @cached_property
    def config(self) -> Config:
        """The settings of the run, resolved: the TSDF parameters are numbers.

        Those that this version does not have are ignored, with a `UserWarning`. Raises `SettingsError` for values that
        it does not have.
        """
        file, unknown = self.folder / "config.toml", list[str]()
        config = Config.load(file=file, unknown=unknown)
        if unknown:
            names = ", ".join(unknown[:_SHOWN_SETTINGS]) + (", ..." if len(unknown) > _SHOWN_SETTINGS else "")
            ignored = f"scopemap ignores settings of another version in {file} ({len(unknown)}): {names}"
            warnings.warn(ignored, stacklevel=3)
        return config

    @cached_property
    def frames(self) -> FrameTable:
        """A row for each frame, those that were lost, skipped or are in other submaps, too."""
        frames, _ = read_frames(self.folder)
        if not self.is_submap:
            frames.rows["map"][frames["map"] >= len(self.submaps)] = -1
        return frames

    @property
    def tracked(self) -> FrameTable:
        """The frames that have a pose in this submap."""
        return self.frames.only(self.frames.tracked)

    @property
    def lost(self) -> FrameTable:
        """The frames that could not be tracked; those of other submaps are not among them."""
        return self.frames.only(self.frames.lost)

    @property
    def trajectory(self) -> Trajectory:
        """The poses with their status; NaN where a frame is lost or in another submap."""
        return self.frames.trajectory

    @cached_property
    def others(self) -> list[Result]:
        """The other submaps, most frames first; each has its own world and scale: their relative pose is unknown."""
        return [Result(folder, self.input_path) for folder in submap_folders(self.folder)[1:]]

    @property
    def submaps(self) -> list[Result]:
        """Itself, then the other submaps: maps/1, maps/2, ..."""
        return [self, *self.others]

    @property
    def is_submap(self) -> bool:
        """Whether it is `maps/N` of a result."""
        folder = self.folder.resolve().parent
        return folder.name == "maps" and (folder.parent / "provenance.json").is_file()

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The surface, world mm, with colours and attributes of its vertices; empty where there is none."""
        return read_mesh(self.folder / "mesh.ply")

    @cached_property
    def textured(self) -> trimesh.Trimesh | None:
        """The triangles of `mesh`, in their order, with a texture of the video's frames; None where there is none."""
        return read_textured(self.folder / "mesh.glb")

    @cached_property
    def segments(self) -> list[SurfaceSegment]:
        """The parts of its time that have a surface of their own, in order; [] in results of earlier versions."""
        return read_segments(self.folder)

    @property
    def main_segment(self) -> int:
        """The number of the segment whose surface `mesh` is: the longest of the best level."""
        return int(self.provenance.get("main_segment", 0))

    def segment_at(self, index: int) -> int:
        """Return the number of the segment of the frame with this number; that of `mesh` where the frame has none."""
        found = self.frames["segment"][self.frames["index"] == index]
        return int(found[0]) if found.size and found[0] >= 0 else self.main_segment

    def surface(self, segment: int) -> trimesh.Trimesh:
        """Return the surface of the segment with this number, as `mesh`."""
        if segment == self.main_segment:
            return self.mesh
        surfaces: dict[int, trimesh.Trimesh] = self.__dict__.setdefault("_surfaces", {})
        if segment not in surfaces:
            surfaces[segment] = read_mesh(surface_file(self.folder, segment))
        return surfaces[segment]

    def mesh_at(self, index: int) -> trimesh.Trimesh:
        """Return the surface that fits the frame with this number: that of its segment."""
        return self.surface(self.segment_at(index))

    @cached_property
    def camera(self) -> PinholeCamera:
        """The working camera of all frames, whose size the depth maps have."""
        with reporting(f"{self.path}/provenance.json does not state the camera"):
            facts = self.provenance["camera"]
            fx, fy, cx, cy = (float(facts[name]) for name in ("fx", "fy", "cx", "cy"))
            width, height = int(facts["width"]), int(facts["height"])
            possible = min(fx, fy) > 0 and np.isfinite([fx, fy, cx, cy]).all()
            if not (possible and 0 < width <= _MOST_PX and 0 < height <= _MOST_PX):
                raise ValueError(f"it is of {width}x{height} px with a focal length of {fx:g} px")
            return PinholeCamera(fx, fy, cx, cy, width, height)

    @property
    def source_camera_file(self) -> Path | None:
        """The calibration of the input's images before rectification; None where it was not kept."""
        file = self.folder / "source_camera.yaml"
        return file if file.is_file() else None

    @cached_property
    def source_camera(self) -> CameraModel | None:
        """The camera of the input's images before rectification; None where it was not kept.

        With it `camera.source_pixel` gives the pixel before rectification.
        """
        from scopemap.input.camera_files.reading import stated_calibration

        file = self.source_camera_file
        return None if file is None else stated_calibration(file, (self.camera.width, self.camera.height)).camera

    @property
    def verdict(self) -> StatedVerdict | None:
        """Whether it can be trusted, as the report says it; None where no run has stated it."""
        facts = self.provenance.get("verdict")
        return facts and StatedVerdict(facts["level"], tuple(reason["code"] for reason in facts["reasons"]))

    @property
    def scale(self) -> str:
        """What is known of the scale, in words."""
        return scale_words(self.provenance.get("scale") or {}) or _SCALE_NOT_STATED

    @property
    def scale_known(self) -> bool:
        """Whether sizes were measured or anchored."""
        return bool((self.provenance.get("scale") or {}).get("known"))

    @cached_property
    def depth(self) -> DepthReader:
        """The final depth of its frames; that of a submap is the run's."""
        own = DepthReader(self.folder)
        return own if own.present or not self.is_submap else DepthReader(self.folder.resolve().parent.parent)

    def picture_file(self, index: int) -> Path:
        """Return the file of a frame's small picture."""
        return self.folder / "frames" / f"{index:06d}.jpg"

    def mask_file(self, index: int) -> Path:
        """Return the file of the mask of a frame's small picture."""
        return self.folder / "frames" / f"{index:06d}_mask.png"

    @cached_property
    def pictured(self) -> list[int]:
        """The numbers of the frames that have a small picture, ascending; none where it is in memory."""
        pictures = () if self.path is None else (self.path / "frames").glob("*.jpg")
        return sorted(int(file.stem) for file in pictures if file.stem.isdecimal())

    @cached_property
    def measures(self) -> dict[int, tuple[float, float]]:
        """Sharpness and milliseconds by frame number; {} where a run kept none."""
        file = self.folder / "frames" / "measures.csv"
        if not file.is_file():
            return {}
        with reporting(f"cannot read {file}"):
            rows = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
            return {int(row["index"]): (float(row["sharpness"]), float(row["ms"])) for row in rows}

    def save(self, folder: Path | str) -> None:
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
            save_mesh(self.mesh, folder / "mesh.ply", folder / "mesh.glb", comment=scale, textured=self.textured)
            surfaces = [self.surface(one.segment) for one in self.segments]
            save_segments(self.segments, surfaces, folder, comment=scale)
            sigma_px = self.provenance.get("camera", {}).get("focal_sigma_px")
            write_calibration(self.camera, folder / "camera.yaml", focal_sigma_px=sigma_px)
            if (source := self.source_camera) is not None:
                sigma_px = None if sigma_px is None else sigma_px * source.central.fx / self.camera.fx
                write_calibration(source, folder / "source_camera.yaml", focal_sigma_px=sigma_px)
            self.frames.write(folder / "frames.csv")
            (folder / "config.toml").write_text(self.config.toml(), encoding="utf-8")
            provenance = json.dumps(self.provenance, indent=2) + "\n"
            (folder / "provenance.json").write_text(provenance, encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot write the result to {folder}: {error.strerror or error}") from None

    def __repr__(self) -> str:
        """Return the stated verdict and the main facts in one line."""
        if self.path is not None and not self.is_finished:
            return f"<Result, not finished: {self.path}>"
        word = "without a verdict" if self.verdict is None else LEVEL_WORDS[self.verdict.level]
        submap = self.frames.submap
        counted = f"{np.sum(submap == 0)} of {np.sum(submap != NOT_USED)} frames are in it"
        return f"<Result, {word}: {counted}; {self.scale}>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the line, and the summary picture where its folder has one."""
        line = f"<p>{html.escape(repr(self))}</p>"
        file = None if self.path is None else self.path / SUMMARY_PICTURE
        if file is None or not file.is_file():
            return line
        picture = b64encode(file.read_bytes()).decode()
        return f'{line}<img alt="summary" src="data:image/png;base64,{picture}" style="max-width: 100%">'


def opened(result: Result | Path | str) -> Result:
    """Return a result, or that of a folder, with its table read.

    Raises `InputError` where the folder holds no finished run, or the result is in memory alone.
    """
    return (result if isinstance(result, Result) else Result(result)).checked()
