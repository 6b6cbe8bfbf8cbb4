"""Films of a run: the surface that turns, and the surface beside the video."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from scopemap.apps.view.fly_through import centreline_of, place_and_clock, smoothed_poses
from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap.report.films import write_turntable
from scopemap.result.result import Result
from tests.support.drawn_run import IN_RESULT, draw_run
from tests.support.front_door import call, refused

pytestmark = pytest.mark.slow


def pictures_of(film: Path) -> list[np.ndarray]:
    with av.open(str(film)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        return [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)]


def test_the_surface_is_seen_beside_the_video(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scale = {"known": True, "measured": True, "source": "measured depth"}
    run, film = draw_run(tmp_path / "run", scale=scale), tmp_path / "out.mp4"
    assert call("view", run, "--video", film) == 0
    assert "out.mp4" in capfd.readouterr().out
    pictures, (height, width) = pictures_of(film), (6 * 64, 6 * 80)
    assert [picture.shape for picture in pictures] == [(height + 54, 2 * width, 3)] * IN_RESULT
    for picture in pictures:
        video, surface = picture[:height, :width], picture[:height, width:]
        assert np.corrcoef(video.ravel(), surface.ravel())[0, 1] > 0.85
    capfd.readouterr()
    assert "cannot write" in refused(capfd, "view", run, "--video", tmp_path / "no" / "out.mp4")
    (run / "frames" / "000004.jpg").unlink()
    assert "frame" in refused(capfd, "view", run, "--video", film, "--overwrite")
    assert not film.exists()


@pytest.mark.parametrize("colours", ["coverage", "confidence"])
def test_a_painting_shines_through_half_with_a_legend(colours: str, tmp_path: Path) -> None:
    run, films = draw_run(tmp_path / "run"), [tmp_path / "plain.mp4", tmp_path / "painted.mp4"]
    assert call("view", run, "--video", films[0]) == 0
    assert call("view", run, "--video", films[1], "--colours", colours) == 0
    assert call("view", run, "--colours", colours) == 2
    (height, width), pair = (6 * 64, 6 * 80), [pictures_of(film)[7] for film in films]
    plain, painted = ((picture[:height, :width], picture[:height, width:], picture[height + 30 :]) for picture in pair)
    assert np.abs(plain[0] - painted[0]).mean() < 4  # the video's side
    assert np.abs(plain[1] - painted[1]).mean() > 20
    assert np.ptp(painted[2], axis=(0, 1)).min() > 100  # the legend has colours


def test_the_clock_is_that_of_the_tube_and_the_place_grows_along_it(tmp_path: Path) -> None:
    line, first = centreline_of(Result(draw_run(tmp_path / "run"))) or pytest.fail("it is a tube")
    (near, hours), (far, _) = (place_and_clock(line, first, se3(np.eye(3), np.array([0, 0, z]))) for z in (20.0, 40.0))
    assert far - near == pytest.approx(20, abs=2 * line.step_mm)
    # The first camera is upright, and looks along the tube: y is down.
    right = {"12": [0, -1], "3": [1, 0], "6": [0, 1], "9": [-1, 0]}
    assert all(hours[hour] == pytest.approx(np.array(way), abs=0.2) for hour, way in right.items())
    across = se3(so3_exp(np.array([0.0, np.pi / 2, 0.0])), np.array([0.0, 0.0, 30.0]))
    assert place_and_clock(line, first, across)[1] == {}


def test_a_shaken_path_is_smoothed_and_a_straight_one_stays() -> None:
    time_s = np.arange(40) / 20
    turns = [se3(so3_exp(np.array([0.0, 0.03 * k, 0.0])), np.array([0.5 * k, 0.0, k])) for k in range(40)]
    straight = np.stack(turns)
    inner = slice(15, 25)
    assert smoothed_poses(straight, time_s) == pytest.approx(straight, abs=5e-3)
    assert smoothed_poses(straight[:1], time_s[:1]) == pytest.approx(straight[:1])
    rng = np.random.default_rng(2)
    shaken = np.stack([T @ se3(so3_exp(rng.normal(0, 0.02, 3)), rng.normal(0, 1, 3)) for T in straight])
    found = smoothed_poses(shaken, time_s)
    assert np.abs(found - straight)[inner].max() < 0.6 * np.abs(shaken - straight)[inner].max()
    assert found[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (40, 1, 1)))


def test_a_turntable_is_a_film_of_the_surface(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run, film = draw_run(tmp_path / "run"), tmp_path / "out.mp4"
    write_turntable(run, film, frames=12)
    with av.open(str(film)) as container:
        pictures = [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)]
    assert [picture.shape for picture in pictures] == [(480, 480, 3)] * 12
    assert all((picture.min(axis=2) < 200).mean() > 0.02 for picture in pictures)  # on white
    assert np.abs(pictures[0] - pictures[3]).mean() > 3
    assert "cannot write" in refused(capfd, "view", run, "--turntable", tmp_path / "no" / "out.mp4")
