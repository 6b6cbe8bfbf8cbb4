"""The final score of a CLiMB submission: means over runs and clips, failures counted, and the time limit."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from drawn_climb import path_of, write_foreign_run, write_reference
from drawn_inputs import picture
from drawn_video_sets import write_frames
from front_door import call

from scopemap_bench.climb.ranking import ranking_of
from scopemap_bench.climb.submission import submission_problems

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
