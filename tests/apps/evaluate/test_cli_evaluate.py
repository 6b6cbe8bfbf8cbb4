"""`scopemap evaluate`: keys, alignment, mesh, depth, forms, warnings, refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import trimesh
import typer
from typer.testing import CliRunner

from scopemap import Config, open_sequence, reconstruct
from scopemap.apps.evaluate.command import evaluate
from scopemap.apps.evaluate.measures import Compared, with_measures
from scopemap.apps.run.command import run as run_command
from scopemap.cli import app as cli
from scopemap.engine.errors import AlignmentError, InputError, SettingsError
from scopemap.engine.geometry.align import align_trajectories
from scopemap.input.trajectory.trajectory import write_kitti
from scopemap_bench.cli.evaluate import MEASURES
from tests.support.sample_trajectories import as_trajectory, vector_a, write_c3vd, write_run
from tests.support.tiny_phantom import write_tiny

KEYS = [
    *(
        "frames",
        "tracked",
        "align",
        "straight",
        "turn",
        "turn_bound_deg",
        "scale",
        "ate_rmse_mm",
        "ate_hold_rmse_mm",
        "ate_mean_mm",
    ),
    *("rotation_mean_deg", "rotation_max_deg", "rotation_unaligned_mean_deg", "rotation_unaligned_max_deg"),
    *("rpe_1_mm", "rpe_1_deg", "rpe_10_mm", "rpe_10_deg", "tlr"),
    *("ate_median_mm", "ate_max_mm", "rpe_10mm_path_mm", "rpe_10mm_path_deg"),
    *("ate_below_1_mm_percent", "ate_below_2_mm_percent", "ate_below_5_mm_percent"),
    *("rotation_below_1_deg_percent", "rotation_below_2_deg_percent", "rotation_below_5_deg_percent"),
    *("coverage", "reference_frames", "longest_tracked", "frames_until_loss"),
]


def run(*arguments: object, code: int = 0) -> Any:
    app = typer.Typer()
    app.command()(with_measures(evaluate, MEASURES))
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, (result.output, result.exception)
    return result


def figures_of(*arguments: object) -> dict[str, Any]:
    return json.loads(run(*arguments, "--json").stdout)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    estimated, reference = vector_a()
    return write_run(tmp_path / "run", as_trajectory(estimated)), write_c3vd(tmp_path / "truth", reference)


@pytest.mark.parametrize(
    ("align", "ate"),
    [("none", 10.058219), ("origin", 8.782756), ("se3", 5.585285), ("sim3", 0.308821), ("scale", 17.469604)],
)
def test_json_has_the_keys_and_the_known_figures(folders: tuple[Path, Path], align: str, ate: float) -> None:
    figures = figures_of(folders[0], "--truth", folders[1], "--align", align, "--paper-units")
    assert list(figures) == [*KEYS, "paper", "sources"]
    assert (figures["align"], figures["frames"]) == (align, 60)
    assert figures["ate_rmse_mm"] == pytest.approx(ate, abs=2e-6)
    assert np.degrees(figures["paper"]["r_avg_rad"]) == pytest.approx(figures["rotation_mean_deg"])


def test_tables_a_line_and_csv_show_the_same_figures(folders: tuple[Path, Path]) -> None:
    given = (folders[0], "--truth", folders[1], "--protocol", "evo")
    table = run(*given, "--paper-units").stdout
    for words in ("60 of 60 frames tracked, align sim3, scale 2.4977", "0.3088", "R_avg +- std (rad)"):
        assert words in table
    assert run(*given, "--quiet").stdout.count("\n") == 1
    rows, figures = dict(csv.reader(run(*given, "--csv").stdout.splitlines())), figures_of(*given)
    assert "0.308821" in rows["ate_rmse_mm"]
    assert float(rows["evo.evo_sim3_ape_rmse_mm"]) == pytest.approx(figures["evo"]["evo_sim3_ape_rmse_mm"])
    assert figures_of(*given, "--align-first", 20)["ate_rmse_mm"] > figures["ate_rmse_mm"]


def test_lost_frames_and_straight_paths_warn_on_stderr(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    lossy = write_run(tmp_path / "lossy", as_trajectory(vector_a()[0][:9], lost=(4, 5)))
    result = run(lossy, "--truth", folders[1], "--json")
    figures = json.loads(result.stdout)
    assert (figures["frames"], figures["tracked"]) == (9, 7)
    assert figures["rpe_10_mm"] is None
    assert "2 of 9 frames are lost" in result.stderr
    assert run(lossy, "--truth", folders[1], "--json", "--quiet").stderr == ""
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(50, 3)) * [20, 0.1, 0.1]
    straight = write_c3vd(tmp_path / "straight", poses)
    assert "nearly a straight line: the turn" in run(straight, "--truth", straight).stderr
    assert run(straight, "--truth", straight, "--align", "origin").stderr == ""


def test_units_and_kinds_of_both_sides_are_asked_for_apart(tmp_path: Path) -> None:
    estimated, reference = (as_trajectory(poses) for poses in vector_a())
    write_kitti(tmp_path / "estimate.txt", estimated, unit="m")
    write_kitti(tmp_path / "truth.txt", reference)
    given = (tmp_path / "estimate.txt", "--truth", tmp_path / "truth.txt", "--truth-unit", "mm")
    figures = figures_of(*given, "--unit", "m", "--truth-kind", "kitti")
    assert figures["tlr"] == pytest.approx(0.436782, abs=1e-6)
    assert "KITTI" in figures["sources"]["truth"]
    assert figures_of(*given, "--unit", "mm")["tlr"] == pytest.approx(0.436782e-3, rel=1e-5)
    assert isinstance(run(*given, "--kind", "kitty", code=1).exception, SettingsError)


def test_mesh_is_moved_by_the_alignment_of_the_trajectory(tmp_path: Path) -> None:
    estimated, reference = vector_a()
    _, similarity = align_trajectories(estimated, reference, "sim3")
    run_folder = write_run(tmp_path / "run", as_trajectory(estimated))
    truth_folder = write_c3vd(tmp_path / "truth", reference)
    trimesh.creation.icosphere(subdivisions=4, radius=20.0).export(truth_folder / "mesh_truth.ply")
    # The estimate's own world: the inverse of the alignment, on a sphere 1 mm larger.
    larger = trimesh.creation.icosphere(subdivisions=4, radius=21.0)
    larger.vertices = (larger.vertices - similarity.t) @ similarity.R / similarity.scale
    larger.export(run_folder / "mesh.ply")
    figures = figures_of(run_folder, "--truth", truth_folder)
    mesh_keys = ["mesh_accuracy_mm", "mesh_accuracy_p90_mm", "mesh_completeness_mm", "surface"]
    assert list(figures) == [*KEYS, *mesh_keys, "sources"]
    assert figures["mesh_accuracy_mm"] == pytest.approx(1.0, abs=0.02)
    assert figures["mesh_completeness_mm"] == pytest.approx(1.0, abs=0.02)
    (run_folder / "mesh.ply").write_text("not a mesh")
    assert isinstance(run(run_folder, "--truth", truth_folder, code=1).exception, InputError)


def test_refusals(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    truth = ("--truth", folders[1])
    two = write_run(tmp_path / "two", as_trajectory(vector_a()[0][:2]))
    assert isinstance(run(two, *truth, code=1).exception, AlignmentError)
    assert isinstance(run(tmp_path / "none", *truth, code=1).exception, InputError)
    assert isinstance(run(folders[0], *truth, "--icp", code=1).exception, InputError)
    assert "endogslam" in str(run(folders[0], *truth, "--protocol", "afs", code=1).exception)
    assert "no depth maps" in str(run(folders[0], *truth, "--depth", "none", code=1).exception)
    for wrong in ((), (*truth, "--align", "sim4"), (*truth, "--csv", "--json"), (*truth, "--depth", "scaled")):
        run(folders[0], *wrong, code=2)


def test_another_package_adds_measures_and_options(folders: tuple[Path, Path]) -> None:
    def turned(compared: Compared, name: Annotated[str | None, typer.Option("--turned")] = None) -> dict[str, Any]:
        return {name: {"frames": len(compared.estimate)}} if name else {}

    app = typer.Typer()
    app.command()(with_measures(evaluate, [turned]))
    given = [str(folders[0]), "--truth", str(folders[1]), "--json"]
    figures = json.loads(CliRunner().invoke(app, [*given, "--turned", "mine"]).stdout)
    assert figures["mine"] == {"frames": 60}
    assert "mine" not in json.loads(CliRunner().invoke(app, given).stdout)
    without = CliRunner().invoke(app, [given[0], "--against-video", "--turned", "mine"])
    assert (without.exit_code, "--truth" in without.output) == (2, True)


def test_a_command_of_scopemap_cannot_be_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    added = (("compare", len), ("run", len))
    monkeypatch.setattr(cli, "plugins", lambda group: added if group == "scopemap.commands" else ())
    found, left_out = cli.commands()
    assert (found["compare"], left_out) == (len, ["run"])
    assert found["run"] is run_command


@pytest.mark.slow
def test_depth_and_its_consistency_are_measured_on_demand(tmp_path: Path) -> None:
    """A run on true depth has no depth error, and its depth agrees from frame to frame as well as the truth does."""
    truth = write_tiny(tmp_path / "phantom", frames=4)
    config = Config.load(settings={"depth.backend": f"files:{truth}", "fusion.enabled": False})
    reconstruct(open_sequence(truth), config, out=tmp_path / "run")
    figures = figures_of(tmp_path / "run", "--truth", truth, "--depth", "median", "--consistency")
    assert figures["depth"]["abs_rel"] < 1e-3
    assert figures["depth"]["scaling"] == "median"
    consistency = figures["depth"]["metric_consistency"]
    assert len(consistency["frames"]) == 4
    assert consistency["median"] == pytest.approx(1, abs=0.02)
    assert figures["consistency"]["frames"] == 4
    assert figures["consistency"]["tae_reference"]["percent"] < 2
    provenance = (tmp_path / "run/provenance.json").read_text()
    fx = json.loads(provenance)["camera"]["fx"]
    (tmp_path / "run/provenance.json").write_text(provenance.replace(f'"fx": {fx}', f'"fx": {fx * 1.1}'))
    with_another = run(tmp_path / "run", "--truth", truth, "--depth", "none", code=1).exception
    assert "another camera" in str(with_another)
