"""Frames of another video located in the map of a result, on a plane that is seen in closed form."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from scopemap.apps.locate.locate import NOT_FOUND, LocatedFrame, PlaceMap, write_located
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.input.camera_files.writing import write_calibration
from scopemap.report.frame_pictures import FramePictures
from scopemap.result.depth_maps import DepthWriter
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result
from tests.support.drawn_run import Shown, changed, drawn_result
from tests.support.front_door import call, refused
from tests.support.plane_scene import CAMERA, EVERYWHERE, PLANE_MM, pose, see

# Where the keyframes are; the last two are in a submap, whose world is another one.
KEYFRAMES = [pose(at_mm=(x, 0.0, z)) for x, z in ((-30, 0), (-22, -2), (22, 2), (30, 0))]
T_OTHER_WORLD = pose(at_mm=(100.0, -20.0, 5.0), turn_rad=(0.1, 0.4, -0.2))
CAMERA_FACTS = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def frame_at(T_world_camera: np.ndarray, index: int = 0, gain: float = 1.0) -> Frame:
    view = see(T_world_camera)
    rgb = np.clip(gain * view.rgb.astype(float), 0, 255).astype(np.uint8)
    return Frame(index, index / 25, rgb, CAMERA, EVERYWHERE, view.depth_mm, T_world_camera)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, kept = tmp_path_factory.mktemp("located") / "run", FramePictures()
    write = DepthWriter(folder)
    for index, T in enumerate(KEYFRAMES):
        write(frame := frame_at(T, index))
        kept(Shown(frame))
    kept.save(folder)
    worlds = [KEYFRAMES, [T_OTHER_WORLD @ T for T in KEYFRAMES]]

    def table(number: int) -> FrameTable:
        rows = []
        for index in range(len(KEYFRAMES)):
            place = int(index >= 2)
            row = {"index": index, "time_s": index / 25, "map": place, "keyframe": 2 * place, "status": "other-map"}
            own = {"status": "ok", "T_world_camera": worlds[number][index], "keyframe": index}
            rows.append(row | (own if place == number else {}))
        return FrameTable.of(row for row in rows if number == 0 or row["map"] == 1)

    facts = drawn_result(camera=CAMERA_FACTS | {"source": "calibration file camera.yaml"})
    result = changed(facts, camera=CAMERA, source_camera=CAMERA, mesh=trimesh.Trimesh(), others=[])
    changed(result, frames=table(0), others=[changed(result, frames=table(1))]).save(folder)
    return folder


@pytest.fixture(scope="module")
def places(run: Path) -> PlaceMap:
    return PlaceMap(Result(run))


@pytest.mark.parametrize("gain", [1.0, 0.55])
@pytest.mark.parametrize("number", [0, 1])
def test_a_frame_is_located_in_the_submap_that_saw_its_place(places: PlaceMap, number: int, gain: float) -> None:
    assert len(places) == len(KEYFRAMES)
    T = pose(at_mm=((-1, 1)[number] * 25.0, 3.0, 6.0), turn_rad=(0.05, -0.04, 0.3))
    found = places.locate(frame_at(T, 7, gain))
    assert (found.index, found.status, found.map) == (7, "found", number)
    assert found.keyframe in ((0, 1), (2, 3))[number]
    assert found.inliers > 60
    wanted = T_OTHER_WORLD @ T if number else T
    error = inverse(wanted) @ found.T_world_camera
    assert np.linalg.norm(error[:3, 3]) < 0.0024 * PLANE_MM  # by features alone 0.0026 and 0.0030 in two of the four
    assert np.degrees(rotation_angle_rad(error[:3, :3])) < 0.5


def test_another_place_is_not_found(places: PlaceMap) -> None:
    far = places.locate(frame_at(pose(at_mm=(0.0, 75.0, 0.0))))
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (CAMERA.height, CAMERA.width, 3)).astype(np.uint8), (0, 0), 2)
    other = places.locate(replace(frame_at(KEYFRAMES[0]), rgb=noise))
    dark = places.locate(replace(frame_at(KEYFRAMES[0]), rgb=np.zeros_like(noise)))
    for found in (far, other, dark):
        assert (found.status, found.map, found.keyframe, found.inliers) == (NOT_FOUND, -1, -1, 0)
        assert np.isnan(found.T_world_camera).all()


def test_a_patch_alone_places_nothing(places: PlaceMap) -> None:
    frame = frame_at(KEYFRAMES[0])
    valid = np.zeros_like(EVERYWHERE)
    valid[75:105, 100:140] = True
    assert places.locate(replace(frame, valid=valid)).status == NOT_FOUND


def test_the_command_writes_a_line_for_each_frame(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    video, out = tmp_path / "video", tmp_path / "located.csv"
    video.mkdir()
    poses = [pose(at_mm=(-26.0 + k, 1.0, 2.0)) for k in range(3)] + [pose(at_mm=(0.0, 75.0, 0.0))]
    for index, T in enumerate(poses):
        cv2.imwrite(str(video / f"{index:04d}.png"), see(T).rgb[..., ::-1])
    assert call("locate", run, video, "--out", out) == 0
    said = capfd.readouterr().out
    assert "source_camera.yaml" in said  # the video has no calibration of its own
    assert "3 of 4 frames found" in said
    rows = list(csv.DictReader(out.open()))
    assert [row["status"] for row in rows] == ["found"] * 3 + [NOT_FOUND]
    assert [float(rows[1][name]) for name in ("tx", "ty", "tz")] == pytest.approx(poses[1][:3, 3], abs=0.5)
    assert rows[3]["tx"] == rows[3]["map"] == ""
    assert "exists" in refused(capfd, "locate", run, video, "--out", out)
    write_calibration(CAMERA, video / "camera.yaml")
    assert call("locate", run, video, "--out", out, "--frames", ":2", "--overwrite", "--json") == 0
    facts = json.loads(capfd.readouterr().out)
    assert (facts["frames"], facts["found"]) == (2, 2)


def test_what_cannot_be_done_is_said(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert "no finished run" in refused(capfd, "locate", tmp_path, run, "--out", tmp_path / "a.csv")
    with pytest.raises(InputError, match="cannot write"):
        write_located([LocatedFrame(0, 0.0)], tmp_path / "no" / "a.csv")
