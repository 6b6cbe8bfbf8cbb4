"""`params.npz` of SplaTAM, EndoGSLAM and Endo-2DTAM: the path, which frame a column is, and nothing unpickled."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from foreign_layouts import assert_is, moving_camera, splatam_arrays, write_splatam

from scopemap.errors import InputError
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap_bench.trajectories import splatam

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


def test_other_and_damaged_npz_files_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", poses=np.eye(4))
    with pytest.raises(InputError, match="expected the arrays cam_unnorm_rots"):
        read_trajectory(tmp_path / "other.npz", kind="splatam")
    (tmp_path / "text.npz").write_text("not a zip")
    np.save(tmp_path / "one.npy", np.eye(4))
    for name in ("text.npz", "one.npy"):
        with pytest.raises(InputError, match="expected the arrays cam_unnorm_rots"):
            read_trajectory(tmp_path / name, kind="splatam")


def test_poses_that_grow_are_refused_and_gaussians_stay_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splatam, "_MOST_BYTES", 1 << 20)
    arrays = splatam_arrays(moving_camera())
    np.savez_compressed(tmp_path / "params.npz", **(arrays | {"means3D": np.zeros((200_000, 3))}))
    assert len(read_trajectory(tmp_path / "params.npz", kind="splatam")) == 20
    np.savez_compressed(tmp_path / "params.npz", **(arrays | {"cam_trans": np.zeros((1, 3, 200_000))}))
    with pytest.raises(InputError, match=r"cam_trans\.npy: it holds 4 MB, expected 1 MB at most"):
        read_trajectory(tmp_path / "params.npz", kind="splatam")
