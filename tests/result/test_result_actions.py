"""What a result is asked in Python answers as the commands do."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import scopemap
from scopemap import Result, locate, measure, measure_lesion
from scopemap.engine.errors import InputError, SettingsError
from tests.apps.measure.test_lesion import patch
from tests.support.drawn_run import draw_run, draw_run_of_frames, drawn_result
from tests.support.front_door import call

REFERENCE = [(30.0, 20.0), (48.0, 20.0)]


def test_sizes_are_those_of_the_command(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run = draw_run(tmp_path / "run")
    assert call("measure", run, "--frame", 2, "--points", "20,20 40,40", "--reference", "30,20 48,20", "--json") == 0
    said = json.loads(capfd.readouterr().out)
    assert [vars(one) for one in measure(run, 2, [(20, 20), (40, 40)], REFERENCE)] == said
    found = measure_lesion(run, patch(2), 2, reference=REFERENCE, reference_mm=8)
    assert [one.unit for one in found.measures] == ["mm", "mm", "mm", "mm2", "mm"]
    assert 2 in found.masks
    with pytest.raises(SettingsError, match="needs its two points"):
        measure_lesion(run, patch(2), 2, reference_mm=8)
    with pytest.raises(ValueError, match="mask"):
        measure_lesion(run, np.ones((3, 4), bool), 2, reference=REFERENCE)


def test_a_submap_answers_for_its_own_folder(tmp_path: Path) -> None:
    run = draw_run(tmp_path / "run")
    [other] = Result(run).others
    assert other.path == run / "maps" / "1"
    area = [(20, 20), (40, 20), (40, 40)]
    of_folder = measure(run / "maps" / "1", 20, area, REFERENCE)
    assert measure(other, 20, area, REFERENCE) == of_folder
    with pytest.raises(InputError, match="maps/1"):
        measure(Result(run), 20, area, REFERENCE)


def test_frames_are_located_by_a_folder_of_them(tmp_path: Path) -> None:
    found = locate(draw_run_of_frames(tmp_path), tmp_path / "frames")
    assert [one.index for one in found] == list(range(24))


@pytest.mark.parametrize("name", ["coverage", "measure", "measure_lesion", "locate"])
def test_a_result_in_memory_knows_no_depth(name: str) -> None:
    arguments = {"coverage": (), "measure": (0, REFERENCE), "measure_lesion": (REFERENCE, 0), "locate": ("a.mp4",)}
    result: Result = drawn_result()
    with pytest.raises(InputError, match="in memory alone"):
        next(iter(getattr(scopemap, name)(result, *arguments[name])))
