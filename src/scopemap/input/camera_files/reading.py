"""Reading a camera: numbers as typed, or a calibration file, whose format is recognised by its content."""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files import colmap_model, matlab, text_formats
from scopemap.input.camera_files.arrays import numpy_fields
from scopemap.input.camera_files.calibration import LARGEST_SIDE_PX, Calibration, Size, fitted, pinhole_of
from scopemap.input.camera_files.direct_methods import CORNER_PX, direct_method_camera
from scopemap.input.camera_files.lens import lens_of, model_in, refuse_other_lens
from scopemap.input.camera_files.metashape import metashape_fields
from scopemap.input.camera_files.other_programs import as_ours, program_of
from scopemap.input.camera_files.parsing import Fields, calibration_bytes, number_rows, read_tree
from scopemap.input.camera_files.scaramuzza import omnidirectional_of
from scopemap.input.camera_files.sizes import size_in_comments, size_of

_FORMATS = (
    "OpenCV, ROS, Kalibr, Basalt, COLMAP, ORB-SLAM, DSO, MATLAB, OCamCalib, a camera matrix, lines `fx: 520`, or one "
    "line fx fy cx cy [k1 k2 p1 p2 [k3]]"
)
_SCARED = "camera-calibration"  # in frame_data*.json
_KALIBR_CAMERA = re.compile(r"cam\d{1,3}")
_BASALT = "value0"
_MATRIX_NAMES = (
    "camera_matrix", "K", "K1", "M1", "M", "cam_K", "intrinsic_matrix", "KL", "mtx", "camera_matrix_1",
    "intrinsics_matrix", "intrinsics", "intrinsic", "camera_intrinsics",
)  # fmt: skip
_MATRIX_SHAPES = ((3, 3), (4, 4), (3, 4))
# Under these names some files put what others have at their top.
_INNER = ("intrinsics", "projection_parameters", "camera_intrinsics", "intrinsic")
_LEFT = re.compile(r"left|cam(era)?[_ ]?0|cameraparameters1", re.IGNORECASE)
_NERFSTUDIO = "fl_x"
_INTRINSICS = {
    "fx": ("fx", _NERFSTUDIO, "focal_x", "focal_length_x", "fc_x", "mu"),
    "fy": ("fy", "fl_y", "focal_y", "focal_length_y", "fc_y", "mv"),
    "cx": ("cx", "ppx", "cc_x", "u0", "principal_point_x"),
    "cy": ("cy", "ppy", "cc_y", "v0", "principal_point_y"),
}
_FOCAL_LENGTHS = ("fc", "focal_length", "focal", "f")
_CENTRES = ("cc", "principal_point", "optical_center", "principal", "pp", "c")
_MOST_NAMED = 4
_SKEW = "skew"
_SKEW_OF_FX = "alpha_c"
_CORNER_TO_CENTRE_PX = 0.5
# PTAM's word for its lens: SVO's files have PTAM's shares, too.
_ATAN = re.compile(r"\batan\b")


def read_calibration(camera: Path | str, image_size: Size, fit: str = "exact") -> Calibration:
    """Return the camera in a file, or of numbers `fx fy cx cy [k1 k2 p1 p2 [k3]]`, for images of `image_size`, px.

    `image_size` is (width, height). A calibration without a size is taken as made for the images. `fit` is the meaning
    of another size: exact: it is refused; scale: the images were resized from it (aspects agree within 1 %); crop:X,Y:
    they were cut out of it at that pixel. Raises `CalibrationError` where the camera cannot be read or does not fit.
    """
    return fitted(stated_calibration(camera, image_size), image_size, fit)


def stated_calibration(camera: Path | str, image_size: Size) -> Calibration:
    """Return the camera at the file's own size, or that of the images where it has none; raises `CalibrationError`."""
    file = Path(camera)
    if not os.path.isfile(file) and (typed := _typed(str(camera), image_size)) is not None:
        return typed
    try:
        calibration = _read(file, image_size)
    except ValueError as error:
        raise CalibrationError(f"the calibration {file} cannot be used: {error}") from None
    shares = ", its numbers taken as shares of the size" if calibration.size_origin == "relative" else ""
    return replace(calibration, source=f"calibration file {file.name}{calibration.source}{shares}", file=file)


def _typed(camera: str, image_size: Size) -> Calibration | None:
    """Return the camera of typed numbers, None for any other text."""
    try:
        rows = number_rows(camera)
        if not rows or len(rows[0]) < 2:
            return None
        return replace(text_formats.of_numbers(rows, image_size), source="camera of the numbers given (--camera)")
    except ValueError as error:
        raise CalibrationError(f"cannot use the camera '{camera[:200]}': {error}") from None


