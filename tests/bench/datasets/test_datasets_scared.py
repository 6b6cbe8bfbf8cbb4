"""SCARED and SCARED-C keyframes: as downloaded, as others unpack them, what does not match in some, what is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.engine.errors import InputError, ScopemapError
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence
from scopemap.result.reference import reference_trajectory
from tests.support.drawn_scared import (
    CAMERA,
    HEIGHT,
    PLANE,
    RATE_HZ,
    WIDTH,
    Files,
    frame_json,
    json_files,
    left_view,
    point_files,
    red_in,
    scene_points,
    true_depth_mm,
    true_pose,
    write_loose,
    write_scared,
    write_scared_c,
    write_stereo_calibration,
    write_stereo_video,
    write_tar,
)

NUMBERS = [1, 2, 4, 7, 8]
Edit = Callable[[Path], object]


@pytest.fixture(scope="module")
def downloaded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scared(tmp_path_factory.mktemp("scared") / "dataset_3" / "keyframe_4")


@pytest.fixture
def keyframe(downloaded: Path, tmp_path: Path) -> Path:
    return shutil.copytree(downloaded, tmp_path / "dataset_3" / "keyframe_4")


@pytest.fixture
def corrected(tmp_path: Path) -> Path:
    """A keyframe of SCARED-C."""
    return write_scared_c(tmp_path / "dataset_1" / "keyframe_1", NUMBERS)


def frame_data(files: Files) -> Edit:
    return lambda keyframe: write_tar(keyframe / "data" / "frame_data.tar.gz", files)


def points(files: Files) -> Edit:
    return lambda keyframe: write_tar(keyframe / "data" / "scene_points.tar.gz", files)


def png(picture: np.ndarray) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1].tobytes()


def picture_files(numbers: list[int], size: tuple[int, int] = (WIDTH, HEIGHT)) -> Files:
    return {f"frame{n:06d}.png": png(cv2.resize(left_view(n), size)) for n in numbers}


def off_the_plane_mm(sequence: Sequence, pose_of: Callable[[np.ndarray], np.ndarray]) -> float:
    """Largest distance of the truth's surface from the plane that was drawn, over all frames."""
    normal, distance_mm = PLANE
    worst = []
    for frame, truth in sequence:
        seen = transform(pose_of(truth.T_world_camera), frame.camera.rays * truth.depth_mm[..., None])
        worst.append(np.nanmax(np.abs(seen @ normal - distance_mm)))
    return float(max(worst[1:]))


# ---- as downloaded


def test_a_keyframe_is_read_as_it_is_downloaded(downloaded: Path) -> None:
    before = sorted(downloaded.rglob("*"))
    sequence = open_sequence(downloaded)
    source = sequence.source
    assert (source.name, source.width, source.height, sequence.count) == ("scared", WIDTH, HEIGHT, 4)
    assert isinstance(source.camera, OpenCvCamera)
    np.testing.assert_allclose(source.camera.central.matrix, CAMERA.central.matrix)
    np.testing.assert_allclose(source.camera.distortion, CAMERA.distortion)
    for number, (frame, truth) in enumerate(sequence):
        assert frame.index == truth.index == red_in(frame.rgb[frame.valid]) == number
        assert frame.rgb[..., 2].max() < 60, "the right view, blue, is not to be seen"
        np.testing.assert_allclose(truth.T_world_camera, true_pose(number), atol=1e-9)
        assert truth.quality == "kinematic"
    depth_mm = source.truth(2).depth_mm
    assert depth_mm.dtype == np.float32
    assert np.isnan(depth_mm[:, :4]).all(), "holes of every kind"
    np.testing.assert_allclose(depth_mm[:, 4:], true_depth_mm(true_pose(2))[:, 4:], rtol=1e-6)
    assert sequence.warnings == []
    assert sorted(downloaded.rglob("*")) == before, "nothing is unpacked"
    assert open_sequence(downloaded / "data").path == downloaded


def test_poses_and_points_agree_through_the_rectification(downloaded: Path) -> None:
    """The camera moves and turns: a pose that is not inverted puts the surface elsewhere."""
    sequence = open_sequence(downloaded)
    assert off_the_plane_mm(sequence, lambda T_world_camera: T_world_camera) < 0.3
    assert off_the_plane_mm(sequence, inverse) > 3


# ---- copies


def _unpacked(keyframe: Path) -> None:
    for name, files in (("frame_data", json_files(range(4))), ("scene_points", point_files(range(4)))):
        (keyframe / "data" / f"{name}.tar.gz").unlink()
        write_loose(keyframe / "data" / name, files)


