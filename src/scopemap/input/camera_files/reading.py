"""Reading a camera: numbers as typed, or a calibration file, whose format is recognised by its content."""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files import colmap_model, matlab
from scopemap.input.camera_files.arranging import arranged
from scopemap.input.camera_files.arrays import numpy_fields
from scopemap.input.camera_files.calibration import LARGEST_SIDE_PX, Calibration, Size, fitted, pinhole_of
from scopemap.input.camera_files.intrinsics import has_camera, intrinsics_in
from scopemap.input.camera_files.lens import lens_of, model_in, refuse_other_lens
from scopemap.input.camera_files.parsing import Fields, calibration_bytes, number_rows, read_tree
from scopemap.input.camera_files.programs import CORNER_PX, FORMATS, program_of
from scopemap.input.camera_files.scaramuzza import omnidirectional_of
from scopemap.input.camera_files.sizes import size_in_comments, size_of
from scopemap.input.camera_files.texts import fields_of_rows, fields_of_text

# Under these names some files put what others have at their top.
_INNER = ("intrinsics", "projection_parameters", "camera_intrinsics", "intrinsic")
_LEFT = re.compile(r"left|cam(era)?[_ ]?0|cameraparameters1", re.IGNORECASE)
_MOST_NAMED = 4
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
        return replace(of_fields(fields_of_rows(rows), image_size), source="camera of the numbers given (--camera)")
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
    fields = fields_of_text(text) or read_tree(text)
    if not isinstance(fields, Fields):
        raise ValueError(
            f"it has none of the formats that are read: {FORMATS}, a matrix, lines `fx: 520`, a line of numbers"
        )
    return of_fields(fields, image_size)


def of_fields(fields: Fields, image_size: Size) -> Calibration:
    """Return the camera of a mapping: by the row of its program (`programs.py`), then by usual names; or `ValueError`.

    `image_size` : (width, height) of the pictures, px, for a mapping without a size.
    """
    found = arranged(fields)
    levels, note = _levels(found.place)
    levels += [found.root] if found.root not in levels else []
    note = found.note + note
    if (omnidirectional := omnidirectional_of(levels, found.root, image_size)) is not None:
        return replace(omnidirectional, depth_scale_mm=_depth_scale_mm(levels))
    model = model_in(levels)
    refuse_other_lens(levels, model)
    intrinsics, intrinsics_note = intrinsics_in(levels)
    size, size_note = size_of(levels, found.root, intrinsics, image_size)
    corner_px = CORNER_PX if _ATAN.search(model) else found.corner_px
    pinhole, origin = pinhole_of(intrinsics, size, image_size, corner_px)
    camera, lens_note = lens_of(pinhole, levels, model)
    notes = note + intrinsics_note + size_note + lens_note
    return _read_out(found.root, Calibration(camera, _depth_scale_mm(levels), notes, origin))


def _depth_scale_mm(levels: Sequence[Fields]) -> float | None:
    found = next((s for level in levels if (s := level.number(("depth_scale",))) is not None), None)
    if found is not None and found <= 0:
        raise ValueError(f"depth_scale, mm per unit of the depth files, must be positive, found {found:g}")
    return found


def _levels(fields: Fields) -> tuple[list[Fields], str]:
    """Return the mappings that describe the camera, the closest first, and a note where it is one of several."""
    levels = [fields, *fields.inner(_INNER)]
    if any(map(has_camera, levels)):
        return levels, ""
    below = [(name, [node, *node.inner(_INNER)]) for name, node in fields.pairs if isinstance(node, Fields)]
    found = [(name, inner) for name, inner in below if any(map(has_camera, inner))]
    left = [(name, inner) for name, inner in found if _LEFT.search(name)]
    chosen = found if len(found) == 1 else left
    if found and len(chosen) != 1:
        names = ", ".join(name[:40] for name, _ in found[:_MOST_NAMED])
        raise ValueError(f"it holds {len(found)} cameras ({names}): leave the one of these images in it")
    if not found:
        return levels, ""
    note = f", {chosen[0][0][:40]} of {len(found)} cameras" if len(found) > 1 else ""
    return [*chosen[0][1], fields], note


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
