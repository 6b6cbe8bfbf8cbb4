"""StereoMIS: the left view of stacked stereo video, with poses by the robot's kinematics."""

from __future__ import annotations

import shutil
from pathlib import Path

import av
import numpy as np
import pytest
from drawn_inputs import number_in, picture, save

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.cameras.lenses import OpenCvCamera
from scopemap.errors import InputError
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory
from scopemap_bench.datasets.stereomis import StereoMisFolder

SIZE = (160, 128)
FRAMES = 6
LENS = (-0.3, 0.1, 1e-3, -2e-3, 0.02, 0.01, -0.01, 0.005)
# A quarter turn to the left about the optical axis: the camera's x is the world's y. Then half a turn about x.
QUATERNIONS = [(0, 0, np.sqrt(0.5), np.sqrt(0.5)), (1, 0, 0, 0)]
ROTATIONS = [[[0, -1, 0], [1, 0, 0], [0, 0, 1]], [[1, 0, 0], [0, -1, 0], [0, 0, -1]]]


def write_frames(file: Path, images: list[np.ndarray], rate: int = 25) -> Path:
    """Write images (h, w, 3) of one size as a video in which every picture stands for itself."""
    height, width = images[0].shape[:2]
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = width, height, "yuv420p", 1
        stream.bit_rate = 4_000_000
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return file


def write_ini(file: Path, **changed: object) -> None:
    left = {"res_x": SIZE[0], "res_y": SIZE[1], "fc_x": 130.5, "fc_y": 131.5, "cc_x": 81.25, "cc_y": 62.75}
    left |= {f"kc_{i}": k for i, k in enumerate(LENS)}
    right = {**left, "fc_x": 999, **{f"R_{i}": int(i % 4 == 0) for i in range(9)}, "T_0": -4.1, "T_1": 0, "T_2": 0}
    left |= changed
    sections = (("StereoLeft", left), ("StereoRight", right))
    lines = [f"[{name}]\n" + "".join(f"{key}={value}\n" for key, value in keys.items()) for name, keys in sections]
    file.write_text("".join(lines))


def row(frame: int) -> list[float]:
    return [0.001 * frame, -0.02, 0.05 + 0.002 * frame, *QUATERNIONS[frame % 2]]


def expected_pose(frame: int) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = ROTATIONS[frame % 2]
    T_world_camera[:3, 3] = [frame, -20, 50 + 2 * frame]
    return T_world_camera


def write_poses(file: Path, first: int = 0, frames: int = FRAMES, separator: str = " ", numbered: bool = True) -> None:
    rows = [[*([first + i] if numbered else []), *row(i)] for i in range(frames)]
    file.write_text("".join(separator.join(f"{value:.9g}" for value in values) + "\n" for values in rows))


