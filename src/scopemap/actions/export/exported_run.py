"""What every export writes: the tracked frames of a run, or of one of its submaps, and their surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.actions.pictures import frames_again
from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import InputError, reporting
from scopemap.frame import Frame
from scopemap.geometry.rendering import vertex_colours
from scopemap.io.decoding import write_encoded
from scopemap.reconstruction import DepthReader, scale_words
from scopemap.report.kept_run import read_run
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap.trajectory.trajectory import Trajectory

_SCALE_NOT_STATED = "scale unknown (the run does not state it): sizes are a guess, compare shapes"


@dataclass(frozen=True)
class ExportedRun:
    """A run to be exported.

    folder : of the run, or of one of its submaps. trajectory : its tracked frames alone, poses in mm. mesh : world mm,
    may be empty. camera : working camera of all frames. scale : what is known of the scale, in words; scale_known :
    whether sizes were measured or anchored.
    """

    folder: Path
    trajectory: Trajectory
    mesh: trimesh.Trimesh
    camera: PinholeCamera
    scale: str
    scale_known: bool

    @property
    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """The vertices of the mesh, (V, 3) float64, world mm, and their colours, (V, 3) uint8 sRGB."""
        return np.asarray(self.mesh.vertices, np.float64).reshape(-1, 3), vertex_colours(self.mesh)[:, :3]

    def frames(self) -> Iterator[Frame]:
        """Yield the tracked frames in order, rectified and masked, read from the run's input again.

        Raises `InputError` where the input is gone, or has not all of them any more.
        """
        missing = set(self.trajectory.indices.tolist())
        for frame in frames_again(self.folder, missing.copy()):
            missing.discard(frame.index)
            yield frame
        if missing:
            raise InputError(f"the input of the run {self.folder} has no frame {min(missing)} any more")

    def depth(self) -> DepthReader | None:
        """Return a reader of the final depth; None unless every tracked frame has it. The depth of submaps is the
        run's.
        """
        for folder in (self.folder, self.folder.parent.parent):
            files = (folder / "depth" / f"{index:06d}.png" for index in self.trajectory.indices)
            if all(file.is_file() for file in files) and (reader := DepthReader(folder)).present:
                return reader
        return None


def read_exported(folder: Path) -> ExportedRun:
    """Read a run's folder, or that of a submap, `maps/N`. Raises `InputError` where it is none or has no pose."""
    kept, trajectory = read_run(folder), read_trajectory(folder, kind="run")
    tracked = trajectory.rows(trajectory.tracked)
    if not len(tracked):
        raise InputError(f"{folder}: no frame was tracked, so there is nothing to export")
    with reporting(f"{folder}/provenance.json does not state the camera"):
        camera = _camera(kept.provenance["camera"])
    scale = scale_words(kept.provenance.get("scale", {})) or _SCALE_NOT_STATED
    known = bool(kept.provenance.get("scale", {}).get("known"))
    return ExportedRun(folder, tracked, kept.maps[0].mesh, camera, scale, known)


def _camera(facts: dict[str, Any]) -> PinholeCamera:
    fx, fy, cx, cy = (float(facts[name]) for name in ("fx", "fy", "cx", "cy"))
    return PinholeCamera(fx, fy, cx, cy, int(facts["width"]), int(facts["height"]))


def write_image(file: Path, image: np.ndarray) -> None:
    """Write an image as OpenCV has it (BGR); raises `InputError` where that fails."""
    with reporting(f"cannot write {file}"):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_encoded(file, image)
