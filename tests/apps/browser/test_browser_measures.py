"""What is measured by clicks in the window is what `scopemap measure` finds, by the command that is shown."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scopemap.apps.browser.hand_measures import (
    Reference,
    broken,
    is_by,
    kept_reference,
    measure_by_hand,
    reference_as_kept,
)
from scopemap.apps.browser.lesion_part import lesion_by_hand
from scopemap.apps.browser.measured_list import measured_words, short, with_interval
from scopemap.apps.browser.seen_by import corners_in
from scopemap.apps.browser.shown_surface import ShownSurface, SurfacePick
from scopemap.apps.measure.hand_measure import HandMeasure, add_measurement, kept_measures, remove_reference
from scopemap.apps.measure.measure import Measure
from scopemap.engine.errors import InputError
from scopemap.report.measured_by_hand import read_measurements
from scopemap.report.page import write_report
from scopemap.report.page_data import by_hand_data
from scopemap.result.result import Result
from tests.support.drawn_run import CAMERA, FRAMES, draw_run, pose_of
from tests.support.front_door import call

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
    for each in (one, one, other):
        add_measurement(folder, each)
    kept = read_measurements(folder)
    assert len(kept) == 2
    assert kept[0]["frame"] == one.frame
    assert kept[0]["command"].startswith(f"scopemap measure . --frame {one.frame} --points")
    assert str(tmp_path) not in json.dumps(kept)
    assert [found["value"] for found in kept[1]["found"]] == [found.value for found in other.found]


def test_a_reference_is_kept_with_its_result(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    surface = ShownSurface(Result(folder))
    points, (first, second) = picked(surface, (20.0, 20.0), (60.0, 44.0)), picked(surface, (24.0, 45.0), (40.0, 45.0))
    reference, shorter = Reference((first, second), 5.0), Reference((first, second), 4.0)
    one = measure_by_hand(surface, points, reference)
    for each in (shorter, reference):
        add_measurement(folder, reference_as_kept(surface, each))
    # There is one: the last.
    again = ShownSurface(Result(folder))
    found = kept_reference(again, kept_measures(folder))
    assert found is not None
    assert len(read_measurements(folder)) == 1
    assert found.length_mm == 5.0
    for pick, known in zip(found.picks, (first, second), strict=True):
        np.testing.assert_allclose(again.position(pick), surface.position(known), atol=1e-6)
    # What was measured by it is known again, and by another one is not.
    assert is_by(again, one, found)
    assert not is_by(again, one, shorter)
    assert not is_by(again, one, Reference((first, points[0]), 5.0))
    # A submap has another surface.
    assert kept_reference(ShownSurface(Result(folder).submaps[1]), kept_measures(folder)) is None


def test_the_command_shows_and_exports_what_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = draw_run(tmp_path / "run", scale=KNOWN)
    surface = ShownSurface(Result(folder))
    assert call("measure", folder) == 2
    assert "nothing was measured by hand" in capsys.readouterr().err
    distance = measure_by_hand(surface, picked(surface, (20.0, 20.0), (60.0, 44.0)))
    corners = picked(surface, (52.0, 26.0), (64.0, 26.0), (64.0, 38.0), (52.0, 38.0))
    for one in (distance, lesion_by_hand(surface, 4, corners, None, "polyp at the fold")):
        add_measurement(folder, one)
    assert call("measure", folder, "--json") == 0
    assert json.loads(capsys.readouterr().out) == [one.as_json for one in kept_measures(folder)]
    file = tmp_path / "kept.mrk.json"
    assert call("measure", folder, "--export", file) == 0
    said = capsys.readouterr().out
    assert f"straight: {distance.found[0].value:.3g} mm" in said
    assert "polyp at the fold: largest diameter: " in said
    line, outline = json.loads(file.read_text())["markups"]
    assert (line["type"], outline["type"], outline["name"]) == ("Curve", "ClosedCurve", "polyp at the fold")
    assert len(outline["controlPoints"]) == 4
    # The commands that are shown give the same again.
    for one in kept_measures(folder):
        assert one.command(str(folder)) in said
    assert call("measure", folder, "--reference-mm", "5") == 2


def test_the_report_has_what_is_kept_at_once(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    page = next(file for file in write_report(folder) if file.suffix == ".html")

    def data() -> dict[str, object]:
        text = page.read_text().split('<script type="application/json" id="data">')[1]
        return dict(json.loads(text.split("</script>")[0])["runs"][0])

    before = data()
    surface = ShownSurface(Result(folder))
    first, second = picked(surface, (24.0, 45.0), (40.0, 45.0))
    add_measurement(folder, reference_as_kept(surface, Reference((first, second), 5.0)))
    now = data()
    assert now["measurements"] == json.loads((folder / "measurements.json").read_text())
    # What it says of sizes is what the measures beside it say, and nothing else is other.
    assert str(before["verdict"]["advice"]).endswith("Sizes are unknown: compare shapes, do not measure.")  # type: ignore[index]
    assert str(now["verdict"]["advice"]).endswith("Sizes are in mm by your reference (5 mm).")  # type: ignore[index]
    assert {name for name in now if now[name] != before[name]} == {"measurements", "verdict"}
    # Written anew it is the same.
    patched = page.read_bytes()
    write_report(folder)
    assert page.read_bytes() == patched


def test_sizes_by_another_reference_than_the_kept_one_are_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = draw_run(tmp_path)
    surface = ShownSurface(Result(folder))
    points, (first, second) = picked(surface, (20.0, 20.0), (60.0, 44.0)), picked(surface, (24.0, 45.0), (40.0, 45.0))
    reference = Reference((first, second), 5.0)
    add_measurement(folder, measure_by_hand(surface, points, reference))

    def is_marked() -> bool:
        assert call("measure", folder) == 0
        said = "by an earlier reference" in capsys.readouterr().out
        assert by_hand_data(Result(folder))["by_earlier_reference"] == [0] * said
        return said

    assert is_marked()
    add_measurement(folder, reference_as_kept(surface, reference))
    assert not is_marked()
    # Of another length, and at another place.
    for other in (Reference((first, second), 4.0), Reference((first, points[0]), 5.0)):
        add_measurement(folder, reference_as_kept(surface, other))
        assert is_marked()
    remove_reference(folder, ".")
    assert is_marked()


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


def test_a_measure_whose_interval_begins_at_0_is_not_measurable() -> None:
    height = Measure("height", 0.4716, 0.0, 10.91, "mm", "the relief")
    assert str(height) == "height: not measurable (0 to 10.9 mm; wide mainly because of the relief)"
    assert with_interval(height) == "not measurable (to 11 mm)"
    assert short(height) == "not measurable"
    one = HandMeasure(".", 4, np.zeros((3, 2)), None, None, [height], np.zeros((3, 3)), "lesion", "Polyp")
    assert "height: not measurable, 95 % interval 0 to 10.9 mm" in measured_words(one).replace("\\", "")
    assert str(replace(height, low=0.2, why="")) == "height: 0.472 mm (0.2 to 10.9)"
