"""The final score of a CLiMB submission: means over runs and clips, failures counted, and the time limit."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from scopemap_bench.climb.figures import ClimbScore
from scopemap_bench.climb.ranking import ranked, ranking_of
from scopemap_bench.climb.submission import submission_problems
from scopemap_bench.result import RunResult
from scopemap_bench.tables import benchmark_tables
from tests.support.drawn_climb import path_of, write_foreign_run, write_reference
from tests.support.drawn_inputs import picture
from tests.support.drawn_video_sets import write_frames
from tests.support.front_door import call

FRAMES = 300  # 6 s at 50 frames a second


def write_runs(clip: Path, truth: np.ndarray, noise_mm: list[float], processing_s: float = 3.0) -> None:
    """Five runs, each with noise of its own strength."""
    for number, strength in enumerate(noise_mm, start=1):
        poses = truth.copy()
        poses[:, :3, 3] += strength * np.random.default_rng(number).normal(size=(len(truth), 3))
        run = write_foreign_run(clip / str(number), (poses, [*range(1, len(truth) + 1)]))
        (run / "runtime.txt").write_text(f"init_seconds=0.5\nprocessing_seconds={processing_s}\n")


@pytest.fixture
def truths(tmp_path: Path) -> Path:
    """References of three clips."""
    for seed in range(3):
        write_reference(tmp_path / "climb", path_of(FRAMES, seed), f"Seq_00{seed}_a", scale=None)
    return tmp_path / "climb"


def test_the_final_score_is_the_mean_over_clips_and_counts_what_is_missing(truths: Path, tmp_path: Path) -> None:
    out = tmp_path / "submission"
    write_runs(out / "Seq_000_a", path_of(FRAMES, 0), [0.0, 0.0, 0.0, 0.0, 1.0])
    write_runs(out / "Seq_001_a", path_of(FRAMES, 1), [0.0] * 5, processing_s=9.0)
    found = ranking_of(out, truths)
    assert list(found.clips) == ["Seq_000_a", "Seq_001_a", "Seq_002_a"]
    # One of five runs is about 1.5 mm off (the norm of three coordinates of 1 mm): a fifth of it is the mean.
    assert found.clips["Seq_000_a"].ate == pytest.approx(0.2 * 1.6, rel=0.1)
    assert found.clips["Seq_001_a"].ate == pytest.approx(0, abs=1e-6)
    assert (found.failed, found.clips["Seq_002_a"].ate) == (("Seq_002_a",), 56.25)
    assert found.final.ate == pytest.approx((found.clips["Seq_000_a"].ate + 56.25) / 3)
    assert found.final.rotation == pytest.approx(45 / 3, abs=1e-4)


def test_a_run_without_its_time_is_a_failed_one(truths: Path, tmp_path: Path) -> None:
    out = tmp_path / "submission"
    write_runs(out / "Seq_000_a", path_of(FRAMES, 0), [0.0] * 5)
    for number in "12":
        (out / "Seq_000_a" / number / "runtime.txt").unlink()
    # 60 % of the frames on average: W_rtf 1.2 on an error of 0.
    assert ranking_of(out, truths).failed == ("Seq_001_a", "Seq_002_a")
    (out / "Seq_000_a" / "3" / "runtime.txt").unlink()
    assert "Seq_000_a" in ranking_of(out, truths).failed


@pytest.mark.slow
@pytest.mark.parametrize("column", ["timestamp", "tx", "tz", "qw", "qz"])
@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_number_that_is_none_costs_its_frame_and_no_more(
    column: str, value: str, truths: Path, tmp_path: Path
) -> None:
    """In a run of 300 frames, one of which is lost where the pose is not known; the challenge reads no time stamp."""
    out = tmp_path / "submission"
    write_runs(out / "Seq_000_a", path_of(FRAMES, 0), [1.0] * 5)
    whole = ranking_of(out, truths).clips["Seq_000_a"]
    for number in "12345":
        file = out / "Seq_000_a" / number / "camera_trajectory" / "cam_traj_map_000.txt"
        head, *lines = file.read_text().splitlines()
        fields = lines[100].split(", ")
        fields[head.removeprefix("# ").split(", ").index(column)] = value
        lines[100] = ", ".join(fields)
        file.write_text("\n".join([head, *lines]) + "\n")
    found = ranking_of(out, truths)
    assert "Seq_000_a" not in found.failed
    one, lost = found.clips["Seq_000_a"], 0 if column == "timestamp" else 1
    # W_rtf of a frame that is lost; the others' mean error hardly changes.
    assert one.ate == pytest.approx(whole.ate * (1 + 0.5 * lost / FRAMES), rel=5e-3)
    assert one.rotation == pytest.approx(whole.rotation * (1 + 0.5 * lost / FRAMES), abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("stamp", "weight"), [("0", 1.5), ("nan", 1.5), ("inf", 1.5), (None, 1.0)])
def test_time_stamps_that_tell_no_interval_cost_the_whole_weight_of_the_time(
    stamp: str | None, weight: float, truths: Path, tmp_path: Path
) -> None:
    out = tmp_path / "submission"
    write_runs(out / "Seq_000_a", path_of(FRAMES, 0), [1.0] * 5)
    whole = ranking_of(out, truths).clips["Seq_000_a"]
    for file in out.rglob("cam_traj_map_000.txt") if stamp else []:
        head, *lines = file.read_text().splitlines()
        file.write_text("\n".join([head, *(", ".join([stamp, *line.split(", ")[1:]]) for line in lines)]) + "\n")
    assert ranking_of(out, truths).clips["Seq_000_a"].ate == pytest.approx(weight * whole.ate)


def test_a_first_map_of_one_pose_changes_no_score(truths: Path, tmp_path: Path) -> None:
    true, out = path_of(FRAMES, 0), tmp_path / "submission"
    for number in "12345":
        run = write_foreign_run(out / "Seq_000_a" / number, (true[:1], [1]), (true, [*range(1, FRAMES + 1)]))
        (run / "runtime.txt").write_text("init_seconds=0.5\nprocessing_seconds=3.0\n")
    assert ranking_of(out, truths).clips["Seq_000_a"].ate == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("finals", "order"),
    [
        ({"a": (4.0, 1.0), "b": (3.0, 9.0)}, "ba"),
        ({"a": (4.0, 3.0), "b": (4.2, 2.0)}, "ba"),  # exactly 5 %
        ({"a": (4.0, 3.0), "b": (4.21, 2.0)}, "ab"),
        # b ties with a and c, but c not with a: a's group is a and b.
        ({"a": (4.0, 3.0), "b": (4.15, 2.0), "c": (4.3, 1.0)}, "bac"),
        ({"c": (56.25, 45.0), "a": (0.0, 1.0), "b": (0.0, 0.5), "d": (56.25, 45.0)}, "bacd"),
        ({}, ""),
    ],
)
def test_scores_within_5_percent_are_ordered_by_rotation(finals: dict[str, tuple[float, float]], order: str) -> None:
    assert "".join(ranked({name: ClimbScore(*scores) for name, scores in finals.items()})) == order


def test_a_benchmark_ranks_its_methods_by_the_rule() -> None:
    scores = {"first": [(4.0, 3.0), (4.0, 3.0)], "tied": [(4.1, 2.0), (4.2, 2.0)], "half": [(1.0, 1.0)], "untimed": []}
    rows = []
    for method, found in scores.items():
        for clip in range(2):
            named = dict(zip(("climb_score", "climb_rotation_score"), found[clip], strict=True)) if found[clip:] else {}
            figures = {"climb": {"climb_ate_mean_mm": 2.0} | named}
            status = "failed" if method == "half" and clip else "done"
            rows.append(RunResult(f"clip {clip}", method, status=status, figures={} if status == "failed" else figures))
    (table,) = (table for table in benchmark_tables(rows) if table.name == "climb-ranking")
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.markdown().splitlines()[2:5]]
    # A failed clip is 56.25 and 45.
    assert lines == [
        ["1", "tied", "2 of 2", "4.150", "2.000"],
        ["2", "first", "2 of 2", "4.000", "3.000"],
        ["3", "half", "1 of 2", "28.625", "23.000"],
    ]
    assert "untimed" not in table.markdown()


@pytest.mark.slow
def test_the_command_scores(truths: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "submission"
    write_runs(out / "Seq_000_a", path_of(FRAMES, 0), [0.0] * 5)
    call("climb", "--out", out, "--truth", truths, "--json")
    facts = json.loads(capfd.readouterr().out)
    assert facts["final"]["ate"] == pytest.approx(2 * 56.25 / 3, abs=1e-4)
    assert facts["failed"] == ["Seq_001_a", "Seq_002_a"]
    call("climb", "--out", out, "--truth", truths)
    assert "Seq_002_a: score 56.250, rotation 45.000 (decides a tie), failed" in capfd.readouterr().out


@pytest.mark.parametrize(("processing_s", "breaks"), [(100.0, False), (140.0, False), (160.0, True)])
def test_the_time_limit_is_five_times_the_clips_times_their_runs(
    processing_s: float, breaks: bool, tmp_path: Path
) -> None:
    """Equal copies are one run: 6 s x 5 x 5 = 150 s for it."""
    videos = tmp_path / "videos"
    videos.mkdir()
    write_frames(videos / "Seq_000_a.mp4", [picture(n % 4, (64, 48)) for n in range(FRAMES)], rate=50)
    out = tmp_path / "submission"
    write_runs(out / "Seq_000_a", path_of(FRAMES), [0.0] * 5, processing_s)
    found = [problem for problem in submission_problems(out, videos) if "the limit is" in problem]
    assert len(found) == breaks
    # Runs that each took their own time add up.
    shutil.rmtree(out)
    write_runs(out / "Seq_000_a", path_of(FRAMES), [0.0] * 5, processing_s / 5)
    for number in "12345":
        text = f"init_seconds=0.5\nprocessing_seconds={processing_s / 5 + int(number) / 1000}\n"
        (out / "Seq_000_a" / number / "runtime.txt").write_text(text)
    found = [problem for problem in submission_problems(out, videos) if "the limit is" in problem]
    assert len(found) == breaks