def _plain_tar(keyframe: Path) -> None:
    for name, files in (("frame_data", json_files(range(4))), ("scene_points", point_files(range(4)))):
        (keyframe / "data" / f"{name}.tar.gz").unlink()
        write_tar(keyframe / "data" / f"{name}.tar", {f"./{name}/{file}": data for file, data in files.items()})


def _images_of_one(place: str) -> Edit:
    """Copies with the left views as images, which count from 1."""

    def change(keyframe: Path) -> None:
        (keyframe / "data" / "rgb.mp4").unlink()
        write_loose(keyframe / place, {f"{n + 1:010d}.png": png(left_view(n)) for n in range(4)})

    return change


def _other_names(keyframe: Path) -> None:
    (keyframe / "endoscope_calibration.yaml").rename(keyframe / "camera_calibration.yaml")
    for name in ("frame_data", "scene_points"):
        (keyframe / "data" / f"{name}.tar.gz").rename(keyframe / "data" / f"{name}.tgz")
    (keyframe / "data" / "rgb.mp4").rename(keyframe / "rgb.mp4")


def _unpacked_for_learning(keyframe: Path) -> None:
    _unpacked(keyframe)
    _images_of_one("image_02/data")(keyframe)
    (keyframe / "data" / "frame_data").rename(keyframe / "image_02" / "data" / "frame_data")
    (keyframe / "data" / "scene_points").rename(keyframe / "image_02" / "data" / "groundtruth")


@pytest.mark.parametrize(
    "change", [_unpacked, _plain_tar, _other_names, _images_of_one("left"), _unpacked_for_learning]
)
def test_other_copies_read_the_same(change: Edit, keyframe: Path) -> None:
    change(keyframe)
    sequence = open_sequence(keyframe)
    assert sequence.source.name == "scared"
    pairs = list(sequence)
    assert [red_in(frame.rgb[frame.valid]) for frame, _ in pairs] == [frame.index for frame, _ in pairs] == [0, 1, 2, 3]
    for frame, truth in pairs:
        np.testing.assert_allclose(truth.T_world_camera, true_pose(frame.index), atol=1e-9)
    np.testing.assert_allclose(sequence.source.truth(3).depth_mm[:, 4:], true_depth_mm(true_pose(3))[:, 4:], rtol=1e-6)
    assert sequence.warnings == []


@pytest.mark.parametrize("inner", ["dataset_8/dataset_8/keyframe_0", "dataset8_keyframe0"])
def test_a_test_keyframe_has_a_video_and_no_truth(inner: str, tmp_path: Path) -> None:
    folder = tmp_path / inner
    write_stereo_calibration(folder / "endoscope_calibration.yaml")
    write_stereo_video(folder / "rgb.mp4", 3)
    sequence = open_sequence(tmp_path)
    assert sequence.path == folder
    assert [(frame.index, truth) for frame, truth in sequence] == [(0, None), (1, None), (2, None)]
    assert reference_trajectory(sequence) is None
    assert any("no pose is known" in note for note in sequence.notes)


def test_a_calibration_beside_the_frames_wins_with_its_scale(keyframe: Path, corrected: Path) -> None:
    mine = PinholeCamera(70.0, 70.0, 5.0, 5.0, WIDTH, HEIGHT)
    for folder in (keyframe, corrected):
        write_calibration(mine, folder / "camera.yaml", depth_scale_mm=2.0)
        source = open_sequence(folder).source
        assert source.camera == mine
        np.testing.assert_allclose(source.truth(1).depth_mm[:, 4:], 2 * true_depth_mm(true_pose(1))[:, 4:], rtol=1e-6)


# ---- what does not match


@pytest.mark.parametrize(("videos", "jsons"), [(4, 3), (3, 5)])
def test_frames_are_those_with_picture_and_pose(videos: int, jsons: int, keyframe: Path) -> None:
    write_stereo_video(keyframe / "data" / "rgb.mp4", videos)
    frame_data(json_files(range(jsons)))(keyframe)
    sequence = open_sequence(keyframe)
    assert (sequence.count, [frame.index for frame, _ in sequence]) == (3, [0, 1, 2])
    assert f"{videos} pictures, but {jsons} frame_data files; the 3 frames that have both" in sequence.warnings[0]


