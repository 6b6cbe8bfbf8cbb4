"""The map of what was seen: its classes, its clock, and a cavity as a disc."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.report.coverage_picture import COLOURS, DrawnMap, draw_coverage, legend_of
from scopemap.report.sheet import rgb_of

SEEN, BADLY, HIDDEN = COLOURS


def drawn(kind: str, classes: np.ndarray, folder: Path) -> np.ndarray:
    """The picture (H, W, 3) uint8 of classes, all seen by all frames."""
    end = 40.0
    of = DrawnMap(kind, "mm", classes, np.ones(classes.shape), (0.0, end), [], "not seen")  # type: ignore[arg-type]
    draw_coverage(of, folder / "map.png")
    picture = cv2.imread(str(folder / "map.png"))
    assert picture is not None
    return picture[..., ::-1]


def middle_of(picture: np.ndarray, words: str) -> np.ndarray:
    """Where most of a colour is, x and y, px."""
    rows, columns = np.nonzero((picture[:600] == rgb_of(COLOURS[words])).all(-1))
    return np.array([columns.mean(), rows.mean()])


def test_the_legend_has_the_classes_that_occur() -> None:
    assert list(legend_of(np.array([[0, 1], [2, 1]]))) == [SEEN, BADLY]
    assert list(legend_of(np.array([[3, 0]]))) == [HIDDEN]


@pytest.mark.parametrize(("hours", "x", "y"), [(0, 0, -1), (3, 1, 0), (6, 0, 1), (9, -1, 0)])
def test_a_cavity_is_a_disc_with_its_clock_around(hours: int, x: int, y: int, tmp_path: Path) -> None:
    classes = np.ones((10, 36), np.uint8)
    classes[6:, np.arange(3 * hours - 2, 3 * hours + 2) % 36] = 3
    picture = drawn("cavity", classes, tmp_path)
    aside = middle_of(picture, HIDDEN) - middle_of(drawn("cavity", np.ones_like(classes), tmp_path), SEEN)
    assert np.linalg.norm(aside) > 100
    assert aside / np.linalg.norm(aside) == pytest.approx([x, y], abs=0.15)
    assert (picture[80:90, 80:90] == 255).all()  # white in the corner: a disc


def test_a_lumen_is_cut_open_from_left_to_right(tmp_path: Path) -> None:
    classes = np.ones((10, 36), np.uint8)
    classes[8:, 8:11] = 3  # at its end, at 3 o'clock
    x, y = middle_of(drawn("lumen", classes, tmp_path), HIDDEN)
    assert (x, y) == pytest.approx((90 + 0.9 * 820, 90 + 0.75 * 500), abs=15)
