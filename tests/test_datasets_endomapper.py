"""EndoMapper: the video of a procedure, its endoscope's calibration, and the largest of COLMAP's sub-models."""

from __future__ import annotations

import json
import shutil
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from drawn_inputs import number_in, picture
from test_datasets_stereomis import write_frames

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.cameras.lenses import FisheyeCamera
from scopemap.errors import InputError
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory

SIZE = (160, 120)
FRAMES = 6
KB4 = (79.7, 79.8, 81.6, 61.3, -0.1396589, -0.0003139987, 0.001505504, -0.0001316715)
XML = """<rig>
  <camera>
    <camera_model name="" index="0" serialno="0" type="{kind}" version="8">
      <width> {width} </width>
      <height> {height} </height>
      <right>[ 1; 0; 0 ]</right>
      <params>[
        {params}
      ]</params>
    </camera_model>
  </camera>
</rig>
"""
# World-to-camera, quaternion with the scalar first: half a turn about z, then away from the origin.
HALF_TURN_ABOUT_Z = (0.0, 0.0, 0.0, 1.0)


def xml(params: tuple[float, ...] = KB4, kind: str = "calibu_fu_fv_u0_v0_kb4", size: tuple[int, int] = SIZE) -> str:
    return XML.format(kind=kind, width=size[0], height=size[1], params=";\n        ".join(map(str, params)))


def images_bin(frames: list[int], name: str = "out{}.png", quaternion: tuple[float, ...] = HALF_TURN_ABOUT_Z) -> bytes:
    """An images.bin whose frame N has the translation (N, 2, -3), and N points that are to be passed over."""
    content = struct.pack("<Q", len(frames))
    for number, frame in enumerate(frames):
        content += (
            struct.pack("<i7di", number + 1, *quaternion, frame, 2.0, -3.0, 1) + name.format(frame).encode() + b"\0"
        )
        content += struct.pack("<Q", frame) + b"\x07" * 24 * frame
    return content


def write_models(archive: Path, models: dict[int, bytes]) -> None:
    """Write sub-models."""
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as opened:
        for number, content in models.items():
            opened.writestr(f"33/sparse/{number}/images.bin", content)
            opened.writestr(f"33/sparse/{number}/cameras.bin", b"")


def write_endomapper(root: Path, number: object = 1) -> Path:
    """Write a procedure without reconstruction, below `root`; return its folder."""
    folder = root / "Sequences" / "Seq_001"
    folder.mkdir(parents=True)
    write_frames(folder / "Seq_001.mov", [picture(i, SIZE) for i in range(FRAMES)], rate=50)
    (folder / "Seq_001_info.json").write_text(json.dumps({"endoscope_number": number, "meta-data": []}))
    calibration = root / "Calibrations" / "Endoscope_01" / "Endoscope_01_geometrical.xml"
    calibration.parent.mkdir(parents=True)
    calibration.write_text(xml())
    return folder


def archive_of(folder: Path) -> Path:
    return folder / "meta-data" / "colmap" / "Seq_001.zip"


def test_a_procedure(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path / "EndoMapper")
    for path in (folder, folder.parent, tmp_path / "EndoMapper", tmp_path):
        sequence = open_sequence(path)
        assert (sequence.source.name, sequence.path, sequence.count) == ("endomapper", folder, FRAMES)
    assert sequence.source.camera == FisheyeCamera(PinholeCamera(*KB4[:4], *SIZE), KB4[4:])
    assert "Endoscope_01_geometrical.xml" in sequence.camera_source
    raw = list(sequence.source.frames(slice(None)))
    assert [number_in(frame.rgb) for frame in raw] == [frame.index for frame in raw] == list(range(FRAMES))
    np.testing.assert_allclose([frame.time_s for frame in raw], np.arange(FRAMES) / 50)
    assert all(truth is None for _, truth in sequence)
    assert reference_trajectory(sequence) is None
    assert sequence.source.masks is None
    assert any("no pose is known" in note for note in sequence.notes)
    assert sequence.warnings == []


@pytest.mark.parametrize("number", [1, "1", "01", "Endoscope_01"])
def test_every_form_of_the_endoscopes_number(number: object, tmp_path: Path) -> None:
    assert open_sequence(write_endomapper(tmp_path, number)).calibrated


@pytest.mark.parametrize("number", ["N/A", "", None])
def test_a_procedure_without_calibration(number: object, tmp_path: Path) -> None:
    sequence = open_sequence(write_endomapper(tmp_path, number))
    assert not sequence.calibrated
    assert any("no calibration: Seq_001_info.json names no endoscope" in note for note in sequence.notes)
    assert any("field of view" in note for note in sequence.notes)


def test_a_calibration_beside_the_video(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path, "N/A")
    (folder / "Endoscope_07_geometrical.xml").write_text(xml((90.0, *KB4[1:])))
    assert open_sequence(folder).source.camera.central.fx == 90.0
    write_calibration(PinholeCamera(100.0, 100.0, 80.0, 60.0, *SIZE), folder / "camera.yaml")
    assert open_sequence(folder).source.camera.central.fx == 100.0