def _read(file: Path, image_size: Size) -> Calibration:
    content = calibration_bytes(file)
    if colmap_model.is_cameras_binary(content):
        return Calibration(colmap_model.only_camera(file), None, "")
    if matlab.is_mat_file(content):
        return of_fields(matlab.mat_fields(content), image_size)
    if (arrays := numpy_fields(content)) is not None:
        return of_fields(arrays, image_size)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        content = content.decode("utf-16", errors="replace").encode()  # what PowerShell's > writes
    if b"\0" in content:
        raise ValueError("it is binary, not text")
    text = content.decode("utf-8-sig", errors="replace")  # comments may have any encoding
    try:
        return _of_any_text(file, text, image_size)
    except ValueError as error:
        if program := program_of(text):
            raise ValueError(program) from error
        raise


def _of_any_text(file: Path, text: str, image_size: Size) -> Calibration:
    """Return the camera of a text; `file` : where it is from, beside which COLMAP keeps the pictures' sizes."""
    if colmap_model.is_cameras_text(text):
        return Calibration(colmap_model.only_camera(file), None, "")
    calibration = _of_text(text, image_size)
    commented = size_in_comments(text) if calibration.size_origin != "stated" else None
    if commented is None:
        return calibration
    camera = _of_text(text, commented).camera
    if camera.central.cx > commented[0] or camera.central.cy > commented[1]:  # of something else
        return calibration
    source = f"{calibration.source}, its size that of its comment"
    return replace(calibration, camera=camera, source=source, size_origin="stated")


def _of_text(text: str, image_size: Size) -> Calibration:
    if (found := direct_method_camera(text, image_size)) is not None:
        return found
    if (rows := number_rows(text)) is not None:
        return text_formats.of_numbers(rows, image_size)
    fields = text_formats.calibu_fields(text) if "<camera_model" in text else metashape_fields(text)
    tree = fields or read_tree(text)
    if not isinstance(tree, Fields):
        raise ValueError(f"it has none of the formats that are read: {_FORMATS}")
    return of_fields(next(iter(tree.inner((_SCARED,))), tree), image_size)


def of_fields(fields: Fields, image_size: Size) -> Calibration:
    """Return the camera of a mapping: OpenCV, ROS, Kalibr, Basalt, ORB-SLAM, nerfstudio, MATLAB; or `ValueError`."""
    if (ocam := matlab.of_ocam_model(fields)) is not None:
        return ocam
    fields = as_ours(matlab.without_matlabs_conventions(fields))
    levels, chain_note = _levels(fields)
    if (omnidirectional := omnidirectional_of(levels, fields, image_size)) is not None:
        return replace(omnidirectional, depth_scale_mm=_depth_scale_mm(levels))
    model = model_in(levels)
    refuse_other_lens(levels, model)
    intrinsics, note = _intrinsics(levels)
    size, size_note = size_of(levels, fields, intrinsics, image_size)
    corner_px = CORNER_PX if _ATAN.search(model) else 0.0
    pinhole, origin = pinhole_of(intrinsics, size, image_size, corner_px)
    camera, lens_note = lens_of(pinhole, levels, model)
    notes = chain_note + note + size_note + lens_note
    return _read_out(fields, Calibration(camera, _depth_scale_mm(levels), notes, origin))


def _depth_scale_mm(levels: Sequence[Fields]) -> float | None:
    found = next((s for level in levels if (s := level.number(("depth_scale",))) is not None), None)
    if found is not None and found <= 0:
        raise ValueError(f"depth_scale, mm per unit of the depth files, must be positive, found {found:g}")
    return found


def _levels(fields: Fields) -> tuple[list[Fields], str]:
    """Return the mappings that describe the camera, the closest first, and a note where it is one of several."""
    cameras = sorted(name for name, _ in fields.pairs if _KALIBR_CAMERA.fullmatch(name))
    if chain := fields.inner(cameras):
        return [chain[0], fields], f", {cameras[0]} of {len(chain)} cameras" if len(chain) > 1 else ""
    if basalt := fields.inner((_BASALT,)):
        return _basalt_levels(basalt[0])
    levels = [fields, *fields.inner(_INNER)]
    if any(map(_has_camera, levels)):
        return levels, ""
    below = [(name, [node, *node.inner(_INNER)]) for name, node in fields.pairs if isinstance(node, Fields)]
    found = [(name, inner) for name, inner in below if any(map(_has_camera, inner))]
    left = [(name, inner) for name, inner in found if _LEFT.search(name)]
    chosen = found if len(found) == 1 else left
    if found and len(chosen) != 1:
        names = ", ".join(name[:40] for name, _ in found[:_MOST_NAMED])
        raise ValueError(f"it holds {len(found)} cameras ({names}): leave the one of these images in it")
    if not found:
        return levels, ""
    note = f", {chosen[0][0][:40]} of {len(found)} cameras" if len(found) > 1 else ""
    return [*chosen[0][1], fields], note


