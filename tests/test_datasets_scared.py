"""SCARED keyframes: as downloaded, as others unpack them, and what is wrong with some."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_scared import (
    CAMERA,
    HEIGHT,
    PLANE,
    WIDTH,
    json_files,
    left_view,
    point_files,
    red_in,
    true_depth_mm,
    true_pose,
    write_loose,
    write_scared,
    write_stereo_calibration,
    write_stereo_video,
    write_tar,
)

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.cameras.lenses import OpenCvCamera
from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse, transform
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory
from scopemap.io.sequence import Sequence
from scopemap_bench.datasets.scared import ScaredKeyframe


@pytest.fixture(scope="module")
def downloaded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scared(tmp_path_factory.mktemp("scared") / "dataset_3" / "keyframe_4")


@pytest.fixture
def keyframe(downloaded: Path, tmp_path: Path) -> Path:
    return shutil.copytree(downloaded, tmp_path / "dataset_3" / "keyframe_4")


def off_the_plane_mm(sequence: Sequence, pose_of: Callable[[np.ndarray], np.ndarray]) -> float:
    """Largest distance of the truth's surface from the plane that was drawn, over all frames."""
    normal, distance_mm = PLANE
    worst = []
    for frame, truth in sequence:
        points = transform(pose_of(truth.T_world_camera), frame.camera.rays * truth.depth_mm[..., None])
        worst.append(np.nanmax(np.abs(points @ normal - distance_mm)))
    return float(max(worst[1:]))


# ---- as downloaded


def test_a_keyframe_is_read_as_it_is_downloaded(downloaded: Path) -> None:
    before = sorted(downloaded.rglob("*"))
    sequence = open_sequence(downloaded)
    source = sequence.source
    assert (source.name, source.width, source.height, sequence.count) == ("scared", WIDTH, HEIGHT, 4)
    assert isinstance(sequence.rectifier.source, OpenCvCamera)
    np.testing.assert_allclose(sequence.rectifier.source.central.matrix, CAMERA.central.matrix)
    np.testing.assert_allclose(sequence.rectifier.source.distortion, CAMERA.distortion)
    assert sequence.camera_source == "calibration file endoscope_calibration.yaml beside the frames"
    for number, (frame, truth) in enumerate(sequence):
        assert frame.index == truth.index == number
        assert red_in(frame.rgb[frame.valid]) == number
        assert frame.rgb[..., 2].max() < 60, "the right view, blue, is not to be seen"
        np.testing.assert_allclose(truth.T_world_camera, true_pose(number), atol=1e-9)
        assert truth.quality == "kinematic"
    assert sequence.warnings == []
    assert sorted(downloaded.rglob("*")) == before, "nothing is unpacked"


def test_depth_is_the_left_views_z_and_holes_of_every_kind_are_unknown(downloaded: Path) -> None:
    depth_mm = open_sequence(downloaded).source.truth(2).depth_mm
    assert depth_mm.dtype == np.float32
    assert np.isnan(depth_mm[:, :4]).all()
    np.testing.assert_allclose(depth_mm[:, 4:], true_depth_mm(true_pose(2))[:, 4:], rtol=1e-6)


def test_poses_and_points_agree_through_the_rectification(downloaded: Path) -> None:
    """The camera moves and turns: a pose that is not inverted puts the surface elsewhere."""
    sequence = open_sequence(downloaded)
    assert off_the_plane_mm(sequence, lambda T_world_camera: T_world_camera) < 0.3
    assert off_the_plane_mm(sequence, inverse) > 3
    for frame, truth in sequence:
        expected = true_depth_mm(true_pose(frame.index), frame.camera)
        half_a_pixel = 0.6 * np.abs(np.gradient(expected)).sum(0)
        assert np.all((np.abs(truth.depth_mm - expected) <= half_a_pixel) | np.isnan(truth.depth_mm))
        assert np.isfinite(truth.depth_mm).mean() > 0.8


@pytest.mark.parametrize("selection", [slice(1, 3), slice(None, None, 2), slice(-1, None), slice(3, 9)])
def test_selections_are_python_slices(selection: slice, downloaded: Path) -> None:
    source = ScaredKeyframe(downloaded)
    expected = list(range(4))[selection]
    frames = list(source.frames(selection))
    assert [frame.index for frame in frames] == [red_in(frame.rgb) for frame in frames] == expected
    assert source.stamps(selection) == [(frame.index, frame.time_s) for frame in frames]


# ---- copies


def _unpacked(keyframe: Path) -> None:
    for name in ("frame_data", "scene_points"):
        (keyframe / "data" / f"{name}.tar.gz").unlink()
    write_loose(keyframe / "data" / "frame_data", json_files(range(4)))
    write_loose(keyframe / "data" / "scene_points", point_files(range(4)))


def _plain_tar(keyframe: Path) -> None:
    for name, files in (("frame_data", json_files(range(4))), ("scene_points", point_files(range(4)))):
        (keyframe / "data" / f"{name}.tar.gz").unlink()
        write_tar(keyframe / "data" / f"{name}.tar", {f"./{name}/{file}": data for file, data in files.items()})


def _video_beside(keyframe: Path) -> None:
    (keyframe / "data" / "rgb.mp4").rename(keyframe / "rgb.mp4")


