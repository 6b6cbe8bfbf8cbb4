"""Why frames are lost: the cause of each, segments of them, and the advice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config, TrackingSettings
from scopemap.engine.frame import Frame
from scopemap.engine.tracking.causes import LossCause, causes_of_loss
from scopemap.engine.tracking.usable import too_few_pixels
from scopemap.result.frame_table import ELSEWHERE, LOST, NOT_USED
from scopemap.result.losses import ADVICE, losses, main_cause
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import write_phantom
from tests.support.drawn_run import placed_frames

REJECTED = LossCause.VIEW_CHANGED


def causes(*frames: tuple[LossCause, float] | None) -> list[LossCause]:
    """The causes of frames, lost by what the tracker said and their motion; None: not lost."""
    status = np.array(["ok" if frame is None else "lost" for frame in frames])
    judged, motion = zip(*((LossCause.NONE, 0.01) if frame is None else frame for frame in frames), strict=True)
    return causes_of_loss(status, np.array(judged), np.array(motion))


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
    assert causes(None, (judged, motion)) == [LossCause.NONE, cause]
    assert ADVICE[cause]


@pytest.mark.parametrize(("level", "cause"), [(5, "too dark"), (250, "overexposed"), (120, "view covered")])
def test_why_hardly_a_pixel_is_usable(level: int, cause: str) -> None:
    camera = PinholeCamera(8.0, 8.0, 3.5, 3.5, 8, 8)
    rgb, valid = np.full((8, 8, 3), level, np.uint8), np.zeros((8, 8), bool)
    found = too_few_pixels(Frame(0, 0.0, rgb, camera, valid), TrackingSettings())
    assert found is not None
    assert (found.cause, found.reason[:8]) == (cause, "only 0% ")
    assert too_few_pixels(Frame(0, 0.0, rgb, camera, ~valid), TrackingSettings()) is None


def test_what_follows_a_loss_without_a_fault_of_its_own_is_not_found_again() -> None:
    found = causes((REJECTED, 0.05), (LossCause.OTHER, 0.01), (REJECTED, 0.01), None, (REJECTED, 0.01))
    assert found == ["fast motion", "not found again", "not found again", "", "view changed"]


def test_segments_have_the_cause_that_began_them() -> None:
    again = "not found again"
    lost_by = ["", "fast motion", "", again, again, "", "too dark", "", again, ""]
    place = [LOST if cause else 0 for cause in lost_by]
    place[2], place[7] = NOT_USED, ELSEWHERE
    found = losses(placed_frames(place, cause=lost_by))
    assert [(loss.first, loss.last, loss.frames, loss.cause) for loss in found] == [
        (1, 4, 3, "fast motion"),
        (6, 6, 1, "too dark"),
        (8, 8, 1, again),
    ]
    assert [loss.when for loss in found] == ["0.10 to 0.40 s", "0.60 s", "0.80 s"]
    assert main_cause(found) is LossCause.FAST_MOTION
    assert main_cause([]) is LossCause.NONE


@pytest.mark.slow
def test_black_frames_of_a_phantom_are_too_dark_and_motion_is_measured(tmp_path: Path) -> None:
    spec = PhantomSpec(frames=8, width=96, height=80, seed=3, events=parse_events("black:4-5"))
    write_phantom(spec, tmp_path / "phantom")
    result = reconstruct(open_sequence(tmp_path / "phantom"), Config.load(settings={"mapping.method": "none"}))
    (loss,) = losses(result.frames)
    assert (loss.first, loss.last, loss.cause) == (4, 5, "too dark")
    seen = result.frames.only(np.arange(1, 4))
    assert all((seen["motion"] > 0.0) & (seen["motion"] < 0.05) & (seen["sharpness"] > 0.3) & (seen["sharpness"] < 3))
    assert result.frames["usable"][4] < 0.2 < result.frames["usable"][3]
