"""The result of a run, and the folder it is written to.

out/  trajectory.tum  mesh.ply  mesh.glb  camera.yaml  source_camera.yaml  frames.csv  config.toml  provenance.json
      depth/000000.png (16 bit, depth/depth.json has the scale)  depth_sigma/000000.png (8 bit, relative)
      depth_preview/000000.jpg (colours)  tissue_motion.npz mesh_over_time.glb (where tissue moves)
      maps/1 (the same for submaps that are not merged), ...
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.config import Config
from scopemap.engine.errors import InputError
from scopemap.engine.fusion.mesh_files import save_mesh, save_mesh_over_time
from scopemap.engine.mapping.tissue_states import TissueStates
from scopemap.engine.notices import scale_words
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.source import SkippedFrame
from scopemap.input.trajectory.trajectory import SKIPPED, Trajectory, write_tum
from scopemap.result.frame_table import FrameTable
from scopemap.result.result_actions import ResultActions

VIEWS: dict[str, Callable[[Reconstruction], str]] = {}
"""How a result shows itself, "line" and "html": `scopemap.report.notebook` adds both, since a result knows no page."""


class StatedVerdict(NamedTuple):
    """The verdict on a result: the level (good, doubtful, bad) and the codes of its reasons, worst first."""

    level: str
    codes: tuple[str, ...]


@dataclass(frozen=True)
class Reconstruction(ResultActions):
    """The result of a run.

    Attributes
    ----------
    camera : working camera of all frames. frames : a row per frame, also of frames that are lost or in `others`.
    mesh : world mm, vertex colours; may be empty. config : the resolved settings.
    provenance : what the result depends on and what was assumed: input, camera, scale, weights, versions, machine,
        time.
    source_camera : the camera of the input's images before rectification; None where it is not kept. With it
        `camera.source_pixel` gives the pixel before rectification.
    skipped : frames that were read and not used.
    focal_sigma_px : standard deviation of the focal length of `camera` where it is an estimate, or None.
    others : the other submaps, with their own frames, each with its own world and scale, since their relative pose is
        unknown; most frames first, as in maps/1, maps/2, ...
    states : of tissue that moves, and in which `mesh` is; None: it is taken to be at rest.
    path : the folder that `reconstruct` wrote it to, which knows its depth, too; None: it is in memory alone.
    """

    camera: PinholeCamera
    frames: FrameTable
    mesh: trimesh.Trimesh
    config: Config
    provenance: dict[str, Any] = field(default_factory=dict)
    source_camera: CameraModel | None = None
    skipped: list[SkippedFrame] = field(default_factory=list)
    focal_sigma_px: float | None = None
    others: list[Reconstruction] = field(default_factory=list)
    states: TissueStates | None = None
    path: Path | None = None

    def __repr__(self) -> str:
        if "line" in VIEWS:
            return VIEWS["line"](self)
        counts = self.frames.counts
        return (
            f"<Reconstruction, {counts['tracked']} of {counts['frames']} frames tracked, {len(self.mesh.faces)} faces>"
        )

    def _repr_html_(self) -> str | None:
        return VIEWS["html"](self) if "html" in VIEWS else None

    @property
    def verdict(self) -> StatedVerdict | None:
        """Whether it can be trusted, as the report says it; None where no run has stated it."""
        facts = self.provenance.get("verdict")
        return facts and StatedVerdict(facts["level"], tuple(reason["code"] for reason in facts["reasons"]))

    @property
    def trajectory(self) -> Trajectory:
        """The poses with their status; NaN where a frame is lost or in another submap."""
        return self.frames.trajectory

    @property
    def lost(self) -> FrameTable:
        """The frames that could not be tracked; those of other submaps are not among them."""
        return self.frames.only(self.frames.lost)

    @property
    def submaps(self) -> list[Reconstruction]:
        """Itself, and the other submaps."""
        return [self, *self.others]

    def kept_in(self, folder: Path) -> Reconstruction:
        """Return this result, whose folder is known now."""
        others = [other.kept_in(folder / "maps" / str(number)) for number, other in enumerate(self.others, 1)]
        return replace(self, others=others, path=folder)

    def mesh_at(self, index: int) -> trimesh.Trimesh:
        """Return the surface in the state of the frame with this number; `mesh` itself where tissue is at rest."""
        return self.mesh if self.states is None else self.states.moved(self.mesh, index)

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
            if self.states is not None:
                self.states.save(folder)
                save_mesh_over_time(self.mesh, self.states, folder / "mesh_over_time.glb", comment=scale)
            sigma_px = self.focal_sigma_px
            write_calibration(self.camera, folder / "camera.yaml", focal_sigma_px=sigma_px)
            if (source := self.source_camera) is not None:
                sigma_px = None if sigma_px is None else sigma_px * source.central.fx / self.camera.fx
                write_calibration(source, folder / "source_camera.yaml", focal_sigma_px=sigma_px)
            known = ("index", "time_s", "name", "reason")
            skipped = [{name: getattr(one, name) for name in known} | {"status": SKIPPED} for one in self.skipped]
            rows = np.concatenate([self.frames.rows, FrameTable.of(skipped).rows])
            FrameTable(rows).write(folder / "frames.csv")
            (folder / "config.toml").write_text(self.config.toml(), encoding="utf-8")
            provenance = json.dumps(self.provenance, indent=2) + "\n"
            (folder / "provenance.json").write_text(provenance, encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot write the result to {folder}: {error.strerror or error}") from None
