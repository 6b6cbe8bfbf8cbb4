"""Point cloud, Gaussians, MCAP, DICOM and EndoNeRF's folder, read back by readers that are not ours."""

from __future__ import annotations

import json
import sys
from base64 import b64decode
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pydicom
import pytest
import trimesh
from mcap.reader import make_reader
from PIL import Image
from scipy.spatial.transform import Rotation

from scopemap.apps.export.image_layouts import write_endonerf
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.fusion.mesh_files import save_mesh
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.result.result import Result
from tests.support.drawn_run import CAMERA, IN_RESULT, draw_run, draw_run_of_frames, pose_of, tube
from tests.support.front_door import exported, refused

UNKNOWN = "scale unknown (scopenet's own scale): compare shapes, not sizes"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_run_of_frames(tmp_path_factory.mktemp("exports"))


def columns_of(file: Path) -> np.ndarray:
    """The table of vertices as trimesh parses it."""
    return np.asarray(trimesh.load(file, process=False).metadata["_ply_raw"]["vertex"]["data"])


def test_point_cloud(run: Path, tmp_path: Path) -> None:
    mesh = Result(run).mesh
    mesh.vertex_attributes["sigma_mm"] = np.full(len(mesh.vertices), 2.0, np.float32)
    save_mesh(mesh, run / "mesh.ply")
    for kind in ("ply", "pointcloud"):
        columns = columns_of(exported(run, kind, tmp_path / f"{kind}.ply", "--units", "m"))
        np.testing.assert_array_equal(columns["confidence"], mesh.vertex_attributes["confidence"])
        np.testing.assert_allclose(columns["sigma_m"], 0.002)
    file = exported(run, "pointcloud", tmp_path / "points.ply", "--units", "m")
    cloud = trimesh.load(file, process=False)
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_allclose(cloud.vertices, tube().vertices / 1000, atol=1e-7)
    np.testing.assert_array_equal(cloud.colors[:, :3], tube().visual.vertex_colors[:, :3])
    columns = columns_of(file)
    np.testing.assert_array_equal(columns["confidence"], tube().vertex_attributes["confidence"])
    normals = np.stack([columns[name] for name in ("nx", "ny", "nz")], -1)
    wall = tube().vertices[:, 2] < 84
    inward = -tube().vertices[wall, :2] / 10
    np.testing.assert_allclose(normals[wall, :2], inward, atol=0.02)
    assert f"comment {UNKNOWN}".encode() in file.read_bytes()[:600]


