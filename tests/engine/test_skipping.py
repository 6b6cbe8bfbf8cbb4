"""Frames in which nothing can be followed: no network looks at them, and what is said of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.config import Config
from scopemap.engine.preprocessing import DepthTurns
from scopemap.input.picture_difference import is_at_rest
from scopemap.result.depth_maps import DepthReader
from tests.support.spied_depth import spied
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

FRAMES = 24
BLACK, WALL = {4, 5, 6}, set(range(7, 20))
PASSED_OVER = {17, 18, 19}  # the first ten of a wall are looked at


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A phantom; some frames are black, some show a red wall with a sensor's noise."""
    made, rng = write_tiny(tmp_path_factory.mktemp("phantom"), frames=FRAMES), np.random.default_rng(0)
    for index in BLACK | WALL:
        file = made / f"{index:04d}_color.png"
        shape = cv2.imread(str(file)).shape
        # Brighter on one side, as a wall that is touched is.
        wall = np.linspace(0.6, 1.2, shape[1])[None, :, None] * np.array([50, 60, 180])
        picture = (0 if index in BLACK else wall) + rng.normal(0, 1.5, shape)
        cv2.imwrite(str(file), picture.clip(0, 255).astype(np.uint8))
    return made


def test_no_network_looks_at_them_and_they_are_counted(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spies = spied(monkeypatch)
    result = reconstruct(open_sequence(folder), Config(), out=tmp_path / "out")
    asked = {frame.index for frame in spies[0].seen}
    assert asked == set(range(FRAMES)) - BLACK - PASSED_OVER
    causes = dict(zip(result.frames["index"].tolist(), result.frames["cause"].tolist(), strict=True))
    assert {causes[index] for index in BLACK} == {"too dark"}
    assert {causes[index] for index in PASSED_OVER} == {"no texture"}
    (notice,) = (one for one in result.provenance["notices"] if one["code"] == "frames-skipped")
    assert notice["values"] == {"frames": 6, "causes": "3 too dark, 3 no texture"}
    depths = {int(file.stem) for file in (tmp_path / "out" / "depth").glob("*.png")}
    assert depths == asked


def test_in_realtime_the_network_looks_at_every_second_frame_and_flow_carries_its_depth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_tiny(tmp_path / "phantom", frames=12)
    spies, found = spied(monkeypatch), []
    for method in ("realtime", "scopemap"):
        out = tmp_path / method
        config = Config.load("realtime", settings={"depth.method": method})
        found.append(reconstruct(open_sequence(folder), config, out=out))
        assert found[-1].frames.tracked.all()
    assert [frame.index for frame in spies[0].seen] == [*range(0, 12, 2)]
    assert len(spies[1].seen) == 12
    carried, own = [DepthReader(tmp_path / name).read(3) for name in ("realtime", "scopemap")]
    assert carried is not None
    assert own is not None
    known = (carried > 0) & (own > 0)
    assert known.mean() > 0.7
    assert np.median(np.abs(np.log(carried[known] / own[known]))) < 0.05
    (notice,) = (one for one in found[0].provenance["notices"] if one["code"] == "depth-propagated")
    assert notice["values"] == {"frames": 6, "every": 2}


def test_noise_is_no_motion_and_a_small_motion_is_one() -> None:
    rng = np.random.default_rng(1)
    scene = cv2.GaussianBlur(rng.normal(0, 800, (256, 330, 3)), (0, 0), 12) + 120

    def seen(x: int) -> np.ndarray:
        return (scene[:, x : x + 320] + rng.normal(0, 2, (256, 320, 3))).clip(0, 255).astype(np.uint8)

    assert is_at_rest(seen(0), seen(0))
    assert not is_at_rest(seen(0), seen(1))
    black = np.zeros((256, 320, 3), np.uint8)
    assert not is_at_rest(black, black)


def test_the_network_looks_at_one_frame_in_three_and_where_nothing_can_be_propagated() -> None:
    turns, looks = DepthTurns(3), []
    for number in range(9):
        if number == 5:  # a frame without depth
            turns.interrupt()
        looks.append(turns.propagated_kind() is None)
        if looks[-1]:
            turns.looked("depth")
    assert [number for number, look in enumerate(looks) if look] == [0, 3, 5, 8]
    assert [notice.values["frames"] for notice in turns.notices] == [5]
    assert DepthTurns(1).notices == []
