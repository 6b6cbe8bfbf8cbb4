"""A submission to CLiMB: what an export writes, each rule of the challenge, and the container's one call."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from scopemap.engine.errors import InputError
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.climb.submission import submission_problems, write_submission
from tests.support.drawn_climb import frames_of, path_of, write_finished_run
from tests.support.drawn_video_sets import write_frames
from tests.support.front_door import call, refused
from tests.support.places import ROOT
from tests.support.tiny_phantom import write_tiny

Edit = Callable[[Path], object]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run with a mesh, and a second submap without."""
    folder = write_finished_run(tmp_path / "result", frames_of(path_of(12)), frames_of(path_of(20, 1), 12))
    colours = np.tile([10, 20, 30, 255], (8, 1))
    trimesh.Trimesh(trimesh.creation.box().vertices, [[0, 1, 2]], vertex_colors=colours, process=False).export(
        folder / "mesh.ply"
    )
    return folder


# ---- what is written


def test_a_submission(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "submission"
    assert write_submission(run, out) == "Seq_001_a"
    assert sorted(path.name for path in (out / "Seq_001_a").iterdir()) == ["1", "2", "3", "4", "5"]
    one = {p.relative_to(out / "Seq_001_a/1"): p.read_bytes() for p in (out / "Seq_001_a/1").rglob("*.txt")}
    assert sorted(map(str, one)) == [
        *("3D_maps/0/points3D.txt", "3D_maps/1/points3D.txt"),
        *("camera_trajectory/cam_traj_map_000.txt", "camera_trajectory/cam_traj_map_001.txt", "runtime.txt"),
    ]
    assert all((out / "Seq_001_a" / n / file).read_bytes() == text for n in "2345" for file, text in one.items())
    # 10 s in all, but for 1.5 s of preparation and 1.25 s of fusion after the last pose.
    assert one[Path("runtime.txt")] == b"init_seconds=1.500\nprocessing_seconds=7.250\n"
    points = one[Path("3D_maps/0/points3D.txt")].decode().splitlines()
    assert points[:2] == ["# POINT3D_ID X Y Z R G B ERROR", "1 -0.500000 -0.500000 -0.500000 10 20 30 0"]
    assert len(points) == 9
    # Without a mesh there are the camera centres: the evaluation breaks off at a map without points.
    assert len(one[Path("3D_maps/1/points3D.txt")].decode().splitlines()) == 21
    assert submission_problems(out) == []


def test_it_is_read_back_with_its_submaps(run: Path, tmp_path: Path) -> None:
    write_submission(run, tmp_path / "submission", "other")
    ours, found = read_trajectory(run), read_trajectory(tmp_path / "submission/other/4")
    assert len(found.others) == len(ours.others) == 1
    for one, other in zip((found, *found.others), (ours, *ours.others), strict=True):
        assert one.indices.tolist() == other.indices.tolist()
        np.testing.assert_allclose(one.T_world_camera, other.T_world_camera, atol=1e-8)


def test_what_cannot_be_exported_is_refused(run: Path, tmp_path: Path) -> None:
    write_submission(run, tmp_path / "submission")
    with pytest.raises(InputError, match=r"Seq_001_a/1: File exists"):
        write_submission(run, tmp_path / "submission")
    (run / "provenance.json").unlink()
    with pytest.raises(InputError, match="not the folder of a finished run"):
        write_submission(run, tmp_path / "other")
    assert not (tmp_path / "other").exists()


# ---- each rule


def _text(name: str, text: str) -> Edit:
    return lambda run: (run / name).write_text(text)


def _also(name: str, line: str) -> Edit:
    return lambda run: (run / name).write_text((run / name).read_text() + line)


RUNTIME, POINTS, TRAJECTORY = "runtime.txt", "3D_maps/0/points3D.txt", "camera_trajectory/cam_traj_map_000.txt"
BROKEN: list[tuple[Edit, str]] = [
    (shutil.rmtree, "Seq_001_a/2: missing"),
    (lambda run: run.rename(run.parent / "second"), "Seq_001_a/second: not a run"),
    (lambda run: (run / RUNTIME).unlink(), "runtime.txt"),
    (_text(RUNTIME, "init_seconds=1\n"), "expected a line processing_seconds="),
    (_text(RUNTIME, "init_seconds=1\nprocessing_seconds=fast\n"), "expected a line processing_seconds="),
    (_text(RUNTIME, "init_seconds=-1\nprocessing_seconds=1\n"), "expected a line init_seconds="),
    (lambda run: shutil.rmtree(run / "3D_maps"), "3D_maps: no map"),
    (lambda run: (run / "3D_maps/0").rename(run / "3D_maps/first"), "first: the name of a map must be an integer"),
    (lambda run: shutil.copytree(run / "3D_maps/0", run / "3D_maps/000"), "another map has this number"),
    (lambda run: shutil.rmtree(run / "3D_maps/1"), "cam_traj_map_001.txt: no map in 3D_maps"),
    (lambda run: (run / POINTS).unlink(), "points3D.txt"),
    (_text(POINTS, "# POINT3D_ID X Y Z R G B ERROR\n"), "points3D.txt: no point"),
    (_also(POINTS, "9 1 2 3 0 0 256 0\n"), "line 10: expected POINT3D_ID"),
    (_also(POINTS, "9 1 nan 3 0 0 0 0\n"), "line 10: expected POINT3D_ID"),
    (_also(POINTS, "9 1 2 3 0 0 0\n"), "line 10: expected POINT3D_ID"),
    (_also(POINTS, "9,1,2,3,0,0,0,0\n"), "line 10: expected POINT3D_ID"),
    (_also(POINTS, "8 1 2 3 0 0 0 0\n"), "each number once"),
    (_also(POINTS, "\n"), "line 10: expected POINT3D_ID"),
    (lambda run: (run / TRAJECTORY).rename(run / "camera_trajectory/cam_traj_map_0.txt"), "no map in 3D_maps"),
    (lambda run: shutil.rmtree(run / "camera_trajectory"), "cannot read"),
    (_text(TRAJECTORY, "# no pose\n"), "it holds no pose"),
    (_also(TRAJECTORY, "0,000000.png,0,0,0,1,0,0,0\n"), "from 1"),
    (_also(TRAJECTORY, "0,000090.png,0,0,0,1,0,0\n"), "found 8 fields"),
    (_also(TRAJECTORY, "0,000090.png,0,0,0,1,nan,0,0\n"), "line 14: a rotation is not finite"),
]


@pytest.mark.parametrize(("edit", "message"), BROKEN)
def test_a_broken_rule_is_told(edit: Edit, message: str, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "submission"
    write_submission(run, out)
    edit(out / "Seq_001_a" / "2")
    assert any(message in problem for problem in submission_problems(out))


def test_what_the_rules_allow(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "submission"
    write_submission(run, out)
    (out / "Seq_001_a/1/3D_maps/0").rename(out / "Seq_001_a/1/3D_maps/00")
    _also(POINTS, "10 1 2 3 0 0 0 0 1 2 3 4\n")(out / "Seq_001_a/2")
    _also(TRAJECTORY, "0,000090.png,0,0,0,1,0,0,0,2,1\n0, 91_kf.png, nan,0,0,1,0,0,0\n")(out / "Seq_001_a/3")
    _text(RUNTIME, "# audit\nprocessing_seconds = 1e-3\ninit_seconds=2\nmore=text\n")(out / "Seq_001_a/4")
    assert submission_problems(out) == []


def test_every_video_needs_its_clip(run: Path, tmp_path: Path) -> None:
    out, videos = tmp_path / "submission", tmp_path / "videos"
    write_submission(run, out)
    assert submission_problems(tmp_path / "none") == [f"{tmp_path / 'none'}: no clip"]
    videos.mkdir()
    assert submission_problems(out, videos) == [f"{videos}: no clip"]
    for name in ("Seq_001_a.mp4", "Seq_002_a.mp4", "notes.txt"):
        (videos / name).touch()
    assert submission_problems(out, videos) == [f"{out / 'Seq_002_a' / number}: missing" for number in "12345"]


# ---- the command, and the container


def test_the_command_writes_and_checks(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "submission"
    assert call("climb", run, "--out", out, "--json") == 0
    assert json.loads(capfd.readouterr().out) == {
        "out": str(out),
        "format": "climb",
        "written": ["Seq_001_a"],
        "problems": [],
    }
    assert call("climb", "--out", out) == 0
    assert capfd.readouterr().out == f"{out}: valid\n"
    (out / "Seq_001_a/3/runtime.txt").unlink()
    assert "1 problems, the first: cannot read" in refused(capfd, "climb", "--out", out, "--quiet")


@pytest.mark.slow
def test_one_call_of_the_container_writes_every_clip(tmp_path: Path) -> None:
    videos, out = tmp_path / "input", tmp_path / "output"
    videos.mkdir()
    pictures = [
        cv2.imread(str(file))[..., ::-1] for file in sorted(write_tiny(tmp_path / "phantom").glob("*_color.png"))
    ]
    # A repeated picture is a frame of the clip, too.
    write_frames(videos / "Seq_001_a.mp4", [*pictures, pictures[-1]], rate=50)
    (videos / "Seq_002_a.mp4").write_text("not a video")
    calibrations = tmp_path / "calibrations"
    calibrations.mkdir()
    shutil.copy(tmp_path / "phantom" / "camera.yaml", calibrations / "Seq_001.yaml")
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "scopemap").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m scopemap "$@"\n')
    (programs / "scopemap").chmod(0o755)
    changed = {"CLIMB_INPUT": videos, "CLIMB_OUTPUT": out, "CLIMB_CALIBRATIONS": calibrations}
    changed["PATH"] = f"{programs}:{os.environ['PATH']}"
    done = subprocess.run(
        [ROOT / "containers/climb/entrypoint", "--set", "networks.flow=dis", "--set", "fusion.enabled=false"],
        env=os.environ | {name: str(value) for name, value in changed.items()},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert f"camera {calibrations / 'Seq_001.yaml'}" in done.stdout
    assert "Seq_002_a: failed" in done.stderr
    assert submission_problems(out) == []
    assert submission_problems(out, videos) == [f"{out / 'Seq_002_a' / number}: missing" for number in "12345"]
    found = read_trajectory(out / "Seq_001_a" / "5")
    assert found.indices.tolist() == list(range(len(pictures) + 1))