def write_stereomis(folder: Path, stacking: int = 0) -> Path:
    """Write a recording of six frames; `stacking` 0: left above right, 1: left beside right."""
    folder.mkdir(parents=True)
    pairs = [(picture(i, SIZE), picture(30 - i, SIZE)) for i in range(FRAMES)]
    write_frames(folder / "endoscope_part0001.mp4", [np.concatenate(pair, axis=stacking) for pair in pairs])
    write_ini(folder / "StereoCalibration.ini")
    write_poses(folder / "groundtruth.txt")
    (folder / "masks").mkdir()
    for i in range(FRAMES):
        save(folder / "masks" / f"{i + 1:06d}l.png", np.full((SIZE[1] // 2, SIZE[0] // 2, 3), 255, np.uint8))
    (folder / "test_split.csv").write_text("start,end\n0,5\n")
    return folder


def test_a_recording(tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P2_0")
    sequence = open_sequence(folder)
    assert (sequence.source.name, sequence.name, sequence.count) == ("stereomis", "P2_0", FRAMES)
    assert (sequence.source.width, sequence.source.height) == SIZE
    assert sequence.calibrated
    assert sequence.source.camera == OpenCvCamera(PinholeCamera(130.5, 131.5, 81.25, 62.75, *SIZE), LENS)
    raw = list(sequence.source.frames(slice(None)))
    assert [number_in(frame.rgb) for frame in raw] == [frame.index for frame in raw] == list(range(FRAMES))
    np.testing.assert_allclose([frame.time_s for frame in raw], np.arange(FRAMES) / 25)
    for frame, truth in sequence:
        np.testing.assert_allclose(truth.T_world_camera, expected_pose(frame.index), atol=1e-6)
        assert (truth.depth_mm, truth.quality) == (None, "kinematic")
    assert sequence.warnings == []
    assert any("groundtruth.txt taken as camera-to-world in metres" in note for note in sequence.notes)
    assert any("left, the upper half" in note for note in sequence.notes)


def test_the_reference_is_known_without_decoding(tmp_path: Path) -> None:
    sequence = open_sequence(write_stereomis(tmp_path / "P1"), frames=slice(1, None, 2))
    reference = reference_trajectory(sequence)
    assert reference is not None
    np.testing.assert_array_equal(reference.indices, [1, 3, 5])
    np.testing.assert_allclose(reference.times_s, [1 / 25, 3 / 25, 5 / 25])
    np.testing.assert_allclose(reference.positions_mm, [[i, -20, 50 + 2 * i] for i in (1, 3, 5)], atol=1e-6)
    assert [(frame.index, number_in(frame.rgb)) for frame in sequence.source.frames(slice(1, 4))] == [
        *((1, 1), (2, 2), (3, 3))
    ]


def test_it_is_found_one_folder_up_and_in_a_folder_of_its_own_name(tmp_path: Path) -> None:
    root = tmp_path / "StereoMIS_0_0_1" / "StereoMIS_0_0_1"
    folder = write_stereomis(root / "P1")
    (root / "sequences.txt").write_text("P1\n")
    for path in (root, root.parent, tmp_path):
        assert open_sequence(path).path == folder
    shutil.copytree(folder, root / "P3")
    with pytest.raises(InputError, match=r"holds 2 sequences \(P1, P3\)"):
        open_sequence(root)


def test_masks_are_the_other_way_round_and_are_not_used(tmp_path: Path) -> None:
    sequence = open_sequence(write_stereomis(tmp_path / "P1"))
    assert sequence.source.masks is None
    assert any("masks/ is not used: 0 is where instruments are" in note for note in sequence.notes)


def test_views_beside_each_other_and_a_single_one(tmp_path: Path) -> None:
    sequence = open_sequence(write_stereomis(tmp_path / "P1", stacking=1))
    assert (sequence.source.width, sequence.source.height) == SIZE
    assert any("left, the left half" in note for note in sequence.notes)
    assert [number_in(frame.rgb) for frame in sequence.source.frames(slice(None))] == list(range(FRAMES))
    video = next((tmp_path / "P1").glob("*.mp4"))
    write_frames(video, [picture(i, SIZE) for i in range(FRAMES)])
    sequence = open_sequence(tmp_path / "P1")
    assert (sequence.source.width, sequence.source.height) == SIZE
    assert any("the whole image" in note for note in sequence.notes)


def test_the_calibration_is_brought_to_the_size_of_the_view_and_ones_own_wins(tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    write_ini(folder / "StereoCalibration.ini", res_x=320, res_y=256, fc_x=261, fc_y=263, cc_x=163, cc_y=126)
    sequence = open_sequence(folder)
    # Half the size: a centre c moves to (c + 0.5) / 2 - 0.5.
    assert sequence.source.camera.central == PinholeCamera(130.5, 131.5, 81.25, 62.75, *SIZE)
    assert "rescaled from 320x256 px" in sequence.camera_source
    write_calibration(PinholeCamera(140.0, 140.0, 80.0, 64.0, *SIZE), folder / "camera.yaml")
    assert open_sequence(folder).source.camera == PinholeCamera(140.0, 140.0, 80.0, 64.0, *SIZE)


@pytest.mark.parametrize(
    ("first", "separator"),
    [(0, ","), (1, " "), (1, "\t")],
)
def test_every_form_of_the_poses(first: int, separator: str, tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    write_poses(folder / "groundtruth.txt", first, FRAMES, separator)
    (folder / "groundtruth.txt").write_text("# a comment\n\n" + (folder / "groundtruth.txt").read_text())
    source = open_sequence(folder).source
    for i in range(FRAMES):
        np.testing.assert_allclose(source.pose(i), expected_pose(i), atol=1e-6)
    assert source.pose(FRAMES) is None


def test_frames_without_a_pose(tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    kept = [lines[4], lines[0], "1 nan nan nan nan nan nan nan", lines[2].replace("0.002", "inf"), lines[3]]
    (folder / "groundtruth.txt").write_text("\n".join(kept))
    sequence = open_sequence(folder)
    assert [truth is not None for _, truth in sequence] == [True, False, False, True, True, False]
    np.testing.assert_array_equal(reference_trajectory(sequence).indices, [0, 3, 4])
    np.testing.assert_allclose(sequence.source.pose(4), expected_pose(4), atol=1e-6)


def test_without_poses_it_is_a_video(tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    (folder / "groundtruth.txt").unlink()
    sequence = open_sequence(folder)
    assert reference_trajectory(sequence) is None
    assert all(truth is None for _, truth in sequence)
    assert any("no pose is known" in note for note in sequence.notes)


def test_poses_that_do_not_fit_the_video_are_told(tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    write_poses(folder / "groundtruth.txt", frames=FRAMES + 2)
    assert any(f"2 of {FRAMES + 2} poses are of frames beyond" in warning for warning in open_sequence(folder).warnings)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no pose"),
        ("# only this\n", "holds no pose"),
        ("0 1 2 3\n", "line 1: found 4 numbers where frame tx ty tz"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 1\n", "line 2: found 7 numbers where earlier lines have 8"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 x\n", "line 2: expected numbers"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 0\n", "line 2: the quaternion has length 0"),
        ("0 0 0 0 0 0 0 1\n\n0 0 0 0 0 0 0 1\n", "line 3: the time stamp of an earlier line comes again"),
        ("0.5 0 0 0 0 0 0 1\n", "must be frame numbers"),
        ("nan 0 0 0 0 0 0 1\n", "must be frame numbers"),
        ("-1 0 0 0 0 0 0 1\n", "must be frame numbers"),
        (b"\xff\xfe\x00", "cannot read"),
    ],
)
def test_poses_that_are_none_are_one_sentence(text: str | bytes, message: str, tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    (folder / "groundtruth.txt").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(folder)
    assert "\n" not in str(caught.value)


def test_one_video_is_wanted_and_readable(tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    shutil.copy(folder / "endoscope_part0001.mp4", folder / "endoscope_part0002.mp4")
    with pytest.raises(
        InputError, match=r"holds one video, found 2 \(endoscope_part0001\.mp4, endoscope_part0002\.mp4"
    ):
        open_sequence(folder)
    (folder / "endoscope_part0002.mp4").unlink()
    (folder / "endoscope_part0001.mp4").write_bytes(b"not a video")
    with pytest.raises(InputError, match="reading the video"):
        open_sequence(folder)
    (folder / "endoscope_part0001.mp4").unlink()
    with pytest.raises(InputError, match=r"P1: a folder of stereomis holds one video, found 0 \(none\)"):
        StereoMisFolder(folder)


def test_without_its_calibration_the_camera_is_assumed(tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    (folder / "StereoCalibration.ini").unlink()
    (folder / "masks").rename(folder / ".masks")
    sequence = open_sequence(folder, dataset="stereomis")
    assert not sequence.calibrated
    assert (sequence.source.width, sequence.source.height) == SIZE
    assert any("field of view" in note for note in sequence.notes)
