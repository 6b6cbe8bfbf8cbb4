"""Frame and the shape check at its door."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from scopemap import errors
from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import ScopemapError, check_shape
from scopemap.frame import Frame, Truth, percentiles

CAMERA = PinholeCamera(50.0, 50.0, 19.5, 14.5, 40, 30)


def _frame(**parts: object) -> Frame:
    given: dict[str, object] = {
        "index": 3,
        "time_s": 0.1,
        "rgb": np.zeros((30, 40, 3), np.uint8),
        "camera": CAMERA,
        "valid": np.ones((30, 40), bool),
    }
    return Frame(**(given | parts))  # type: ignore[arg-type]


def test_a_frame_starts_without_depth_and_pose() -> None:
    frame = _frame()
    assert frame.depth_mm is None
    assert frame.T_world_camera is None
    assert frame.name == ""


@pytest.mark.parametrize(
    ("part", "shape"),
    [
        ("rgb", (40, 30, 3)),
        ("rgb", (30, 40)),
        ("rgb", (30, 40, 4)),
        ("valid", (40, 30)),
        ("valid", (30, 40, 1)),
        ("depth_mm", (15, 20)),
        ("T_world_camera", (3, 4)),
    ],
)
def test_a_part_of_another_shape_is_refused_by_name(part: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=rf"Frame\.{part}: expected an array of shape .* got \({shape[0]}, "):
        _frame(**{part: np.zeros(shape)})


def test_a_stage_gives_a_new_frame_and_is_checked_again() -> None:
    frame = _frame()
    known = replace(frame, depth_mm=np.ones((30, 40), np.float32))
    assert frame.depth_mm is None
    assert known.depth_mm is not None
    with pytest.raises(ValueError, match="depth_mm"):
        replace(known, depth_mm=np.ones((30, 41), np.float32))
    with pytest.raises(FrozenInstanceError):
        frame.index = 4  # type: ignore[misc]


def test_a_frame_has_no_room_for_truth() -> None:
    with pytest.raises(TypeError):
        _frame(truth=Truth(3))
    assert not isinstance(Truth(3), Frame)


@pytest.mark.parametrize(
    ("found", "wanted", "fits"),
    [
        ((2, 3), (2, 3), True),
        ((2, 3), (None, 3), True),
        ((2, 3), (None, None), True),
        ((2, 3), (2,), False),
        ((2, 3), (2, 3, None), False),
        ((2, 3), (None, 2), False),
        ((0, 3), (0, 3), True),
        ((), (), True),
        ((), (None,), False),
    ],
)
def test_check_shape(found: tuple[int, ...], wanted: tuple[int | None, ...], fits: bool) -> None:
    if fits:
        check_shape("it", np.zeros(found), wanted)
        return
    with pytest.raises(ValueError, match=r"^it: expected an array of shape"):
        check_shape("it", np.zeros(found), wanted)


def test_check_shape_says_what_may_be_any() -> None:
    with pytest.raises(ValueError, match=r"shape \(any, 3\), got \(4,\)"):
        check_shape("points", np.zeros(4), (None, 3))


def test_every_kind_of_error_is_a_scopemap_error() -> None:
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    assert len(kinds) >= 6
    assert all(issubclass(kind, ScopemapError) for kind in kinds)


@pytest.mark.parametrize("count", [1, 2, 3, 100, 1001])
def test_percentiles_of_levels_are_those_of_numpy(count: int) -> None:
    levels = np.random.default_rng(count).integers(0, 40, (1, count)).astype(np.uint8)
    shares = [0.0, 0.5, 50.0, 99.5, 100.0]
    np.testing.assert_allclose(percentiles(levels, shares), np.percentile(levels, shares), atol=1e-9)
