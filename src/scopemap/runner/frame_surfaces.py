"""Writes the surface of every frame of a camera at rest, where the tissue moves and one surface would smear it."""

from __future__ import annotations

from pathlib import Path

from scopemap.engine.config import Config
from scopemap.engine.depth.anchor import depth_downscale
from scopemap.engine.errors import reporting
from scopemap.engine.estimators import Estimators
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.depth_mesh import depth_mesh
from scopemap.engine.fusion.mesh_files import save_mesh
from scopemap.engine.fusion.surface_fusion import steepest_cosine
from scopemap.result.wording import scale_words
from scopemap.runner.provenance import scale_facts

SURFACES = "surfaces"
"""Folder of a result with a PLY per frame, named by its number."""


class SurfaceWriter:
    """Writes surfaces/000000.ply, ...: usable pixels, spaced as the depth estimate's. Raises `InputError`."""

    def __init__(self, folder: Path, config: Config, estimators: Estimators) -> None:
        self._folder, self._config, self._estimators = folder / SURFACES, config, estimators

    def __call__(self, frame: Frame) -> None:
        """Write the surface of a frame that has a pose; without any usable pixel it has no vertex."""
        if frame.T_world_camera is None:
            return
        step_px = depth_downscale(self._config.depth, max(frame.valid.shape))
        mesh = depth_mesh(frame, step_px, steepest_cosine(self._config.fusion))
        with reporting(f"cannot write to {self._folder}"):
            self._folder.mkdir(parents=True, exist_ok=True)
            scale = scale_words(scale_facts(self._estimators))
            save_mesh(mesh, self._folder / f"{frame.index:06d}.ply", comment=scale)
