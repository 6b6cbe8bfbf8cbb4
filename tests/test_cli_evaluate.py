"""`scopemap evaluate`: keys, alignment, mesh, formats, warnings, refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
import typer
from sample_trajectories import as_trajectory, vector_a, write_c3vd, write_run
from tiny_phantom import write_tiny
from typer.testing import CliRunner

from scopemap import Config, open_sequence, reconstruct
from scopemap.errors import AlignmentError, InputError, SettingsError
from scopemap.geometry.align import align_trajectories
from scopemap.trajectory.trajectory import path_length_mm, write_kitti, write_tum
from scopemap_bench.cli.evaluate import evaluate

KEYS = [
    *("frames", "tracked", "align", "scale", "ate_rmse_mm", "ate_hold_rmse_mm", "ate_mean_mm"),
    *("rotation_mean_deg", "rotation_max_deg", "rotation_unaligned_mean_deg", "rotation_unaligned_max_deg"),
    *("rpe_1_mm", "rpe_1_deg", "rpe_10_mm", "rpe_10_deg", "tlr"),
    *("ate_median_mm", "ate_max_mm", "rpe_10mm_path_mm", "rpe_10mm_path_deg"),
    *("ate_below_1_mm_percent", "ate_below_2_mm_percent", "ate_below_5_mm_percent"),
    *("rotation_below_1_deg_percent", "rotation_below_2_deg_percent", "rotation_below_5_deg_percent"),
    *("coverage", "reference_frames", "longest_tracked", "frames_until_loss"),
]


def run(*arguments: object, code: int = 0) -> object:
    app = typer.Typer()
    app.command()(evaluate)
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, (result.output, result.exception)
    return result


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    estimated, reference = vector_a()
    return write_run(tmp_path / "run", as_trajectory(estimated)), write_c3vd(tmp_path / "truth", reference)


@pytest.mark.parametrize(
    ("align", "ate"), [("none", 10.058219), ("origin", 8.782756), ("se3", 5.585285), ("sim3", 0.308821)]
)
def test_json_has_the_keys_and_the_known_figures(folders: tuple[Path, Path], align: str, ate: float) -> None:
    figures = json.loads(run(folders[0], "--truth", folders[1], "--align", align, "--json").stdout)
    assert list(figures) == [*KEYS, "sources"]
    assert figures["align"] == align
    assert figures["ate_rmse_mm"] == pytest.approx(ate, abs=2e-6)
    assert figures["frames"] == 60


def test_sim3_is_the_default_and_the_table_says_so(folders: tuple[Path, Path]) -> None:
    output = run(folders[0], "--truth", folders[1]).stdout
    assert "60 of 60 frames tracked, align sim3, scale 2.4977" in output
    assert "0.3088" in output
    assert run(folders[0], "--truth", folders[1], "--quiet").stdout.count("\n") == 1


def test_paper_units_are_radians(folders: tuple[Path, Path]) -> None:
    figures = json.loads(run(folders[0], "--truth", folders[1], "--json", "--paper-units").stdout)
    assert list(figures) == [*KEYS, "paper", "sources"]
    assert np.degrees(figures["paper"]["r_avg_rad"]) == pytest.approx(figures["rotation_mean_deg"])
    assert figures["paper"]["t_fin_mm"] == pytest.approx(0.225936, abs=2e-6)
    assert "R_avg +- std (rad)" in run(folders[0], "--truth", folders[1], "--paper-units").stdout


def test_lost_frames_warn_on_stderr_and_json_stays_json(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    lossy = write_run(tmp_path / "lossy", as_trajectory(vector_a()[0][:9], lost=(4, 5)))
    result = run(lossy, "--truth", folders[1], "--json")
    figures = json.loads(result.stdout)
    assert (figures["frames"], figures["tracked"]) == (9, 7)
    assert figures["ate_hold_rmse_mm"] > figures["ate_rmse_mm"]
    assert figures["rpe_10_mm"] is None
    assert "2 of 9 frames are lost" in result.stderr
    assert run(lossy, "--truth", folders[1], "--json", "--quiet").stderr == ""


def test_nearly_straight_path_warns(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(50, 3)) * [20, 0.1, 0.1]
    truth = write_c3vd(tmp_path / "truth", poses)
    assert "nearly a straight line" in run(truth, "--truth", truth).stderr
    assert run(truth, "--truth", truth, "--align", "origin").stderr == ""


def test_foreign_files_in_metres_and_by_frame_number(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    estimated = as_trajectory(vector_a()[0])
    write_kitti(tmp_path / "kitti.txt", estimated, unit="m")
    write_tum(tmp_path / "ours.tum", estimated)
    rows = np.loadtxt(tmp_path / "ours.tum")
    rows[:, 0] = np.arange(60)
    rows[:, 1:4] /= 1000
    np.savetxt(tmp_path / "numbered.tum", rows[5:50:3])
    lengths = [path_length_mm(poses[5:50:3, :3, 3]) for poses in vector_a()]
    expected = [("kitti.txt", 60, 0.436782), ("ours.tum", 60, 0.436782), ("numbered.tum", 15, lengths[0] / lengths[1])]
    for name, frames, tlr in expected:
        arguments = (tmp_path / name, "--truth", folders[1], "--unit", "m", "--align", "none", "--json")
        figures = json.loads(run(*arguments).stdout)
        assert figures["frames"] == frames
        assert figures["tlr"] == pytest.approx(tlr, abs=1e-6)
    wrong = json.loads(run(tmp_path / "kitti.txt", "--truth", folders[1], "--json").stdout)
    assert wrong["tlr"] == pytest.approx(0.436782e-3, rel=1e-5)


def test_mesh_is_moved_by_the_alignment_of_the_trajectory(tmp_path: Path) -> None:
    estimated, reference = vector_a()
    _, similarity = align_trajectories(estimated, reference, "sim3")
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
    run_folder = write_run(tmp_path / "run", as_trajectory(estimated))
    truth_folder = write_c3vd(tmp_path / "truth", reference)
    sphere.export(truth_folder / "mesh_truth.ply")
    # The estimate's own world: the inverse of the alignment, on a sphere 1 mm larger.
    larger = trimesh.creation.icosphere(subdivisions=4, radius=21.0)
    larger.vertices = (larger.vertices - similarity.t) @ similarity.R / similarity.scale
    larger.export(run_folder / "mesh.ply")
    figures = json.loads(run(run_folder, "--truth", truth_folder, "--json").stdout)
    mesh_keys = ["mesh_accuracy_mm", "mesh_accuracy_p90_mm", "mesh_completeness_mm", "surface"]
    assert list(figures) == [*KEYS, *mesh_keys, "sources"]
    assert figures["surface"]["f_2mm"] == pytest.approx(1.0)
    assert figures["mesh_accuracy_mm"] == pytest.approx(1.0, abs=0.02)
    assert figures["mesh_accuracy_p90_mm"] == pytest.approx(1.0, abs=0.05)
    assert figures["mesh_completeness_mm"] == pytest.approx(1.0, abs=0.02)
    (run_folder / "mesh.ply").write_text("not a mesh")
    assert isinstance(run(run_folder, "--truth", truth_folder, code=1).exception, InputError)


def test_refusals(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    two = write_run(tmp_path / "two", as_trajectory(vector_a()[0][:2]))
    assert isinstance(run(two, "--truth", folders[1], code=1).exception, AlignmentError)
    assert isinstance(run(tmp_path / "none", "--truth", folders[1], code=1).exception, InputError)
    assert "sim4" in run(folders[0], "--truth", folders[1], "--align", "sim4", code=2).output
    run(folders[0], code=2)


def test_csv_is_one_figure_a_line_and_the_same_as_json(folders: tuple[Path, Path]) -> None:
    given = (folders[0], "--truth", folders[1], "--protocol", "evo")
    rows = dict(csv.reader(run(*given, "--csv").stdout.splitlines()))
    figures = json.loads(run(*given, "--json").stdout)
    assert float(rows["ate_rmse_mm"]) == pytest.approx(figures["ate_rmse_mm"])
    assert rows["align"] == "sim3"
    assert float(rows["evo.evo_sim3_ape_rmse_mm"]) == pytest.approx(figures["evo"]["evo_sim3_ape_rmse_mm"])
    assert "0.308821" in rows["ate_rmse_mm"]


def test_protocols_keep_their_own_names(folders: tuple[Path, Path]) -> None:
    figures = json.loads(run(folders[0], "--truth", folders[1], "--json", "--protocol", "af").stdout)
    assert figures["af"]["af_ate_mean_mm"] == pytest.approx(0.177045, abs=1e-6)
    assert "5 frames" in figures["af"]["description"]
    table = run(folders[0], "--truth", folders[1], "--protocol", "af").stdout
    assert "af_ate_mean_mm" in table
    refused = run(folders[0], "--truth", folders[1], "--protocol", "afs", code=1).exception
    assert isinstance(refused, SettingsError)
    assert "endogslam" in str(refused)


def test_alignment_by_scale_and_on_the_first_frames(folders: tuple[Path, Path]) -> None:
    scale = json.loads(run(folders[0], "--truth", folders[1], "--align", "scale", "--json").stdout)
    assert scale["ate_rmse_mm"] == pytest.approx(17.469604, abs=2e-6)
    every = json.loads(run(folders[0], "--truth", folders[1], "--json").stdout)
    first = json.loads(run(folders[0], "--truth", folders[1], "--align-first", 20, "--json").stdout)
    assert first["ate_rmse_mm"] > every["ate_rmse_mm"]


def test_units_and_kinds_of_both_sides_are_asked_for_apart(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    estimated, reference = (as_trajectory(poses) for poses in vector_a())
    write_kitti(tmp_path / "estimate.txt", estimated, unit="m")
    write_kitti(tmp_path / "truth.txt", reference)
    given = (tmp_path / "estimate.txt", "--truth", tmp_path / "truth.txt", "--unit", "m", "--truth-unit", "mm")
    figures = json.loads(run(*given, "--truth-kind", "kitti", "--json").stdout)
    assert figures["tlr"] == pytest.approx(0.436782, abs=1e-6)
    assert "KITTI" in figures["sources"]["truth"]
    assert isinstance(run(*given, "--kind", "kitty", code=1).exception, SettingsError)


def test_depth_and_its_consistency_are_measured_on_demand(tmp_path: Path) -> None:
    """A run on true depth has no depth error, and its depth agrees from frame to frame as well as the truth does."""
    truth = write_tiny(tmp_path / "phantom", frames=4)
    settings = {"networks.flow": "dis", "networks.perceptual": "structure", "fusion.enabled": False}
    config = Config.load(settings={"depth.backend": f"files:{truth}"} | settings)
    reconstruct(open_sequence(truth), config, out=tmp_path / "run")
    figures = json.loads(run(tmp_path / "run", "--truth", truth, "--depth", "median", "--consistency", "--json").stdout)
    assert figures["depth"]["abs_rel"] < 1e-3
    assert figures["depth"]["scaling"] == "median"
    assert figures["consistency"]["frames"] == 4
    assert figures["consistency"]["tae_reference"]["percent"] < 2
    assert figures["consistency"]["scale"] == pytest.approx(1, abs=1e-3)
    assert "sequence-median" in run(tmp_path / "run", "--truth", truth, "--depth", "scaled", code=2).output
    provenance = (tmp_path / "run/provenance.json").read_text()
    camera = json.loads(provenance)["camera"]
    other = provenance.replace(f'"fx": {camera["fx"]}', f'"fx": {camera["fx"] * 1.1}')
    (tmp_path / "run/provenance.json").write_text(other)
    with_another = run(tmp_path / "run", "--truth", truth, "--depth", "none", code=1).exception
    assert "another camera" in str(with_another)
    bare = write_run(tmp_path / "bare", as_trajectory(vector_a()[0]))
    refused = run(bare, "--truth", truth, "--align", "origin", "--depth", "none", code=1).exception
    assert isinstance(refused, InputError)
    assert "no depth maps" in str(refused)


def test_options_that_would_be_ignored_are_refused(folders: tuple[Path, Path]) -> None:
    assert isinstance(run(folders[0], "--truth", folders[1], "--icp", code=1).exception, InputError)
    assert "--csv" in run(folders[0], "--truth", folders[1], "--csv", "--json", code=2).output