def test_a_video_of_another_name_beside_a_calibration(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    (folder / "Seq_001.mov").rename(folder / "clip.mov")
    assert not open_sequence(folder / "clip.mov").calibrated
    (folder / "Endoscope_01_geometrical.xml").write_text(xml())
    sequence = open_sequence(folder)
    assert (sequence.source.name, sequence.calibrated) == ("endomapper", True)


def test_a_calibration_that_is_named_but_not_there_is_told(tmp_path: Path) -> None:
    sequence = open_sequence(write_endomapper(tmp_path, 12))
    assert not sequence.calibrated
    assert any("Endoscope_12_geometrical.xml (Seq_001_info.json) is not in" in w for w in sequence.warnings)
    (sequence.path / "Seq_001_info.json").unlink()
    assert any("Seq_001_info.json is missing" in note for note in open_sequence(sequence.path).notes)


def test_a_calibration_of_another_size_is_rescaled(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    file = tmp_path / "Calibrations" / "Endoscope_01" / "Endoscope_01_geometrical.xml"
    file.write_text(xml((160.0, 162.0, 161.5, 119.5, *KB4[4:]), size=(320, 240)))
    assert open_sequence(folder).source.camera == FisheyeCamera(PinholeCamera(80.0, 81.0, 80.5, 59.5, *SIZE), KB4[4:])


# ---- poses


def test_poses_of_the_largest_sub_model(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    # The second and the third have most images; the first has the longest file, as it has more points.
    models = {0: images_bin([90, 91]), 4: images_bin([2, 6, 3]), 10: images_bin([1, 2, 3])}
    write_models(archive_of(folder), models)
    sequence = open_sequence(folder)
    # out2.png is frame 1; x_camera = R x_world + t, half a turn about z: the centre is -R^T t = (tx, ty, -tz).
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    for index, tx in ((1, 2.0), (2, 3.0), (5, 6.0)):
        expected = turned.copy()
        expected[:3, 3] = [tx, 2.0, 3.0]
        np.testing.assert_allclose(sequence.source.pose(index), expected, atol=1e-12)
        truth = sequence.source.truth(index)
        assert (truth.depth_mm, truth.quality) == (None, "sfm")
    assert [sequence.source.pose(index) is None for index in (0, 3, 4)] == [True, True, True]
    reference = reference_trajectory(sequence)
    np.testing.assert_array_equal(reference.indices, [1, 2, 5])
    np.testing.assert_allclose(reference.times_s, [0.02, 0.04, 0.1])
    assert any("sub-model 4, the largest of 3: 3 frames; its scale is arbitrary" in note for note in sequence.notes)


def test_an_image_that_is_not_posed_has_no_pose(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    nan = images_bin([2], quaternion=(np.nan,) * 4)
    write_models(archive_of(folder), {0: struct.pack("<Q", 2) + images_bin([1])[8:] + nan[8:]})
    assert sorted(open_sequence(folder).source.poses) == [0]


def test_poses_beyond_the_video_are_told(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    write_models(archive_of(folder), {0: images_bin([1, 7, 8])})
    assert any("2 of 3 poses are of frames beyond the 6" in warning for warning in open_sequence(folder).warnings)


def test_a_large_list_of_points_does_not_end_in_memory(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    write_models(archive_of(folder), {0: images_bin([1])[:-32] + struct.pack("<Q", 2**60)})
    with pytest.raises(InputError, match=r"Seq_001\.zip: the archive is damaged or incomplete \(it is cut off"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cut off"),
        (images_bin([1, 2, 3])[:-30], "cut off"),
        (images_bin([1, 2])[:40], "cut off"),
        (images_bin([]), "no image with its pose"),
        (images_bin([1, 1]), "comes again"),
        (images_bin([1, 2], name="frame{}.png"), "'frame1.png' is none of a frame"),
        (images_bin([0, 1]), "'out0.png' is none of a frame"),
        (images_bin([1, 2], quaternion=(2.0, 0.0, 0.0, 0.0)), "quaternion has length 2"),
    ],
)
def test_a_model_that_is_none_is_one_sentence(content: bytes, message: str, tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path / "EndoMapper")
    write_models(archive_of(folder), {0: content})
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(folder)
    assert "Seq_001.zip" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_archive_that_is_none_is_one_sentence(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    archive = archive_of(folder)
    write_models(archive, {0: images_bin([1, 2, 3])})
    whole = archive.read_bytes()
    archive.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"Seq_001\.zip: the archive is damaged or incomplete"):
        open_sequence(folder)
    damaged = bytearray(whole)
    damaged[60:70] = b"\xff" * 10
    archive.write_bytes(damaged)
    with pytest.raises(InputError, match=r"Seq_001\.zip: the archive is damaged or incomplete"):
        open_sequence(folder)
    write_models(archive, {})
    with pytest.raises(InputError, match="it holds no COLMAP model"):
        open_sequence(folder)


# ---- faults


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no JSON"),
        ("[1]", "is no JSON object"),
        ("{", "is no JSON"),
        ('{"endoscope_number": "front"}', "endoscope_number 'front' is none"),
        ('{"endoscope_number": [1]}', "is none: expected 1"),
    ],
)
def test_an_info_file_that_is_none_is_one_sentence(text: str, message: str, tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    (folder / "Seq_001_info.json").write_text(text)
    with pytest.raises(InputError, match=message):
        open_sequence(folder)


def test_one_video_is_wanted_and_readable(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    shutil.copy(folder / "Seq_001.mov", folder / "other.mov")
    assert open_sequence(folder).count == FRAMES
    shutil.copy(folder / "Seq_001.mov", folder / "Seq_002.mov")
    with pytest.raises(InputError, match=r"holds one video, found 2 \(Seq_001\.mov, Seq_002\.mov\)"):
        open_sequence(folder)
    (folder / "Seq_002.mov").unlink()
    (folder / "Seq_001.mov").write_bytes(b"")
    with pytest.raises(InputError, match="reading the video"):
        open_sequence(folder)
