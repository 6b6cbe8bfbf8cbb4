"""`scopemap compare` and `scopemap bench`: rows from anywhere, tables and figures, plans on the command line."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from scopemap import Config, open_sequence, reconstruct
from scopemap.cli.app import app
from scopemap.engine.config import MaskSettings
from scopemap.engine.errors import InputError
from scopemap.engine.masking.masker import Masker
from scopemap.input.trajectory.trajectory import write_kitti
from scopemap.report.depth_figures import MASKED_GREY
from scopemap_bench.result import RunResult
from tests.support.sample_trajectories import as_trajectory, vector_a, write_c3vd, write_run
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow


def run(*arguments: object, code: int = 0) -> object:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, (result.output, result.exception)
    return result


@pytest.fixture
def places(tmp_path: Path) -> tuple[Path, Path, Path]:
    """A run, a foreign file of the true path, and the truth."""
    estimated, reference = vector_a()
    write_kitti(tmp_path / "theirs.txt", as_trajectory(reference))
    run_folder = write_run(tmp_path / "ours", as_trajectory(estimated))
    return run_folder, tmp_path / "theirs.txt", write_c3vd(tmp_path / "truth", reference) / "pose.txt"


def test_runs_and_foreign_files_stand_side_by_side(places: tuple[Path, Path, Path], tmp_path: Path) -> None:
    ours, theirs, truth = places
    # A run that is an import is compared, and left out of the page.
    (ours / "provenance.json").write_text(json.dumps({"input": str(truth), "imported": str(theirs)}))
    result = run("compare", ours, theirs, "--truth", truth, "--out", tmp_path / "out")
    assert not (tmp_path / "out/report.html").exists()
    assert "0.309" in result.stdout
    assert "theirs.txt" in result.stdout
    rows = list(csv.DictReader((tmp_path / "out/tables/overview.csv").read_text().splitlines()))
    assert [row["method"] for row in rows] == ["ours", "theirs.txt"]
    assert float(rows[0]["ATE RMSE [mm]"]) == pytest.approx(0.308821, abs=1e-6)
    assert float(rows[1]["ATE RMSE [mm]"]) == pytest.approx(0, abs=1e-6)
    figures = {file.name for file in (tmp_path / "out/figures").iterdir()}
    assert {"ate.png", "frames_until_loss.png"} <= figures


def test_names_alignment_and_json(places: tuple[Path, Path, Path]) -> None:
    ours, theirs, truth = places
    given = ("compare", ours, theirs, "--truth", truth, "--names", "A, B", "--align", "se3", "--json")
    rows = json.loads(run(*given).stdout)
    assert [row["method"] for row in rows] == ["A", "B"]
    assert rows[0]["figures"]["poses"]["align"] == "se3"
    assert rows[0]["figures"]["poses"]["ate_rmse_mm"] == pytest.approx(5.585285, abs=1e-5)
    assert run("compare", ours, "--truth", truth, "--quiet").stdout == ""


def test_the_frames_outside_a_part_are_not_lost(places: tuple[Path, Path, Path], tmp_path: Path) -> None:
    ours, theirs, truth = places
    part = write_run(tmp_path / "part", as_trajectory(vector_a()[0]).rows(np.arange(20, 50)))
    (part / "provenance.json").write_text(json.dumps({"selection": {"frames": "20:50", "of": 60}}))
    run("compare", ours, part, theirs, "--truth", truth, "--out", tmp_path / "out")
    rows = list(csv.DictReader((tmp_path / "out/tables/overview.csv").read_text().splitlines()))
    found = {row["method"]: (row["sequence"], row["frames tracked"]) for row in rows}
    assert found["part"] == ("pose, frames 20 to 49 of 60", "30 of 30")
    assert found["ours"] == found["theirs.txt"] == ("pose", "60 of 60")


def test_a_benchmarks_run_brings_its_figures(tmp_path: Path) -> None:
    for name, ate in (("a", 1.0), ("b", 2.0)):
        (tmp_path / name).mkdir()
        RunResult("clip", name, figures={"poses": {"ate_rmse_mm": ate, "align": "sim3"}}).save(tmp_path / name)
    output = run("compare", tmp_path / "a", tmp_path / "b").stdout
    assert "**1.000**" in output
    assert "2.000" in output
    again = tmp_path / "again"
    again.mkdir()
    RunResult("clip", "a", figures={"poses": {"ate_rmse_mm": 3.0, "align": "sim3"}}).save(again)
    named = run("compare", tmp_path / "a", again, "--names", "old,new").stdout
    assert "old" in named
    assert "3.000" in named
    for arguments, message in (((), "all called 'a' on 'clip'"), (("--consistency",), "measured no consistency")):
        error = run("compare", tmp_path / "a", again, *arguments, code=1).exception
        assert isinstance(error, InputError)
        assert message in str(error)


def test_refusals_of_compare(places: tuple[Path, Path, Path], tmp_path: Path) -> None:
    ours, theirs, truth = places
    for arguments, message in (
        ((ours,), "name the true poses by --truth"),
        ((tmp_path / "none", "--truth", truth), "no such file or folder"),
        ((ours, theirs, "--truth", truth, "--names", "A"), "1 names were given"),
        ((ours, "--truth", truth, "--out", theirs), "cannot write"),
    ):
        error = run("compare", *arguments, code=1).exception
        assert isinstance(error, InputError)
        assert message in str(error)


def test_runs_on_a_phantom_are_drawn_with_mesh_depth_and_paths(tmp_path: Path) -> None:
    truth = write_tiny(tmp_path / "phantom", frames=5)
    light = {
        "networks.flow": "dis",
        "networks.perceptual": "structure",
        "fusion.voxel_mm": 2.0,
        "fusion.method": "unweighted",
    }
    reconstruct(open_sequence(truth), Config.load(settings=light), out=tmp_path / "one")
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    out = tmp_path / "out"
    run("compare", tmp_path / "one", tmp_path / "two", "--truth", truth, "--consistency", "--out", out)
    drawn = {file.name for file in (out / "figures").iterdir()}
    assert drawn == {
        *("ate.png", "frames_until_loss.png", "mesh_phantom_one.png", "mesh_phantom_two.png"),
        *(f"{name}_phantom.png" for name in ("orb_pairs", "orb_points", "orb_bars", "depth_change", "clouds")),
    }
    consistency = list(csv.DictReader((out / "tables/consistency.csv").read_text().splitlines()))
    assert [row["method"] for row in consistency] == ["one", "two"]
    assert all(np.isfinite(float(row["TAE, true poses [%]"])) for row in consistency)
    assert "## Consistency in time" in (out / "results.md").read_text()
    assert "<title>one, phantom, two, phantom" in (out / "report.html").read_text(encoding="utf-8")


def test_what_the_mask_leaves_out_is_neither_counted_nor_drawn(tmp_path: Path) -> None:
    """No figure and no number of consistency may depend on the depth of highlights or outside the field of view."""
    truth = write_tiny(tmp_path / "phantom", frames=3)
    for file in truth.glob("*_color.png"):
        picture = cv2.imread(str(file))
        picture[:, :30] = 0
        cv2.circle(picture, (100, 60), 12, (255, 255, 255), cv2.FILLED)
        cv2.imwrite(str(file), picture)
    light = {"networks.flow": "dis", "networks.perceptual": "structure", "fusion.voxel_mm": 2.0}
    reconstruct(open_sequence(truth), Config.load(settings=light), out=tmp_path / "as-it-is" / "run")
    masker, masked = Masker(MaskSettings()), []
    shutil.copytree(tmp_path / "as-it-is", tmp_path / "rubbish")
    for frame in open_sequence(truth).frames():
        file = tmp_path / "rubbish" / "run" / "depth" / f"{frame.index:06d}.png"
        units, outside = cv2.imread(str(file), cv2.IMREAD_UNCHANGED), ~masker(frame).valid
        assert (units[outside] > 0).any()
        units[outside] = 60_000 - 10_000 * frame.index
        cv2.imwrite(str(file), units)
        masked.append(outside)
    for file in truth.glob("*_depth.*"):  # the one scale of the sequence is that of all true depth
        file.unlink()
    shown = {}
    for name in ("as-it-is", "rubbish"):
        out = tmp_path / name / "out"
        run("compare", tmp_path / name / "run", "--truth", truth, "--consistency", "--out", out)
        files = [*(out / "figures").iterdir(), out / "tables" / "consistency.csv"]
        shown[name] = {file.name: file.read_bytes() for file in files}
    assert {"depth_change_phantom.png", "clouds_phantom.png", "orb_points_phantom.png"} < set(shown["rubbish"])
    different = [name for name, content in shown["rubbish"].items() if content != shown["as-it-is"][name]]
    assert different == []
    # Depth and difference of both frames are grey there, two thirds of three pictures in all.
    drawn = cv2.imread(str(tmp_path / "rubbish" / "out" / "figures" / "depth_change_phantom.png"))
    is_grey = (drawn == MASKED_GREY).all(axis=2).sum()
    cell_px = (300 / masked[0].shape[1]) ** 2
    assert is_grey == pytest.approx(3 * cell_px * np.mean([one.sum() for one in masked[1:]]), rel=0.15)


def test_a_plan_needs_a_folder_and_its_data(tmp_path: Path) -> None:
    assert "c3vd-rgbd: C3VD, ten clips, true depth, 9 methods" in run("bench").output
    assert "--out" in run("bench", "scared", code=2).output
    error = run("bench", "scared", "--out", tmp_path / "out", "--data", tmp_path, code=1).exception
    assert isinstance(error, InputError)
    assert "nothing like that in" in str(error)