def _basalt_levels(calibration: Fields) -> tuple[list[Fields], str]:
    """Return the levels of the first camera of Basalt's JSON, whose sizes are in a list of their own."""
    cameras = [n for _, node in calibration.nodes(("intrinsics",)) if isinstance(node, list) for n in node]
    sizes = [size for _, node in calibration.nodes(("resolution",)) if isinstance(node, list) for size in node]
    if not cameras or not isinstance(cameras[0], Fields):
        raise ValueError("it is Basalt's, but has no list of intrinsics")
    size = Fields([("resolution", sizes[0])] if sizes else [])
    note = f", the first of {len(cameras)} cameras" if len(cameras) > 1 else ""
    return [*cameras[0].inner(("intrinsics",)), cameras[0], size], note


def _has_camera(place: Fields) -> bool:
    """Return whether a mapping may hold a camera: a matrix, or names of intrinsics."""
    named = (*_MATRIX_NAMES, *_INTRINSICS["fx"], "fc", "polynomial", "a0")
    return any(not isinstance(node, Fields) for _, node in place.nodes(named))


def _intrinsics(levels: Sequence[Fields]) -> tuple[list[float], str]:
    """Return fx fy cx cy, and a note: of a matrix, else by name, else of lists, Bouguet's or Kalibr's."""
    for level in levels:
        for rows, columns in _MATRIX_SHAPES:
            if (matrix := level.numbers(_MATRIX_NAMES, rows * columns)) is not None:
                return text_formats.intrinsics_of(np.reshape(matrix, (rows, columns)))
    for level in levels:
        found = {name: level.number(spellings) for name, spellings in _INTRINSICS.items()}
        if found["fx"] is not None or _from_lists(level, found):
            return _of_names(level, found)
    listed = next((four for level in levels if (four := level.numbers(("intrinsics",), 4)) is not None), None)
    if listed is None:
        raise ValueError("it has no 3x3 camera matrix under any usual name (camera_matrix, K), and no fx fy cx cy")
    return listed, ""


def _from_lists(level: Fields, found: dict[str, float | None]) -> bool:
    """Fill in what is in lists, fc = [fx, fy] and cc = [cx, cy], or one focal length; return whether it is there."""
    one = level.number(_FOCAL_LENGTHS)
    pairs = level.numbers(_FOCAL_LENGTHS, 2) or ([one, one] if one is not None else None)
    centre = level.numbers(_CENTRES, 2)
    for names, values in ((("fx", "fy"), pairs), (("cx", "cy"), centre)):
        if values is not None:
            found |= {name: value for name, value in zip(names, values, strict=True) if found[name] is None}
    return found["fx"] is not None


def _of_names(level: Fields, found: dict[str, float | None]) -> tuple[list[float], str]:
    intrinsics = [value for value in found.values() if value is not None]
    if len(intrinsics) < len(found):
        raise ValueError(f"it has no {', '.join(name for name, value in found.items() if value is None)}")
    fx = intrinsics[0]
    skew = level.number((_SKEW,)) or (level.number((_SKEW_OF_FX,)) or 0.0) * fx
    note = text_formats.without_skew(skew, fx)
    if level.number((_NERFSTUDIO,)) is not None and max(intrinsics[2:]) > 1:
        intrinsics[2:] = [value - _CORNER_TO_CENTRE_PX for value in intrinsics[2:]]
        note += ", its pixels counted from the corner, as in nerfstudio"
    return intrinsics, note


def _read_out(fields: Fields, calibration: Calibration) -> Calibration:
    """Return the camera of a binned region of a sensor (ROS CameraInfo); `ValueError` where that is no part of it."""
    sensor = calibration.camera
    roi = next(iter(fields.inner(("roi",))), Fields([]))
    x, y, width, height = (_whole(roi, name) for name in ("x_offset", "y_offset", "width", "height"))
    if not width or not height:
        x, y, width, height = 0, 0, sensor.width, sensor.height
    across, down = (max(1, _whole(fields, name)) for name in ("binning_x", "binning_y"))
    if (x, y, width, height, across, down) == (0, 0, sensor.width, sensor.height, 1, 1):
        return calibration
    if calibration.size_origin != "stated":
        raise ValueError("it has a region or a binning, but not the size of the sensor (image_width, image_height)")
    columns, rows = width // across, height // down
    if x + width > sensor.width or y + height > sensor.height or not columns or not rows:
        raise ValueError(f"its region, {width}x{height} px at {x},{y}, is no part of {sensor.width}x{sensor.height} px")
    camera = sensor.cropped(x, y, columns * across, rows * down).resized(columns, rows)
    source = f"{calibration.source}, its region and binning of {sensor.width}x{sensor.height} px taken"
    return replace(calibration, camera=camera, source=source)


def _whole(place: Fields, name: str) -> int:
    value = place.number((name,)) or 0.0
    if value % 1 or not 0 <= value <= LARGEST_SIDE_PX:
        raise ValueError(f"{name} must be a whole number of pixels, found {value:g}")
    return int(value)
