"""Made-up copies of research data sets that come as video: StereoMIS, EndoMapper, STIR."""

from __future__ import annotations

import json
import struct
import zipfile
from pathlib import Path

import av
import numpy as np

from tests.support.drawn_inputs import picture, save

FRAMES = 6
STEREO_SIZE, SCOPE_SIZE = (160, 128), (160, 120)
LENS = (-0.3, 0.1, 1e-3, -2e-3, 0.02, 0.01, -0.01, 0.005)
KB4 = (79.7, 79.8, 81.6, 61.3, -0.1396589, -0.0003139987, 0.001505504, -0.0001316715)
# A quarter turn to the left about the optical axis: the camera's x is the world's y. Then half a turn about x.
QUATERNIONS = [(0, 0, np.sqrt(0.5), np.sqrt(0.5)), (1, 0, 0, 0)]
ROTATIONS = [[[0, -1, 0], [1, 0, 0], [0, 0, 1]], [[1, 0, 0], [0, -1, 0], [0, 0, -1]]]
# World-to-camera, quaternion with the scalar first: half a turn about z, then away from the origin.
HALF_TURN_ABOUT_Z = (0.0, 0.0, 0.0, 1.0)
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


def write_frames(file: Path, images: list[np.ndarray], rate: int = 25) -> Path:
    """Write images (h, w, 3) of one size as a video in which every picture stands for itself."""
    height, width = images[0].shape[:2]
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = width, height, "yuv420p", 1
        stream.bit_rate = 4_000_000
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return file


# ---- StereoMIS


def write_ini(file: Path, **changed: object) -> None:
    left = {"res_x": STEREO_SIZE[0], "res_y": STEREO_SIZE[1], "fc_x": 130.5, "fc_y": 131.5, "cc_x": 81.25}
    left |= {"cc_y": 62.75} | {f"kc_{i}": k for i, k in enumerate(LENS)}
    right = {**left, "fc_x": 999, **{f"R_{i}": int(i % 4 == 0) for i in range(9)}, "T_0": -4.1, "T_1": 0, "T_2": 0}
    sections = (("StereoLeft", left | changed), ("StereoRight", right))
    lines = [f"[{name}]\n" + "".join(f"{key}={value}\n" for key, value in keys.items()) for name, keys in sections]
    file.write_text("".join(lines))


def kinematic_pose(frame: int) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = ROTATIONS[frame % 2]
    T_world_camera[:3, 3] = [frame, -20, 50 + 2 * frame]
    return T_world_camera


def write_kinematics(file: Path, first: int = 0, frames: int = FRAMES, separator: str = " ") -> None:
    rows = [[first + i, 0.001 * i, -0.02, 0.05 + 0.002 * i, *QUATERNIONS[i % 2]] for i in range(frames)]
    file.write_text("".join(separator.join(f"{value:.9g}" for value in values) + "\n" for values in rows))


def write_stereomis(folder: Path, stacking: int = 0) -> Path:
    """Write a recording of six frames; `stacking` 0: left above right, 1: left beside right."""
    folder.mkdir(parents=True)
    pairs = [(picture(i, STEREO_SIZE), picture(30 - i, STEREO_SIZE)) for i in range(FRAMES)]
    write_frames(folder / "endoscope_part0001.mp4", [np.concatenate(pair, axis=stacking) for pair in pairs])
    write_ini(folder / "StereoCalibration.ini")
    write_kinematics(folder / "groundtruth.txt")
    (folder / "masks").mkdir()
    save(folder / "masks" / "000001l.png", np.full((STEREO_SIZE[1] // 2, STEREO_SIZE[0] // 2, 3), 255, np.uint8))
    (folder / "test_split.csv").write_text("start,end\n0,5\n")
    return folder


# ---- EndoMapper


def xml(params: tuple[float, ...] = KB4, size: tuple[int, int] = SCOPE_SIZE) -> str:
    listed = ";\n        ".join(map(str, params))
    return XML.format(kind="calibu_fu_fv_u0_v0_kb4", width=size[0], height=size[1], params=listed)


def images_bin(frames: list[int], name: str = "out{}.png", quaternion: tuple[float, ...] = HALF_TURN_ABOUT_Z) -> bytes:
    """An images.bin whose frame N has the translation (N, 2, -3), and N points that are to be passed over."""
    content = struct.pack("<Q", len(frames))
    for number, frame in enumerate(frames):
        image = struct.pack("<i7di", number + 1, *quaternion, frame, 2.0, -3.0, 1)
        content += image + name.format(frame).encode() + b"\0" + struct.pack("<Q", frame) + b"\x07" * 24 * frame
    return content


def write_models(archive: Path, models: dict[int, bytes]) -> None:
    """Write sub-models."""
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as opened:
        for number, content in models.items():
            opened.writestr(f"33/sparse/{number}/images.bin", content)
            opened.writestr(f"33/sparse/{number}/cameras.bin", b"")


def write_geometry(root: Path) -> None:
    calibration = root / "Calibrations" / "Endoscope_01" / "Endoscope_01_geometrical.xml"
    calibration.parent.mkdir(parents=True)
    calibration.write_text(xml())


def write_endomapper(root: Path, number: object = 1) -> Path:
    """Write a procedure without reconstruction, below `root`; return its folder."""
    folder = root / "Sequences" / "Seq_001"
    folder.mkdir(parents=True)
    write_frames(folder / "Seq_001.mov", [picture(i, SCOPE_SIZE) for i in range(FRAMES)], rate=50)
    (folder / "Seq_001_info.json").write_text(json.dumps({"endoscope_number": number, "meta-data": []}))
    write_geometry(root)
    return folder


def archive_of(folder: Path) -> Path:
    return folder / "meta-data" / "colmap" / "Seq_001.zip"


def write_endomapper_with_model(root: Path) -> Path:
    folder = write_endomapper(root)
    write_models(archive_of(folder), {0: images_bin([1, 2, 3])})
    return folder


# ---- STIR

STIR_K = [[120.5, 0, 80.25], [0, 121.5, 63.5], [0, 0, 1]]
TATTOOS = {"start": [(20, 30), (90, 40), (60, 100)], "end": [(24, 33), (88, 40)]}


def write_stir(root: Path) -> Path:
    """Write a clip of six frames with three points of dye, of which two are still seen in the last."""
    folder = root / "exvivo01" / "left02" / "seq03"
    for part in ("frames", "segmentation"):
        (folder / part).mkdir(parents=True)
    write_frames(folder / "frames" / "1200ms-1440ms-visible.mp4", [picture(i, STEREO_SIZE) for i in range(FRAMES)])
    for end, centres in TATTOOS.items():
        seen = np.zeros((STEREO_SIZE[1], STEREO_SIZE[0], 3), np.uint8)
        for x, y in centres:
            seen[y - 2 : y + 3, x - 3 : x + 4] = 255
        save(folder / "segmentation" / f"icg{end}seg.png", seen)
    stated = {"leftcameramat": STIR_K, "rightcameramat": STIR_K, "leftdistortioncoeffs": [0, 0, 0, 0, 0]}
    (root / "exvivo01" / "calib.json").write_text(json.dumps(stated | {"translation": [-0.004, 0, 0]}))
    return folder
