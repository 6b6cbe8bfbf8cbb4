"""Files of other people's systems: each is written here in its own layout and read back as the same camera's path."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.geometry.se3 import se3_exp
from scopemap.input.trajectory.trajectory import Trajectory
from scopemap.result.trajectories import read_trajectory, trajectory_kinds
from scopemap_bench.trajectories import splatam
from tests.support.foreign_layouts import (
    assert_is,
    colmap_text,
    log_text,
    moving_camera,
    oneslam_text,
    scaled,
    scared_documents,
    splatam_arrays,
    write_files,
    write_splatam,
    write_tar,
)
from tests.support.sample_trajectories import as_trajectory, write_c3vd, write_run

# ---- SCARED

KINDS = ("auto", *trajectory_kinds())


@pytest.mark.parametrize(
    ("place", "opened"),
    [
        (".", "."),
        ("data", "."),
        ("data/frame_data", "."),
        ("data/frame_data", "data"),
        ("frame_data", "."),
        ("image_02/data/frame_data", "."),
        ("data/frame_data.tar.gz", "."),
        ("data/frame_data.tar.gz", "data"),
        ("data/frame_data.tar.gz", "data/frame_data.tar.gz"),
        ("frame_data.tar", "frame_data.tar"),
    ],
)
def test_scared_is_found_wherever_it_is_unpacked(tmp_path: Path, place: str, opened: str) -> None:
    poses = moving_camera(12)
    documents = scared_documents(poses, list(range(12)))
    # Listing order must not matter: 10 comes before 2 here, and the tar starts with the last frame.
    documents = dict(reversed(documents.items()))
    if "tar" in place:
        write_tar(tmp_path / place, documents, "w:gz" if place.endswith("gz") else "w")
    else:
        write_files(tmp_path / place, documents)
    for kind in ("auto", "scared"):
        found = read_trajectory(tmp_path / opened, kind=kind, unit="m")  # its unit is known, and not the caller's
        assert_is(found, poses, list(range(12)))
        assert found.source.startswith("SCARED JSON, world-to-camera inverted, mm, ")


def test_scared_c_counts_from_one_with_gaps_and_names_its_calibration(tmp_path: Path) -> None:
    poses, indices = moving_camera(6), [1, 2, 5, 9, 10, 11]
    documents = scared_documents(poses, indices, **{"camera-calibration": "intrinsics_colmap.yaml"})
    # A Mac leaves a twin of every file in its tars, and other files lie beside them.
    documents |= {f"._{name}": "\x00\x05\x16\x07" for name in documents} | {"frame_log.json": "[]"}
    found = read_trajectory(write_tar(tmp_path / "data" / "frame_data.tar.gz", documents).parents[1])
    assert_is(found, poses, indices)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"frame_data000003\.json: expected a JSON object with a 4x4 'camera-pose'"),
        (json.dumps({"camera-pose": np.eye(3).tolist()}), r"frame_data000003\.json: .*shape \(3, 3\)"),
        (json.dumps({"camera-pose": [[float("nan")] * 4] * 4}), r"frame_data000003\.json: a pose holds NaN"),
        (json.dumps({"camera-pose": (2 * np.eye(4)).tolist()}), r"frame_data000003\.json: not a rigid motion"),
    ],
)
def test_bad_scared_files_are_named(tmp_path: Path, text: str, message: str) -> None:
    documents = scared_documents(moving_camera(5), list(range(5))) | {"frame_data000003.json": text}
    for path in (write_files(tmp_path / "a", documents), write_tar(tmp_path / "b" / "frame_data.tar.gz", documents)):
        with pytest.raises(InputError, match=message):
            read_trajectory(path)


# ---- OneSLAM, BodySLAM


def test_oneslam_keyframes_keep_their_frame_numbers(tmp_path: Path) -> None:
    poses, indices = moving_camera(6), [3, 7, 11, 15, 19, 27]
    # A run backwards through the video writes its keyframes backwards.
    (tmp_path / "poses_pred.txt").write_text(oneslam_text(poses[::-1], indices[::-1]))
    (tmp_path / "poses.pickle").write_bytes(pickle.dumps({}))
    for path in (tmp_path, tmp_path / "poses_pred.txt"):
        for kind in ("auto", "oneslam"):
            found = read_trajectory(path, kind=kind)
            assert_is(found, poses, indices)
            assert found.source == "OneSLAM, TUM rows by frame number, camera-to-world, mm (assumed)"
    np.testing.assert_allclose(read_trajectory(tmp_path, unit="m").positions_mm, poses[:, :3, 3] * 1000)
    (tmp_path / "poses_pred.txt").rename(tmp_path / "poses_gt.txt")
    assert_is(read_trajectory(tmp_path), poses, indices)
    (tmp_path / "poses_gt.txt").write_text("0.5 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="OneSLAM stamps poses by frame number"):
        read_trajectory(tmp_path)


def test_bodyslam_writes_the_upper_three_rows_of_every_pose(tmp_path: Path) -> None:
    poses = moving_camera()
    lines = [" ".join(map(str, pose.flatten()[:-4])) for pose in poses]
    (tmp_path / "poses.txt").write_text("\n".join(lines) + "\n")
    assert_is(found := read_trajectory(tmp_path / "poses.txt", kind="bodyslam"), poses, list(range(20)))
    assert found.source == "KITTI, camera-to-world, mm (assumed), row = frame"
    for kind in ("auto", "kitti"):
        found = read_trajectory(tmp_path / "poses.txt", kind=kind)
        np.testing.assert_allclose(found.positions_mm, 1000 * poses[:, :3, 3])
        assert_is(read_trajectory(tmp_path / "poses.txt", kind=kind, unit="mm"), poses, list(range(20)))


# ---- Open3D and Endo-Depth-and-Motion


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_logs_point_one_way_for_open3d_and_the_other_for_endo_depth(tmp_path: Path, unit: str) -> None:
    poses = moving_camera()
    path = tmp_path / "trajectory.log"
    path.write_text(log_text(scaled(poses, unit)))
    for opened in (path, tmp_path):
        found = read_trajectory(opened, kind="open3d", unit=unit)
        assert_is(found, poses, list(range(20)), atol=2e-4)
        assert found.source == f"Open3D log, camera-to-world, {unit} (assumed)"
    # Endo-Depth-and-Motion: world-to-camera, and metres whatever the caller says.
    path.write_text(log_text(scaled(np.linalg.inv(poses), "m")))
    found = read_trajectory(tmp_path, kind="endo-depth", unit=unit)
    assert_is(found, poses, list(range(20)), atol=2e-4)
    assert "world-to-camera inverted, m" in found.source


def test_log_is_as_open3d_itself_reads_it(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d", reason="Open3D is not a dependency", exc_type=ImportError)
    (tmp_path / "trajectory.log").write_text(log_text(moving_camera()))
    theirs = o3d.io.read_pinhole_camera_trajectory(str(tmp_path / "trajectory.log")).parameters
    found = read_trajectory(tmp_path, kind="open3d").T_world_camera
    np.testing.assert_allclose(found, [np.linalg.inv(camera.extrinsic) for camera in theirs], atol=1e-6)


def test_log_that_could_point_either_way_asks_for_the_kind(tmp_path: Path) -> None:
    (tmp_path / "trajectory.log").write_text(log_text(moving_camera()))
    for path in (tmp_path, tmp_path / "trajectory.log"):
        with pytest.raises(InputError, match=r"name the kind, 'open3d' .* or 'endo-depth'"):
            read_trajectory(path)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text.rsplit("\n", 2)[0], "lines of 3, 4, 4, 4 and 4 numbers"),
        (lambda text: "", "holds no pose"),
        (lambda text: text.replace("1 1 2\n", "1 1\n"), "lines of 3, 4, 4, 4 and 4 numbers"),
        (lambda text: text.replace("1 1 2\n", "1 x 2\n"), "line 6: expected numbers"),
        (lambda text: text.replace("1.00000000", "2.00000000"), "line 1: not a rigid motion"),
    ],
)
def test_bad_logs_are_named_with_their_line(tmp_path: Path, edit: Callable[[str], str], message: str) -> None:
    (tmp_path / "a.log").write_text(edit(log_text(moving_camera())))
    with pytest.raises(InputError, match=message):
        read_trajectory(tmp_path / "a.log", kind="open3d")


# ---- COLMAP


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_colmap_is_inverted_and_numbered_by_the_names(tmp_path: Path, unit: str) -> None:
    poses = moving_camera(5)
    numbers = [30, 4, 100, 7, 12]
    names = [f"clip 2/frame_{number:06d}.png" for number in numbers]
    # No point, a point, and ten numbers in the line of points, which then is as long as an image's.
    points = ["", "1.5 2.5 -1", "1 2 3 4 5 6 7 8 9 10 11 12", "", "3 4 5"]
    text = colmap_text(scaled(poses, unit), names, points)
    expected = poses[np.argsort(numbers)]
    for name in ("images.txt", "sparse/0/images.txt"):
        path = write_files((tmp_path / name).parent, {"images.txt": text}) / "images.txt"
        for opened, kind in ((path, "auto"), (tmp_path, "auto"), (tmp_path, "colmap")):
            found = read_trajectory(opened, unit=unit, kind=kind)
            assert_is(found, expected, sorted(numbers))
            assert found.source.startswith("COLMAP images.txt, world-to-camera inverted, scale arbitrary, ")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a1.png", "a2.png", "b01.png"], "line 8: the number in this image's name is that of an earlier"),
        (["a1.png", "a2.png", "left.png"], "line 8: the image name 'left.png' holds no number"),
        (["a1.png", "a2.png", f"{10**20}.png"], "line 8: the image name .* holds no number"),
    ],
)
def test_colmap_images_that_cannot_be_numbered_are_named(tmp_path: Path, names: list[str], message: str) -> None:
    (tmp_path / "images.txt").write_text(colmap_text(moving_camera(3), names, [""] * 3))
    with pytest.raises(InputError, match=message):
        read_trajectory(tmp_path)


# ---- which is which


def test_unknown_kind_is_refused_with_all_that_are_known(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"unknown kind of trajectory 'orb-slam'; known are auto, run, .*colmap"):
        read_trajectory(tmp_path, kind="orb-slam")
    assert len(set(KINDS)) == len(KINDS)


def test_folder_with_two_trajectories_asks_which(tmp_path: Path) -> None:
    poses = moving_camera()
    write_run(tmp_path, as_trajectory(poses))
    write_c3vd(tmp_path, se3_exp(np.ones(6)) @ poses)
    with pytest.raises(InputError, match=r"holds trajectory\.tum \(run\) and pose\.txt \(c3vd\); name"):
        read_trajectory(tmp_path)
    assert_is(read_trajectory(tmp_path, kind="run"), poses, list(range(20)))
    assert_is(read_trajectory(tmp_path, kind="c3vd"), se3_exp(np.ones(6)) @ poses, list(range(20)))
    assert_is(read_trajectory(tmp_path / "pose.txt"), se3_exp(np.ones(6)) @ poses, list(range(20)))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_refuses_what_is_not_there(tmp_path: Path, kind: str) -> None:
    (tmp_path / "letter.txt").write_text("Dear reader,\n")
    (tmp_path / "empty").write_bytes(b"")
    for name in ("nowhere", "letter.txt", "empty", "."):
        with pytest.raises(InputError, match=str(tmp_path / name)):
            read_trajectory(tmp_path / name, kind=kind)


NUMBERS = st.sampled_from(["0", "1", "-1", "1e300", "nan", "0.5", "7", "#", "x", ",", "\n", "a1.png", "\n0 0 1\n"])


@given(
    content=st.one_of(
        st.binary(max_size=80), st.lists(NUMBERS, max_size=60).map(lambda words: " ".join(words).encode())
    ),
    kind=st.sampled_from(KINDS),
)
@settings(max_examples=150, deadline=None)
def test_any_file_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes, kind: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any"
    path.write_bytes(content)
    try:
        found = read_trajectory(path, kind=kind)
    except InputError:
        return
    assert isinstance(found, Trajectory)
    assert found.source


@given(st.lists(st.tuples(*[st.floats(-3, 3)] * 3, *[st.floats(-500, 500)] * 3), min_size=1, max_size=5))
@settings(max_examples=25, deadline=None)
def test_any_path_is_the_same_in_every_form(
    tmp_path_factory: pytest.TempPathFactory, twists: list[tuple[float, ...]]
) -> None:
    poses = np.stack([np.eye(4), *(se3_exp(np.array(twist)) for twist in twists)])
    folder, count = tmp_path_factory.mktemp("forms"), len(poses)
    frames = list(range(count))
    (folder / "a.log").write_text(log_text(poses))
    (folder / "b.log").write_text(log_text(scaled(np.linalg.inv(poses), "m")))
    write_files(folder / "oneslam", {"poses_pred.txt": oneslam_text(poses, frames)})
    write_files(folder / "colmap", {"images.txt": colmap_text(poses, [f"{i}.png" for i in frames], [""] * count)})
    forms = [
        (write_files(folder / "scared", scared_documents(poses, frames)), "auto"),
        (write_splatam(folder / "splatam", splatam_arrays(poses)), "splatam"),
        (folder / "oneslam", "auto"),
        (folder / "colmap", "auto"),
        (folder / "a.log", "open3d"),
        (folder / "b.log", "endo-depth"),
    ]
    for path, kind in forms:
        found = read_trajectory(path, kind=kind)
        # Eight decimals of a metre, and float32, are what some forms keep.
        np.testing.assert_allclose(found.T_world_camera, poses[: len(found)], atol=2e-3)
        assert found.indices.tolist() == frames[: len(found)]


# ---- SplaTAM's family


HELD_OUT = [frame for frame in range(100) if frame % 8 != 7]


@pytest.mark.parametrize("unit", ["mm", "m"])
@pytest.mark.parametrize(
    ("kind", "config", "frames"),
    [
        ("endogslam", None, HELD_OUT),
        ("splatam", None, list(range(100))),
        ("auto", 'start=0, stride=1, train_or_test="train"', HELD_OUT),
        ("auto", "start=0, stride=1", list(range(100))),
        ("auto", "start=3, stride=2, train_or_test='all'", list(range(3, 100, 2))),
        ("auto", "start=3, stride=2, train_or_test='train'", [f for f in range(3, 100) if (f - 3) % 8 != 7][::2]),
        ("splatam", 'train_or_test="train"', list(range(100))),
    ],
)
def test_gaussian_slam_is_inverted_and_numbered_by_its_split(
    tmp_path: Path, unit: str, kind: str, config: str | None, frames: list[int]
) -> None:
    poses = moving_camera(30)
    folder = write_splatam(tmp_path, splatam_arrays(poses, unit), config)
    for path in (folder, folder / "params.npz"):
        found = read_trajectory(path, kind=kind, unit=unit)
        assert_is(found, poses, frames[:30], atol=1e-4)
        assert f"world-to-camera inverted, {unit} (assumed)" in found.source
        assert str(frames[2]) in found.source


@pytest.mark.parametrize(
    "config",
    [
        None,
        "stride=int(os.environ['STRIDE'])",
        "stride=0",
        "train_or_test='test'",
        "stride=1))) #",
    ],
)
def test_gaussian_slam_of_an_unknown_split_asks_for_the_kind(tmp_path: Path, config: str | None) -> None:
    folder = write_splatam(tmp_path, splatam_arrays(moving_camera()), config)
    with pytest.raises(InputError, match=r"name the kind: 'endogslam' .* or 'splatam'"):
        read_trajectory(folder)


def test_config_of_a_run_is_read_but_never_run(tmp_path: Path) -> None:
    trap = f"stride=1, trap=open({str(tmp_path / 'sprung')!r}, 'w')"
    assert len(read_trajectory(write_splatam(tmp_path / "run", splatam_arrays(moving_camera()), trap))) == 20
    assert not (tmp_path / "sprung").exists()


def test_untracked_tail_of_a_checkpoint_is_left_out(tmp_path: Path) -> None:
    arrays = splatam_arrays(moving_camera(), seed=1)
    arrays["cam_unnorm_rots"][..., 12:] = np.array([1, 0, 0, 0])[:, None]
    arrays["cam_trans"][..., 12:] = 0
    np.savez(tmp_path / "params11.npz", **arrays)
    found = read_trajectory(tmp_path / "params11.npz", kind="endogslam")
    assert_is(found, moving_camera()[:12], HELD_OUT[:12], atol=1e-4)


class Trap:
    """Unpickling it leaves a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str, str]]:
        return open, (str(self.path), "w")