def _images_of_one(place: str) -> Callable[[Path], None]:
    """Copies with the left views as images, which count from 1."""

    def change(keyframe: Path) -> None:
        (keyframe / "data" / "rgb.mp4").unlink()
        pictures = {n + 1: cv2.imencode(".png", left_view(n)[..., ::-1])[1].tobytes() for n in range(4)}
        write_loose(keyframe / place, {f"{n:010d}.png": content for n, content in pictures.items()})

    return change


def _other_names(keyframe: Path) -> None:
    (keyframe / "endoscope_calibration.yaml").rename(keyframe / "camera_calibration.yaml")
    for name in ("frame_data", "scene_points"):
        (keyframe / "data" / f"{name}.tar.gz").rename(keyframe / "data" / f"{name}.tgz")


def _unpacked_for_learning(keyframe: Path) -> None:
    _unpacked(keyframe)
    _images_of_one("image_02/data")(keyframe)
    (keyframe / "data" / "frame_data").rename(keyframe / "image_02" / "data" / "frame_data")
    (keyframe / "data" / "scene_points").rename(keyframe / "image_02" / "data" / "groundtruth")


@pytest.mark.parametrize(
    "change",
    [_unpacked, _plain_tar, _video_beside, _other_names, _images_of_one("left"), _unpacked_for_learning],
)
def test_other_copies_say_the_same(change: Callable[[Path], None], keyframe: Path) -> None:
    change(keyframe)
    sequence = open_sequence(keyframe)
    assert sequence.source.name == "scared"
    np.testing.assert_allclose(sequence.rectifier.source.distortion, CAMERA.distortion)
    pairs = list(sequence)
    assert [red_in(frame.rgb[frame.valid]) for frame, _ in pairs] == [frame.index for frame, _ in pairs] == [0, 1, 2, 3]
    for frame, truth in pairs:
        np.testing.assert_allclose(truth.T_world_camera, true_pose(frame.index), atol=1e-9)
    np.testing.assert_allclose(sequence.source.truth(3).depth_mm[:, 4:], true_depth_mm(true_pose(3))[:, 4:], rtol=1e-6)
    assert sequence.warnings == []


@pytest.mark.parametrize(
    "inner", ["dataset8/keyframe0", "dataset_8/keyframe_0", "dataset_8/dataset_8/keyframe_0", "dataset8_keyframe0"]
)
def test_a_test_keyframe_has_a_video_and_no_truth(inner: str, tmp_path: Path) -> None:
    folder = tmp_path / inner
    write_stereo_calibration(folder / "endoscope_calibration.yaml")
    write_stereo_video(folder / "rgb.mp4", 3)
    sequence = open_sequence(tmp_path)
    assert sequence.path == folder
    pairs = list(sequence)
    assert [frame.index for frame, _ in pairs] == [0, 1, 2]
    assert all(truth is None for _, truth in pairs)
    assert reference_trajectory(sequence) is None
    assert any("no pose is known" in note for note in sequence.notes)


def test_the_data_folder_means_its_keyframe(downloaded: Path) -> None:
    assert open_sequence(downloaded / "data").path == downloaded


def test_several_keyframes_are_named(downloaded: Path, tmp_path: Path) -> None:
    for name in ("keyframe_1", "keyframe_2"):
        shutil.copytree(downloaded, tmp_path / "dataset_1" / name)
    with pytest.raises(InputError, match=r"holds 2 sequences \(dataset_1/keyframe_1, dataset_1/keyframe_2\)"):
        open_sequence(tmp_path)
    shutil.rmtree(tmp_path / "dataset_1" / "keyframe_2")
    (tmp_path / "notes").mkdir()
    (tmp_path / "__MACOSX").mkdir()
    assert open_sequence(tmp_path).path == tmp_path / "dataset_1" / "keyframe_1"


def test_a_calibration_beside_the_frames_wins_with_its_scale(keyframe: Path) -> None:
    write_calibration(PinholeCamera(70.0, 70.0, 5.0, 5.0, WIDTH, HEIGHT), keyframe / "camera.yaml", depth_scale_mm=2.0)
    sequence = open_sequence(keyframe)
    assert sequence.camera.cx == 5.0
    expected = 2 * true_depth_mm(true_pose(1))[:, 4:]
    np.testing.assert_allclose(sequence.source.truth(1).depth_mm[:, 4:], expected, rtol=1e-6)


def test_a_data_set_can_be_named_but_must_be_known(downloaded: Path) -> None:
    assert open_sequence(downloaded, dataset="scared").source.name == "scared"
    with pytest.raises(InputError, match="unknown data set 'scored': choose one of scared-c, scared, "):
        open_sequence(downloaded, dataset="scored")
    with pytest.raises(InputError, match="no SCARED-C keyframe"):
        open_sequence(downloaded, dataset="scared-c")


def test_json_is_the_only_thing_needed_for_poses(keyframe: Path) -> None:
    (keyframe / "data" / "scene_points.tar.gz").unlink()
    truths = [truth for _, truth in open_sequence(keyframe)]
    assert all(truth.depth_mm is None for truth in truths)
    np.testing.assert_allclose(truths[3].T_world_camera, true_pose(3), atol=1e-9)
