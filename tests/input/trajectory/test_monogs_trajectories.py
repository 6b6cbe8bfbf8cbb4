"""MonoGS' keyframes are read by their frame numbers, and SVO-pro's files as TUM."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.errors import InputError
from scopemap.result.trajectories import read_trajectory
from tests.support.foreign_layouts import assert_is, moving_camera


def monogs_text(numbers: list[object], poses: np.ndarray) -> str:
    return json.dumps({"trj_id": numbers, "trj_est": poses.tolist(), "trj_gt": poses.tolist()}, indent=4)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_monogs_keyframes_keep_their_frame_numbers(tmp_path: Path, unit: str) -> None:
    poses = moving_camera(20)[[0, 3, 9]]
    stored = poses.copy()
    stored[:, :3, 3] /= 1000 if unit == "m" else 1
    (tmp_path / "plot").mkdir()
    file = tmp_path / "plot/trj_final.json"
    file.write_text(monogs_text([9, 0, 3], stored[[2, 0, 1]]))
    for place in (tmp_path, file.parent, file):
        assert_is(read_trajectory(place, unit=unit), poses, [0, 3, 9])  # type: ignore[arg-type]
    assert "MonoGS" in read_trajectory(file).source


@pytest.mark.parametrize(
    ("numbers", "message"),
    [([0, 1], "expected trj_id and 4x4 matrices"), ([0, 0, 1], "each once"), ([0.5, 1, 2], "each once"), ([[]], "4x4")],
)
def test_bad_monogs_files_are_refused(tmp_path: Path, numbers: list[object], message: str) -> None:
    file = tmp_path / "trj_final.json"
    file.write_text(monogs_text(numbers, moving_camera(20)[:3]))
    with pytest.raises(InputError, match=rf"trj_final\.json: .*{message}"):
        read_trajectory(file)


@pytest.mark.parametrize("head", ["# timestamp tx ty tz qx qy qz qw", "#timestamp[ns] tx ty tz qx qy qz qw"])
def test_the_files_of_svo_pro_are_tum(tmp_path: Path, head: str) -> None:
    rows = [f"{1403636579000000000 + 50000000 * row} {row} 2 3 0 0 0 1" for row in range(4)]
    rows = rows if "[ns]" in head else [f"{int(row.split()[0]) / 1e9:.9f} {row.split(maxsplit=1)[1]}" for row in rows]
    file = tmp_path / "stamped_traj_estimate.txt"
    file.write_text("\n".join([head, *rows]) + "\n")
    found = read_trajectory(file)
    np.testing.assert_allclose(np.diff(found.times_s), 0.05, atol=1e-5)
    np.testing.assert_allclose(found.positions_mm[:, 0], 1000 * np.arange(4))
