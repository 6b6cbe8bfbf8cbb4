"""STIR and D4D beyond frames, camera and poses: points of dye and how they are scored, structured light, faults."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.input.opening import open_sequence
from scopemap_bench.datasets.d4d import D4dClip
from scopemap_bench.datasets.stir import StirClip
from scopemap_bench.evaluation.tattoos import accuracy, followed
from scopemap_bench.scripts import deforming_clips
from tests.support.drawn_image_sets import levels, write_d4d
from tests.support.drawn_run import write_placed
from tests.support.drawn_video_sets import FRAMES, STIR_K, TATTOOS, write_stir


def test_points_of_dye_are_the_centres_of_the_white_parts(tmp_path: Path) -> None:
    start, end = StirClip(write_stir(tmp_path / "s")).tattoos()
    assert sorted(map(tuple, start)) == sorted(TATTOOS["start"])
    assert sorted(map(tuple, end)) == sorted(TATTOOS["end"])


def test_accuracy_is_the_mean_share_within_the_published_distances() -> None:
    found = np.array([[0.0, 4.0], [100.0, 8.5], [0.0, 70.0], [np.nan, np.nan]])
    figures = accuracy(found, np.array([[0.0, 0.0], [100.0, 0.0]]))
    shares = [figures[f"within_{limit}_px"] for limit in (4, 8, 16, 32, 64)]
    assert shares == [0.25, 0.25, 0.5, 0.5, 0.5]
    assert figures["accuracy"] == pytest.approx(0.4)
    assert accuracy(found, np.zeros((0, 2)))["accuracy"] == 0


def test_a_result_carries_the_points_by_depth_and_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clip, run = write_stir(tmp_path / "s"), tmp_path / "run"
    frames = list(open_sequence(clip).frames())
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = 0.5 * np.arange(FRAMES)
    write_placed(run, [(frame, np.full(frame.valid.shape, 60.0), poses[frame.index]) for frame in frames])
    start = np.array(TATTOOS["start"], float)
    np.testing.assert_allclose(followed(run, clip, start) - start, [[-2.5 / 60 * STIR_K[0][0], 0]] * 3, atol=0.01)
    monkeypatch.setattr("sys.argv", ["deforming_clips", "--runs", str(run), "--clips", str(clip)])
    deforming_clips.main()
    assert "| seq03 | 3 points | accuracy 0.60 / 0.53 | within_4_px 0.33 / 0.33 |" in capsys.readouterr().out


def test_the_lens_of_a_clip_is_kept(tmp_path: Path) -> None:
    folder = write_stir(tmp_path / "s")
    stated = folder.parents[1] / "calib.json"
    stated.write_text(stated.read_text().replace("[0, 0, 0, 0, 0]", "[-0.2, 0.1, 0, 0, 0]"))
    camera = open_sequence(folder).source.camera
    assert isinstance(camera, OpenCvCamera)
    assert camera.distortion[:2] == (-0.2, 0.1)
    stated.write_text('{"leftcameramat": 3}')
    with pytest.raises(CalibrationError, match="no matrix leftcameramat"):
        StirClip(folder)
    (folder / "segmentation" / "icgendseg.png").write_bytes(b"no image")
    stated.unlink()
    assert not open_sequence(folder).calibrated
    with pytest.raises(InputError, match="icgendseg"):
        StirClip(folder).tattoos()


def test_structured_light_is_the_depth_of_the_first_and_the_last_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, run = write_d4d(tmp_path / "s"), tmp_path / "run"
    clip = D4dClip(folder)
    # The plane that the cloud is of, 100 mm before the first camera; 3 mm farther before the last.
    for end, z_mm in (("start", 100.0), ("end", 103.0)):
        light = clip.structured_light_mm(end)
        assert light is not None
        assert np.isfinite(light).mean() > 0.5
        np.testing.assert_allclose(light[np.isfinite(light)], z_mm, rtol=1e-5)
    # Of half the size, and of the right deformation but for 1 mm.
    depth_mm = {0: 50.0, 3: 52.0}
    frames = [frame for frame in open_sequence(folder).frames() if frame.index in depth_mm]
    write_placed(run, [(frame, np.full(frame.valid.shape, depth_mm[frame.index]), np.eye(4)) for frame in frames])
    monkeypatch.setattr("sys.argv", ["deforming_clips", "--runs", str(run), "--clips", str(folder)])
    deforming_clips.main()
    before, after, still = (float(cell.split()[-1]) for cell in capsys.readouterr().out.split("|")[2:5])
    assert (before + after, still) == (pytest.approx(1.0, abs=0.06), pytest.approx(3.0, abs=0.01))
    (folder.parents[1] / "pointcloud" / "end.ply").write_bytes(b"ply")
    with pytest.raises(InputError, match=r"clips\.json names for Clip_1"):
        clip.structured_light_mm("end")
    (folder.parents[1] / "clips.json").unlink()
    with pytest.raises(InputError, match="has no depth of frame 0 to compare"):
        deforming_clips.main()


def test_the_camera_of_the_session_is_used_where_the_clip_has_none(tmp_path: Path) -> None:
    folder = write_d4d(tmp_path / "s")
    (folder.parents[1] / "camera_info").mkdir()
    (folder / "camera_info" / "left_rect.yaml").rename(folder.parents[1] / "camera_info" / "left.yaml")
    assert D4dClip(folder).camera is not None


@pytest.mark.parametrize(
    ("alter", "message"),
    [
        (
            lambda f: np.save(f / "stereo_depth/000000.npy", levels(np.uint16, 3, 3)),
            "expected 64x80 floats, found uint16",
        ),
        (lambda f: np.save(f / "stereo_depth/000000.npy", np.ones((4, 4))), r"found float64 of shape \(4, 4\)"),
        (lambda f: (f / "stereo_depth/000000.npy").write_bytes(b"\x93NUMPY"), "no NumPy array of depth"),
    ],
)
def test_what_is_damaged_is_named(alter: Callable[[Path], object], message: str, tmp_path: Path) -> None:
    folder = write_d4d(tmp_path / "s")
    alter(folder)
    with pytest.raises(InputError, match=message):
        D4dClip(folder).truth(0)


def test_a_pose_that_is_none_is_named(tmp_path: Path) -> None:
    folder = write_d4d(tmp_path / "s")
    (folder / "curated_camera_pose_end.txt").write_text("1 0 0 0\n")
    with pytest.raises(InputError, match="expected 4 rows of 4"):
        D4dClip(folder).structured_light_mm("end")


def test_depth_of_fewer_frames_belongs_to_those_of_its_names(tmp_path: Path) -> None:
    folder = write_d4d(tmp_path / "s")
    (folder / "stereo_depth" / "000001.npy").unlink()
    clip = D4dClip(folder)
    assert sorted(clip.depth_files) == [0, 2, 3]
    assert any("3 files for 4 images" in str(warning) for warning in clip.warnings)
