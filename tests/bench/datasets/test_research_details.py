"""What is peculiar to one research data set of pictures: forms of its poses, its cameras, masks, places and copies."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import se3_exp
from scopemap.input.mask_files import MaskFiles
from scopemap.input.opening import open_sequence
from scopemap.input.trajectory.text import read_poses
from scopemap.result.reference import reference_trajectory
from scopemap_bench.datasets.c3vd import CAMERA
from scopemap_bench.datasets.tum import associated
from tests.support.drawn_image_sets import (
    HAMLYN_K,
    ONESLAM_NUMBERS,
    P1,
    ROOM,
    SCENE_NUMBERS,
    SQUARE,
    STAMPS,
    STATED,
    TUM_TURN,
    UNITY_K,
    at_rest,
    calibration_json,
    levels,
    llff,
    replace_line,
    write_endogslam,
    write_endonerf,
    write_experiment,
    write_image,
    write_images,
    write_json,
    write_oneslam,
    write_picture,
    write_simcol,
    write_tracking,
    write_tum,
    write_v2,
)
from tests.support.drawn_inputs import SIZE, frames_of, number_in, poses, save, write_c3vd

# ---- C3VD


@pytest.mark.parametrize(("transposed", "name"), [(False, "{}_color.png"), (True, "{:04d}_color.png")])
def test_c3vds_poses_are_read_row_major_or_transposed(transposed: bool, name: str, tmp_path: Path) -> None:
    source = open_sequence(write_c3vd(tmp_path / "c", 11, transposed, name)).source
    np.testing.assert_allclose([source.pose(n) for n in source.numbers], poses(11), atol=1e-6)
    rotation = se3_exp(np.array([0.3, -0.2, 0.5, 0, 0, 0]))
    (tmp_path / "pose.txt").write_text(",".join(str(x) for x in rotation.T.ravel()))
    np.testing.assert_allclose(read_poses(tmp_path / "pose.txt")[0], rotation)


@pytest.mark.parametrize("name", ["{}_color.png", "{:04d}.png"])
def test_names_of_endogslams_copy(name: str, tmp_path: Path) -> None:
    source = open_sequence(write_endogslam(tmp_path / "c", name)).source
    assert [number_in(frame.rgb) for frame in source.frames(slice(None))] == list(range(11))
    assert source.truth(10).depth_mm[54, 67] == pytest.approx(40)


def test_c3vds_folders_with_depth_of_16_bit_keep_the_lens_and_need_none(tmp_path: Path) -> None:
    folder = write_endogslam(tmp_path / "c")
    for file in (folder / "depth").iterdir():
        write_image(file, levels(np.uint16, 32768, 65535, SIZE))
    source = open_sequence(folder).source
    assert source.camera == CAMERA.resized(*SIZE)
    assert source.truth(3).depth_mm[54, 67] == pytest.approx(32768 / 655.35)
    shutil.rmtree(write_v2(tmp_path / "v4") / "depth")
    source = open_sequence(tmp_path / "v4").source
    assert source.truth(5).depth_mm is None
    np.testing.assert_allclose(source.pose(5), poses(11)[5], atol=1e-6)


def test_c3vds_flat_folder_is_read_even_beside_other_folders(tmp_path: Path) -> None:
    folder = write_c3vd(tmp_path / "c")
    write_picture(folder / "rgb" / "0.png", 9)
    assert open_sequence(folder).count == 11


# ---- Hamlyn


@pytest.mark.parametrize(
    "place",
    [
        "rectified01/intrinsics.txt",
        "calibration/rectified01/intrinsics.txt",
        "../calibration/rectified01/intrinsics.txt",
        "intrinsics_rectified01.txt",
    ],
)
def test_hamlyns_intrinsics_are_looked_for_in_every_place(place: str, tmp_path: Path) -> None:
    root = tmp_path / "sets" / "hamlyn"
    folder = write_images(root / "rectified01", [0, 1])
    file = root / place
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(file, np.hstack([HAMLYN_K, np.zeros((3, 1))]))
    np.testing.assert_allclose(open_sequence(folder).camera.matrix, HAMLYN_K)


def test_other_names_are_not_taken_for_a_tracking_sequence(tmp_path: Path) -> None:
    folder = write_tracking(tmp_path / "test1")
    for file in (folder / "color").iterdir():
        file.rename(file.with_stem(f"a{file.stem}"))
    with pytest.raises(InputError, match="there is no image"):
        open_sequence(folder)


# ---- EndoNeRF


def moving() -> np.ndarray:
    return np.stack([se3_exp(i * np.array([0.01, -0.05, 0.1, 2.0, -1.0, 0.5])) for i in range(len(SCENE_NUMBERS))])


def test_poses_that_start_at_the_identity_are_camera_to_world_and_may_be_missing(tmp_path: Path) -> None:
    rows = llff(moving())
    rows[2, :4] = np.nan
    rows[3, 4] = np.nan  # the height, which is no part of the pose
    sequence = open_sequence(write_endonerf(tmp_path / "a", rows, name="pose_bounds.npy"))
    reference = reference_trajectory(sequence)
    assert reference.indices.tolist() == [n for n in SCENE_NUMBERS if n != 2]
    np.testing.assert_allclose(reference.T_world_camera, np.delete(moving(), 2, axis=0), atol=1e-12)
    assert sequence.source.truth(2).depth_mm[30, 30] == 62
    assert any("as they are" in str(note) for note in sequence.notes)
    assert not any("at rest" in str(note) for note in sequence.notes)
    assert not sequence.source.camera_at_rest
    assert open_sequence(write_endonerf(tmp_path / "still")).source.camera_at_rest
    rows[:, 3] = np.inf
    np.save(sequence.path / "pose_bounds.npy", rows)
    assert any("no finite pose" in warning for warning in open_sequence(sequence.path).warnings)


def test_other_poses_are_in_the_axes_of_llff(tmp_path: Path) -> None:
    right, down, forward = np.array([0.0, -1, 0]), np.array([0.0, 0, -1]), np.array([1.0, 0, 0])
    rows = at_rest()
    rows[:, :3] = [np.column_stack([down, right, -forward, [10.0 * i, 2, 3]]) for i in range(len(rows))]
    pose = open_sequence(write_endonerf(tmp_path / "a", llff(rows))).source.pose(SCENE_NUMBERS[3])
    np.testing.assert_allclose(pose, [[0, 0, 1, 30], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]], atol=1e-12)
    # A point 5 mm ahead of the camera is 5 mm along the world's x.
    np.testing.assert_allclose((pose @ [0, 0, 5, 1])[:3], [35, 2, 3], atol=1e-12)


def test_instruments_are_masked_unless_the_masks_hold_holes_of_the_depth(tmp_path: Path) -> None:
    folder = write_endonerf(tmp_path / "a")
    sequence = open_sequence(folder)
    covered = MaskFiles(sequence.source.masks, sequence.rectifier).covered(9)
    np.testing.assert_array_equal(covered, np.broadcast_to(np.arange(64)[:, None] < 10, (64, 80)))
    shutil.rmtree(folder / "gt_masks")
    sequence = open_sequence(folder)
    assert sequence.source.masks is None
    assert "masks (instruments and holes of the depth) is not used by default" in sequence.notes


def test_files_of_llff_alone_are_no_scene(tmp_path: Path) -> None:
    folder = write_endonerf(tmp_path / "a")
    shutil.rmtree(folder / "depth")
    assert open_sequence(folder).source.name == "endonerf"
    shutil.rmtree(folder / "gt_masks")
    assert open_sequence(folder).source.name == "images"
    (folder / "poses_bounds.npy").unlink()
    with pytest.raises(InputError, match=r"no EndoNeRF scene, looked for poses_bounds\.npy and pose_bounds\.npy"):
        open_sequence(folder, dataset="endonerf")


@pytest.mark.real
def test_real_scene_of_endonerf(real_data: Path) -> None:
    folder = real_data / "endoscopy" / "endonerf" / "pulling_soft_tissues"
    sequence = open_sequence(folder, size=(640, 512))
    assert (sequence.source.name, sequence.count, sequence.source.masks) == ("endonerf", 63, folder / "gt_masks")
    np.testing.assert_allclose(sequence.camera.matrix, [[569.468, 0, 319.5], [0, 569.468, 255.5], [0, 0, 1]], atol=1e-3)
    masks = MaskFiles(folder / "gt_masks", sequence.rectifier)
    for frame, truth in sequence:
        stored = cv2.imread(str(folder / "depth" / f"frame-{frame.index:06d}.depth.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(np.nan_to_num(truth.depth_mm), stored)
        np.testing.assert_array_equal(truth.T_world_camera, np.eye(4))
        # Stereo has no depth under an instrument: the masks belong to these frames, and are of this polarity.
        instrument = masks.covered(frame.index)
        assert 0.1 < instrument.mean() < 0.4
        assert np.isnan(truth.depth_mm[instrument]).all()


# ---- SERV-CT


def test_ct_is_preferred_and_what_it_does_not_hold_is_unknown(tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / "Experiment_2", truth="Reference_CT")
    write_experiment(folder, truth="Ground_truth_RGB")
    for file in (folder / "Ground_truth_RGB" / "DepthL").iterdir():
        write_image(file, np.full((64, 80), 256 * 7, np.uint16))
    (folder / "Reference_CT" / "OcclusionL" / "011.png").unlink()
    source = open_sequence(folder).source
    assert source.truth(9).depth_mm[30, 30] == 59.25
    assert np.isnan(source.truth(9).depth_mm[30, 60:]).all()
    np.testing.assert_array_equal(source.truth(11).depth_mm[30], 61.25)
    shutil.rmtree(folder / "Reference_CT")
    source = open_sequence(folder).source
    assert source.truth(9).depth_mm[30, 30] == 7.0
    assert any("structured light" in note for note in source.notes)
    shutil.rmtree(folder / "Ground_truth_RGB")
    assert open_sequence(folder).source.truth(9) is None
    shutil.rmtree(folder / "Rectified_calibration")
    assert open_sequence(folder / "Left_rectified").source.name == "images"


def test_pictures_of_another_camera_are_brought_to_that_of_the_first(tmp_path: Path) -> None:
    """Points are where the first camera sees them, in picture and depth alike; their depth stays what it is."""
    folder = write_experiment(tmp_path / "Experiment_1")
    other = np.array(P1)
    other[:2, :3] = [[105.0, 0, 33.0], [0, 106.0, 27.0]]
    (folder / "Rectified_calibration" / "010.json").write_text(calibration_json(other.tolist()))
    points = np.array([[-10.0, -5, 60], [5, 8, 70], [12, -9, 55]])
    rgb, depth = np.full((64, 80, 3), 60, np.uint8), np.full((64, 80), 30 * 256, np.uint16)
    for point in points:
        u, v, _ = np.rint(other[:, :3] @ point / point[2]).astype(int)
        rgb[v - 1 : v + 2, u - 1 : u + 2] = 250
        depth[v - 1 : v + 2, u - 1 : u + 2] = point[2] * 256
    save(folder / "Left_rectified" / "010.png", rgb)
    write_image(folder / "Ground_truth_CT" / "DepthL" / "010.png", depth)
    sequence = open_sequence(folder)
    (before, _), (frame, truth), (after, _) = sequence
    for point in points:
        u, v, _ = np.rint(np.array(P1)[:, :3] @ point / point[2]).astype(int)
        assert frame.rgb[v, u].min() > 180
        assert truth.depth_mm[v, u] == point[2]
    # The first camera sees 12 px further to the left (33.5 / 105 against 41.75 / 90.5): the other knows nothing there.
    assert np.isnan(truth.depth_mm[:, :12]).all()
    assert np.isfinite(truth.depth_mm[20:50, 14:50]).all()
    assert (number_in(before.rgb), number_in(after.rgb)) == (9, 11)
    assert any("1 pictures of other cameras" in note for note in sequence.notes)


# ---- TUM


@pytest.mark.parametrize(
    ("name", "expected", "distortion"),
    [
        ("rgbd_dataset_freiburg1_xyz", [51.73, 51.65, 31.41, 25.08], (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
        ("rgbd_dataset_freiburg2_desk", [52.09, 52.10, 32.06, 24.52], (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
        (f"{ROOM}/sequence", [53.54, 53.92, 31.56, 24.31], None),
        ("frame4_phantom", None, None),
    ],
)
def test_the_published_cameras_of_tum(
    name: str, expected: list[float] | None, distortion: tuple[float, ...] | None, tmp_path: Path
) -> None:
    """At a tenth of the size: cx = (cx + 0.5) / 10 - 0.5."""
    camera = open_sequence(write_tum(tmp_path / name)).source.camera
    if expected is None:
        assert camera is None
        return
    central = camera.central
    np.testing.assert_allclose([central.fx, central.fy, central.cx, central.cy], expected, atol=1e-9)
    assert (camera.distortion if isinstance(camera, OpenCvCamera) else None) == distortion


def test_tums_poses_may_state_their_unit_and_whole_stamps_are_seconds(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM, [0.0, 1.0, 2.0, 3.0])
    text = (folder / "groundtruth.txt").read_text()
    (folder / "groundtruth.txt").write_text("# unit: mm; time: s\n" + text)
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.source.pose(3)[:3, 3], [0.3, 2.0, -0.5], atol=1e-9)
    assert [frame.time_s for frame in frames_of(sequence)] == [0.0, 1.0, 2.0, 3.0]
    assert all(any(words in note for note in sequence.notes) for words in ("mm (stated)", "whole numbers"))


def test_association_is_greedy_by_time_and_one_to_one(tmp_path: Path) -> None:
    # 0.110 is nearer to 0.112 than 0.100 is; 0.100 then takes what is left within 0.02 s.
    assert associated([0.100, 0.110], [0.085, 0.112]) == {1: 1, 0: 0}
    assert associated([0.100, 0.110], [0.112]) == {1: 0}
    assert associated([1.0, 2.0], [1.0199, 2.0201]) == {0: 0}
    assert associated([1.0], []) == {}
    folder = write_tum(tmp_path / ROOM)
    replace_line(folder / "groundtruth.txt", 5, f"{STAMPS[3] + 0.021:.4f} 9 9 9 {TUM_TURN}")
    assert reference_trajectory(open_sequence(folder)).indices.tolist() == [0, 1, 2]


@pytest.mark.parametrize("depth_first", [True, False])
def test_associations_win_over_time(depth_first: bool, tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    colour, depth = (f"rgb/{STAMPS[2]:.6f}.png", f"depth/{STAMPS[3] + 0.005:.6f}.png")
    first, second = (depth, colour) if depth_first else (colour, depth)
    (folder / "associations.txt").write_text(f"# pairs\n1.0 {first} 2.0 {second}\n3.0 rgb/other.png 4.0 depth/o.png\n")
    sequence = open_sequence(folder)
    assert [sequence.source.truth(number).depth_mm is None for number in range(4)] == [True, True, False, True]
    np.testing.assert_allclose(sequence.source.truth(2).depth_mm[10:], 1003.0, rtol=1e-6)


def test_tums_lists_may_be_out_of_order_and_name_what_is_not_there(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(reversed(lines)) + "\n\n")
    (folder / f"rgb/{STAMPS[1]:.6f}.png").unlink()
    (folder / f"rgb/{STAMPS[2]:.6f}.png").write_bytes(b"no image")
    (folder / f"depth/{STAMPS[3] + 0.005:.6f}.png").unlink()
    sequence = open_sequence(folder)
    assert [(f.index, number_in(f.rgb)) for f in frames_of(sequence)] == [(0, 0), (3, 3)]
    assert sequence.source.pose(3)[0, 3] == pytest.approx(300)
    assert sequence.source.truth(3).depth_mm is None
    told = " ".join(sequence.warnings)
    for words in ("rgb.txt: 1 of the 4 images that it names are not there", "depth.txt: 1 of the 3 images",
                  "not in the order of time", "cannot be read and was left out"):  # fmt: skip
        assert words in told


@pytest.mark.parametrize("row", ["nan nan nan nan nan nan nan", "1 2 3 0 0 0 0"])
@pytest.mark.parametrize("write", [write_tum, write_oneslam])
def test_a_row_without_a_pose_leaves_its_frame_without_one(
    write: Callable[[Path], Path], row: str, tmp_path: Path
) -> None:
    folder = write(tmp_path / ROOM)
    name, number, stamp = ("groundtruth.txt", 3, f"{STAMPS[1]:.4f}") if write is write_tum else ("poses_gt.txt", 1, "3")
    replace_line(folder / name, number, f"{stamp} {row}")
    source = open_sequence(folder).source
    assert source.pose(1 if write is write_tum else 3) is None
    assert source.pose(3 if write is write_tum else 10) is not None


# ---- OneSLAM


def test_oneslams_scene_in_metres_is_brought_to_mm_as_a_whole(tmp_path: Path) -> None:
    source = open_sequence(write_oneslam(tmp_path / "colon", "png", header="# unit: m")).source
    np.testing.assert_allclose(source.pose(3)[:3, 3], [3000.0, -2500.0, 40000.0])
    np.testing.assert_allclose(source.truth(3).depth_mm[10:], 40003.0, rtol=1e-6)


@pytest.mark.parametrize("colour", [False, True])
def test_depth_outside_oneslams_mask_is_unknown(colour: bool, tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    mask = np.full((64, 80), 255, np.uint8)
    mask[:, -10:-5], mask[:, -5:] = 254, 0  # 254 is not enough
    write_image(folder / "mask.bmp", cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR) if colour else mask)
    source = open_sequence(folder).source
    assert np.isnan(source.truth(3).depth_mm[:, -10:]).all()
    assert np.isfinite(source.truth(3).depth_mm[10:, :-10]).all()


def test_oneslam_without_truth_and_rate(tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    (folder / "poses_gt.txt").unlink()
    shutil.rmtree(folder / "depths")
    write_json(folder, {"intrinsics": STATED["intrinsics"]})
    sequence = open_sequence(folder)
    assert [truth for _, truth in sequence] == [None] * 4
    assert [frame.time_s for frame in frames_of(sequence)] == pytest.approx([n / 30 for n in ONESLAM_NUMBERS])
    assert "no pose is known: there is no poses_gt.txt" in sequence.notes
    assert any("frame number / 30 s (assumed" in note for note in sequence.notes)


# ---- SimCol3D


def test_simcols_frames_keep_their_lines_and_its_depth_ends_at_20_cm(tmp_path: Path) -> None:
    folder = write_simcol(tmp_path, numbers=(3, 1, 2))
    (folder / "FrameBuffer_0002.png").rename(folder / "FrameBuffer_2.png")
    write_image(folder / "Depth_0001.png", levels(np.uint8, 51, 255, SQUARE))
    write_image(folder / "Depth_0003.png", levels(np.uint16, 65280, 65281, SQUARE))
    text = (tmp_path / "SavedPosition_S1.txt").read_text().splitlines()
    (tmp_path / "SavedPosition_S1.txt").write_text("\n".join([*text[:2], "nan nan nan", text[3]]))
    source = open_sequence(folder).source
    assert [number_in(frame.rgb) for frame in source.frames(slice(None))] == source.numbers == [1, 2, 3]
    np.testing.assert_allclose(source.pose(3)[:3, 3], [6.9, -90.1, -31])
    assert source.truth(2) is None
    np.testing.assert_allclose(source.truth(1).depth_mm[[40, -1], 0], [40, 200], rtol=1e-6)
    np.testing.assert_allclose(source.truth(3).depth_mm[[0, 40, -1], 0], [np.nan, 200, np.nan], rtol=1e-6)


def test_simcol_is_found_in_a_repeated_folder_and_by_files_of_any_name(tmp_path: Path) -> None:
    scene = tmp_path / "SyntheticColon_I"
    folder = write_simcol(scene)
    shutil.move(folder, scene / "away")
    folder.mkdir()
    folder = Path(shutil.move(scene / "away", folder / "Frames_S1"))
    source = open_sequence(scene).source
    np.testing.assert_allclose(source.pose(1)[:3, 3], [6.7, -89.9, -31.2])
    np.testing.assert_array_equal(source.camera.matrix, UNITY_K)
    for name in ("SavedPosition", "SavedRotationQuaternion"):
        (scene / f"{name}_S1.txt").rename(folder / f"{name}.txt")
    folder = folder.rename(tmp_path / "mine")
    assert open_sequence(folder).source.pose(1) is not None
    for name in ("SavedPosition", "SavedRotationQuaternion"):
        shutil.copy(folder / f"{name}.txt", folder / f"{name}_S9.txt")
    assert open_sequence(folder).source.pose(1) is None  # of which of the two they are is unknown
