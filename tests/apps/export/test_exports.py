"""Every export, read back by a reader that is not ours: scale, axes and order agree with the run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import trimesh
import yaml
from evo.core import metrics, trajectory
from evo.tools import file_interface
from PIL import Image

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.result.trajectories import read_trajectory
from tests.support.drawn_run import CAMERA, IN_FIRST_MAP, IN_RESULT, draw_run, draw_run_of_frames, pose_of, tube
from tests.support.front_door import call, exported, refused

POSES = np.stack([pose_of(index) for index in range(IN_RESULT)])
UNKNOWN = "scale unknown (scopenet's own scale): compare shapes, not sizes"
BOX_MM = tube().bounds


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 24 frames, of which 14 are in the result and 7 in maps/1, and its input."""
    return draw_run_of_frames(tmp_path_factory.mktemp("exports"))


def seen(index: int) -> np.ndarray:
    """The picture of a frame, drawn."""
    return render_mesh(tube(), CAMERA, pose_of(index)).rgb


def depth_of(index: int) -> np.ndarray:
    return np.nan_to_num(render_mesh(tube(), CAMERA, pose_of(index)).depth_mm)


# ---- pictures


def test_nerfstudio(run: Path, tmp_path: Path) -> None:
    # Its parser: columns of a camera-to-world matrix are right, up and backward; a pixel's centre is at + 0.5; depth
    # files are multiplied by 0.001; points are in the world of the poses; frames are sorted by name; unknown = 0.
    folder = exported(run, "nerfstudio", tmp_path / "out")
    meta: dict[str, Any] = json.loads((folder / "transforms.json").read_text())
    assert (meta["w"], meta["h"], meta["scale"]) == (80, 64, UNKNOWN)
    files = [frame["file_path"] for frame in meta["frames"]]
    assert files == sorted(files) == [f"images/{index:06d}.png" for index in range(IN_RESULT)]
    cloud = trimesh.load(folder / meta["ply_file_path"])
    assert f"comment {UNKNOWN}".encode() in (folder / meta["ply_file_path"]).read_bytes()
    np.testing.assert_allclose(cloud.bounds, BOX_MM / 1000, atol=1e-6)
    for index in (0, 9):
        frame = meta["frames"][index]
        c2w = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(c2w[:3, 3], POSES[index, :3, 3] / 1000, atol=1e-9)
        depth_m = np.load(folder / frame["depth_file_path"]) * 0.001
        np.testing.assert_allclose(depth_m, depth_of(index) / 1000, atol=1e-5)
        # Each pixel goes along its ray and ends at the surface.
        v, u = np.mgrid[4:64:20, 10:80:20]
        x = (u + 0.5 - meta["cx"]) / meta["fl_x"]
        y = -(v + 0.5 - meta["cy"]) / meta["fl_y"]
        rays = np.stack([x, y, -np.ones_like(x)], axis=-1)
        points = (rays * depth_m[v, u][..., None]) @ c2w[:3, :3].T + c2w[:3, 3]
        inside = depth_m[v, u] > 0
        radius_m = np.hypot(points[..., 0], points[..., 1])[inside]
        on_wall = points[..., 2][inside] < 0.0849
        assert np.abs(radius_m[on_wall] - 0.01).max() < 1e-4
        assert on_wall.sum() > 5
        np.testing.assert_allclose(np.asarray(Image.open(folder / frame["file_path"])), seen(index), atol=2)
        mask = np.asarray(Image.open(folder / frame["mask_path"]))
        assert mask.shape == (64, 80)
        assert set(np.unique(mask)) <= {0, 255}


def test_colmap(run: Path, tmp_path: Path) -> None:
    folder = exported(run, "colmap", tmp_path / "out")
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    (camera,) = model.cameras.values()
    assert camera.model == pycolmap.CameraModelId.PINHOLE
    assert (camera.width, camera.height) == (80, 64)
    images = sorted(model.images.values(), key=lambda image: image.image_id)
    assert [image.name for image in images] == [f"{index:06d}.png" for index in range(IN_RESULT)]
    found = np.stack([image.cam_from_world().matrix() for image in images])
    np.testing.assert_allclose(found, np.linalg.inv(POSES)[:, :3], atol=1e-7)
    # A vertex falls where our own camera sees it; COLMAP's pixels count from the corner.
    points = np.array([model.points3D[number].xyz for number in sorted(model.points3D)])
    np.testing.assert_allclose(points, tube().vertices, atol=1e-6)
    assert (model.points3D[1].color == tube().visual.vertex_colors[0, :3]).all()
    in_camera = (points[500] - POSES[3, :3, 3]) @ POSES[3, :3, :3]
    pixel = np.array([60, 60]) * in_camera[:2] / in_camera[2] + [39.5, 31.5]
    np.testing.assert_allclose(images[3].project_point(points[500]), pixel + 0.5, atol=1e-6)
    assert UNKNOWN in (folder / "sparse/0/images.txt").read_text()
    np.testing.assert_allclose(np.asarray(Image.open(folder / "images/000003.png")), seen(3), atol=2)
    assert (folder / "masks/000003.png.png").is_file()
    metres = pycolmap.Reconstruction(exported(run, "colmap", tmp_path / "m", "--units", "m") / "sparse" / "0")
    np.testing.assert_allclose(metres.points3D[7].xyz * 1000, points[6], atol=1e-5)


