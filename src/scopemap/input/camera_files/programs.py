"""The table of programs whose camera files are read: how each is told, where its numbers are, and what they count.

`arranging.py` reads a file by its row; docs/calibrate.md has the list that is made of the table. A name in it is found
whatever its case, hyphens, underscores and blanks are, but for those with `=` before them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from scopemap.input.camera_files.conversions import (
    Conversion,
    from_corner,
    from_first_pixel,
    from_middle,
    of_longer_side,
    of_sensor,
    of_toolbox_axes,
    with_affinity,
)
from scopemap.input.camera_files.lens_models import LENS_MODELS

# What shares of the size count the centre of the first pixel as, where they count from the picture's corner.
CORNER_PX = 0.5


@dataclass(frozen=True)
class Program:
    """A row: a program, or a few that write alike.

    name, told_by, lenses_read : for the document and for sentences. signs : names that are all in the camera's mapping;
    `a|b` is one of them, `a/b` one below another, `a#4,8` one that holds so many numbers. at : where this mapping is,
    the first of these paths that leads anywhere; `*` is any name or any place in a list, `**` any mapping.
    takes_first : of several cameras the first is taken, else they are refused. adjusted : the mapping in it that is
    taken, and the word by which one of several is told.

    takes : our names of numbers, by which the path to them holds, from the mapping or (`/`) from the file. `_` is a
    number that is passed over, 0 and 1 are what must be there, `...` takes all that are left, `?` marks what may be
    missing, and the name `*` takes all other names as they are. A row without any is a wrapper: what is in it is read
    as if it were the file. beside : names in the rest of the file count, too. only : names of numbers that have one
    value in all files that can be read, and what is said of others.

    lens_words : where the lens is named; lenses : by these words our model, and the coefficients' names in the order
    of the file, `*` for OpenCV's order. convert : what is done to the numbers, in this order. corner_px : what shares
    count the first pixel's centre as. note : what is said of the camera.
    """

    name: str
    told_by: str
    lenses_read: str
    signs: tuple[str, ...] = ()
    takes: Mapping[str, str] = field(default_factory=dict)
    at: tuple[str, ...] = ("",)
    takes_first: bool = False
    adjusted: tuple[str, str] | None = None
    beside: bool = False
    only: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    lens_words: tuple[str, ...] = ()
    lenses: Mapping[str, str] = field(default_factory=dict)
    convert: tuple[Conversion, ...] = ()
    corner_px: float = 0.0
    note: str = ""


def _as_named(*names: str) -> dict[str, str]:
    """Return what is taken by the names that it has here, too."""
    return {name: name.rstrip("?") for name in names}


_SIZE = _as_named("width", "height")
_MATLAB_SIZE = {"height width?": "ImageSize"}
_MATLAB_LENS = {"radial_distortion...?": "RadialDistortion", "tangential_distortion...?": "TangentialDistortion"}
_MATLAB_ADVICE = "objects only MATLAB reads: `s = toStruct(params); save('cam.mat', '-struct', 's', '-v7')`"
# Meshroom's radial terms count r^2, r^4, r^6; the names are those of one version after the other (`jsonIO.cpp`).
_MESHROOM = {
    "": "opencv", "none": "opencv", "radial1": "opencv k1", "radialk1": "opencv k1", "radial3": "opencv k1 k2 k3",
    "radialk3": "opencv k1 k2 k3", "brown": "opencv k1 k2 k3 p1 p2", "fisheye4": "fisheye k1 k2 k3 k4",
}  # fmt: skip
_MESHROOM_RATIO = "is not 1, which versions of Meshroom mean differently: calibrate anew"
_GYROFLOW_STRETCH = "is not 1: its pictures were stretched, which is not read: calibrate anew"
_METASHAPE_TERM = "of its Metashape lens has no place in OpenCV's: export it as OpenCV XML (Tools, Camera Calibration)"
# The corner of the picture is (0, 0), its middle the origin; p1 is OpenCV's p2 (Agisoft Metashape User Manual, appendix
# "Camera models").
_METASHAPE = Program(
    "Metashape", "XML with `projection`, or `sensors`",
    "frame cameras; of others the OpenCV XML that Metashape exports (Tools, Camera Calibration)",
    ("<calibration>", "projection"),
    {"f": "f", **_as_named("cx?", "cy?", "b1?", "b2?", "k1?", "k2?", "k3?"), "p1?": "p2", "p2?": "p1",
     "width": "width|resolution/width", "height": "height|resolution/height"},
    only=dict.fromkeys(("k4", "p3", "p4"), (0.0, _METASHAPE_TERM)),
    lens_words=("projection",), lenses={"frame": "opencv k1 k2 p1 p2 k3"}, convert=(with_affinity, from_middle),
)  # fmt: skip

PROGRAMS: tuple[Program, ...] = (
    Program(
        "OCamCalib", "`ocam_model` in a `.mat`", "Scaramuzza",
        ("ss", "xc", "yc", "c", "d", "e", "width", "height"),
        {"polynomial...": "ss", "cy": "xc", "cx": "yc", **_as_named("c", "d", "e"), **_SIZE},
        at=("**",), takes_first=True, convert=(from_first_pixel, of_toolbox_axes),
    ),
    Program(
        "OCamCalib", "its `calib_results.txt`", "Scaramuzza",
        ("OCamCalib's polynomial",),
        {"_ polynomial...": "OCamCalib's polynomial", "cy cx": "center", "c d e": "affine", "height width": "size"},
        convert=(of_toolbox_axes,),
    ),
    # MATLAB's first pixel is (1, 1), its sizes are rows before columns; an IntrinsicMatrix is transposed, a K is not
    # (mathworks.com/help/vision/ref/cameraparameters.html, fisheyeintrinsics.html).
    Program(
        "MATLAB", "`fisheyeParameters`, as `.mat` or JSON", "Scaramuzza",
        ("=MappingCoefficients", "=DistortionCenter"),
        {"a0 a2 a3 a4": "MappingCoefficients", "cx cy": "DistortionCenter", "c d e 1?": "StretchMatrix",
         **_MATLAB_SIZE},
        at=("**",), takes_first=True, convert=(from_first_pixel,),
    ),
    Program(
        "MATLAB", "`cameraIntrinsics`, as `.mat` or JSON", "OpenCV",
        ("=FocalLength", "=PrincipalPoint"),
        {"fx fy": "FocalLength", "cx cy": "PrincipalPoint", "skew?": "Skew", **_MATLAB_LENS, **_MATLAB_SIZE},
        at=("**",), takes_first=True, convert=(from_first_pixel,),
    ),
    Program(
        "MATLAB", "`cameraParameters`, `stereoParameters` (the first camera), as `.mat` or JSON", "OpenCV",
        ("=RadialDistortion", "=IntrinsicMatrix"),
        {"fx 0 0 skew fy 0 cx cy 1": "IntrinsicMatrix", **_MATLAB_LENS, **_MATLAB_SIZE},
        at=("**",), takes_first=True, convert=(from_first_pixel,),
    ),
    Program(
        "MATLAB", f"the same of newer versions; {_MATLAB_ADVICE}", "OpenCV",
        ("=RadialDistortion", "=ImageSize", "=K"),
        {"fx skew cx 0 fy cy 0 0 1": "K", **_MATLAB_LENS, **_MATLAB_SIZE},
        at=("**",), takes_first=True, convert=(from_first_pixel,),
    ),
    Program(
        "MASt3R-SLAM", "`calibration: [fx, fy, cx, cy, k1, k2, p1, p2]`", "OpenCV",
        ("calibration#4,8,9,12",), {"fx fy cx cy lens...": "calibration", "*": ""},
    ),
    Program(
        "EndoVis", "2017 and 2018: `Camera-0-F`, `-C`, `-K`; of the pair the left camera", "OpenCV",
        ("Camera-0-F", "Camera-0-C"),
        {"fx fy": "Camera-0-F", "cx cy": "Camera-0-C", "lens...?": "Camera-0-K", **_as_named("width?", "height?")},
        lenses={"": "opencv *"},
    ),
    Program("OKVIS", "`cameras:` of one", "its own", at=("cameras/*",)),
    # Shares of the longer side, from the middle (opensfm.readthedocs.io, "Geometric Models").
    Program(
        "OpenSfM", "`camera_models.json` of one camera (`projection_type`)",
        "perspective, brown, fisheye, fisheye_opencv",
        ("projection_type", "focal|focal_x"),
        {"fx": "focal_x|focal", "fy": "focal_y|focal|focal_x", "cx?": "c_x", "cy?": "c_y", **_SIZE,
         **_as_named("k1?", "k2?", "k3?", "k4?", "p1?", "p2?")},
        at=("", "*"), lens_words=("projection_type",),
        lenses={"perspective": "opencv k1 k2", "brown": "opencv k1 k2 p1 p2 k3", "fisheye": "fisheye k1 k2",
                "fisheye opencv": "fisheye k1 k2 k3 k4"},
        convert=(of_longer_side, from_middle),
    ),
    Program(
        "Meshroom", "`.sfm` of one camera (`sensorWidth`)", "radial1, radial3, brown, fisheye4",
        ("sensorWidth",),
        {"f": "focalLength", "sensor": "sensorWidth", "cx cy?": "principalPoint", "lens...?": "distortionParams",
         **_SIZE},
        at=("intrinsics/*",), only={"pixelRatio": (1.0, _MESHROOM_RATIO)}, lens_words=("type", "distortionType"),
        lenses={**_MESHROOM, **{f"pinhole {name}".strip(): lens for name, lens in _MESHROOM.items()}},
        convert=(of_sensor, from_middle),
    ),
    Program(
        "Gyroflow", "the lens profile (`fisheye_params`)", "opencv_fisheye, opencv_standard",
        ("fisheye_params",),
        {"camera_matrix...": "fisheye_params/camera_matrix", "lens...": "fisheye_params/distortion_coeffs",
         "width?": "calib_dimension/w", "height?": "calib_dimension/h"},
        only={f"input_{way}_stretch": (1.0, _GYROFLOW_STRETCH) for way in ("horizontal", "vertical")},
        lens_words=("distortion_model",),
        lenses={"": "fisheye *", "opencv fisheye": "fisheye *", "opencv standard": "opencv *"},
    ),
    Program(
        "Calibu", 'XML of EndoMapper (`camera_model type="calibu_..."`)', "pinhole, k1 k2, Kannala-Brandt",
        ("params", "type"), {"fx fy cx cy lens...": "params", **_as_named("width?", "height?")},
        at=("**/camera_model",), takes_first=True, lens_words=("type",),
        lenses={"calibu fu fv u0 v0": "opencv", "calibu fu fv u0 v0 k1 k2": "opencv k1 k2",
                "calibu fu fv u0 v0 kb4": "fisheye k1 k2 k3 k4"},
    ),
    _METASHAPE,
    replace(_METASHAPE, signs=("calibration/type",), at=("**/sensor",), adjusted=("calibration", "adjusted"),
            lens_words=("type",)),
    # github.com/Oxford-PTAM/PTAM-GPL, ATANCamera; github.com/JakobEngel/dso, README, "Geometric Calibration File".
    Program(
        "PTAM", "`Camera.Parameters`, five shares of the size", "FOV (ATAN)",
        ("PTAM's Camera.Parameters",), {"fx fy cx cy lens...": "PTAM's Camera.Parameters"},
        lenses={"": "fov omega"}, corner_px=CORNER_PX,
    ),
    Program(
        "DSO, TUM-mono", "`camera.txt`: numbers, size, what is done, output size",
        "Pinhole, FOV, RadTan, EquiDistant, KannalaBrandt",
        ("DSO's first line",), {"fx fy cx cy lens...": "DSO's first line", "width height?": "DSO's size"},
        lens_words=("DSO's lens",),
        lenses={"": "opencv *", "pinhole": "opencv", "fov": "fov omega", "radtan": "opencv k1 k2 p1 p2",
                "equidistant": "fisheye k1 k2 k3 k4", "kannalabrandt": "fisheye k1 k2 k3 k4"},
        corner_px=CORNER_PX,
    ),
    Program(
        "Kalibr", "camchain (`cam0:`); the first camera", "pinhole with radtan, equidistant, fov or none",
        takes={"*": ""}, at=(r"cam\d{1,3}",), takes_first=True, beside=True,
    ),
    Program(
        "Basalt", "JSON with `value0`; of several cameras the first", "pinhole, pinhole-radtan8, kb4, fov",
        ("intrinsics",), {"*": "intrinsics", "width height?": "/value0/resolution/0"},
        at=("value0/intrinsics/*",), takes_first=True, lens_words=("camera_type",),
    ),
    Program("SCARED", "`camera-calibration` in `frame_data*.json`", "OpenCV", at=("camera-calibration",)),
    Program(
        "nerfstudio", "`fl_x`, `fl_y`", "its own",
        ("fl_x",), {"*": "", **_as_named("cx", "cy")}, at=("", "*"), beside=True,
        convert=(from_corner,), note=", its pixels counted from the corner, as in nerfstudio",
    ),
)  # fmt: skip

_LENSES = ", ".join(f"{lens.name} ({lens.title})" for lens in LENS_MODELS)
# Programs that write the usual names (`coefficients.py`, `lens.py`, `sizes.py`, `intrinsics.py`) or plain numbers.
OTHERS: tuple[tuple[str, str, str], ...] = (
    ("OpenCV",
     "YAML, XML, JSON: `camera_matrix` or `K`, `distortion_coefficients` or `D`, `image_width`, `image_height`",
     f"`camera_model`: {_LENSES}, omnidirectional (Scaramuzza); without one OpenCV"),
    ("ROS", "camera_info, with binning and region", "plumb_bob, rational_polynomial, equidistant"),
    ("COLMAP", "`cameras.txt`, `cameras.bin` of one camera", "all but thin-prism, division, EUCM, panoramic"),
    ("EuRoC", "sensor files", "as Kalibr"),
    ("ORB-SLAM2 and 3", "`Camera.fx`, `Camera1.fx`", "PinHole, KannalaBrandt8"),
    ("VINS, camodocal", "`projection_parameters`", "PINHOLE, KANNALA_BRANDT"),
    ("SVO", "`cam_fx` lines", "Pinhole, ATAN"),
    ("OneSLAM, RealSense, Open3D, Polycam, Record3D", "JSON: `fx` or `intrinsics`", "OpenCV"),
    ("StereoMIS", "ini; the left camera", "OpenCV"),
    ("C3VD", "`config.ini`: `a0 a2 a3 a4`, `c d e`", "Scaramuzza"),
    ("Bouguet's toolbox", "`Calib_Results.mat`: `fc cc kc`", "OpenCV"),
    ("NumPy", "`.npz` (`mtx`, `dist`, or other usual names), a matrix as `.npy`",
     "OpenCV; a `D` of 4x1, which only `cv2.fisheye` returns, is a fisheye's"),
    ("SciKit-Surgery", "a matrix of 3x3, and a row of coefficients", "OpenCV"),
    ("none of these",
     "`fx: 520` or `fx=520` lines, with or without `[sections]`; a matrix of 3x3, 3x4 or 4x4; one line of numbers",
     "pinhole, OpenCV"),
)  # fmt: skip

# A sentence for a file that is of none.
FORMATS = ", ".join(dict.fromkeys([*(name for name, *_ in OTHERS[:-1]), *(program.name for program in PROGRAMS)]))

_EXPORT = "calibrate with `scopemap calibrate`, or write one line fx fy cx cy [k1 k2 p1 p2 [k3]] (px)"
# Files that hold less than a camera needs, or in another form: how they are told, and what to do.
NOT_READ: tuple[tuple[re.Pattern[str], str], ...] = (
    (re.compile(r"^\s*fc\s*=\s*\[", re.M), "the text of Bouguet's toolbox; its Calib_Results.mat is read"),
    (re.compile(r"projection:.*\+-|reprojection error:"), "Kalibr's report; its camchain.yaml is read"),
    (re.compile(r"^# oST version", re.M), "ROS' ost.txt; the ost.yaml beside it is read"),
    (re.compile(r"^ParGroup: Cam_Par", re.M), f"HALCON's; {_EXPORT}"),
    (re.compile(r"""\b[fc][xy]"?\s*[:=]\s*-?\d+,\d|\d,\d+\s*[,;]\s+-?\d+(,\d+)?\s*[,;]\s+-?\d+,\d"""),
     "written with decimal commas; write points (fx: 900.5)"),
    (re.compile(r'"(polymorphic_name|sfm_data_version)"'), f"OpenMVG's; {_EXPORT}"),
    (re.compile(r"pix4d|^\s*FOCAL\s+\d", re.I | re.M), f"Pix4D's; {_EXPORT}"),
    (re.compile(r'"img_name"'), f"the list of cameras of 3D Gaussian splatting, one for each picture; {_EXPORT}"),
    (re.compile(r"\barray\(\s*\["),
     "what Python prints of arrays; save them with numpy.savez(file, K=K, D=D), or as JSON by .tolist()"),
)  # fmt: skip


def program_of(text: str) -> str:
    """Return whose file a text is that is not read, with what to do, "" where it is nobody's that is known."""
    return next((f"it is {words}" for finds, words in NOT_READ if finds.search(text)), "")
