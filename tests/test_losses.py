"""Why frames are lost: the cause of each, segments of them, and the advice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.config import Config
from scopemap.report.kept_run import LOST, NOT_USED, OTHER_MAP, KeptRun
from scopemap.report.losses import in_words, losses
from scopemap.tracking.track import TOO_BRIGHT, TOO_DARK, Status, Track
from scopemap.trajectory.causes import ADVICE, causes_of_loss
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import write_phantom


def track(reason: str, motion: float = 0.01, status: Status = "lost") -> Track:
    return Track(0, status, reason, np.eye(4), 0, motion=motion)


REJECTED = "rejected: correlation 0.08 with the keyframe"


@pytest.mark.parametrize(
    ("reason", "motion", "cause"),
    [
        (f"only 3% of the image is usable{TOO_DARK}", 0.0, "too dark"),
        (f"only 3% of the image is usable{TOO_BRIGHT}", 0.0, "overexposed"),
        ("only 3% of the image is usable", 0.0, "view covered"),
        ("only 40% of the usual sharpness: blur, smoke or fluid", 0.01, "smoke, fluid or out of focus"),
        ("only 40% of the usual sharpness: blur, smoke or fluid", 0.05, "motion blur"),
        ("rejected: weakly constrained, hardly any texture", 0.05, "no texture"),
        (REJECTED, 0.05, "fast motion"),
        (REJECTED, 0.01, "view changed"),
        (REJECTED, float("nan"), "view changed"),
        ("too little of its depth is known to start from", 0.01, "other"),
    ],
)
def test_the_cause_of_the_first_lost_frame(reason: str, motion: float, cause: str) -> None:
    found = causes_of_loss([track("", status="ok"), track(reason, motion)])
    assert found == ["", cause]
    assert ADVICE[cause]


def test_what_follows_a_loss_without_a_fault_of_its_own_is_not_found_again() -> None:
    searched = track("not searched: one of 3 lost frames is")
    tracks = [track(REJECTED, 0.05), searched, track(REJECTED), track("", status="ok"), track(REJECTED)]
    assert causes_of_loss(tracks) == ["fast motion", "not found again", "not found again", "", "view changed"]


def run_of(causes: list[str | int]) -> KeptRun:
    """A run at 10 frames/s; a number is the place of a frame that is not lost."""
    rows = [
        {"index": str(n), "time_s": str(n / 10), "cause": "" if isinstance(cause, int) else cause}
        for n, cause in enumerate(causes)
    ]
    return KeptRun(None, rows, [], np.array([cause if isinstance(cause, int) else LOST for cause in causes]))


def test_segments_have_the_cause_that_began_them() -> None:
    again = "not found again"
    run = run_of([0, "fast motion", NOT_USED, again, again, 0, "too dark", OTHER_MAP, again, 0])
    found = losses(run)
    assert [(loss.first, loss.last, loss.frames, loss.cause) for loss in found] == [
        (1, 4, 3, "fast motion"),
        (6, 6, 1, "too dark"),
        (8, 8, 1, again),
    ]
    assert [loss.when for loss in found] == ["0.10 to 0.40 s", "0.60 s", "0.80 s"]
    assert in_words(found).startswith("Mostly by this: fast motion. Next time: turn and withdraw more slowly")


def test_a_run_without_causes_says_nothing() -> None:
    found = losses(run_of([0, "", "", 0]))
    assert [(loss.frames, loss.advice) for loss in found] == [(2, "")]
    assert in_words(found) == in_words([]) == ""


def test_black_frames_of_a_phantom_are_too_dark_and_motion_is_measured(tmp_path: Path) -> None:
    spec = PhantomSpec(frames=8, width=96, height=80, seed=3, events=parse_events("black:4-5"))
    write_phantom(spec, tmp_path / "phantom")
    result = reconstruct(open_sequence(tmp_path / "phantom"), Config.load(settings={"mapping.method": "none"}))
    (loss,) = result.losses
    assert (loss.first, loss.last, loss.cause) == (4, 5, "too dark")
    seen = [record.track for record in result.records]
    assert all(0.0 < one.motion < 0.05 and 0.3 < one.sharpness < 3 for one in seen[1:4])
    assert seen[4].usable < 0.2 < seen[3].usable