def test_gaps_of_poses_and_points(keyframe: Path) -> None:
    frame_data(json_files([0, 1, 3]))(keyframe)
    points(point_files([0, 3]))(keyframe)
    source = open_sequence(keyframe).source
    frames = list(source.frames(slice(None)))
    assert [frame.index for frame in frames] == [red_in(frame.rgb) for frame in frames] == [0, 1, 3]
    assert [source.truth(frame.index).depth_mm is None for frame in frames] == [False, True, False]
    (keyframe / "data" / "scene_points.tar.gz").unlink()
    np.testing.assert_allclose(open_sequence(keyframe).source.truth(3).T_world_camera, true_pose(3), atol=1e-9)


def _not_finite(entry: dict[str, Any]) -> Any:
    entry["camera-pose"][0][3] = float("nan")
    return entry


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (_not_finite, "NaN or infinity"),
        (lambda e: e | {"camera-pose": (np.diag([1, -1, 1, 1]) @ e["camera-pose"]).tolist()}, "not a rigid motion"),
        (lambda entry: {"camera-pose": [[1, 2], [3]]}, "inhomogeneous"),
        (lambda entry: {"camera-pose": [[10**400] * 4] * 4}, "too large"),
        (lambda entry: [1, 2], "attribute"),
        (lambda entry: b"{broken", "Expecting"),
        (lambda entry: b"[" * 5000, "camera-pose"),
    ],
)
def test_a_frame_whose_pose_cannot_be_used_has_none(spoil: Callable[[Any], Any], told: str, keyframe: Path) -> None:
    frame_data(json_files(range(4), lambda n, entry: spoil(entry) if n == 1 else entry))(keyframe)
    sequence = open_sequence(keyframe)
    assert sequence.source.pose(1) is None
    assert sequence.source.truth(1).depth_mm is not None
    assert "1 of 4 files cannot be used" in sequence.warnings[0]
    assert told in sequence.warnings[0]
    np.testing.assert_array_equal(reference_trajectory(sequence).indices, [0, 2, 3])


@pytest.mark.parametrize("unit_s", [1e-9, 1e-3])
def test_the_unit_of_time_stamps_is_found(unit_s: float, keyframe: Path) -> None:
    frame_data(json_files(range(4), lambda n, entry: frame_json(n, stamp_unit_s=unit_s)))(keyframe)
    sequence = open_sequence(keyframe)
    np.testing.assert_allclose([frame.time_s for frame, _ in sequence], np.arange(4) / 20, atol=1e-9)
    assert any("those of frame_data" in note for note in sequence.notes)


@pytest.mark.parametrize("stamps", [[0, 5, 3, 7], [0, 1, 2, 3], [0, 10**6, 2 * 10**6, 3 * 10**6], ["a", 1, 2, 3]])
def test_time_stamps_that_are_none_give_way_to_the_videos_rate(stamps: list[Any], keyframe: Path) -> None:
    frame_data(json_files(range(4), lambda n, entry: entry | {"timestamp": stamps[n]}))(keyframe)
    times_s = [frame.time_s for frame, _ in open_sequence(keyframe)]
    np.testing.assert_allclose(times_s, np.arange(4) / RATE_HZ)


