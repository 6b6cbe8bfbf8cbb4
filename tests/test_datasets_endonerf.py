"""EndoNeRF: poses and camera in LLFF's file, stereo depth of 8 and 16 bit, the data set's own instrument masks."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_inputs import number_in, picture, save

from scopemap.config import MaskSettings
from scopemap.config.input import MaskAdvanced
from scopemap.errors import CalibrationError, InputError
from scopemap.geometry.se3 import se3_exp
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory
from scopemap.masking.mask_files import create_masks

SIZE = (80, 64)
FOCAL_PX = 71.25
MATRIX = [[FOCAL_PX, 0, 39.5], [0, FOCAL_PX, 31.5], [0, 0, 1]]
NUMBERS = [0, 1, 2, 9, 10]


def llff(poses: np.ndarray, height: float = 64, width: float = 80, focal_px: float = FOCAL_PX) -> np.ndarray:
    """Rows of LLFF: 3x5 with height, width, focal length as its last column, then near and far."""
    motions = [np.hstack([T[:3, :4], [[height], [width], [focal_px]]]).ravel() for T in poses]
    return np.array([np.append(motion, [0, 105]) for motion in motions])


def at_rest(count: int = len(NUMBERS)) -> np.ndarray:
    return np.tile(np.eye(4), (count, 1, 1))


def moving() -> np.ndarray:
    """Camera-to-world from the identity on, turning and moving."""
    return np.stack([se3_exp(i * np.array([0.01, -0.05, 0.1, 2.0, -1.0, 0.5])) for i in range(len(NUMBERS))])


def depth_image(number: int) -> np.ndarray:
    """8 bit for even numbers, 16 for odd, each with its own value; the upper rows are unknown."""
    values = np.full((SIZE[1], SIZE[0]), 60 + number, np.uint16 if number % 2 else np.uint8)
    values[:12] = 0
    values[-8:] = 392 if number % 2 else 255
    return values


def mask_image(rows: int) -> np.ndarray:
    mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    mask[:rows] = 255
    return mask


def write_scene(folder: Path, rows: np.ndarray | None = None, name: str = "poses_bounds.npy") -> Path:
    for inner in ("images", "depth", "gt_masks", "masks"):
        (folder / inner).mkdir(parents=True, exist_ok=True)
    for number in NUMBERS:
        stem = f"frame-{number}"
        save(folder / "images" / f"{stem}.color.png", picture(number, SIZE))
        cv2.imwrite(str(folder / "depth" / f"{stem}.depth.png"), depth_image(number))
        cv2.imwrite(str(folder / "gt_masks" / f"{stem}.mask.png"), mask_image(10))
        cv2.imwrite(str(folder / "masks" / f"{stem}.mask.png"), mask_image(20))
    (folder / "masks" / "left_video.mp4").write_bytes(b"no mask")
    np.save(folder / name, llff(at_rest()) if rows is None else rows)
    return folder


# ---- what is there is read


@pytest.mark.parametrize("name", ["poses_bounds.npy", "pose_bounds.npy"])
def test_a_scene(name: str, tmp_path: Path) -> None:
    sequence = open_sequence(write_scene(tmp_path / "pulling", name=name))
    assert (sequence.source.name, sequence.count, sequence.calibrated) == ("endonerf", len(NUMBERS), True)
    np.testing.assert_allclose(sequence.camera.matrix, MATRIX, rtol=0, atol=1e-12)
    assert name in sequence.camera_source
    for (frame, truth), number in zip(sequence, NUMBERS, strict=True):
        assert frame.index == truth.index == number_in(frame.rgb) == number
        assert frame.time_s == pytest.approx(number / 30)
        assert truth.quality == "stereo"
        np.testing.assert_array_equal(truth.T_world_camera, np.eye(4))
        assert truth.depth_mm.dtype == np.float32
        assert np.isnan(truth.depth_mm[:12]).all()
        np.testing.assert_array_equal(truth.depth_mm[12:-8], 60 + number)
        np.testing.assert_array_equal(truth.depth_mm[-8:], 392 if number % 2 else 255)
    assert sequence.warnings == []
    told = " ".join(map(str, sequence.notes))
    assert all(words in told for words in ("camera is at rest", "stereo matching", "mm", "gt_masks"))


@pytest.mark.parametrize("outer", ["", "again", "__other__/again"])
def test_it_is_found_from_outside(outer: str, tmp_path: Path) -> None:
    folder = write_scene(tmp_path / outer / "cutting")
    assert open_sequence(tmp_path).path == folder


def test_a_folder_of_images_without_poses_is_no_scene(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "pulling")
    (folder / "poses_bounds.npy").unlink()
    assert open_sequence(folder).source.name == "images"
    with pytest.raises(InputError, match=r"no EndoNeRF scene, looked for poses_bounds\.npy and pose_bounds\.npy"):
        open_sequence(folder, dataset="endonerf")


def test_poses_that_start_at_the_identity_are_camera_to_world(tmp_path: Path) -> None:
    sequence = open_sequence(write_scene(tmp_path / "a", llff(moving())))
    reference = reference_trajectory(sequence)
    np.testing.assert_allclose(reference.T_world_camera, moving(), atol=1e-12)
    assert reference.indices.tolist() == NUMBERS
    assert any("as they are" in str(note) for note in sequence.notes)
    assert not any("at rest" in str(note) for note in sequence.notes)


def test_other_poses_are_in_the_axes_of_llff(tmp_path: Path) -> None:
    right, down, forward = np.array([0.0, -1, 0]), np.array([0.0, 0, -1]), np.array([1.0, 0, 0])
    rows = []
    for i in range(len(NUMBERS)):
        T = np.eye(4)
        T[:3] = np.column_stack([down, right, -forward, [10.0 * i, 2, 3]])
        rows.append(T)
    sequence = open_sequence(write_scene(tmp_path / "a", llff(np.stack(rows))))
    pose = sequence.source.pose(NUMBERS[3])
    np.testing.assert_allclose(pose, [[0, 0, 1, 30], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]], atol=1e-12)
    # A point 5 mm ahead of the camera lies 5 mm along the world's x.
    np.testing.assert_allclose((pose @ [0, 0, 5, 1])[:3], [35, 2, 3], atol=1e-12)
    assert any("down, right, back" in str(note) for note in sequence.notes)


def test_a_row_that_is_not_finite_is_a_frame_without_a_pose(tmp_path: Path) -> None:
    rows = llff(moving())
    rows[2, :4] = np.nan
    rows[3, 4] = np.nan  # the height, which is no part of the pose
    sequence = open_sequence(write_scene(tmp_path / "a", rows))
    assert [sequence.source.pose(number) is None for number in NUMBERS] == [False, False, True, False, False]
    np.testing.assert_allclose(sequence.source.pose(10), moving()[4], atol=1e-12)
    truth = sequence.source.truth(2)
    assert truth.T_world_camera is None
    assert truth.depth_mm[30, 30] == 62
    (tmp_path / "a" / "depth" / "frame-2.depth.png").unlink()
    assert open_sequence(tmp_path / "a").source.truth(2) is None


def test_no_finite_pose_is_said(tmp_path: Path) -> None:
    rows = llff(at_rest())
    rows[:, 3] = np.inf
    sequence = open_sequence(write_scene(tmp_path / "a", rows))
    assert reference_trajectory(sequence) is None
    assert any("no finite pose" in warning for warning in sequence.warnings)


def test_the_camera_of_larger_images_is_rescaled(tmp_path: Path) -> None:
    sequence = open_sequence(write_scene(tmp_path / "a", llff(at_rest(), 128, 160, 2 * FOCAL_PX)))
    np.testing.assert_allclose(sequence.camera.matrix, MATRIX, atol=1e-12)


# ---- masks


def test_instruments_are_masked_unasked(tmp_path: Path) -> None:
    sequence = open_sequence(write_scene(tmp_path / "a"))
    settings = MaskSettings(advanced=MaskAdvanced(files_grow_px=0))
    masks = create_masks(settings, sequence.rectifier, sequence.source.masks)
    np.testing.assert_array_equal(masks.covered(9), mask_image(10) > 0)


@pytest.mark.parametrize("emptied", [False, True])
def test_masks_with_the_holes_of_the_depth_are_not_used_unasked_and_said(emptied: bool, tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "a")
    shutil.rmtree(folder / "gt_masks")
    if emptied:
        (folder / "gt_masks").mkdir()
    sequence = open_sequence(folder)
    assert sequence.source.masks is None
    assert "masks (instruments and holes of the depth) is not used by default" in sequence.notes
    shutil.rmtree(folder / "masks")
    assert not any("masks" in str(note) for note in open_sequence(folder).notes)


def test_files_of_llff_alone_are_no_scene(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "a")
    shutil.rmtree(folder / "depth")
    assert open_sequence(folder).source.name == "endonerf"
    shutil.rmtree(folder / "gt_masks")
    assert open_sequence(folder).source.name == "images"
    assert open_sequence(folder, dataset="endonerf").source.name == "endonerf"


# ---- faults


def bytes_of(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda file: file.write_bytes(change(file.read_bytes())) and None


def stored(rows: np.ndarray) -> Callable[[Path], None]:
    return lambda file: np.save(file, rows, allow_pickle=True)


def archived(file: Path) -> None:
    with file.open("wb") as opened:
        np.savez(opened, rows=llff(at_rest()))


def mirrored() -> np.ndarray:
    poses = moving()
    poses[3, :3, 0] *= -1
    return llff(poses)


def scaled() -> np.ndarray:
    poses = moving()
    poses[1, :3, :3] *= 1.5
    return llff(poses)


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (bytes_of(lambda _: b""), InputError, "no NumPy array of numbers"),
        (bytes_of(lambda _: b"1 0 0 0 512\n"), InputError, "no NumPy array of numbers"),
        (bytes_of(lambda content: content[:200]), InputError, "no NumPy array of numbers"),
        (bytes_of(lambda content: content.replace(b"(5, 17)", b"(9**9, ")), InputError, "no NumPy array of numbers"),
        (bytes_of(lambda content: content.replace(b"(5, 17), }    ", b"(99999, 17), }")), InputError, "no NumPy array"),
        (archived, InputError, "it is an archive"),
        (stored(np.array([{"a": 1}], dtype=object)), InputError, "no NumPy array of numbers"),
        (stored(np.array([["a"] * 17] * 5)), InputError, "found <U1 of shape"),
        (
            stored(llff(at_rest())[:, :15]),
            InputError,
            r"expected LLFF's numbers of shape \(images, 17\), found float64",
        ),
        (stored(llff(at_rest()).ravel()), InputError, r"found float64 of shape \(85,\)"),
        (stored(np.zeros((0, 17))), CalibrationError, "found none"),
        (stored(mirrored()), InputError, r"row 3: not a rigid motion .* det R = -1"),
        (stored(scaled()), InputError, "row 1: not a rigid motion"),
        (stored(llff(moving())[:4]), InputError, "holds 4 rows for 5 images"),
        (stored(np.vstack([llff(at_rest(4)), llff(at_rest(1), focal_px=50)])), CalibrationError, "several cameras"),
        (stored(llff(at_rest(), focal_px=np.nan)), CalibrationError, "found none"),
        (stored(llff(at_rest(), focal_px=0)), CalibrationError, "width 80, focal length 0"),
        (stored(llff(at_rest(), focal_px=1e4)), CalibrationError, r"focal length 10000; .*camera\.yaml"),
        (stored(llff(at_rest(), 80, 64)), CalibrationError, "is for 64x80 px, but the images are 80x64 px"),
    ],
)
def test_a_bad_file_of_poses_is_one_sentence(
    spoil: Callable[[Path], None], error: type[Exception], message: str, tmp_path: Path
) -> None:
    folder = write_scene(tmp_path / "a")
    spoil(folder / "poses_bounds.npy")
    with pytest.raises(error, match=message) as caught:
        open_sequence(folder)
    assert "poses_bounds.npy" in str(caught.value)


def test_two_depth_files_for_one_frame_are_refused(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "a")
    cv2.imwrite(str(folder / "depth" / "coloured-009.png"), depth_image(1))
    with pytest.raises(InputError, match=r"coloured-009\.png and frame-9\.depth\.png have the same number"):
        open_sequence(folder)


@pytest.mark.parametrize("values", [picture(3, SIZE), np.zeros((64, 80), np.float32), None])
def test_depth_that_is_none_is_refused(values: np.ndarray | None, tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "a")
    file = folder / "depth" / "frame-2.depth.png"
    if values is None:
        file.write_bytes(file.read_bytes()[:40])
    else:
        file.unlink()
        cv2.imwrite(str(file.with_suffix(".tiff")), values)
    with pytest.raises(InputError, match=r"frame-2\.depth\.\w+: expected a depth image of one 8- or 16-bit channel"):
        open_sequence(folder).source.truth(2)


# ---- the real thing


@pytest.mark.real
def test_real_scene(real_data: Path) -> None:
    folder = real_data / "endoscopy" / "endonerf" / "pulling_soft_tissues"
    sequence = open_sequence(folder, size=(640, 512))
    assert (sequence.source.name, sequence.count, sequence.source.masks) == ("endonerf", 63, folder / "gt_masks")
    np.testing.assert_allclose(sequence.camera.matrix, [[569.468, 0, 319.5], [0, 569.468, 255.5], [0, 0, 1]], atol=1e-3)
    masks = create_masks(MaskSettings(advanced=MaskAdvanced(files_grow_px=0)), sequence.rectifier, folder / "gt_masks")
    types = set()
    for frame, truth in sequence:
        stored_depth = cv2.imread(str(folder / "depth" / f"frame-{frame.index:06d}.depth.png"), cv2.IMREAD_UNCHANGED)
        types.add(stored_depth.dtype)
        np.testing.assert_array_equal(np.nan_to_num(truth.depth_mm), stored_depth)
        np.testing.assert_array_equal(truth.T_world_camera, np.eye(4))
        assert 60 < np.nanmedian(truth.depth_mm) < 75
        # Stereo has no depth under an instrument: the masks belong to these frames, and are of this polarity.
        instrument = masks.covered(frame.index)
        assert 0.1 < instrument.mean() < 0.4
        assert np.isnan(truth.depth_mm[instrument]).all()
    assert types == {np.dtype(np.uint8), np.dtype(np.uint16)}
    assert sequence.warnings == []
