"""What is measured by clicks in the window is what `scopemap measure` finds, by the command that is shown."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from drawn_run import CAMERA, FRAMES, draw_run, pose_of
from front_door import call

from scopemap.apps.browser.hand_measures import HandMeasure, Reference, add_measurements, broken, measure_by_hand
from scopemap.apps.browser.lesion_part import corners_in
from scopemap.apps.browser.shown_surface import ShownSurface, SurfacePick
from scopemap.engine.errors import InputError
from scopemap.report.page_data import read_measurements
from scopemap.result.result import Result

KNOWN = {"known": True, "source": "a ruler", "measured": True}


def picked(surface: ShownSurface, *pixels: tuple[float, float], frame: int = 4) -> list[SurfacePick]:
    """The places on the surface at pixels of a frame."""
    pose = pose_of(frame)
    found = [surface.pick(pose[:3, 3], pose[:3, :3] @ CAMERA.unproject(np.array(pixel))) for pixel in pixels]
    return [one for one in found if one is not None]


def by_command(command: str, capsys: pytest.CaptureFixture[str]) -> list[dict[str, object]]:
    """What the command finds, as JSON."""
    capsys.readouterr()
    program, *words = shlex.split(command.replace("\\\n", " "))
    assert (program, call(*words, "--json")) == ("scopemap", 0)
    return list(json.loads(capsys.readouterr().out))


def check(one: HandMeasure, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = by_command(broken(one.command(str(folder))), capsys)
    assert [vars(measure) for measure in one.found] == found


def test_distances_and_areas_are_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = draw_run(tmp_path / "a result", scale=KNOWN)
    surface = ShownSurface(Result(folder))
    distance = measure_by_hand(surface, picked(surface, (20.0, 20.0), (60.0, 44.0)))
    assert [one.what for one in distance.found] == ["straight", "along the surface"]
    assert distance.found[0].unit == "mm"
    # Tenths of a pixel are all that is left out of what was clicked.
    straight = float(np.linalg.norm(np.diff(distance.world, axis=0)))
    assert distance.found[0].value == pytest.approx(straight, rel=0.03)
    check(distance, folder, capsys)
    area = measure_by_hand(surface, picked(surface, (20.0, 20.0), (60.0, 20.0), (60.0, 44.0), (20.0, 44.0)))
    assert [one.unit for one in area.found] == ["mm2"]
    check(area, folder, capsys)


def test_a_reference_is_that_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = draw_run(tmp_path)
    surface = ShownSurface(Result(folder))
    points, ends = picked(surface, (20.0, 20.0), (60.0, 44.0)), picked(surface, (24.0, 45.0), (33.0, 40.0))
    with pytest.raises(InputError, match="give two points as a reference"):
        measure_by_hand(surface, points)
    for length_mm, unit in ((None, "times the reference"), (5.0, "mm")):
        one = measure_by_hand(surface, points, Reference((ends[0], ends[1]), length_mm))
        assert one.found[0].unit == unit
        check(one, folder, capsys)


def test_a_submap_is_measured_in_its_own_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = draw_run(tmp_path, scale=KNOWN)
    surface = ShownSurface(Result(folder).submaps[1])
    one = measure_by_hand(surface, picked(surface, (20.0, 20.0), (60.0, 44.0), frame=FRAMES - 3))
    assert one.folder == "maps/1"
    assert one.frame > FRAMES - 8
    check(one, folder, capsys)


def test_what_no_frame_saw_is_not_measured(tmp_path: Path) -> None:
    surface = ShownSurface(Result(draw_run(tmp_path, scale=KNOWN)))
    # Beside all cameras, before the view of the first begins.
    beside = surface.pick(np.array([0.0, 0.0, 8.0]), np.array([1.0, 0.0, 0.0]))
    assert beside is not None
    with pytest.raises(InputError, match="no frame saw all of these points"):
        measure_by_hand(surface, [beside, *picked(surface, (60.0, 44.0))])


def test_measurements_are_kept_as_the_report_has_them(tmp_path: Path) -> None:
    folder = draw_run(tmp_path, scale=KNOWN)
    surface = ShownSurface(Result(folder))
    one = measure_by_hand(surface, picked(surface, (20.0, 20.0), (60.0, 44.0)))
    other = measure_by_hand(surface, picked(surface, (30.0, 20.0), (50.0, 44.0)))
    assert add_measurements(folder, [one]) == 1
    assert add_measurements(folder, [one, other]) == 2
    kept = read_measurements(folder)
    assert kept[0]["frame"] == one.frame
    assert kept[0]["command"].startswith(f"scopemap measure . --frame {one.frame} --points")
    assert str(tmp_path) not in json.dumps(kept)
    assert [found["value"] for found in kept[1]["found"]] == [found.value for found in other.found]


def test_the_outline_of_a_lesion_is_in_the_pixels_of_its_frame(tmp_path: Path) -> None:
    surface = ShownSurface(Result(draw_run(tmp_path, scale=KNOWN)))
    corners = [(30.0, 25.0), (50.0, 25.0), (50.0, 40.0)]
    np.testing.assert_allclose(corners_in(surface, 4, picked(surface, *corners)), corners, atol=1e-6)
    with pytest.raises(InputError, match="frame 23 has no pose in this submap"):
        corners_in(surface, 23, picked(surface, *corners))


def test_commands_are_broken_before_options() -> None:
    command = 'scopemap measure "a b" --frame 3 --points "1.0,2.0 3.0,4.0"'
    assert re.sub(r" \\\n +", " ", broken(command)) == command
    assert broken(command).count("\n") == 2
