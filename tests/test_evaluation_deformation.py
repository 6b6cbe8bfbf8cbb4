"""Shape over time and displacement: of an estimate that is the truth in another world, and of wrong ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drawn_run import write_placed

from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import so3_exp
from scopemap.engine.mapping.tissue_states import TissueStates
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.reread_frames import open_truth
from scopemap_bench.evaluation.deformation import displacement_error, shape_over_time
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import DISPLACEMENT, write_phantom

S_RUN_TRUTH = Similarity(0.4, so3_exp(np.array([0.3, -0.5, 0.2])), np.array([5.0, -30.0, 12.0]))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rebound") / "phantom"
    events = parse_events("rebound:1-7")
    write_phantom(PhantomSpec("laparoscopy", frames=8, width=80, height=64, seed=5, events=events), folder)
    return folder


@pytest.fixture
def run(source: Path, tmp_path: Path) -> Path:
    """The truth of the phantom, as a result in a turned world of another scale."""
    poses = S_RUN_TRUTH.transform_poses(read_trajectory(source).T_world_camera)
    return write_placed(
        tmp_path / "run",
        [(f, S_RUN_TRUTH.scale * truth.depth_mm, poses[f.index]) for f, truth in open_truth(tmp_path, source)],
    )


def write_motion(run: Path, source: Path, share: float) -> None:
    """Write that part of the true motion as the run's: every point a node, every frame a mode."""
    positions = S_RUN_TRUTH.transform_points(np.load(source / DISPLACEMENT)["positions_mm"].astype(float))
    times_s = np.array([frame.time_s for frame, _ in open_truth(run, source)])
    modes = share * (positions - positions[0]) + 3.0  # which state is that of the nodes does not matter
    index, curves = np.arange(len(times_s)), np.eye(len(times_s))
    TissueStates(positions[0], modes, index, times_s, curves, curves[0]).save(run)


def test_shape_over_time_is_that_of_the_tissue_at_each_time(run: Path, source: Path) -> None:
    shape = shape_over_time(run, source, every=1, pixels=4)
    assert shape.median_mm < 0.01
    assert shape.S_truth_run.scale == pytest.approx(1 / S_RUN_TRUTH.scale, rel=1e-4)
    # Depth of another state: that of the first frame, for all.
    for index in range(1, 8):
        (run / f"depth/{index:06d}.png").write_bytes((run / "depth/000000.png").read_bytes())
    assert 0.1 < shape_over_time(run, source, every=1, pixels=4).median_mm < 6.0


def test_displacement_is_compared_point_by_point_beside_nothing_moves(run: Path, source: Path) -> None:
    S = shape_over_time(run, source, every=1, pixels=4).S_truth_run
    nothing = displacement_error(run, source, S, every=1)
    assert (nothing.median_mm, nothing.rms_mm) == (nothing.still_mm, nothing.still_rms_mm)
    true = np.load(source / DISPLACEMENT)["positions_mm"].astype(float)
    size = np.linalg.norm(true - true[0], axis=-1)
    assert nothing.still_mm == pytest.approx(np.median(size[size > 1.0]))
    assert nothing.still_rms_mm == pytest.approx(np.sqrt(np.mean(size**2)))
    for share, left in ((1.0, 0.03), (0.5, 0.5), (-1.0, 2.0)):
        write_motion(run, source, share)
        found = displacement_error(run, source, S, every=1)
        assert found.median_mm == pytest.approx(left * found.still_mm, rel=0.1, abs=0.1)
        assert found.still_mm == nothing.still_mm
