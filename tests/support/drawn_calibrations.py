"""One camera, or its likes, in every form that calibration files have: written by hand from each form's definition."""

from __future__ import annotations

import json
import struct
from pathlib import Path

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, FovCamera, OmnidirectionalCamera, OpenCvCamera

SIZE = (640, 480)
PINHOLE = PinholeCamera(520.5, 525.25, 318.0, 245.0, *SIZE)
RADTAN = OpenCvCamera(PINHOLE, (-0.3, 0.1, 1e-3, -5e-4))
RADTAN5 = OpenCvCamera(PINHOLE, (-0.3, 0.1, 1e-3, -5e-4, -0.01))
RATIONAL = OpenCvCamera(PINHOLE, (0.6, -0.1, -3e-4, 2e-4, 0.02, 0.9, 0.05, 0.01))
FISHEYE = FisheyeCamera(PINHOLE, (-0.13, -3e-4, 1.5e-3, -1e-4))
FOV = FovCamera(PINHOLE, 0.9)
OMNI = OmnidirectionalCamera((400.0, 0.0, -8e-4, 6e-7), 318.0, 245.0, *SIZE, (0.9999, 0.003, -0.003))
CAMERAS: list[CameraModel] = [PINHOLE, RADTAN5, RATIONAL, FISHEYE, OMNI, FOV]

OPENCV = """camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.2050000000000000e+02, 0., 3.1800000000000000e+02, 0.,
       525.25, 245., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.3, 0.1, 1e-3, -5e-4, -0.01 ]
"""
OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<!-- by hand -->
<image_width>640</image_width>
<image_height>480</image_height>
<M1 type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>520.5 0. 318. 0. 525.25 245. 0. 0. 1.</data></M1>
<D1 type_id="opencv-matrix"><rows>1</rows><cols>5</cols><dt>d</dt>
  <data>-0.3 0.1 1e-3 -5e-4 -0.01</data></D1>
</opencv_storage>
"""
OPENCV_JSON = """{"K": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d",
 "data": [520.5, 0., 318., 0., 525.25, 245., 0., 0., 1.]}, "D": [-0.3, 0.1, 1e-3, -5e-4, -0.01]}
"""
ROS = """image_width: 640
image_height: 480
camera_name: scope
camera_matrix:
  rows: 3
  cols: 3
  data: [520.5, 0., 318., 0., 525.25, 245., 0., 0., 1.]
distortion_model: equidistant
distortion_coefficients:
  rows: 1
  cols: 4
  data: [-0.13, -0.0003, 0.0015, -0.0001]
"""
ROS_TOPIC = """header:
  frame_id: ''
