"""SCARED-C keyframes: frames in an archive, counted from 1, with gaps."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_scared import (
    CAMERA,
    HEIGHT,
    WIDTH,
    frame_json,
    json_files,
    left_view,
    red_in,
    true_depth_mm,
    true_pose,
    write_loose,
    write_scared,
    write_scared_c,
    write_tar,
)

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.errors import InputError, ScopemapError
from scopemap.io.opening import open_sequence
from scopemap_bench.trajectories.numbered import find_numbered

NUMBERS = [1, 2, 4, 7, 8]


@pytest.fixture
def keyframe(tmp_path: Path) -> Path:
    return write_scared_c(tmp_path / "dataset_1" / "keyframe_1", NUMBERS)


def picture_files(numbers: list[int], size: tuple[int, int] = (WIDTH, HEIGHT)) -> dict[str, bytes]:
    pictures = {n: cv2.resize(left_view(n)[..., ::-1], size) for n in numbers}
    return {f"frame{n:06d}.png": cv2.imencode(".png", picture)[1].tobytes() for n, picture in pictures.items()}


def test_frames_poses_and_points_share_their_numbers(keyframe: Path) -> None:
    sequence = open_sequence(keyframe)
    assert (sequence.source.name, sequence.count, sequence.warnings) == ("scared-c", 5, [])
    pairs = list(sequence)
    assert [frame.index for frame, _ in pairs] == NUMBERS
    for frame, truth in pairs:
        assert red_in(frame.rgb) == frame.index == truth.index
        assert frame.name == f"frame{frame.index:06d}.png"
        np.testing.assert_allclose(truth.T_world_camera, true_pose(frame.index), atol=1e-9)
        assert truth.quality == "sfm"
    depth_mm = sequence.source.truth(7).depth_mm
    assert np.isnan(depth_mm[:, :4]).all()
    np.testing.assert_allclose(depth_mm[:, 4:], true_depth_mm(true_pose(7))[:, 4:], rtol=1e-6)


def test_colmaps_pixel_centres_are_moved_by_half_a_pixel(keyframe: Path) -> None:
    sequence = open_sequence(keyframe)
    expected = CAMERA.central
    found = sequence.rectifier.source
    assert isinstance(found, PinholeCamera)
    np.testing.assert_allclose([found.fx, found.fy], [expected.fx, expected.fy])
    np.testing.assert_allclose([found.cx, found.cy], [expected.cx - 0.5, expected.cy - 0.5])
    assert "half a pixel" in sequence.camera_source


def test_scared_itself_is_not_taken_for_it(keyframe: Path, tmp_path: Path) -> None:
    assert open_sequence(write_scared(tmp_path / "dataset_2" / "keyframe_1")).source.name == "scared"
    # Both lie in one folder where somebody downloads the one over the other: the corrected poses win.
    write_scared(keyframe)
    write_tar(keyframe / "data" / "frame_data.tar.gz", json_files(NUMBERS))
    assert open_sequence(keyframe).source.name == "scared-c"


@pytest.mark.parametrize("selection", [slice(1, 4), slice(None, None, 2), slice(-2, None)])
def test_selections_count_the_frames_that_there_are(selection: slice, keyframe: Path) -> None:
    source = open_sequence(keyframe).source
    frames = list(source.frames(selection))
    assert [frame.index for frame in frames] == NUMBERS[selection]
    assert source.stamps(selection) == [(frame.index, frame.time_s) for frame in frames]


def test_time_stamps_are_those_of_frame_data_or_count_frames(keyframe: Path) -> None:
    times_s = [frame.time_s for frame, _ in open_sequence(keyframe)]
    np.testing.assert_allclose(times_s, np.array(NUMBERS) / 20, atol=1e-9)
    # Where the correction found no time stamps it wrote 1 000 000 per frame.
    write_tar(
        keyframe / "data" / "frame_data.tar.gz", json_files(NUMBERS, lambda n, entry: entry | {"timestamp": n * 10**6})
    )
    np.testing.assert_allclose([frame.time_s for frame, _ in open_sequence(keyframe)], np.array(NUMBERS) / 30)


def test_unpacked_archives_read_the_same(keyframe: Path) -> None:
    for name, prefix, suffix in (
        ("rgb_frames", "frame", ".png"),
        ("frame_data", "frame_data", ".json"),
        ("scene_points", "scene_points", ".tiff"),
    ):
        files = find_numbered(keyframe / "data", (name,), prefix, (suffix,))
        loose = {f"{prefix}{number:06d}{suffix}": files.read(number) for number in files.numbers()}
        write_loose(keyframe / "data" / name, loose)
        (keyframe / "data" / f"{name}.tar.gz").unlink()
    sequence = open_sequence(keyframe)
    assert [red_in(frame.rgb) for frame, _ in sequence] == NUMBERS
    assert sequence.source.truth(2).depth_mm is not None


def test_without_a_log_the_poses_say_which_frames_there_are(keyframe: Path) -> None:
    (keyframe / "frame_log.json").unlink()
    assert [frame.index for frame, _ in open_sequence(keyframe)] == NUMBERS
    (keyframe / "data" / "frame_data.tar.gz").unlink()
    sequence = open_sequence(keyframe)
    assert [frame.index for frame, _ in sequence] == NUMBERS
    assert sequence.source.pose(1) is None
    assert sequence.source.truth(1).depth_mm is not None


def test_frames_that_log_and_poses_do_not_share_are_left_out(keyframe: Path) -> None:
    write_tar(keyframe / "data" / "frame_data.tar.gz", json_files([1, 2, 7, 9]))
    sequence = open_sequence(keyframe)
    assert [frame.index for frame, _ in sequence] == [1, 2, 7]
    assert "5 pictures, but 4 frame_data files; the 3 frames that have both are used" in sequence.warnings[0]


def test_a_picture_that_is_missing_or_damaged_is_left_out_with_a_warning(keyframe: Path) -> None:
    write_tar(keyframe / "data" / "rgb_frames.tar.gz", picture_files([1, 2, 7]) | {"frame000008.png": b"no image"})
    sequence = open_sequence(keyframe)
    assert [frame.index for frame, _ in sequence] == [1, 2, 7]
    assert ["frame000004" in sequence.warnings[0], "frame000008" in sequence.warnings[1]] == [True, True]
    assert len(list(sequence)) == 3
    assert len(sequence.warnings) == 2, "a second walk warns no more"


def test_pictures_of_changing_size_are_named(keyframe: Path) -> None:
    pictures = picture_files(NUMBERS) | picture_files([4], (32, 24))
    write_tar(keyframe / "data" / "rgb_frames.tar.gz", pictures)
    with pytest.raises(InputError, match=r"frame000004\.png: it is 32x24 px, those before it are 64x48 px"):
        list(open_sequence(keyframe))


def test_a_calibration_beside_the_frames_wins(keyframe: Path) -> None:
    write_calibration(PinholeCamera(70.0, 70.0, 31.0, 22.0, WIDTH, HEIGHT), keyframe / "camera.yaml")
    assert open_sequence(keyframe).camera.cx == 31.0


def _nothing_decodes(keyframe: Path) -> None:
    write_tar(keyframe / "data" / "rgb_frames.tar.gz", {"frame000001.png": b""})


def _nothing_common(keyframe: Path) -> None:
    write_tar(keyframe / "data" / "frame_data.tar.gz", {"frame_data000050.json": json.dumps(frame_json(50)).encode()})


def _log_of(text: str) -> Callable[[Path], None]:
    return lambda keyframe: (keyframe / "frame_log.json").write_text(text) and None


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_nothing_decodes, "none of the 5 images can be read"),
        (_nothing_common, "no picture has the number of a frame_data file"),
        (_log_of("{"), r"cannot read included_frames in .*frame_log\.json"),
        (_log_of("[]"), "cannot read included_frames"),
        (_log_of('{"included_frames": ["a"]}'), "cannot read included_frames"),
        (_log_of('{"included_frames": [Infinity]}'), "cannot read included_frames"),
        (_log_of('{"included_frames": []}'), "names no frame"),
        (lambda keyframe: (keyframe / "intrinsics_colmap.yaml").write_text("K: 3\n") and None, "no 3x3 camera matrix"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(
    spoil: Callable[[Path], None], message: str, keyframe: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(keyframe, tmp_path / "spoilt")
    spoil(folder)
    with pytest.raises(ScopemapError, match=message) as caught:
        open_sequence(folder)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


def test_intrinsics_are_needed_where_the_reader_is_named(keyframe: Path) -> None:
    (keyframe / "intrinsics_colmap.yaml").unlink()
    with pytest.raises(ScopemapError, match=r"intrinsics_colmap\.yaml is not there"):
        open_sequence(keyframe, dataset="scared-c")