def test_gaussians_as_the_reference_loads_them(run: Path, tmp_path: Path) -> None:
    # load_ply sorts columns by the number at their end, and asserts 45 of f_rest_ at degree 3; activations: exp of the
    # scales, sigmoid of the opacity, quaternions with w first; colour = 0.5 + C0 * f_dc.
    columns = columns_of(exported(run, "gaussians", tmp_path / "start.ply"))
    names = list(columns.dtype.names)
    rest = [name for name in names if name.startswith("f_rest_")]
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    assert names == [*expected, "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert len(rest) == 3 * (3 + 1) ** 2 - 3
    assert all(columns.dtype[name] == np.float32 for name in names)
    xyz = np.stack([columns[name] for name in "xyz"], -1)
    np.testing.assert_allclose(xyz, tube().vertices, atol=1e-5)
    colour = 0.5 + 0.28209479177387814 * np.stack([columns[f"f_dc_{k}"] for k in range(3)], -1)
    np.testing.assert_allclose(255 * colour, tube().visual.vertex_colors[:, :3], atol=1e-3)
    assert 1 / (1 + np.exp(-columns["opacity"])) == pytest.approx(0.9)
    # A disc on the wall: its thin axis is the normal, and it reaches its neighbours, 1.31 and 1.33 mm away.
    wall = tube().vertices[:, 2] < 80
    scales = np.exp(np.stack([columns[f"scale_{k}"] for k in range(3)], -1))[wall]
    np.testing.assert_allclose(scales[:, :2], 1.32, atol=0.03)
    np.testing.assert_allclose(scales[:, 2], 0.132, atol=0.003)
    wxyz = np.stack([columns[f"rot_{k}"] for k in range(4)], -1)
    thin = Rotation.from_quat(np.roll(wxyz, -1, axis=1)).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(thin[wall, :2], -tube().vertices[wall, :2] / 10, atol=0.02)
    lid = np.flatnonzero(np.hypot(*tube().vertices[:, :2].T) < 1)
    np.testing.assert_allclose(thin[lid], [[0, 0, -1]], atol=1e-6)  # straight against the z axis


def messages_of(file: Path) -> dict[str, list[tuple[str, int, Any]]]:
    """By topic: name of the schema, time in ns, content."""
    found: dict[str, list[tuple[str, int, Any]]] = {}
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            content = json.loads(message.data)
            assert set(content) == set(json.loads(schema.data)["properties"])
            found.setdefault(channel.topic, []).append((schema.name, message.log_time, content))
    return found


def test_mcap(run: Path, tmp_path: Path) -> None:
    file = exported(run, "mcap", tmp_path / "run.mcap")
    found = messages_of(file)
    assert {topic: rows[0][0] for topic, rows in found.items()} == {
        "/image": "foxglove.CompressedImage",
        "/calibration": "foxglove.CameraCalibration",
        "/tf": "foxglove.FrameTransform",
    }
    for rows in found.values():
        assert [time_ns for _, time_ns, _ in rows] == [round(index * 1e9 / 25) for index in range(IN_RESULT)]
        stamps = [row["timestamp"]["sec"] * 10**9 + row["timestamp"]["nsec"] for _, _, row in rows]
        assert stamps == [time_ns for _, time_ns, _ in rows]
    for index in (0, 9):
        image = found["/image"][index][2]
        picture = cv2.imdecode(np.frombuffer(b64decode(image["data"]), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        seen = render_mesh(tube(), CAMERA, pose_of(index)).rgb
        assert np.abs(picture.astype(int) - seen).mean() < 6
        pose = found["/tf"][index][2]
        assert (pose["parent_frame_id"], pose["child_frame_id"], image["frame_id"]) == ("world", "camera", "camera")
        np.testing.assert_allclose([pose["translation"][k] for k in "xyz"], pose_of(index)[:3, 3] / 1000, atol=1e-9)
        R = Rotation.from_quat([pose["rotation"][k] for k in "xyzw"]).as_matrix()
        np.testing.assert_allclose(R, pose_of(index)[:3, :3], atol=1e-9)
    calibration = found["/calibration"][0][2]
    assert (calibration["width"], calibration["height"]) == (80, 64)
    assert calibration["K"] == [60.0, 0.0, 39.5, 0.0, 60.0, 31.5, 0.0, 0.0, 1.0]
    with file.open("rb") as stream:
        (kept,) = make_reader(stream).iter_metadata()
    assert kept.metadata == {"unit": "m", "scale": UNKNOWN}


def test_dicom(run: Path, tmp_path: Path) -> None:
    file = exported(run, "dicom", tmp_path / "surface.dcm")
    data = pydicom.dcmread(file)
    assert data.SOPClassUID == data.file_meta.MediaStorageSOPClassUID == "1.2.840.10008.5.1.4.1.1.104.3"
    assert (data.Modality, data.MIMETypeOfEncapsulatedDocument) == ("M3D", "model/stl")
    content = data.EncapsulatedDocument[: data.EncapsulatedDocumentLength]
    surface = trimesh.load(BytesIO(content), file_type="stl", process=False)
    np.testing.assert_allclose(surface.triangles, tube().triangles, atol=1e-5)
    assert content.startswith(b"SPACE=LPS")
    # Nobody is named, and no viewer measures in a unit that is a guess.
    assert data.PatientIdentityRemoved == "YES"
    # What was done is known; whether a patient can be told by the shape is not.
    assert data.DeidentificationMethod == "nothing copied from the input's tags; not checked further"
    assert "no name, number or date was copied" in data.ImageComments
    assert "patient's data" not in str(data)
    assert UNKNOWN in data.ImageComments
    assert {str(data[k].value) for k in ("PatientName", "PatientID", "PatientBirthDate", "StudyDate")} <= {"", "None"}
    assert data.MeasurementUnitsCodeSequence[0].CodeValue == "1"
    assert str(run.parent) not in str(data)
    again = pydicom.dcmread(exported(run, "dicom", tmp_path / "again.dcm"))
    assert again.SOPInstanceUID == data.SOPInstanceUID
    metres = pydicom.dcmread(exported(run, "dicom", tmp_path / "m.dcm", "--units", "m"))
    assert metres.SOPInstanceUID != data.SOPInstanceUID


def test_dicom_of_known_scale_has_its_unit(tmp_path: Path) -> None:
    known = draw_run(tmp_path / "run", scale={"known": True, "source": "measured depth"})
    data = pydicom.dcmread(exported(known, "dicom", tmp_path / "surface.dcm"))
    assert data.MeasurementUnitsCodeSequence[0].CodeValue == "mm"
    assert data.ContentDescription == "scale known"
    stated = draw_run(tmp_path / "stated", scale={"known": True, "stated": True, "source": "near-far 10:80 mm"})
    data = pydicom.dcmread(exported(stated, "dicom", tmp_path / "stated.dcm"))
    assert data.ContentDescription == "scale as stated"
    assert "sizes rest on the stated near-far 10:80 mm" in data.ImageComments


def test_endonerf(run: Path, tmp_path: Path) -> None:
    # As load_llff.py has it: sorted files, rows of 17, [R | t] used as camera-to-world, rays by one focal length from
    # the middle of the picture, masks inverted, depth in the unit of the poses.
    folder = exported(run, "endonerf", tmp_path / "out")
    rows = np.load(folder / "poses_bounds.npy")
    assert rows.shape == (IN_RESULT, 17)
    matrices = rows[:, :15].reshape(-1, 3, 5)
    np.testing.assert_allclose(matrices[:, :, :4], [pose_of(k)[:3] for k in range(IN_RESULT)], atol=1e-7)
    np.testing.assert_allclose(matrices[:, :, 4], np.tile([64, 80, 60], (IN_RESULT, 1)))
    files = {name: sorted((folder / name).iterdir()) for name in ("images", "depth", "masks")}
    assert {len(found) for found in files.values()} == {IN_RESULT}
    for index in (0, 9):
        seen = render_mesh(tube(), CAMERA, pose_of(index))
        np.testing.assert_allclose(np.asarray(Image.open(files["images"][index])), seen.rgb, atol=2)
        depth_mm = np.asarray(Image.open(files["depth"][index])).astype(float)
        np.testing.assert_allclose(depth_mm, np.nan_to_num(seen.depth_mm), atol=0.51)
        assert rows[index, 15:] == pytest.approx([np.nanmin(seen.depth_mm), np.nanmax(seen.depth_mm)], abs=0.02)
        usable = 1 - np.asarray(Image.open(files["masks"][index])) / 255.0
        assert set(np.unique(usable)) <= {0.0, 1.0}
        assert 0.3 < usable.mean() <= 1


def test_endonerf_has_its_principal_point_in_the_middle(run: Path, tmp_path: Path) -> None:

    lens = PinholeCamera(60.0, 48.0, 36.5, 29.0, 80, 64)
    exported = Result(run)
    exported.camera = lens
    write_endonerf(exported, tmp_path / "out")
    # What the run's picture shows at (u, v) is where a camera with one focal length, centred, has it.
    u, v = 50, 40
    there = (39.5 + (u - 36.5), 31.5 + (v - 29.0) * 60 / 48)
    depth_mm = np.nan_to_num(render_mesh(tube(), CAMERA, pose_of(3)).depth_mm)
    moved = cv2.imread(str(tmp_path / "out/depth/frame-000003.depth.png"), cv2.IMREAD_UNCHANGED)
    assert moved[round(there[1]), round(there[0])] == pytest.approx(depth_mm[v, u], abs=0.6)
    assert (moved[:, :3] == 0).all()  # not seen by the run's camera
    hidden = cv2.imread(str(tmp_path / "out/masks/frame-000003.mask.png"), cv2.IMREAD_UNCHANGED)
    assert (hidden[:, :3] == 255).all()


@pytest.mark.parametrize(("to", "package"), [("mcap", "mcap.writer"), ("dicom", "pydicom.uid")])
def test_a_missing_extra_is_named(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], to: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    ending = {"mcap": ".mcap", "dicom": ".dcm"}[to]
    assert f"'.[{to}]'" in refused(capfd, "export", run, "--to", to, "--out", tmp_path / f"a{ending}")
