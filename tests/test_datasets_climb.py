"""CLiMB's clips: poses in mm from the reference, the clip's place, the endoscope's calibration, the plan."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from drawn_climb import path_of, write_clip, write_foreign_run, write_reference
from test_datasets_endomapper import KB4, SIZE

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.lenses import FisheyeCamera
from scopemap.errors import InputError
from scopemap.io.opening import open_sequence
from scopemap.io.reference import read_reference, reference_trajectory
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap_bench.methods.method import create_method
from scopemap_bench.plan import MethodPlan, found_sequences, read_plan


def test_a_clip(tmp_path: Path) -> None:
    folder = write_clip(tmp_path)
    sequence = open_sequence(folder)
    assert (sequence.source.name, sequence.path, sequence.count, sequence.warnings) == ("climb", folder, 6, [])
    assert sequence.source.camera == FisheyeCamera(PinholeCamera(*KB4[:4], *SIZE), KB4[4:])
    reference = reference_trajectory(sequence)
    # Image 000001.png is frame 0 of 50 a second; scales.csv says 2 mm per unit.
    assert reference.indices.tolist() == [0, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(reference.times_s, np.arange(6) / 50)
    np.testing.assert_allclose(reference.T_world_camera, path_of(6), atol=1e-9)
    assert sequence.source.truth(3).quality == "sfm"
    assert any("mm by scales.csv: 6 frames" in note for note in sequence.notes)


def test_the_clip_may_be_in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_clip(tmp_path)
    shutil.move(tmp_path / "Seq_001_a.mp4", folder)
    monkeypatch.chdir(folder)
    for path in (folder, tmp_path, Path()):
        assert open_sequence(path).source.name == "climb"


def test_a_reference_alone_is_a_truth_but_no_input(tmp_path: Path) -> None:
    folder = write_reference(tmp_path, path_of(6))
    np.testing.assert_allclose(read_reference(folder).T_world_camera, path_of(6), atol=1e-9)
    with pytest.raises(InputError):
        open_sequence(folder)


def test_what_is_missing_or_too_much_is_told(tmp_path: Path) -> None:
    folder = write_clip(tmp_path)
    shutil.rmtree(folder / "results_txt")
    (tmp_path / "scales.csv").unlink()
    write_reference(tmp_path / "longer", path_of(8), scale=None)
    shutil.move(tmp_path / "longer" / "Seq_001_a" / "results_txt", folder)
    (folder / "Seq_001_info.json").unlink()
    sequence = open_sequence(folder)
    assert len(sequence.warnings) == 1
    assert "Seq_001_a.mp4: 2 of 8 poses are of frames beyond the 6 of the video" in sequence.warnings[0]
    assert any("scale unknown" in note for note in sequence.notes)
    assert any("no calibration: Seq_001_info.json is missing" in note for note in sequence.notes)


def test_the_plan_finds_the_clips(tmp_path: Path) -> None:
    write_clip(tmp_path)
    write_reference(tmp_path, path_of(6), clip="Seq_002_a")
    found, missing = found_sequences(read_plan("climb"), tmp_path)
    assert ([sequence.path for sequence in found], missing) == (["Seq_001_a"], [])


def test_a_submission_of_another_system_is_imported_with_its_submaps(tmp_path: Path) -> None:
    folder, poses = write_clip(tmp_path), path_of(6)
    write_foreign_run(tmp_path / "theirs/Seq_001_a/1", (poses[:3], [1, 2, 3]), (poses[3:], [4, 5, 6]))
    plan = MethodPlan(name="theirs", use="import", files="theirs/{sequence}/1")
    create_method(plan, tmp_path, "Seq_001_a").run(open_sequence(folder), {}, tmp_path / "run")
    found = read_trajectory(tmp_path / "run")
    tracked = [submap.indices[submap.tracked].tolist() for submap in (found, *found.others)]
    assert tracked == [[0, 1, 2], [3, 4, 5]]
    np.testing.assert_allclose(found.others[0].T_world_camera, poses[3:], atol=1e-6)
