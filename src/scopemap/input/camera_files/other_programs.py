"""Calibrations of programs that arrange them in a way of their own, as mappings of ours; and programs that are named.

Where a program's file holds less than a camera here needs, or in another form, its name and what to do are the answer.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from scopemap.input.camera_files.parsing import Fields, as_number, numbers_in

_ENDOVIS = re.compile(r"camera0([fck])")
_LISTED = ("calibration",)
_LISTED_COUNTS = (4, 8, 9, 12)
_CAMERAS = ("cameras",)
# OpenSfM (opensfm.readthedocs.io, "Geometric Models"): the lens by its name, in our words, and its coefficients.
_OPENSFM = {
    "perspective": ("opencv", ("k1", "k2")),
    "brown": ("opencv", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("fisheye", ("k1", "k2")),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}
# Meshroom (AliceVision's `jsonIO.cpp`): the same by the names in its file, of one version after the other; radial ones
# count r^2, r^4, r^6.
_RADIAL = ("opencv", ("k1", "k2", "k3"))
_MESHROOM = {
    "pinhole": ("opencv", ()),
    "none": ("opencv", ()),
    "radial1": ("opencv", ("k1",)),
    "radialk1": ("opencv", ("k1",)),
    "radial3": _RADIAL,
    "radialk3": _RADIAL,
    "brown": ("opencv", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye4": ("fisheye", ("k1", "k2", "k3", "k4")),
}
_GYROFLOW = {"": "fisheye", "opencv_fisheye": "fisheye", "opencv_standard": "opencv"}
_OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3")
_MIDDLE_PX = 0.5  # the middle of a row of n pixels is at (n - 1) / 2


def as_ours(fields: Fields) -> Fields:
    """Return a mapping of ours of a program's own arrangement; any other mapping as it is.

    Raises `ValueError`, with their number, where it holds several cameras, and, with its name, for a lens that has no
    counterpart here.
    """
    for arrange in (_of_list, _of_endovis, _of_cameras, _of_opensfm, _of_meshroom, _of_gyroflow):
        if (found := arrange(fields)) is not None:
            return found
    return fields


def _of_list(fields: Fields) -> Fields | None:
    """`calibration: [fx, fy, cx, cy, k1, k2, p1, p2, k3]` (MASt3R-SLAM)."""
    for name, node in fields.nodes(_LISTED):
        values = numbers_in(node, name) if isinstance(node, list | str) else None
        if values and len(values) in _LISTED_COUNTS:
            beside = [pair for pair in fields.pairs if pair[1] is not node]
            return Fields([*beside, ("intrinsics", values[:4]), ("distortion_coefficients", values[4:])])
    return None


def _of_endovis(fields: Fields) -> Fields | None:
    """EndoVis 2017 and 2018: `Camera-0-F`, `-C` and `-K` of the left camera."""
    names = {"f": "fc", "c": "cc", "k": "distortion_coefficients"}
    found = {match[1]: node for name, node in fields.pairs if (match := _ENDOVIS.fullmatch(_bare(name)))}
    if not {"f", "c"} <= found.keys():
        return None
    size = [(name, node) for name, node in fields.pairs if _bare(name) in ("width", "height")]
    values = [(names[letter], numbers_in(node, names[letter]) or node) for letter, node in found.items()]
    return Fields([*values, *size, ("model", "opencv")])


def _of_cameras(fields: Fields) -> Fields | None:
    """`cameras:`, a list (OKVIS) or mapping of one."""
    for _, node in fields.nodes(_CAMERAS):
        inner = node if isinstance(node, list) else [one for _, one in node.pairs] if isinstance(node, Fields) else []
        cameras = [one for one in inner if isinstance(one, Fields)]
        if len(cameras) > 1:
            raise ValueError(f"it holds {len(cameras)} cameras: leave the one of these images in it")
        if cameras:
            return as_ours(cameras[0])
    return None


def _of_opensfm(fields: Fields) -> Fields | None:
    """OpenSfM's `camera_models.json`: focal length and centre over the longer side, from the middle of the picture."""
    inner = [node for _, node in fields.pairs if isinstance(node, Fields)]
    place = inner[0] if len(inner) == len(fields.pairs) == 1 else fields
    names = {name for name, _ in place.pairs}
    if "projection_type" not in names or not names & {"focal", "focal_x"}:
        return None
    kind, spelled = place.words(("projection_type",)).replace(" ", "_"), "projection_type"
    model, coefficients = _known(_OPENSFM, kind, spelled)
    width, height = (place.number((side,)) or 0.0 for side in ("width", "height"))
    longer = max(width, height)
    focal = place.number(("focal_x", "focal")) or 0.0
    fx, fy = focal * longer, (place.number(("focal_y",)) or focal) * longer
    cx, cy = (
        (side - 1) / 2 + (place.number((name,)) or 0.0) * longer for side, name in ((width, "c_x"), (height, "c_y"))
    )
    lens = {name: place.number((name,)) or 0.0 for name in coefficients}
    return _camera((fx, fy, cx, cy), (width, height), model, lens)


