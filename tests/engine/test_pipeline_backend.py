"""Mapping in a whole run: adjusted poses, depth maps and mesh agree; none of it with measured depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.config import Config
from scopemap.engine.estimators import Estimators
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.engine.odometry import Step
from scopemap.result.depth_maps import DepthReader
from scopemap.result.result import Result
from scopemap.runner.estimators import create_estimators
from tests.support.front_door import said
from tests.support.tiny_phantom import true_poses, with_true_depth, write_tiny

pytestmark = pytest.mark.slow

LOST, FRAMES = 8, 14
EXPONENT = 1.3
SETTINGS = {"networks__flow": "dis", "networks__perceptual": "structure", "tracking__keyframe_every": 2}


@dataclass(frozen=True)
class _Bent:
    """True depth distorted by a power law, and reported as predicted."""

    inner: Any
    name: str = "bent"

    def estimate(self, frame: Any) -> Any:
        found = self.inner.estimate(frame)
        middle = np.nanmedian(found.values)
        return replace(found, kind="depth", values=middle * (found.values / middle) ** np.float32(EXPONENT))

    def provenance(self) -> dict[str, str]:
        return {"depth": self.name}


@dataclass(frozen=True)
class _Run:
    phantom: Path
    out: Path
    steps: list[Step]
    adjusted: Result
    tracked: Result


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> _Run:
    folder = tmp_path_factory.mktemp("backend")
    phantom = write_tiny(folder / "phantom", f"black:{LOST}-{LOST}", frames=FRAMES)
    create, steps = create_estimators, []

    def bent(config: Config, sequence: Any, own: Any) -> Estimators:
        parts = create(config, sequence)
        return replace(parts, depth=_Bent(parts.depth))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scopemap.runner.preparation.create_estimators", bent)
        config = with_true_depth(phantom, **SETTINGS)
        adjusted = reconstruct(open_sequence(phantom), config, out=folder / "out", observers=(steps.append,))
        plain = with_true_depth(phantom, **SETTINGS, mapping__method="none")
        tracked = reconstruct(open_sequence(phantom), plain)
    return _Run(phantom, folder / "out", steps, adjusted, tracked)


def _rotation_errors_rad(result: Result, phantom: Path) -> np.ndarray:
    poses, tracked = result.trajectory.T_world_camera, result.trajectory.tracked
    return rotation_angle_rad((inverse(poses[tracked]) @ true_poses(phantom)[tracked])[:, :3, :3])


def test_adjusted_rotations_are_better_than_tracked_ones(run: _Run) -> None:
    tracked, adjusted = (_rotation_errors_rad(result, run.phantom) for result in (run.tracked, run.adjusted))
    assert adjusted.max() < 0.8 * tracked.max()


def test_depth_maps_in_the_folder_have_the_adjusted_scale_and_shape(run: _Run) -> None:
    reader, factors, before_all, after_all = DepthReader(run.out), [], [], []
    scales = run.adjusted.frames["depth_scale"] / run.tracked.frames["depth_scale"]
    for step, factor in zip(run.steps, scales.tolist(), strict=True):
        if step.track.status == "lost":
            continue
        factors.append(factor)
        known = np.isfinite(step.refined.depth_mm)
        kept = reader.read(step.frame.index)
        scaled = factors[-1] * step.refined.depth_mm[known]
        before_all.append(_shape_error(scaled, step.raw_mm[known]))
        after_all.append(_shape_error(kept[known], step.raw_mm[known]))
    assert max(np.abs(np.log(factors))) > 1e-4
    assert np.mean(after_all) < 0.7 * np.mean(before_all)


def _shape_error(depth_mm: np.ndarray, bent_mm: np.ndarray) -> float:
    """Mean error of ln depth against the true one, whose power `bent_mm` is, up to a scale."""
    off = np.log(depth_mm) - np.log(bent_mm) / EXPONENT
    return float(np.abs(off - np.median(off)).mean())


def test_the_mesh_agrees_with_adjusted_poses_and_depth(run: _Run) -> None:
    number = FRAMES - 1
    depth_mm = DepthReader(run.out).read(number)
    camera, T = run.adjusted.camera, run.adjusted.trajectory.T_world_camera[number]
    points = (camera.rays * depth_mm[..., None])[20:-20:7, 20:-20:7].reshape(-1, 3)
    points = points[np.isfinite(points[:, 2])] @ T[:3, :3].T + T[:3, 3]
    distances = np.linalg.norm(run.adjusted.mesh.vertices[None] - points[:, None], axis=-1).min(1)
    assert np.median(distances) < 1.5


def test_measured_depth_is_not_adjusted(run: _Run) -> None:
    result = reconstruct(open_sequence(run.phantom), with_true_depth(run.phantom, **SETTINGS))
    assert not any(note.startswith("mapping:") for note in said(result.provenance))
    assert len(result.mesh.faces) > 1000
