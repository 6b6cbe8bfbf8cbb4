"""Why frames are lost: the cause of each, segments of them, and the advice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.cameras.camera import PinholeCamera
from scopemap.config import Config
from scopemap.frame import Frame
from scopemap.report.kept_run import LOST, NOT_USED, OTHER_MAP, KeptRun
from scopemap.report.kept_run import run_of as run_of_result
from scopemap.report.losses import in_words, losses
from scopemap.tracking.track import Status, Track, unusable
from scopemap.trajectory.causes import ADVICE, LossCause, causes_of_loss
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import write_phantom


def track(cause: LossCause, motion: float = 0.01, status: Status = "lost") -> Track:
    return Track(0, status, "", np.eye(4), 0, motion=motion, cause=cause)


OK, REJECTED = track(LossCause.NONE, status="ok"), LossCause.VIEW_CHANGED


@pytest.mark.parametrize(
    ("judged", "motion", "cause"),
    [
        *((one, 0.05, one) for one in (LossCause.TOO_DARK, LossCause.VIEW_COVERED, LossCause.CONTACT)),
        (LossCause.NO_TEXTURE, 0.05, LossCause.NO_TEXTURE),
        (LossCause.UNSHARP, 0.01, LossCause.UNSHARP),
        (LossCause.UNSHARP, 0.05, LossCause.MOTION_BLUR),
        (REJECTED, 0.05, LossCause.FAST_MOTION),
        (REJECTED, 0.01, LossCause.VIEW_CHANGED),
        (REJECTED, float("nan"), LossCause.VIEW_CHANGED),
        (LossCause.OTHER, 0.01, LossCause.OTHER),
    ],
)
def test_the_cause_of_the_first_lost_frame(judged: LossCause, motion: float, cause: LossCause) -> None:
    assert causes_of_loss([OK, track(judged, motion)]) == [LossCause.NONE, cause]
    assert ADVICE[cause]


@pytest.mark.parametrize(("level", "cause"), [(5, "too dark"), (250, "overexposed"), (120, "view covered")])
def test_why_hardly_a_pixel_is_usable(level: int, cause: str) -> None:
    camera = PinholeCamera(8.0, 8.0, 3.5, 3.5, 8, 8)
    rgb, valid = np.full((8, 8, 3), level, np.uint8), np.zeros((8, 8), bool)
    found = unusable(Frame(0, 0.0, rgb, camera, valid))
    assert (found.cause, found.reason[:8]) == (cause, "only 0% ")


def test_what_follows_a_loss_without_a_fault_of_its_own_is_not_found_again() -> None:
    tracks = [track(REJECTED, 0.05), track(LossCause.OTHER), track(REJECTED), OK, track(REJECTED)]
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


def test_black_frames_of_a_phantom_are_too_dark_and_motion_is_measured(tmp_path: Path) -> None:
    spec = PhantomSpec(frames=8, width=96, height=80, seed=3, events=parse_events("black:4-5"))
    write_phantom(spec, tmp_path / "phantom")
    result = reconstruct(open_sequence(tmp_path / "phantom"), Config.load(settings={"mapping.method": "none"}))
    (loss,) = losses(run_of_result(result))
    assert (loss.first, loss.last, loss.cause) == (4, 5, "too dark")
    seen = [record.track for record in result.records]
    assert all(0.0 < one.motion < 0.05 and 0.3 < one.sharpness < 3 for one in seen[1:4])
    assert seen[4].usable < 0.2 < seen[3].usable
