"""RunFolder: a finished run, read from its folder."""

from __future__ import annotations

import csv
import json
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config
from scopemap.engine.errors import InputError, reporting
from scopemap.engine.mapping.tissue_states import TissueStates
from scopemap.engine.notices import scale_words
from scopemap.result.depth_maps import DepthReader
from scopemap.result.frame_table import FrameTable
from scopemap.result.result_actions import ResultActions
from scopemap.result.trajectory_folders import read_frames, submap_folders

_SCALE_NOT_STATED = "scale unknown (the run does not state it): sizes are a guess, compare shapes"
_MOST_PX = 1 << 15


class RunFolder(ResultActions):
    """A finished run in its folder `path`, or a submap in `maps/N`; parts are read when asked for, or `InputError`."""

    path: Path

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)

    @property
    def is_finished(self) -> bool:
        """Whether it holds a finished run with its camera: an imported trajectory has none."""
        needed = ("frames.csv", "trajectory.tum", "provenance.json")
        return all((self.path / name).is_file() for name in needed) and "camera" in self.provenance

    def checked(self) -> RunFolder:
        """Return this folder, its table read. Raises `InputError` where it holds no finished run, or a damaged one."""
        if not self.is_finished:
            needed = "frames.csv, trajectory.tum and a provenance.json that knows the camera are needed"
            raise InputError(f"no finished run in {self.path}: {needed}")
        assert self.frames is not None
        return self

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """The content of provenance.json; {} where there is none."""
        file = self.path / "provenance.json"
        if not file.is_file():
            return {}
        with reporting(f"cannot read {file}"):
            return dict(json.loads(file.read_text(encoding="utf-8")))

    @property
    def config_text(self) -> str:
        """The content of config.toml; "" where there is none."""
        file = self.path / "config.toml"
        with reporting(f"cannot read {file}"):
            return file.read_text(encoding="utf-8") if file.is_file() else ""

    @property
    def config(self) -> Config:
        """The settings of the run. Raises `SettingsError` for those of another version."""
        return Config.load(file=self.path / "config.toml")

    @cached_property
    def frames(self) -> FrameTable:
        """The table of its frames, those that were skipped, too, with poses."""
        frames, _ = read_frames(self.path)
        frames.rows["map"][frames["map"] >= len(self.submaps)] = -1
        return frames

    @cached_property
    def submaps(self) -> list[RunFolder]:
        """The result first, then maps/1, maps/2, ..."""
        return [self, *(RunFolder(folder) for folder in submap_folders(self.path)[1:])]

    @property
    def is_submap(self) -> bool:
        """Whether it is `maps/N` of a result."""
        folder = self.path.resolve().parent
        return folder.name == "maps" and (folder.parent / "provenance.json").is_file()

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The surface with its vertices' attributes; empty where there is no mesh.ply or no face."""
        return read_mesh(self.path / "mesh.ply")

    @cached_property
    def states(self) -> TissueStates | None:
        """The states of tissue that moves; None where it is taken to be at rest."""
        return TissueStates.read(self.path)

    @cached_property
    def camera(self) -> PinholeCamera:
        """The working camera, whose size the depth maps have."""
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
        file = self.path / "source_camera.yaml"
        return file if file.is_file() else None

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
        own = DepthReader(self.path)
        return own if own.present or not self.is_submap else DepthReader(self.path.resolve().parent.parent)

    def picture_file(self, index: int) -> Path:
        """Return the file of a frame's small picture."""
        return self.path / "frames" / f"{index:06d}.jpg"

    def mask_file(self, index: int) -> Path:
        """Return the file of the mask of a frame's small picture."""
        return self.path / "frames" / f"{index:06d}_mask.png"

    @cached_property
    def pictured(self) -> list[int]:
        """The numbers of the frames that have a small picture, ascending."""
        return sorted(int(file.stem) for file in (self.path / "frames").glob("*.jpg") if file.stem.isdecimal())

    @cached_property
    def measures(self) -> dict[int, tuple[float, float]]:
        """Sharpness and milliseconds by frame number; {} where a run kept none."""
        file = self.path / "frames" / "measures.csv"
        if not file.is_file():
            return {}
        with reporting(f"cannot read {file}"):
            rows = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
            return {int(row["index"]): (float(row["sharpness"]), float(row["ms"])) for row in rows}


def read_mesh(file: Path) -> trimesh.Trimesh:
    """Return the surface in a PLY file with its vertices' attributes; empty where there is no file or no face.

    Raises `InputError` where it is damaged.
    """
    if not file.is_file():
        return trimesh.Trimesh()
    with reporting(f"cannot read {file}"):
        mesh = trimesh.load(file, process=False)
        if not isinstance(mesh, trimesh.Trimesh):
            return trimesh.Trimesh()
        # trimesh leaves properties that it does not know in the raw table.
        vertices = mesh.metadata["_ply_raw"]["vertex"]["data"]
        for name in sorted({"confidence", "moving", "sigma_mm"} & set(vertices.dtype.names)):
            mesh.vertex_attributes[name] = np.array(vertices[name])
        if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError("it is damaged: a face has a vertex that is not there")
        if not np.isfinite(mesh.vertices).all():
            raise ValueError("it is damaged: a vertex is nowhere")
    return mesh
