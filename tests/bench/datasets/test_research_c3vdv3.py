"""What C3VDv3's folders have beside C3VD's: a lens in config.ini, and poses with the time before them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.lenses import OmnidirectionalCamera
from scopemap.engine.errors import InputError
from scopemap.input.opening import open_sequence
from scopemap.result.reference import reference_trajectory
from tests.support.drawn_inputs import SIZE, poses, write_c3vd


def test_config_ini_is_the_lens(tmp_path: Path) -> None:
    folder = write_c3vd(tmp_path / "a")
    terms = {"width": 1350, "height": 1080, "cx": 677.7, "cy": 543.1, "a0": 767.7, "a2": -5.9e-4, "a3": -2.7e-7}
    (folder / "config.ini").write_text("; v3\n" + "".join(f"{name} = {value}\n" for name, value in terms.items()))
    sequence = open_sequence(folder)
    lens = OmnidirectionalCamera((767.7, 0.0, -5.9e-4, -2.7e-7), 677.7, 543.1, 1350, 1080)
    assert sequence.rectifier.source == lens.resized(*SIZE)
    assert "config.ini" in sequence.camera_source


def test_a_log_by_time_is_no_truth_of_pictures_that_it_does_not_match(tmp_path: Path) -> None:
    folder = write_c3vd(tmp_path / "a")  # 11 pictures, 13 poses
    rows = np.loadtxt(folder / "pose.txt", delimiter=",")
    np.savetxt(folder / "pose.txt", np.column_stack([np.arange(13) / 29.97 + 0.01, rows]), delimiter=",")
    with pytest.raises(InputError, match="a log by time, of 13 poses for 11 pictures"):
        open_sequence(folder)
    np.savetxt(folder / "pose.txt", np.column_stack([np.arange(13), rows]), delimiter=",")
    truth = reference_trajectory(open_sequence(folder))
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, poses(11), atol=1e-6)