def test_rgbd_as_endogslam_reads_it(run: Path, tmp_path: Path) -> None:
    folder = exported(run, "endogslam", tmp_path / "out")
    facts = yaml.safe_load((folder / "camera.yaml").read_text())
    known = facts["camera_params"]
    assert facts["dataset_name"] == "c3vd"
    names = ("image_height", "image_width", "fx", "fy", "cx", "cy")
    assert [known[name] for name in names] == [64, 80, 60, 60, 39.5, 31.5]
    colours, depths = sorted((folder / "color").glob("*.png")), sorted((folder / "depth").glob("*.tiff"))
    assert len(colours) == len(depths) == IN_RESULT
    for index in (0, 13):
        assert Image.open(depths[index]).info["compression"] == "tiff_adobe_deflate"  # LZW needs imagecodecs
        depth_mm = np.array(Image.open(depths[index]), dtype=np.float64) / known["png_depth_scale"]
        np.testing.assert_allclose(depth_mm, depth_of(index), atol=0.011)
        np.testing.assert_allclose(np.asarray(Image.open(colours[index])), seen(index), atol=2)
    lines = (folder / "pose.txt").read_text().splitlines()
    poses = np.array([[float(number) for number in line.split(",")] for line in lines]).reshape(-1, 4, 4)
    np.testing.assert_allclose(poses.transpose(0, 2, 1), POSES, atol=1e-7)


