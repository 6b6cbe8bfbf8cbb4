"""`inspect` finds text that stays in the picture, and other overlays, and warns that one may name a patient."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.apps.inspect.inspecting import Inspection, inspect
from tests.support.drawn_clips import Change, circle, clip, inside, text, write

pytestmark = pytest.mark.slow


def inspected(folder: Path, *changes: Change) -> Inspection:
    folder.mkdir(exist_ok=True)
    return inspect(write(folder / "video.mp4", clip(50, *changes)))


def drawn(draw: Callable[[np.ndarray], object]) -> Change:
    """What `draw` draws stays where it is, over tissue that moves."""

    def change(_: int, picture: np.ndarray) -> np.ndarray:
        out = picture.copy()
        draw(out)
        return out

    return change


def rod(tip: tuple[int, int], towards_deg: float, width_px: int) -> Change:
    """An instrument at rest: a shaft of steel from the tip out of the picture, bright along its middle."""
    axis = np.array([np.cos(np.deg2rad(towards_deg)), np.sin(np.deg2rad(towards_deg))])
    across = np.array([-axis[1], axis[0]]) * width_px

    def draw(out: np.ndarray) -> None:
        for side, share, level in ((0.0, 1.0, 150), (-0.35, 0.3, 90), (0.05, 0.2, 250)):
            ends = [tip + side * across, tip + side * across + 400 * axis]
            half = share / 2 * across
            corners = np.array([ends[0] - half, ends[0] + half, ends[1] + half, ends[1] - half])
            cv2.fillConvexPoly(out, np.round(corners * 16).astype(int), (level, level, level + 5), cv2.LINE_AA, 4)

    return drawn(draw)


def jaws(tip: tuple[int, int], towards_deg: float) -> Change:
    """Forceps at rest, open."""
    upper, lower = rod(tip, towards_deg, 12), rod((tip[0] - 8, tip[1] + 12), towards_deg + 14, 12)
    return lambda number, picture: lower(number, upper(number, picture))


def logo(out: np.ndarray) -> None:
    for radius, colour in ((22, (235, 235, 240)), (16, (40, 70, 160)), (7, (235, 235, 240))):
        cv2.circle(out, (270, 200), radius, colour, -1, cv2.LINE_AA)


def glare(out: np.ndarray) -> None:
    """The lamp on the rim of a cap: a bright arc."""
    cv2.ellipse(out, (160, 120), (95, 95), 0, 200, 300, (250, 250, 250), 3, cv2.LINE_AA)


def light_panel(out: np.ndarray) -> None:
    cv2.rectangle(out, (2, 2), (62, 26), (225, 225, 225), -1)


@pytest.mark.parametrize(
    ("changes", "in_field"),
    [([text(scale=0.35)], True),
     ([text(scale=0.35, level=5)], True),
     ([text("Mueller, Anna", level=5)], True),
     ([text("Lee 1951", (20, 150), scale=1.0)], True),
     ([text("Lee 1951", (20, 150), scale=1.0, level=5)], True),
     ([text("ANNA", (20, 150), scale=2.2)], True),
     ([inside(circle), text("SMITH", (2, 20), scale=0.4)], False),
     ([inside(circle), text("ID 7", (2, 30), scale=0.7)], False),
     ([inside(circle), drawn(light_panel), text("SMITH", (6, 19), scale=0.5, level=10)], False)],
)  # fmt: skip
def test_text_is_an_overlay_that_may_name_a_patient(tmp_path: Path, changes: list[Change], in_field: bool) -> None:
    found = inspected(tmp_path, *changes)
    assert "overlay-privacy" in {finding.code for finding in found.findings}
    assert {one.in_field for one in found.overlays} == {in_field}
    messages = [one.message for one in found.findings if one.code == "overlay"]
    assert len(messages) == in_field
    assert all("(text" in message for message in messages)


@pytest.mark.parametrize(
    "change",
    [*(rod((160, 120), towards, width) for towards in (5, 90, 150, 230, 300) for width in (12, 30)),
     jaws((150, 120), 20), drawn(logo), drawn(glare)],
)  # fmt: skip
def test_an_edge_that_stays_is_an_overlay_and_the_words_say_that_it_may_be_an_instrument(
    tmp_path: Path, change: Change
) -> None:
    found = inspected(tmp_path, change)
    assert found.overlays
    assert {finding.code for finding in found.findings} == {"overlay", "overlay-privacy"}
    assert "(text, logos or an instrument that rests)" in found.findings[0].message


def test_a_name_beside_an_instrument_is_found(tmp_path: Path) -> None:
    alone = inspected(tmp_path / "alone", text())
    beside = inspected(tmp_path / "beside", rod((180, 140), 40, 20), text())
    (name,) = alone.overlays
    left, top, right, bottom = name.box
    middle = (left + right) / 2, (top + bottom) / 2
    assert any(one.box[0] < middle[0] < one.box[2] and one.box[1] < middle[1] < one.box[3] for one in beside.overlays)
