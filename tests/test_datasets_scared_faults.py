"""SCARED keyframes that do not match themselves, and those that cannot be read."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from drawn_scared import (
    HEIGHT,
    RATE_HZ,
    WIDTH,
    frame_json,
    json_files,
    left_view,
    point_files,
    red_in,
    scene_points,
    write_scared,
    write_stereo_video,
    write_tar,
)

from scopemap.errors import InputError, ScopemapError
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory
from scopemap_bench.datasets.scared import ScaredKeyframe


@pytest.fixture(scope="module")
def downloaded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scared(tmp_path_factory.mktemp("scared") / "dataset_3" / "keyframe_4")


@pytest.fixture
def keyframe(downloaded: Path, tmp_path: Path) -> Path:
    return shutil.copytree(downloaded, tmp_path / "dataset_3" / "keyframe_4")


def replace_frame_data(keyframe: Path, count: int, change: Callable[[int, dict[str, Any]], Any] | None = None) -> None:
    write_tar(keyframe / "data" / "frame_data.tar.gz", json_files(range(count), change))


# ---- what does not match


@pytest.mark.parametrize(("videos", "jsons"), [(4, 3), (3, 5)])
def test_frames_are_those_with_picture_and_pose(videos: int, jsons: int, keyframe: Path) -> None:
    write_stereo_video(keyframe / "data" / "rgb.mp4", videos)
    replace_frame_data(keyframe, jsons)
    sequence = open_sequence(keyframe)
    assert sequence.count == 3
    assert [frame.index for frame, _ in sequence] == [0, 1, 2]
    assert f"{videos} pictures, but {jsons} frame_data files; the 3 frames that have both" in sequence.warnings[0]


def test_a_gap_in_frame_data_is_a_gap_in_the_frames(keyframe: Path) -> None:
    write_tar(keyframe / "data" / "frame_data.tar.gz", json_files([0, 1, 3]))
    frames = list(open_sequence(keyframe).source.frames(slice(None)))
    assert [frame.index for frame in frames] == [red_in(frame.rgb) for frame in frames] == [0, 1, 3]


def test_missing_scene_points_leave_the_pose(keyframe: Path) -> None:
    write_tar(keyframe / "data" / "scene_points.tar.gz", point_files([0, 2]))
    truths = [truth for _, truth in open_sequence(keyframe)]
    assert [truth.depth_mm is None for truth in truths] == [False, True, False, True]
    assert all(truth.T_world_camera is not None for truth in truths)


def _not_finite(entry: dict[str, Any]) -> Any:
    entry["camera-pose"][0][3] = float("nan")
    return entry


def _left_handed(entry: dict[str, Any]) -> Any:
    entry["camera-pose"] = (np.diag([1, -1, 1, 1]) @ entry["camera-pose"]).tolist()
    return entry


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (_not_finite, "NaN or infinity"),
        (_left_handed, "not a rigid motion"),
        (lambda entry: {"camera-pose": [[1, 2], [3]]}, "inhomogeneous"),
        (lambda entry: {"camera-pose": [[10**400] * 4] * 4}, "too large"),
        (lambda entry: [1, 2], "attribute"),
        (lambda entry: b"{broken", "Expecting"),
        (lambda entry: b"[" * 5000, "recursion"),
    ],
)
def test_a_frame_whose_pose_cannot_be_used_has_none(spoil: Callable[[Any], Any], told: str, keyframe: Path) -> None:
    replace_frame_data(keyframe, 4, lambda n, entry: spoil(entry) if n == 1 else entry)
    sequence = open_sequence(keyframe)
    assert sequence.source.pose(1) is None
    assert sequence.source.truth(1).depth_mm is not None
    assert "1 of 4 files cannot be used" in sequence.warnings[0]
    assert told in sequence.warnings[0]
    np.testing.assert_array_equal(reference_trajectory(sequence).indices, [0, 2, 3])


@pytest.mark.parametrize("unit_s", [1e-9, 1e-6, 1e-3])
def test_time_stamps_tell_their_unit(unit_s: float, keyframe: Path) -> None:
    replace_frame_data(keyframe, 4, lambda n, entry: frame_json(n, stamp_unit_s=unit_s))
    sequence = open_sequence(keyframe)
    np.testing.assert_allclose([frame.time_s for frame, _ in sequence], np.arange(4) / 20, atol=1e-9)
    assert any("those of frame_data" in note for note in sequence.notes)


@pytest.mark.parametrize(
    "stamps",
    [[0, 5, 3, 7], [0, 33, 33, 66], [0, 1, 2, 3], [0, 10**6, 2 * 10**6, 3 * 10**6], ["a", 1, 2, 3], [10**400] * 4],
)
def test_time_stamps_that_are_none_give_way_to_the_videos_rate(stamps: list[Any], keyframe: Path) -> None:
    replace_frame_data(keyframe, 4, lambda n, entry: entry | {"timestamp": stamps[n]})
    sequence = open_sequence(keyframe)
    np.testing.assert_allclose([frame.time_s for frame, _ in sequence], np.arange(4) / RATE_HZ)
    assert any(f"frame number / {RATE_HZ} s" in note for note in sequence.notes)


@pytest.mark.parametrize(
    ("name", "count"), [("dataset_4", 1), ("test_dataset_5", 1), ("dataset_6", 0), ("dataset_14", 0)]
)
def test_the_datasets_with_a_bad_calibration_are_told(name: str, count: int, downloaded: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(downloaded, tmp_path / name / "keyframe_4")
    warnings = open_sequence(folder).warnings
    assert len(warnings) == count
    assert all("known to be inaccurate" in warning for warning in warnings)


# ---- refusals


def _single_picture(keyframe: Path) -> None:
    shutil.rmtree(keyframe / "data")


def _one_frame(keyframe: Path) -> None:
    write_stereo_video(keyframe / "data" / "rgb.mp4", 1)


def _no_archive(keyframe: Path) -> None:
    (keyframe / "data" / "frame_data.tar.gz").write_bytes(b"no archive at all")


def _other_numbers(keyframe: Path) -> None:
    write_tar(keyframe / "data" / "frame_data.tar.gz", json_files([70, 71]))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_one_frame, "holds one frame, two are needed"),
        (_no_archive, r"frame_data\.tar\.gz: the archive is damaged"),
        (_other_numbers, "no picture has the number of a frame_data file"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(spoil: Callable[[Path], None], message: str, keyframe: Path) -> None:
    spoil(keyframe)
    with pytest.raises(ScopemapError, match=message) as caught:
        open_sequence(keyframe)
    assert "\n" not in str(caught.value)
    assert str(keyframe) in str(caught.value)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (b"II*\0no tiff", "no image of 3"),
        (cv2.imencode(".png", left_view(0))[1].tobytes(), "no image of 3"),
        (scene_points(0)[:3000], "scene points"),
    ],
)
def test_scene_points_that_are_none_are_refused(points: bytes, message: str, keyframe: Path) -> None:
    write_tar(keyframe / "data" / "scene_points.tar.gz", {"scene_points000000.tiff": points})
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(keyframe).source.truth(0)
    assert "\n" not in str(caught.value)


def test_scene_points_of_another_view_are_refused(keyframe: Path) -> None:
    image = cv2.imencode(".tiff", np.ones((HEIGHT, WIDTH - 10, 3), np.float32))[1].tobytes()
    write_tar(keyframe / "data" / "scene_points.tar.gz", {"scene_points000000.tiff": image})
    with pytest.raises(InputError, match=r"54x48 px do not fit"):
        open_sequence(keyframe).source.truth(0)


def test_no_permission_is_a_sentence(downloaded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(ScaredKeyframe, "recognises", staticmethod(refuse))
    with pytest.raises(InputError, match="no permission to look into it"):
        open_sequence(downloaded)


def test_poses_that_grow_are_refused(keyframe: Path) -> None:
    """Some kB of archive, 8 MB of lists in a list: 300 MB once it is parsed."""
    replace_frame_data(keyframe, 4, lambda n, entry: entry | {"timestamp": [[]] * 2_000_000} if n == 1 else entry)
    with pytest.raises(InputError, match=r"frame_data000001\.json: it holds \d+ MB, expected 1 MB at most"):
        open_sequence(keyframe)