height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.3, 0.1, 0.001, -0.0005, -0.01]
K:
- 520.5
- 0.0
- 318.0
- 0.0
- 525.25
- 245.0
- 0.0
- 0.0
- 1.0
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
K: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
ORB_SLAM = """%YAML:1.0

#--- the older form
Camera.type: "PinHole"
Camera.fx: 520.5
Camera.fy: 525.25
Camera.cx: 318.0
Camera.cy: 245.0
Camera.k1: -0.3
Camera.k2: 0.1
Camera.p1: 0.001
Camera.p2: -0.0005
Camera.k3: -0.01
Camera.width: 640
Camera.height: 480
Camera.fps: 30.0
Tbc: !!opencv-matrix
   rows: 2
   cols: 1
   dt: f
   data: [1., 2.]
"""
ORB_SLAM3 = """%YAML:1.0
File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 520.5
Camera1.fy: 525.25
Camera1.cx: 318.0
Camera1.cy: 245.0
Camera1.k1: -0.13
Camera1.k2: -0.0003
Camera1.k3: 0.0015
Camera1.k4: -0.0001
Camera.width: 640
Camera.height: 480
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [{coefficients}]
  distortion_model: {lens}
  intrinsics: [520.5, 525.25, 318.0, 245.0]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
{more}"""
KALIBR_SECOND = """cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: omni
  intrinsics: [1.0, 500.0, 500.0, 300.0, 200.0]
"""
EUROC = """# General sensor definitions.
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [520.5, 525.25, 318.0, 245.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.3, 0.1, 0.001, -0.0005]
"""
CALIBU = """<rig><camera><camera_model name="" index="0" type="calibu_fu_fv_u0_v0_kb4" version="8">
<width> 640 </width> <height> 480 </height>
<params> [ 520.5; 525.25; 318;
245; -0.13; -0.0003; 0.0015; -0.0001 ] </params>
</camera_model></camera></rig>
"""
STEREO_INI = """[StereoLeft]
res_x=640
res_y=480
fc_x=520.5
fc_y=525.25
cc_x=318
cc_y=245
kc_0=-0.3
kc_1=0.1
kc_2=0.001
kc_3=-0.0005
kc_4=-0.01
[StereoRight]
res_x=640
"""
# Centre and affine part as the toolbox counts: row before column; c d e about (down, right).
OCAM_CENTRE, OCAM_AFFINE = (245.0, 318.0), (0.9995, 0.002, -0.0015)
OCAM_POLYNOMIAL = (-400.0, 0.0, 8e-4, -6e-7)
OCAM = f"""#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). Used by cam2world

4 {" ".join(map(str, OCAM_POLYNOMIAL))}

#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB). These are used by world2cam

3 500.0 200.0 -10.0

#center: "row" and "column", starting from 0 (C convention)

{OCAM_CENTRE[0]} {OCAM_CENTRE[1]}

#affine parameters "c", "d", "e"

{" ".join(map(str, OCAM_AFFINE))}

#image size: "height" and "width"

480 640
"""
COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
3 {model} 640 480 {parameters}
"""


def colmap_bin(model: int, parameters: tuple[float, ...]) -> bytes:
    return struct.pack(f"<QIiQQ{len(parameters)}d", 1, 3, model, *SIZE, *parameters)


def kalibr(lens: str, coefficients: tuple[float, ...], more: str = "") -> str:
    return KALIBR.format(lens=lens, coefficients=", ".join(map(str, coefficients)), more=more)


def forms() -> dict[str, tuple[str | bytes, CameraModel]]:
    """Return by name what stands in a file of each form, and the camera it says."""
    fx, fy, cx, cy = PINHOLE.fx, PINHOLE.fy, PINHOLE.cx, PINHOLE.cy
    corner = f"{fx} {fy} {cx + 0.5} {cy + 0.5}"
    pairs = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    scared = {"KL": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "DL": [list(RADTAN5.distortion)], "KR": [[1, 0, 0]]}
    return {
        "opencv 1.0": (f"%YAML:1.0\n---\n{OPENCV}", RADTAN5),
        "opencv 1.2": (f"%YAML 1.2\n---\n{OPENCV}", RADTAN5),
        "opencv xml": (OPENCV_XML, RADTAN5),
        "opencv json": (OPENCV_JSON, RADTAN5),
        "ros": (ROS, FISHEYE),
        "ros 1.0": (f"%YAML:1.0\n{ROS}", FISHEYE),
        "ros topic": (ROS_TOPIC, RADTAN5),
        "orb-slam": (ORB_SLAM, RADTAN5),
        "orb-slam3": (ORB_SLAM3, FISHEYE),
        "kalibr radtan": (kalibr("radtan", RADTAN.distortion), RADTAN),
        "kalibr equi, two": (kalibr("equi", FISHEYE.distortion, KALIBR_SECOND), FISHEYE),
        "kalibr none": (kalibr("none", ()), PINHOLE),
        "kalibr fov": (kalibr("fov", (0.9,)), FOV),
        "euroc": (EUROC, RADTAN),
        "calibu": (CALIBU, FISHEYE),
        "stereo ini": (STEREO_INI, RADTAN5),
        "colmap pinhole": (COLMAP.format(model="PINHOLE", parameters=corner), PINHOLE),
        "colmap opencv": (COLMAP.format(model="OPENCV", parameters=f"{corner} -0.3 0.1 0.001 -0.0005"), RADTAN),
        "colmap full": (
            COLMAP.format(model="FULL_OPENCV", parameters=f"{corner} 0.6 -0.1 -3e-4 2e-4 0.02 0.9 0.05 0.01"),
            RATIONAL,
        ),
        "colmap fov": (COLMAP.format(model="FOV", parameters=f"{corner} 0.9"), FOV),
        "colmap fisheye": (
            COLMAP.format(model="OPENCV_FISHEYE", parameters=f"{corner} -0.13 -3e-4 1.5e-3 -1e-4"),
            FISHEYE,
        ),
        "colmap bin": (colmap_bin(4, (fx, fy, cx + 0.5, cy + 0.5, *RADTAN.distortion)), RADTAN),
        "matrix 3x3": ("520.5 0 318\n0 525.25 245\n0 0 1\n", PINHOLE),
        "matrix 3x4": ("[[520.5 0 318 0]\n [0 525.25 245 0]\n [0 0 1 0]]", PINHOLE),
        "matrix 4x4": ("520.5 0 318 0\n0 525.25 245 0\n0 0 1 0\n0 0 0 1", PINHOLE),
        "line": (f"# mine\n{fx} {fy} {cx} {cy}", PINHOLE),
        "line of 8": (f"{fx},{fy},{cx},{cy},-0.3,0.1,0.001,-0.0005", RADTAN),
        "line of 9": (f"{fx} {fy} {cx} {cy} -0.3 0.1 0.001 -0.0005 -0.01", RADTAN5),
        "line of 12": (f"{fx} {fy} {cx} {cy} 0.6 -0.1 -3e-4 2e-4 0.02 0.9 0.05 0.01", RATIONAL),
        "shares of the size": (f"{fx / 640!r} {fy / 480!r} {cx / 640!r} {cy / 480!r}", PINHOLE),
        "scared": (json.dumps({"camera-calibration": scared, "timestamp": 1}), RADTAN5),
        "oneslam": (json.dumps({"intrinsics": pairs, "FPS": 30}), PINHOLE),
        "pairs": ("\n".join(f"{name}: {value}" for name, value in pairs.items()), PINHOLE),
        "pairs with a lens": (
            "\n".join(f"{name} = {value}" for name, value in (pairs | {"k1": -0.3, "k2": 0.1, "p1": 1e-3}).items())
            + "\np2=-5e-4\nwidth=640\nheight=480",
            RADTAN,
        ),
    }


def write_forms(folder: Path) -> None:
    """Write each form into a file of its own; the suffix says nothing."""
    for name, (content, _) in (forms() | {"ocam": (OCAM, OMNI)}).items():
        file = folder / f"{name.replace(' ', '_').replace(',', '')}.calib"
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
