"""What every export writes: the tracked frames of a run, or of one of its submaps, and their surface."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.engine.errors import InputError, reporting
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.input.decoding import write_encoded
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit
from scopemap.result.run_folder import RunFolder
from scopemap.runner.reread_frames import reread_frames


class ExportedRun(RunFolder):
    """The folder of a run to be exported, or of one of its submaps; `source`: where its input is, None: looked for."""

    def __init__(self, path: Path | str, source: Path | None = None) -> None:
        super().__init__(path)
        self.source = source

    @cached_property
    def trajectory(self) -> Trajectory:
        """Its tracked frames alone, poses in mm."""
        return self.frames.only(self.frames.tracked).trajectory

    @property
    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """The vertices of the mesh, (V, 3) float64, world mm, and their colours, (V, 3) uint8 sRGB."""
        return np.asarray(self.mesh.vertices, np.float64).reshape(-1, 3), vertex_colours(self.mesh)[:, :3]

    def vertex_attributes(self, unit: Unit) -> dict[str, Any]:
        """Return numbers of each vertex, (V,) float32: confidence, moving, sigma_mm, whose name has the unit."""
        known: dict[str, Any] = {name: np.asarray(x, np.float32) for name, x in self.mesh.vertex_attributes.items()}
        if "sigma_mm" in known:
            known[f"sigma_{unit}"] = known.pop("sigma_mm") / np.float32(MM_PER_UNIT[unit])
        return known

    def tracked_frames(self) -> Iterator[Frame]:
        """Yield the tracked frames in order, rectified and masked, as `reread_frames` has them.

        Raises `InputError` where the input is gone, or has not all of them any more.
        """
        missing = set(self.trajectory.indices.tolist())
        for frame in reread_frames(self.path, missing.copy(), self.source):
            missing.discard(frame.index)
            yield frame
        if missing:
            raise InputError(f"the input of the run {self.path} has no frame {min(missing)} any more")

    @property
    def has_all_depth(self) -> bool:
        """Whether every tracked frame has its depth."""
        return self.depth.present and all(map(self.depth.has, self.trajectory.indices.tolist()))


def read_exported(folder: Path, source: Path | None = None) -> ExportedRun:
    """Read a run's folder, or that of a submap, `maps/N`. Raises `InputError` where it is none or has no pose."""
    run = ExportedRun(folder, source)
    run.checked()
    if not len(run.trajectory):
        raise InputError(f"{folder}: no frame was tracked, so there is nothing to export")
    assert run.camera is not None
    return run


def write_image(file: Path, image: np.ndarray) -> None:
    """Write an image as OpenCV has it (BGR); raises `InputError` where that fails."""
    with reporting(f"cannot write {file}"):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_encoded(file, image)