@pytest.mark.parametrize(("name", "count"), [("dataset_4", 1), ("test_dataset_5", 1), ("dataset_14", 0)])
def test_the_datasets_with_a_bad_calibration_are_named(name: str, count: int, keyframe: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(keyframe, tmp_path / name / "keyframe_4")
    assert ["known to be inaccurate" in warning for warning in open_sequence(folder).warnings] == [True] * count


# ---- SCARED-C


def test_scared_cs_frames_poses_and_points_share_their_numbers(corrected: Path) -> None:
    sequence = open_sequence(corrected)
    assert (sequence.source.name, sequence.count, sequence.warnings) == ("scared-c", 5, [])
    for number, (frame, truth) in zip(NUMBERS, sequence, strict=True):
        assert frame.index == truth.index == red_in(frame.rgb) == number
        assert (frame.name, frame.time_s) == (f"frame{number:06d}.png", pytest.approx(number / 20))
        np.testing.assert_allclose(truth.T_world_camera, true_pose(number), atol=1e-9)
        assert truth.quality == "sfm"
    depth_mm = sequence.source.truth(7).depth_mm
    np.testing.assert_allclose(depth_mm[:, 4:], true_depth_mm(true_pose(7))[:, 4:], rtol=1e-6)
    # COLMAP's centre of the top-left pixel is (0.5, 0.5).
    K = CAMERA.central.matrix - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    np.testing.assert_allclose(sequence.source.camera.central.matrix, K)
    # Where the correction found no time stamps it wrote 1 000 000 per frame.
    frame_data(json_files(NUMBERS, lambda n, entry: entry | {"timestamp": n * 10**6}))(corrected)
    np.testing.assert_allclose([frame.time_s for frame, _ in open_sequence(corrected)], np.array(NUMBERS) / 30)


def test_corrected_poses_win_over_scared_in_the_same_folder(corrected: Path) -> None:
    write_scared(corrected)
    frame_data(json_files(NUMBERS))(corrected)
    assert open_sequence(corrected).source.name == "scared-c"


def test_frames_that_archive_log_and_poses_do_not_share_are_left_out(corrected: Path) -> None:
    frame_data(json_files([1, 2, 7, 9]))(corrected)
    sequence = open_sequence(corrected)
    assert [frame.index for frame, _ in sequence] == [1, 2, 7]
    assert "5 pictures, but 4 frame_data files; the 3 frames that have both are used" in sequence.warnings[0]
    (corrected / "frame_log.json").unlink()
    (corrected / "data" / "frame_data.tar.gz").unlink()
    write_tar(corrected / "data" / "rgb_frames.tar.gz", picture_files([1, 2, 7]) | {"frame000008.png": b"no image"})
    sequence = open_sequence(corrected)
    assert [frame.index for frame, _ in sequence] == [1, 2, 7]
    assert "frame000008" in sequence.warnings[0]
    assert (len(list(sequence)), len(sequence.warnings)) == (3, 1), "a second walk warns no more"
    assert sequence.source.pose(1) is None
    assert sequence.source.truth(1).depth_mm is not None


# ---- refusals


def _log_of(text: str) -> Edit:
    return lambda keyframe: (keyframe / "frame_log.json").write_text(text)


def _nothing_decodes(keyframe: Path) -> None:
    write_tar(keyframe / "data" / "rgb_frames.tar.gz", {"frame000001.png": b""})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda k: write_stereo_video(k / "data" / "rgb.mp4", 1), "holds one frame, two are needed"),
        (lambda k: (k / "data/frame_data.tar.gz").write_bytes(b"no archive"), r"frame_data\.tar\.gz: .* is damaged"),
        (frame_data(json_files([70, 71])), "no picture has the number of a frame_data file"),
        # Some kB of archive, 8 MB of lists in a list: 300 MB once it is parsed.
        (frame_data(json_files(range(4), lambda n, e: e | {"timestamp": [[]] * 2_000_000} if n == 1 else e)),
         r"frame_data000001\.json: it holds \d+ MB, expected 1 MB at most"),
    ],
)  # fmt: skip
def test_what_scared_cannot_read_is_one_sentence(spoil: Edit, message: str, keyframe: Path) -> None:
    spoil(keyframe)
    with pytest.raises(ScopemapError, match=message) as caught:
        open_sequence(keyframe)
    assert "\n" not in str(caught.value)
    assert str(keyframe) in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_nothing_decodes, "none of the 5 images can be read"),
        (frame_data({"frame_data000050.json": json.dumps(frame_json(50)).encode()}), "no picture has the number of"),
        (_log_of("{"), r"cannot read included_frames in .*frame_log\.json"),
        (_log_of('{"included_frames": [Infinity]}'), "cannot read included_frames"),
        (_log_of('{"included_frames": []}'), "names no frame"),
        (lambda keyframe: (keyframe / "intrinsics_colmap.yaml").write_text("K: 3\n"), "no 3x3 camera matrix"),
        (lambda keyframe: (keyframe / "intrinsics_colmap.yaml").unlink(), r"intrinsics_colmap\.yaml is not there"),
    ],
)
def test_what_scared_c_cannot_read_is_one_sentence(spoil: Edit, message: str, corrected: Path) -> None:
    spoil(corrected)
    with pytest.raises(ScopemapError, match=message) as caught:
        open_sequence(corrected, dataset="scared-c")
    assert "\n" not in str(caught.value)
    assert str(corrected) in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"II*\0no tiff", "no image of 3"),
        (png(left_view(0)), "no image of 3"),
        (scene_points(0)[:3000], "scene points"),
        (cv2.imencode(".tiff", np.ones((HEIGHT, WIDTH - 10, 3), np.float32))[1].tobytes(), "54x48 px do not fit"),
    ],
)
def test_scene_points_that_are_none_are_refused(content: bytes, message: str, keyframe: Path) -> None:
    points({"scene_points000000.tiff": content})(keyframe)
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(keyframe).source.truth(0)
    assert "\n" not in str(caught.value)