def test_depth_is_of_all_frames_or_of_none(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    other = Path(shutil.copytree(run, tmp_path / "run"))
    (other / "depth/000005.png").unlink()
    folder = exported(other, "nerfstudio", tmp_path / "out")
    assert not (folder / "depth").exists()
    assert "depth_file_path" not in (folder / "transforms.json").read_text()
    said = refused(capfd, "export", other, "--to", "endogslam", "--out", tmp_path / "rgbd")
    assert "not every tracked frame has its depth" in said


def test_an_export_that_fails_leaves_nothing(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    other, frames, place = tmp_path / "run", tmp_path / "frames", tmp_path / "exports"
    shutil.copytree(run, other)
    facts = json.loads((other / "provenance.json").read_text())
    shutil.copytree(facts["input"], frames)
    (other / "provenance.json").write_text(json.dumps(facts | {"input": str(frames)}))
    (frames / f"{IN_RESULT - 1:06d}.png").unlink()
    assert f"has no frame {IN_RESULT - 1} any more" in refused(
        capfd, "export", other, "--to", "nerfstudio", "--out", place / "out"
    )
    assert list(place.iterdir()) == []
    (other / "mesh.ply").unlink()
    assert "no surface" in refused(capfd, "export", other, "--to", "slicer", "--out", place / "out")
    assert list(place.iterdir()) == []


# ---- paths


def assert_path(found: trajectory.PosePath3D) -> None:
    """By evo, in metres: it has the run's poses without any alignment."""
    expected = POSES.copy()
    expected[:, :3, 3] /= 1000
    truth = trajectory.PosePath3D(poses_se3=list(expected))
    error = metrics.APE(metrics.PoseRelation.full_transformation)
    error.process_data((truth, found))
    assert error.get_statistic(metrics.StatisticsType.max) < 1e-8
    assert truth.path_length == pytest.approx(found.path_length, rel=1e-6)


def test_tum_kitti_and_euroc(run: Path, tmp_path: Path) -> None:
    tum = file_interface.read_tum_trajectory_file(exported(run, "tum", tmp_path / "path.txt"))
    euroc = file_interface.read_euroc_csv_trajectory(exported(run, "euroc", tmp_path / "data.csv"))
    kitti = exported(run, "kitti", tmp_path / "kitti")
    for found in (tum, euroc, file_interface.read_kitti_poses_file(kitti / "poses.txt")):
        assert_path(found)
    for times_s in (tum.timestamps, euroc.timestamps, np.loadtxt(kitti / "times.txt")):
        np.testing.assert_allclose(times_s, np.arange(IN_RESULT) / 25, atol=1e-6)
    assert all(UNKNOWN in (tmp_path / name).read_text() for name in ("path.txt", "data.csv"))
    exported(run, "tum", tmp_path / "mm.txt", "--units", "mm")
    mm = file_interface.read_tum_trajectory_file(tmp_path / "mm.txt")
    np.testing.assert_allclose(mm.positions_xyz, POSES[:, :3, 3], atol=1e-8)


@pytest.mark.parametrize("to", ["tum", "kitti", "euroc"])
@pytest.mark.parametrize("name", ["t.tum", "t.txt", "T.TXT", "t.csv", "t.kitti", "a.b.txt"])
def test_a_text_file_of_poses_may_have_any_ending(to: str, name: str, run: Path, tmp_path: Path) -> None:
    file = exported(run, to, tmp_path / name)
    assert file.is_file()
    reader = {
        "tum": file_interface.read_tum_trajectory_file,
        "kitti": file_interface.read_kitti_poses_file,
        "euroc": file_interface.read_euroc_csv_trajectory,
    }
    assert_path(reader[to](file))


@pytest.mark.parametrize("to", ["nerfstudio", "colmap", "endogslam", "endonerf", "surfaces", "slicer"])
@pytest.mark.parametrize("name", ["a.json", "a.txt", "a.zip", "a.PLY"])
def test_a_files_name_for_a_folder_is_refused(
    to: str, name: str, run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    message = refused(capfd, "export", run, "--to", to, "--out", tmp_path / name)
    assert f"{to} is a folder of files; give --out a name without {Path(name).suffix.lower()}" in message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("to", "name"), [("tum", "t.ply"), ("kitti", "k.stl"), ("euroc", "e.mcap"), ("ply", "t.tum")])
def test_the_ending_of_another_format_is_refused(
    to: str, name: str, run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    message = refused(capfd, "export", run, "--to", to, "--out", tmp_path / name)
    assert "ending of another format" in message or "must end in" in message


def test_a_folder_may_have_a_point_in_its_name(run: Path, tmp_path: Path) -> None:
    assert (exported(run, "kitti", tmp_path / "exam.2") / "poses.txt").is_file()


def test_a_submap_is_exported_by_its_own_folder(run: Path, tmp_path: Path) -> None:
    found = file_interface.read_tum_trajectory_file(exported(run / "maps/1", "tum", tmp_path / "path.txt"))
    np.testing.assert_allclose(found.timestamps, np.arange(24 - IN_FIRST_MAP, 24) / 25, atol=1e-6)
    # Its depth is in the run's folder.
    assert len(list((exported(run / "maps/1", "nerfstudio", tmp_path / "out") / "depth").iterdir())) == IN_FIRST_MAP


# ---- surfaces

TO_FILE = {"lps": [1, 1, 1], "ras": [-1, -1, 1], "opencv": [1, 1, 1], "gltf": [1, -1, -1]}


@pytest.mark.parametrize("ending", ["ply", "obj", "stl"])
@pytest.mark.parametrize("axes", list(TO_FILE))
def test_surfaces(run: Path, tmp_path: Path, ending: str, axes: str) -> None:
    file = exported(run, ending, tmp_path / f"surface.{ending}", "--axes", axes, "--units", "m")
    found = trimesh.load(file, process=False)
    expected = tube().triangles * TO_FILE[axes] / 1000
    np.testing.assert_allclose(found.triangles, expected, atol=1e-7)
    # Faces keep the side that they show: the enclosed volume has the same sign.
    assert found.volume == pytest.approx(tube().volume / 1e9, rel=1e-4)
    if ending != "stl":
        assert (found.visual.vertex_colors[:, :3] == tube().visual.vertex_colors[:, :3]).all()
    if ending == "ply":
        rows = found.metadata["_ply_raw"]["vertex"]["data"]
        np.testing.assert_array_equal(rows["confidence"], tube().vertex_attributes["confidence"])
    head = file.read_bytes()[:400].decode("ascii", "replace")
    assert ("SPACE=LPS" in head, "SPACE=RAS" in head) == (axes == "lps", axes == "ras")
    assert "unit: m" in head
    assert "scale unknown" in head
    assert not head.startswith("solid")


def test_glb_is_in_metres_with_y_up(run: Path, tmp_path: Path) -> None:
    found = trimesh.load(exported(run, "glb", tmp_path / "surface.glb"), force="mesh", process=False)
    np.testing.assert_allclose(found.triangles, tube().triangles * TO_FILE["gltf"] / 1000, atol=1e-7)


def test_slicer(run: Path, tmp_path: Path) -> None:
    folder = exported(run, "slicer", tmp_path / "out")
    document = json.loads((folder / "path.mrk.json").read_text())
    # What markups-schema-v1.0.3.json requires and allows.
    assert "markups-schema-v1.0.3.json" in document["@schema"]
    (curve,) = document["markups"]
    assert (curve["type"], curve["coordinateSystem"], curve["coordinateUnits"]) == ("Curve", "LPS", "mm")
    assert curve["description"] == UNKNOWN
    points = curve["controlPoints"]
    assert [point["label"] for point in points] == [f"frame {index}" for index in range(IN_RESULT)]
    np.testing.assert_allclose([point["position"] for point in points], POSES[:, :3, 3], atol=1e-6)
    assert {point["positionStatus"] for point in points} == {"defined"}
    surface = trimesh.load(folder / "surface.ply")
    np.testing.assert_allclose(surface.bounds, BOX_MM, atol=1e-5)
    assert b"comment SPACE=LPS\n" in (folder / "surface.ply").read_bytes()


# ---- what is said and refused


def test_the_scale_is_said_once(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert call("export", run, "--to", "kitti", "--out", tmp_path / "out") == 0
    assert capfd.readouterr().out == f"{tmp_path / 'out'}: written; {UNKNOWN}\n"
    assert call("export", run, "--to", "tum", "--out", tmp_path / "a.txt", "--json") == 0
    assert json.loads(capfd.readouterr().out) == {"out": str(tmp_path / "a.txt"), "format": "tum", "scale": UNKNOWN}


def test_what_cannot_be_exported_is_refused(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    without = draw_run(tmp_path / "a", pictures=False)
    assert "was not found; name it with --input PATH" in refused(
        capfd, "export", without, "--to", "colmap", "--out", out
    )
    assert "no finished run" in refused(capfd, "export", tmp_path, "--to", "tum", "--out", tmp_path / "a.txt")
    assert "must end in .stl" in refused(capfd, "export", run, "--to", "stl", "--out", out)
    assert "--units mm: euroc has m" in refused(
        capfd, "export", run, "--to", "euroc", "--units", "mm", "--out", tmp_path / "a.csv"
    )
    assert "--axes ras: colmap has opencv" in refused(
        capfd, "export", run, "--to", "colmap", "--axes", "ras", "--out", out
    )
    assert f"{tmp_path} exists" in refused(capfd, "export", run, "--to", "slicer", "--out", tmp_path)
    assert call("export", run, "--to", "tum", "--clip", "x", "--out", tmp_path / "a.txt") == 2
    assert call("export", run, "--to", "climb", "--units", "m", "--out", out) == 2
    assert call("export", "--to", "tum", "--out", tmp_path / "a.txt") == 2
    assert not out.exists()


@pytest.mark.parametrize(("to", "out", "poses"), [("kitti", "k", "k/poses.txt"), ("kitti", "k.txt", "k.txt")])
def test_lines_of_a_part_name_their_frames(
    to: str, out: str, poses: str, run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The first line of a part is no frame 0, and whoever lays it beside a whole video's truth must know."""
    capfd.readouterr()
    assert call("export", run / "maps/1", "--to", to, "--out", tmp_path / out) == 0
    said = capfd.readouterr().out
    first, file = 24 - IN_FIRST_MAP, tmp_path / poses
    assert f"the {IN_FIRST_MAP} lines of {file.name} are frames {first} to 23 of the input" in said
    beside = file.with_name(f"{file.stem}.frames.txt")
    assert beside.name in said
    assert np.loadtxt(beside).tolist() == list(range(first, 24))
    found = read_trajectory(file)
    assert found.indices.tolist() == list(range(first, 24))
    assert "frame numbers by" in found.source
    beside.write_text("3\n4\n")
    with pytest.raises(InputError, match=f"numbers 2 lines, {file.name} has {IN_FIRST_MAP}; export again"):
        read_trajectory(file)


def test_lines_that_are_frame_numbers_need_no_list(
    run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    capfd.readouterr()
    assert call("export", run, "--to", "kitti", "--out", tmp_path / "k.txt", "--json") == 0
    assert "lines" not in json.loads(capfd.readouterr().out)
    assert [file.name for file in tmp_path.iterdir()] == ["k.txt"]


def test_an_export_for_endogslam_names_the_frames_of_its_poses(run: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(run, tmp_path / "run"))
    lines = (other / "frames.csv").read_text().splitlines()
    (other / "frames.csv").write_text("\n".join([lines[0], *lines[4:]]) + "\n")
    poses = (other / "trajectory.tum").read_text().splitlines()
    heads = [line for line in poses if line.startswith("#")]
    (other / "trajectory.tum").write_text("\n".join([*heads, *poses[len(heads) + 3 :]]) + "\n")
    folder = exported(other, "endogslam", tmp_path / "out")
    numbers = [int(file.name[:6]) for file in sorted((folder / "color").glob("*.png"))]
    assert numbers == list(range(3, IN_RESULT))
    assert read_trajectory(folder / "pose.txt").indices.tolist() == numbers
