"""Frame and the shape check at its door."""

from __future__ import annotations

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Frame, percentiles_uint8

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


@pytest.mark.parametrize(
    ("part", "shape"),
    [
        ("rgb", (30, 40, 4)),
        ("valid", (40, 30)),
        ("depth_mm", (15, 20)),
        ("T_world_camera", (3, 4)),
    ],
)
def test_a_part_of_another_shape_is_refused_by_name(part: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=rf"Frame\.{part}: expected an array of shape .* got \({shape[0]}, "):
        _frame(**{part: np.zeros(shape)})


@pytest.mark.parametrize("count", [1, 2, 1001])
def test_percentiles_of_levels_are_those_of_numpy(count: int) -> None:
    levels = np.random.default_rng(count).integers(0, 40, (1, count)).astype(np.uint8)
    shares = [0.0, 0.5, 50.0, 99.5, 100.0]
    np.testing.assert_allclose(percentiles_uint8(levels, shares), np.percentile(levels, shares), atol=1e-9)
