"""`scopemap compare A B` without a truth: two runs in one frame of reference."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import so3_exp
from scopemap.result.frame_table import FrameTable
from tests.support.drawn_run import IN_RESULT, changed, drawn_result
from tests.support.front_door import call, refused

# From the world of the drawn run to that of another run of the same video.
OTHER_WORLD = Similarity(1.7, so3_exp(np.array([0.4, -0.7, 0.2])), np.array([5.0, -30.0, 12.0]))


def write(folder: Path, *, wider: float = 1.0, frames: slice = slice(None), straight: bool = False) -> Path:
    """The drawn run in its own world: the tube `wider`, of some of its frames, and its path a straight line."""
    result = drawn_result()
    table, mesh = FrameTable(result.frames.rows[frames].copy()), result.mesh.copy()
    if straight:
        table.rows["T_world_camera"][:, :2, 3] *= np.where(np.isnan(table.rows["T_world_camera"][:, :2, 3]), 1, 0)
    mesh.vertices[:, :2] *= wider
    changed(result, frames=table, mesh=mesh).save(folder)
    return folder


def move(folder: Path, source: Path) -> Path:
    """The run in `source` in another world and scale."""
    from scopemap.result.result import Result

    run, result = Result(source), drawn_result()
    table, mesh = FrameTable(run.frames.rows.copy()), run.mesh.copy()
    table.rows["T_world_camera"] = OTHER_WORLD.transform_poses(table.rows["T_world_camera"])
    mesh.vertices = OTHER_WORLD.transform_points(np.asarray(mesh.vertices))
    changed(result, frames=table, mesh=mesh).save(folder)
    return folder


def figures(capfd: pytest.CaptureFixture[str], *arguments: object) -> dict[str, dict[str, float]]:
    assert call("compare", *arguments, "--json") == 0
    return dict(json.loads(capfd.readouterr().out))


@pytest.mark.parametrize("straight", [False, True])
def test_the_same_run_in_another_world_agrees(
    straight: bool, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first = write(tmp_path / "a", straight=straight)
    found = figures(capfd, first, move(tmp_path / "b", first))
    assert found["common_frames"] == IN_RESULT
    assert found["scale"] == pytest.approx(1.7, rel=1e-4)
    assert found["path"]["position_max"] < 1e-2
    assert found["path"]["rotation_max_deg"] < 1e-2
    assert found["surface"]["both_percent"] > 99
    assert found["surface"]["within_2_percent"] > 99


def test_the_share_within_two_and_five_percent(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    first = write(tmp_path / "a")
    # A wall that is 3.5 % farther from the axis is as much farther along each ray that meets it.
    found = figures(capfd, move(tmp_path / "wide", write(tmp_path / "w", wider=1.035)), first)
    assert found["scale"] == pytest.approx(1 / 1.7, rel=1e-4)
    assert found["surface"]["within_2_percent"] < 20
    assert found["surface"]["within_5_percent"] > 80
    assert 2.5 < found["surface"]["median_percent"] < 4.5


def test_it_is_told_in_words_and_drawn(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    first, second = write(tmp_path / "a"), write(tmp_path / "b", wider=1.2, frames=slice(4, None))
    assert call("compare", first, second, "--out", tmp_path / "out", "--names", "one,two") == 0
    said = capfd.readouterr().out
    assert f"{IN_RESULT - 4} common frames" in said
    assert "% within 2 %" in said
    assert "Where they differ, neither is confirmed" in said
    assert "one: scale unknown" in said
    assert " mm" not in said
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"path.png", "difference.png", "report.html"}


def test_what_cannot_be_compared_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    first, few = write(tmp_path / "a"), write(tmp_path / "few", frames=slice(12, None))
    assert "they have 2 tracked frames in common" in refused(capfd, "compare", first, few)
    said = refused(capfd, "compare", first, "--truth", few)
    assert f"{few} is a run, which is no truth: `scopemap compare A B`" in said
    assert "name the true poses by --truth" in refused(capfd, "compare", first)
    assert "nowhere: no such file or folder" in refused(capfd, "compare", first, tmp_path / "nowhere")
    assert "need --truth: two runs alone have none" in refused(capfd, "compare", first, few, "--align", "se3")
    assert "with itself: give two runs" in refused(capfd, "compare", first, tmp_path / "few" / ".." / "a")
    assert "2 runs: 1 names" in refused(capfd, "compare", first, few, "--names", "A")