def _of_meshroom(fields: Fields) -> Fields | None:
    """Meshroom's `.sfm`: the focal length in mm beside the sensor's width, the centre from the middle, px."""
    listed = next((node for _, node in fields.nodes(("intrinsics",)) if isinstance(node, list)), [])
    cameras = [one for one in listed if isinstance(one, Fields) and any(one.nodes(("sensorWidth",)))]
    if not cameras:
        return None
    if len(cameras) > 1:
        raise ValueError(f"it is Meshroom's and holds {len(cameras)} cameras: leave the one of these images in it")
    place = cameras[0]
    kind = place.words(("type",))
    lens_kind = place.words(("distortionType",)) if kind == "pinhole" else ""
    model, names = _known(_MESHROOM, lens_kind or kind, "distortionType" if lens_kind else "type")
    width, height, sensor_mm, focal_mm = (
        place.number((name,)) or 0.0 for name in ("width", "height", "sensorWidth", "focalLength")
    )
    if not (width and height and sensor_mm > 0 and focal_mm > 0):
        raise ValueError("it is Meshroom's, but states no width, height, sensorWidth and focalLength of a calibration")
    if (place.number(("pixelRatio",)) or 1.0) != 1:
        raise ValueError("its pixelRatio is not 1, which versions of Meshroom mean differently: calibrate anew")
    focal_px = focal_mm * width / sensor_mm
    x, y = place.numbers(("principalPoint",), 2) or (0.0, 0.0)
    values = next((numbers_in(node, name) or [] for name, node in place.nodes(("distortionParams",))), [])
    if any(values[len(names) :]):
        raise ValueError(f"it has {len(values)} distortionParams, but its lens {lens_kind or kind!r} has {len(names)}")
    lens = dict(zip(names, values, strict=False))
    centre = (width / 2 - _MIDDLE_PX + x, height / 2 - _MIDDLE_PX + y)
    return _camera((focal_px, focal_px, *centre), (width, height), model, lens)


def _of_gyroflow(fields: Fields) -> Fields | None:
    """Gyroflow's lens profile, whose `fisheye_params` are Kannala-Brandt's at `calib_dimension`."""
    place = next(iter(fields.inner(("fisheye_params",))), None)
    if place is None:
        return None
    lens = fields.words(("distortion_model",)).replace(" ", "_")
    if lens not in _GYROFLOW:
        raise ValueError(f"the lens model {lens[:40]!r} of Gyroflow has no counterpart here: calibrate as a fisheye")
    if any((fields.number((name,)) or 1.0) != 1 for name in ("input_horizontal_stretch", "input_vertical_stretch")):
        raise ValueError("its pictures were stretched (input_horizontal_stretch), which is not read: calibrate anew")
    size = next(iter(fields.inner(("calib_dimension",))), Fields([]))
    names = (("image_width", "w"), ("image_height", "h"))
    sides = [(ours, as_number(node, name)) for ours, name in names for _, node in size.nodes((name,))]
    kept = [(name, node) for name, node in place.pairs if name in ("camera_matrix", "distortion_coeffs")]
    return Fields([*kept, *sides, ("model", _GYROFLOW[lens])])


def _known(models: dict[str, tuple[str, tuple[str, ...]]], kind: str, name: str) -> tuple[str, tuple[str, ...]]:
    if kind not in models:
        known = ", ".join(models)
        raise ValueError(f"the lens model {kind[:40]!r} ({name}) has no counterpart here: calibrate as one of {known}")
    return models[kind]


def _camera(intrinsics: tuple[float, ...], size: tuple[float, float], model: str, lens: dict[str, float]) -> Fields:
    order = _OPENCV_ORDER if model == "opencv" else tuple(sorted(lens))
    coefficients = [lens.get(name, 0.0) for name in order]
    sides = [("image_width", size[0]), ("image_height", size[1])]
    return Fields([("intrinsics", [*intrinsics]), *sides, ("distortion_coefficients", coefficients), ("model", model)])


def _bare(name: str) -> str:
    return re.sub(r"[-_\s]", "", name.lower())


_EXPORT = "calibrate with `scopemap calibrate`, or write one line fx fy cx cy [k1 k2 p1 p2 [k3]] (px)"
_NAMED: tuple[tuple[str, Callable[[str], Any]], ...] = (
    ("the text of Bouguet's toolbox; its Calib_Results.mat is read", re.compile(r"^\s*fc\s*=\s*\[", re.M).search),
    ("Kalibr's report; its camchain.yaml is read", re.compile(r"projection:.*\+-|reprojection error:").search),
    ("ROS' ost.txt; the ost.yaml beside it is read", re.compile(r"^# oST version", re.M).search),
    (f"HALCON's; {_EXPORT}", re.compile(r"^ParGroup: Cam_Par", re.M).search),
    (
        "written with decimal commas; write points (fx: 900.5)",
        re.compile(r"""\b[fc][xy]"?\s*[:=]\s*-?\d+,\d|\d,\d+\s*[,;]\s+-?\d+(,\d+)?\s*[,;]\s+-?\d+,\d""").search,
    ),
    (f"OpenMVG's; {_EXPORT}", re.compile(r'"(polymorphic_name|sfm_data_version)"').search),
    (f"Pix4D's; {_EXPORT}", re.compile(r"pix4d|^\s*FOCAL\s+\d", re.I | re.M).search),
    (
        f"the list of cameras of 3D Gaussian splatting, one for each picture; {_EXPORT}",
        re.compile(r'"img_name"').search,
    ),
    (
        "what Python prints of arrays; save them with numpy.savez(file, K=K, D=D), or as JSON by .tolist()",
        re.compile(r"\barray\(\s*\[").search,
    ),
)


def program_of(text: str) -> str:
    """Return whose file a text is that is not read, with what to do, "" where it is nobody's that is known."""
    return next((f"it is {words}" for words, finds in _NAMED if finds(text)), "")
