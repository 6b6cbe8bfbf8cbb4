"""`scopemap evaluate` against every data set that knows something: its poses, or its depth alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from scopemap import Config, open_sequence, reconstruct
from scopemap.apps.evaluate.command import evaluate
from scopemap.apps.evaluate.measures import with_measures
from scopemap.engine.errors import CalibrationError, InputError, SettingsError
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.trajectory.trajectory import write_tum
from scopemap.result.depth_maps import DepthReader
from scopemap.result.reference import read_reference, reference_trajectory
from scopemap.runner.reread_frames import open_truth
from scopemap_bench.cli.evaluate import MEASURES
from scopemap_bench.scoring import default_protocol
from tests.support.drawn_datasets import WRITERS

KNOWS_POSES = sorted(
    {"c3vd", "c3vd:v2", "c3vd:endogslam", "7-scenes", "scared", "scared-c", "endonerf", "tum", "oneslam", "simcol3d"}
    | {"endoslam:unity", "endoslam:real", "stereomis", "endomapper", "climb", "endomapper-sim"}
    | {"colmap:txt", "colmap:bin"}
)
KNOWS_DEPTH_ONLY = ["hamlyn", "hamlyn-tracking", "serv-ct"]


def _figures(*arguments: object) -> dict:
    app = typer.Typer()
    app.command()(with_measures(evaluate, MEASURES))
    result = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    if result.exception is not None:
        raise result.exception
    return json.loads(result.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("name", KNOWS_POSES)
def test_true_poses_of_any_data_set_can_be_named(name: str, tmp_path: Path) -> None:
    folder = WRITERS[name](tmp_path / "input")
    known = reference_trajectory(open_sequence(folder))
    reference = read_reference(folder)
    assert reference is not None
    assert reference.source
    # A pose file's own reader and the data set's agree where both read it; a path in a plane keeps its shape.
    common = np.isin(reference.indices, known.indices)
    assert common.sum() == len(known)
    np.testing.assert_allclose(reference.T_world_camera[common], known.T_world_camera, atol=1e-6)

    moved = known.T_world_camera.copy()
    moved[1:, 0, 3] += 0.25
    estimate = tmp_path / "estimate.tum"
    write_tum(estimate, replace(known, T_world_camera=moved, times_s=known.indices.astype(np.float64)))
    estimate.write_text(estimate.read_text().replace("; time: s", ""))
    figures = _figures(estimate, "--truth", folder, "--align", "none")
    assert figures["frames"] == len(known)
    assert figures["ate_max_mm"] == pytest.approx(0.25, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["images", "hamlyn"])
def test_depth_alone_can_be_compared(name: str, tmp_path: Path) -> None:
    folder, run = WRITERS[name](tmp_path / "input"), tmp_path / "run"
    settings = {"depth.backend": "shading", "networks.flow": "dis", "networks.perceptual": "structure"}
    reconstruct(open_sequence(folder), Config.load(settings=settings), out=run)
    if name not in KNOWS_DEPTH_ONLY:
        with pytest.raises(InputError, match="has no true depth of the frames"):
            _figures(run, "--truth", folder, "--depth", "median")
        return
    depth = _figures(run, "--truth", folder, "--depth", "median")["depth"]
    # The one scale that the median gives is the one that a reader of both by hand finds.
    found, errors = DepthReader(run), []
    nearest_mm, farthest_mm = default_protocol(open_sequence(folder)).depth_range_mm
    for frame, truth in open_sequence(folder):
        true_mm, found_mm = truth.depth_mm, found.read(frame.index)
        both = (true_mm >= nearest_mm) & (true_mm <= farthest_mm) & np.isfinite(found_mm)
        factor = np.median(true_mm[both]) / np.median(found_mm[both])
        errors.append(np.mean(np.abs(found_mm[both] * factor - true_mm[both]) / true_mm[both]))
    assert depth["abs_rel"] == pytest.approx(np.mean(errors), rel=0.02)


def test_a_data_set_can_be_named_where_its_folder_says_something_else(tmp_path: Path) -> None:
    folder = WRITERS["stereomis"](tmp_path / "input")
    named = read_reference(folder, kind="stereomis")
    assert named is not None
    assert named.source.startswith("data set stereomis")
    # The unit is that of files that do not say theirs.
    np.testing.assert_array_equal(read_reference(folder, unit="m").T_world_camera, named.T_world_camera)
    with pytest.raises(InputError, match="as a data set"):
        read_reference(folder, kind="hamlyn")
    with pytest.raises(SettingsError, match="unknown kind"):
        read_reference(folder, kind="nonsense")


@pytest.mark.parametrize("name", ["images", *KNOWS_DEPTH_ONLY])
def test_without_true_poses_it_says_what_can_be_compared(name: str, tmp_path: Path) -> None:
    folder = WRITERS[name](tmp_path / "input")
    assert read_reference(folder) is None
    estimate = tmp_path / "estimate.tum"
    estimate.write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 1 1 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"has no true poses; .*--depth median"):
        _figures(estimate, "--truth", folder)


def test_a_folder_of_nothing_names_both_searches(tmp_path: Path) -> None:
    (tmp_path / "notes.md").write_text("nothing")
    with pytest.raises(InputError, match=r"no true poses in .*no trajectory was recognised.*as a data set"):
        read_reference(tmp_path)


@pytest.fixture
def halved(tmp_path: Path) -> Path:
    """A data set whose pictures are half the size that the calibration beside them is for."""
    folder = WRITERS["oneslam"](tmp_path / "input")
    camera = open_sequence(folder).rectifier.source.central
    write_calibration(camera.resized(2 * camera.width, 2 * camera.height), folder / "images" / "camera.yaml")
    return folder


@pytest.mark.slow
def test_truth_is_read_as_the_run_read_its_input(halved: Path, tmp_path: Path) -> None:
    settings = {"depth.backend": "shading", "networks.flow": "dis", "networks.perceptual": "structure"}
    with pytest.raises(CalibrationError, match="--camera-fit scale"):
        open_sequence(halved)
    config = Config.load(settings=settings | {"input.camera_fit": "scale"})
    run = tmp_path / "run"
    reconstruct(open_sequence(halved, settings=config.input), config, out=run)
    assert open_truth(run, halved).camera == open_sequence(halved, settings=config.input).camera
    assert "abs_rel" in _figures(run, "--truth", halved, "--align", "origin", "--depth", "median")["depth"]
    # Poses need no camera at all.
    assert read_reference(halved).source.startswith("data set oneslam")


@pytest.mark.slow
def test_depth_of_a_run_with_another_camera_is_compared_pixel_by_pixel(tmp_path: Path) -> None:
    folder, run = WRITERS["hamlyn"](tmp_path / "input"), tmp_path / "run"
    settings = {"depth.backend": "shading", "networks.flow": "dis", "networks.perceptual": "structure"}
    own = open_sequence(folder).rectifier.source.central
    other = tmp_path / "other.yaml"
    write_calibration(replace(own, fx=own.fx * 1.3, fy=own.fy * 1.3, cx=own.cx + 2), other)
    reconstruct(open_sequence(folder, camera=other), Config.load(settings=settings), out=run)
    truth = open_truth(run, folder)
    assert truth.camera.fx == pytest.approx(own.fx * 1.3 * truth.camera.width / own.width)
    assert "abs_rel" in _figures(run, "--truth", folder, "--depth", "median")["depth"]
    (run / "source_camera.yaml").unlink()  # as older runs left it
    with pytest.raises(InputError, match="another camera"):
        _figures(run, "--truth", folder, "--depth", "median")
