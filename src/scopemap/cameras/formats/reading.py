"""Which form a calibration file has, told by its content; what it says; and that fitted to the images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from scopemap.cameras.formats import colmap, kalibr, named_numbers, plain_numbers
from scopemap.cameras.formats.calibu import of_calibu
from scopemap.cameras.formats.contents import calibration_bytes, calibration_text
from scopemap.cameras.formats.fitting import fitted
from scopemap.cameras.formats.opencv import has_matrix, of_matrices
from scopemap.cameras.formats.stated import Calibration, Size
from scopemap.cameras.formats.stereo_ini import is_stereo_ini, of_stereo_ini
from scopemap.cameras.formats.trees import read_tree
from scopemap.errors import CalibrationError

_SCARED = "camera-calibration"  # in frame_data*.json
_FORMS = (
    "OpenCV, ROS, Kalibr, COLMAP, ORB-SLAM, OCamCalib, a camera matrix, lines `fx: 520`, or one line fx fy cx cy "
    "[k1 k2 p1 p2 [k3]]"
)


def read_calibration(file: Path | str, image_size: Size, fit: str = "exact") -> Calibration:
    """Return the camera in `file` for images of `image_size` (width, height), px.

    The file's form is told by its content. A calibration without a size is taken as made for the images. `fit` says
    what another size means: exact: it is refused; scale: the images were resized from it (its aspect must agree within
    1 %); crop:X,Y: they were cut out of it at that pixel. Raises `CalibrationError` where the file cannot be read or
    does not fit.
    """
    return fitted(stated_calibration(file, image_size), image_size, fit)


def stated_calibration(file: Path | str, image_size: Size) -> Calibration:
    """Return the camera as it stands in `file`, at the file's own size, or that of the images where it has none.

    Raises `CalibrationError` where the file cannot be read.
    """
    file = Path(file)
    try:
        calibration = _stated(file, image_size)
    except ValueError as error:
        raise CalibrationError(f"the calibration {file} cannot be used: {error}") from None
    shares = ", its numbers taken as shares of the size" if calibration.size_origin == "relative" else ""
    return replace(calibration, source=f"calibration file {file.name}{calibration.source}{shares}", file=file)


def _stated(file: Path, image_size: Size) -> Calibration:
    if colmap.is_cameras_binary(calibration_bytes(file)):
        return Calibration(colmap.only_camera(file, binary=True), None, "")
    text = calibration_text(file)
    rows = plain_numbers.rows_in(text)
    if rows is not None:
        return plain_numbers.of_rows(rows, image_size)
    if colmap.is_cameras_text(text):
        return Calibration(colmap.only_camera(file, binary=False), None, "")
    if is_stereo_ini(text):
        return Calibration(of_stereo_ini(text), None, "")
    if "<camera_model" in text:
        return Calibration(of_calibu(text), None, "")
    return _of_tree(text, image_size)


def _of_tree(text: str, image_size: Size) -> Calibration:
    flat = None if text.lstrip()[:1] in ("{", "[", "<") else named_numbers.pairs_in(text)
    tree = flat or read_tree(text)
    if not isinstance(tree, dict):
        raise ValueError(f"it has none of the forms that are read: {_FORMS}")
    inner = tree.get(_SCARED)
    if isinstance(inner, dict):
        return of_matrices(inner, image_size)
    cameras = kalibr.cameras_in(tree)
    if cameras:
        return kalibr.of_chain(tree, cameras, image_size)
    if not has_matrix(tree) and named_numbers.has_names(tree):
        return named_numbers.of_names(tree, image_size)
    return of_matrices(tree, image_size)