def test_pickles_are_never_loaded(tmp_path: Path) -> None:
    sprung = tmp_path / "sprung"
    trap = np.array([Trap(sprung)], dtype=object)
    arrays = splatam_arrays(moving_camera())
    # Exposure settings, pickled beside the poses, do no harm; pickled poses are refused.
    np.savez(tmp_path / "params.npz", **arrays, exp_list=trap)
    assert len(read_trajectory(tmp_path / "params.npz", kind="splatam")) == 20
    np.savez(tmp_path / "params.npz", **(arrays | {"cam_trans": trap}))
    with pytest.raises(InputError, match="no pickled objects"):
        read_trajectory(tmp_path / "params.npz", kind="splatam")
    for name, protocol in (("test1.pkl", 4), ("odometry", 2), ("old.pickle", 0)):
        (tmp_path / name).write_bytes(pickle.dumps(Trap(sprung), protocol=protocol))
        for kind in ("auto", "endo-depth"):
            with pytest.raises(InputError, match=r"cannot read|expected numbers"):
                read_trajectory(tmp_path / name, kind=kind)
    assert not sprung.exists()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"cam_trans": np.zeros((1, 3, 4))}, r"found \(1, 4, 20\) and \(1, 3, 4\)"),
        ({"cam_unnorm_rots": np.zeros((4, 20))}, r"found \(4, 20\)"),
        ({"cam_unnorm_rots": np.ones((1, 4, 20)) * (np.arange(20) != 5)}, "column 5: the quaternion has length nan"),
        ({"cam_trans": np.where(np.arange(20) == 6, np.nan, 1.0) * np.ones((1, 3, 1))}, "column 6: a pose holds NaN"),
    ],
)
def test_bad_gaussian_slam_files_are_refused(tmp_path: Path, changed: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_trajectory(write_splatam(tmp_path, splatam_arrays(moving_camera()) | changed), kind="splatam")


def test_poses_that_grow_are_refused_and_gaussians_stay_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splatam, "_MOST_BYTES", 1 << 20)
    arrays = splatam_arrays(moving_camera())
    np.savez_compressed(tmp_path / "params.npz", **(arrays | {"means3D": np.zeros((200_000, 3))}))
    assert len(read_trajectory(tmp_path / "params.npz", kind="splatam")) == 20
    np.savez_compressed(tmp_path / "params.npz", **(arrays | {"cam_trans": np.zeros((1, 3, 200_000))}))
    with pytest.raises(InputError, match=r"cam_trans\.npy: it holds 4 MB, expected 1 MB at most"):
        read_trajectory(tmp_path / "params.npz", kind="splatam")
