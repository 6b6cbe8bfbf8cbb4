"""Exports where a reference was set by hand: in mm by it, but not on segments that it says nothing of."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap.apps.measure.findings import write_findings
from scopemap.apps.measure.hand_measure import HandMeasure, add_measurement
from scopemap.apps.measure.surface_finding import SurfaceFinding
from scopemap.result.result import Result
from tests.apps.browser.test_browser_segments import HALF, in_two_segments
from tests.support.drawn_run import IN_RESULT, draw_run, draw_run_of_frames, draw_textured_run, pose_of, tube
from tests.support.front_door import call

ENDS = np.array([[0.0, 0.0, 10.0], [0.0, 4.0, 10.0]])
FACTOR = 1.25
"""4 units of the result are 5 mm."""
BOX = tube().bounds
WORDS = "scale: sizes rest on the stated reference of 5 mm in frame 2; numbers are those of the result times 1.25"


def refer(folder: Path, frame: int, of: str = ".") -> Path:
    """The folder, with a reference in a frame, of the result or of a submap."""
    pixels = np.array([[10.0, 10.0], [30.0, 30.0]])
    add_measurement(folder, HandMeasure(of, frame, pixels, None, 5.0, [], ENDS, "reference"))
    return folder


def exported(run: Path, to: str, out: Path) -> Path:
    assert call("export", run, "--to", to, "--out", out) == 0
    return out


def bounds(file: Path) -> np.ndarray:
    return np.asarray(trimesh.load(file, process=False).bounds)


def test_surfaces_poses_and_depth_are_in_mm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = refer(draw_run_of_frames(tmp_path), 2)
    ply = exported(run, "ply", tmp_path / "a.ply")
    assert capsys.readouterr().out == f"{ply}: written; {WORDS}\n"
    assert f"comment {WORDS}".encode() in ply.read_bytes()
    np.testing.assert_allclose(bounds(ply), BOX * FACTOR, atol=1e-4)
    for name in ("stl", "pointcloud"):
        out = tmp_path / f"{name}.{'stl' if name == 'stl' else 'ply'}"
        np.testing.assert_allclose(bounds(exported(run, name, out)), BOX * FACTOR, atol=1e-4)
    at_m = np.stack([pose_of(index)[:3, 3] for index in range(IN_RESULT)]) * FACTOR / 1000
    tum = np.loadtxt(exported(run, "tum", tmp_path / "a.txt"))
    np.testing.assert_allclose(tum[:, 1:4], at_m, atol=1e-8)
    scene = exported(run, "nerfstudio", tmp_path / "scene")
    meta = json.loads((scene / "transforms.json").read_text())
    poses = np.array([frame["transform_matrix"] for frame in meta["frames"]])
    np.testing.assert_allclose(poses[:, :3, 3], at_m, atol=1e-8)
    np.testing.assert_allclose(bounds(scene / meta["ply_file_path"]), BOX * FACTOR / 1000, atol=1e-6)
    depth = np.load(scene / meta["frames"][3]["depth_file_path"])
    np.testing.assert_allclose(depth, np.nan_to_num(Result(run).depth.read(3)) * FACTOR, rtol=1e-6)
    exported(run, "endogslam", tmp_path / "slam")
    assert f"png_depth_scale: {1 / (Result(run).depth.scale_mm * FACTOR)!r}" in (
        (tmp_path / "slam" / "camera.yaml").read_text()
    )
    # The result itself stays as it is.
    np.testing.assert_allclose(Result(run).mesh.bounds, BOX, atol=1e-4)


def test_a_textured_surface_and_its_path_grow_together(tmp_path: Path) -> None:
    run = refer(draw_textured_run(tmp_path / "run"), 2)
    textured = Result(run).textured
    assert textured is not None
    np.testing.assert_allclose(
        bounds(exported(run, "glb", tmp_path / "a.glb")) * 1000,
        np.sort(textured.bounds * FACTOR * (1, -1, -1), axis=0),
        atol=1e-3,
    )
    slicer = exported(run, "slicer", tmp_path / "slicer")
    np.testing.assert_allclose(bounds(slicer / "surface.ply"), Result(run).mesh.bounds * FACTOR, atol=1e-4)
    [path] = json.loads((slicer / "path.mrk.json").read_text())["markups"]
    assert path["description"] == WORDS
    points = np.array([point["position"] for point in path["controlPoints"]])
    np.testing.assert_allclose(points, Result(run).tracked.trajectory.positions_mm * FACTOR, atol=1e-9)


def test_findings_lie_on_the_exported_surface(tmp_path: Path) -> None:
    run, spot = refer(draw_run(tmp_path / "run"), 2), SurfaceFinding("spot", np.array([[1.0, 2, 3]]), [])
    write_findings(run, [spot], "a guess", tmp_path / "spot.mrk.json")
    [points] = json.loads((tmp_path / "spot.mrk.json").read_text())["markups"]
    assert points["controlPoints"][0]["position"] == [1.25, 2.5, 3.75]
    assert WORDS in points["description"]


def test_a_dicom_surface_has_its_unit(tmp_path: Path) -> None:
    dcmread = pytest.importorskip("pydicom").dcmread
    run = draw_run(tmp_path / "run")
    units = []
    for name in ("before", "after"):
        stored = dcmread(exported(run, "dicom", tmp_path / f"{name}.dcm"))
        units.append((stored.MeasurementUnitsCodeSequence[0].CodeMeaning, stored.ContentDescription))
        refer(run, 2)
    assert units == [("no units", "scale unknown: do not measure"), ("mm", "scale as stated")]


@pytest.mark.parametrize("main", [0, 1])
def test_a_reference_holds_for_the_surface_of_its_segment_alone(
    tmp_path: Path, main: int, capsys: pytest.CaptureFixture[str]
) -> None:
    run = in_two_segments(draw_run(tmp_path / "run"), main=main)
    as_kept, other = Result(run).mesh.bounds, Result(run).segments[0].words
    refer(run, 2)
    of_main = exported(run, "ply", tmp_path / "a.ply")
    said = capsys.readouterr().out
    np.testing.assert_allclose(bounds(of_main), as_kept * (FACTOR if main == 0 else 1), atol=1e-4)
    if main == 0:
        assert WORDS in said
    else:
        assert f"the reference of 5 mm in frame 2 holds only for the part from {other}): compare shapes" in said
    surfaces = exported(run, "surfaces", tmp_path / "all")
    for index in (0, HALF):
        file = surfaces / f"{index:06d}.ply"
        own = Result(run).mesh_at(index).bounds
        np.testing.assert_allclose(bounds(file), own * (FACTOR if index == 0 else 1), atol=1e-4)
        assert (WORDS.encode() in file.read_bytes()) == (index == 0)
    # A path through both has no scale.
    tum = exported(run, "tum", tmp_path / "a.txt")
    np.testing.assert_allclose(np.loadtxt(tum)[3, 1:4] * 1000, pose_of(3)[:3, 3], atol=1e-6)
    assert f"holds only for the part from {other}" in tum.read_text()


def test_a_reference_of_a_submap_is_not_that_of_the_result(tmp_path: Path) -> None:
    run = draw_run(tmp_path / "run")
    frame = int(Result(run).submaps[1].tracked["index"][0])
    refer(run, frame, "maps/1")
    submap = run / "maps" / "1"
    for folder, factor in ((run, 1), (submap, FACTOR)):
        out = exported(folder, "ply", tmp_path / f"{factor}.ply")
        np.testing.assert_allclose(bounds(out), Result(folder).mesh.bounds * factor, atol=1e-4)


def test_a_known_scale_and_a_reference_of_unknown_length_change_nothing(tmp_path: Path) -> None:
    known = refer(draw_run(tmp_path / "known", scale={"known": True, "source": "a ruler", "measured": True}), 2)
    without = draw_run(tmp_path / "without")
    add_measurement(without, HandMeasure(".", 2, np.zeros((2, 2)), None, None, [], ENDS, "reference"))
    for run in (known, without):
        np.testing.assert_allclose(bounds(exported(run, "ply", tmp_path / f"{run.name}.ply")), BOX, atol=1e-4)
