"""Calibration files: OpenCV YAML, XML or JSON, ROS camera_info, and one line `fx fy cx cy [k1 k2 p1 p2 [k3]]`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scopemap.camera import CameraModel, PinholeCamera
from scopemap.errors import CalibrationError
from scopemap.lenses import FisheyeCamera, OmnidirectionalCamera, OpenCvCamera

_MATRIX_NAMES = (
    "camera_matrix", "K", "K1", "M1", "M", "Camera_Matrix", "cameraMatrix", "cam_K", "intrinsic_matrix", "KL", "mtx",
)  # fmt: skip
_DISTORTION_NAMES = (
    "distortion_coefficients", "D", "D1", "K_dist", "Distortion_Coefficients", "distCoeffs", "dist", "DL",
)  # fmt: skip
_WIDTH_NAMES = ("image_width", "image_Width", "width", "Camera.width")
_HEIGHT_NAMES = ("image_height", "image_Height", "height", "Camera.height")
_MODEL_NAMES = ("camera_model", "distortion_model", "model", "Camera.type")
_FISHEYE_WORDS = ("fisheye", "equidistant", "kannala", "kb4")
_OMNIDIRECTIONAL_WORDS = ("omnidirectional", "scaramuzza")
_ASPECT_TOLERANCE = 0.01
_MOST_BYTES = 1 << 20


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says.

    Attributes
    ----------
    camera : camera model at the size of the images.
    depth_scale_mm : mm per unit of the depth files beside it, or None where the file does not say.
    source : how the camera is known, one phrase.
    """

    camera: CameraModel
    depth_scale_mm: float | None
    source: str


def read_calibration(file: Path | str, image_size: tuple[int, int]) -> Calibration:
    """Return the camera in `file` for images of `image_size` (width, height), px.

    The file's kind is told by its content. A calibration made at another size of the same aspect (within 1 %) is
    rescaled, and `source` says so; one without a size is taken as made for the images. Raises `CalibrationError` where
    the file cannot be read or does not fit.
    """
    file = Path(file)
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise CalibrationError(
                f"the calibration {file} is larger than any calibration: {file.stat().st_size} bytes"
            )
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"cannot read the calibration in {file}: {error}") from None
    numbers = _plain_numbers(text)
    if numbers is not None:
        camera, depth_scale_mm = _camera_of_line(numbers, image_size, file), None
    else:
        camera, depth_scale_mm = _read_storage(text, image_size, file)
    fitted = fitted_to(camera, image_size, str(file))
    note = "" if fitted is camera else f", rescaled from {camera.width}x{camera.height} px"
    _check_plausible(fitted, file)
    return Calibration(fitted, depth_scale_mm, f"calibration file {file.name}{note}")


def fitted_to(camera: CameraModel, image_size: tuple[int, int], name: str) -> CameraModel:
    """Return `camera` for images of `image_size` (width, height); `CalibrationError` unless the aspects agree."""
    width, height = image_size
    if (camera.width, camera.height) == (width, height):
        return camera
    if abs(camera.width * height / (camera.height * width) - 1) > _ASPECT_TOLERANCE:
        raise CalibrationError(
            f"the calibration {name} is for {camera.width}x{camera.height} px, but the images are {width}x{height} px: "
            "another aspect, perhaps cropped; give a calibration for these images (--camera)"
        )
    return camera.resized(width, height)


def write_calibration(camera: CameraModel, file: Path | str, depth_scale_mm: float | None = None) -> None:
    """Write `camera` as OpenCV YAML that `read_calibration` reads back exactly.

    `depth_scale_mm` is written as `depth_scale`: mm per unit of the depth files beside it. Raises `CalibrationError`
    where the file cannot be written.
    """
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
    if not storage.isOpened():
        raise CalibrationError(f"cannot write the calibration to {file}: is its folder there and writable?")
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.central.matrix)
    if isinstance(camera, OmnidirectionalCamera):
        storage.write("camera_model", "omnidirectional")
        storage.write("polynomial", np.array([camera.polynomial]))
        storage.write("stretch", np.array([camera.stretch]))
    else:
        distortion = camera.distortion if isinstance(camera, FisheyeCamera | OpenCvCamera) else (0.0,) * 5
        storage.write("camera_model", "fisheye" if isinstance(camera, FisheyeCamera) else "opencv")
        storage.write("distortion_coefficients", np.array([distortion]))
    if depth_scale_mm is not None:
        storage.write("depth_scale", float(depth_scale_mm))
    storage.release()


def _plain_numbers(text: str) -> list[float] | None:
    """Return the numbers of a file that holds nothing else (comments after # aside), or None."""
    lines = [line.split("#")[0] for line in text.splitlines()]
    try:
        return [float(word) for line in lines for word in line.replace(",", " ").split()]
    except ValueError:
        return None


def _camera_of_line(numbers: list[float], image_size: tuple[int, int], file: Path) -> CameraModel:
    if len(numbers) not in (4, 8, 9):
        raise CalibrationError(
            f"the calibration {file} holds {len(numbers)} numbers: expected OpenCV YAML or "
            "one line fx fy cx cy [k1 k2 p1 p2 [k3]]"
        )
    fx, fy, cx, cy, *distortion = numbers
    pinhole = PinholeCamera(fx, fy, cx, cy, *image_size)
    return OpenCvCamera(pinhole, tuple(distortion)) if any(distortion) else pinhole


def _read_storage(text: str, image_size: tuple[int, int], file: Path) -> tuple[CameraModel, float | None]:
    if text.lstrip()[:1] not in tuple("%<{"):
        text = "%YAML:1.0\n---\n" + text  # OpenCV tells its formats by the first line, which other tools leave out
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
    except (cv2.error, SystemError):
        root = None
    if root is None or not root.isMap():
        raise CalibrationError(f"the calibration {file} is neither OpenCV YAML nor a line fx fy cx cy [k1 k2 p1 p2 k3]")
    width, height = (int(_number(root, names) or 0) for names in (_WIDTH_NAMES, _HEIGHT_NAMES))
    size = (width, height) if width > 0 and height > 0 else image_size
    matrix = _array(root, _MATRIX_NAMES)
    if matrix is None or matrix.size != 9:
        raise CalibrationError(
            f"the calibration {file} has no 3x3 camera matrix under any usual name (camera_matrix, K)"
        )
    fx, _, cx, _, fy, cy = (float(value) for value in matrix.ravel()[:6])
    pinhole = PinholeCamera(fx, fy, cx, cy, *size)
    return _with_lens(root, pinhole, file), _number(root, ("depth_scale",))


def _with_lens(root: cv2.FileNode, pinhole: PinholeCamera, file: Path) -> CameraModel:
    words = [root.getNode(name).string().lower() for name in _MODEL_NAMES if root.getNode(name).isString()]
    model = " ".join(words) + (" fisheye" if _number(root, ("fisheye_model", "fisheye")) else "")
    if any(word in model for word in _OMNIDIRECTIONAL_WORDS):
        return _omnidirectional(root, pinhole, file)
    found = _array(root, _DISTORTION_NAMES)
    distortion = () if found is None else tuple(float(k) for k in found.ravel())
    is_fisheye = any(word in model for word in _FISHEYE_WORDS)
    if not is_fisheye and not any(distortion):
        return pinhole
    try:
        return FisheyeCamera(pinhole, distortion) if is_fisheye else OpenCvCamera(pinhole, distortion)
    except ValueError as error:
        raise CalibrationError(f"the calibration {file}: {error}") from None


def _omnidirectional(root: cv2.FileNode, pinhole: PinholeCamera, file: Path) -> OmnidirectionalCamera:
    polynomial, stretch = _array(root, ("polynomial",)), _array(root, ("stretch",))
    if polynomial is None:
        raise CalibrationError(f"the calibration {file} is omnidirectional but has no 'polynomial'")
    centre = (pinhole.cx, pinhole.cy, pinhole.width, pinhole.height)
    try:
        c, d, e = (1.0, 0.0, 0.0) if stretch is None else (float(x) for x in stretch.ravel())
        return OmnidirectionalCamera(tuple(float(a) for a in polynomial.ravel()), *centre, (c, d, e))
    except ValueError as error:
        raise CalibrationError(f"the calibration {file}: {error}") from None


def _number(root: cv2.FileNode, names: tuple[str, ...]) -> float | None:
    nodes = (root.getNode(name) for name in names)
    found = (node.real() for node in nodes if node.isInt() or node.isReal())
    return next((number for number in found if math.isfinite(number)), None)


def _array(root: cv2.FileNode, names: tuple[str, ...]) -> np.ndarray | None:
    """Return the first array found: an OpenCV matrix, a plain map with `data` (ROS), or a list of numbers."""
    for name in names:
        node = root.getNode(name)
        if node.isMap():
            node = node.getNode("data")
        if node.isSeq():
            rows = [node.at(i) for i in range(node.size())]
            cells = [c for row in rows for c in ([row.at(i) for i in range(row.size())] if row.isSeq() else [row])]
            return np.array([cell.real() for cell in cells], dtype=np.float64)
    return None


def _check_plausible(camera: CameraModel, file: Path) -> None:
    central = camera.central
    size = f"{camera.width}x{camera.height} px"
    if not 0.3 * camera.width < central.fx < 5 * camera.width or not 0.2 < central.fy / central.fx < 5:
        raise CalibrationError(
            f"the calibration {file} does not fit images of {size}: focal length {central.fx:g}, {central.fy:g} px "
            f"(plausible: {0.3 * camera.width:g} to {5 * camera.width:g})"
        )
    if not (0 <= central.cx < camera.width and 0 <= central.cy < camera.height):
        raise CalibrationError(
            f"the calibration {file} does not fit images of {size}: its principal point {central.cx:g}, {central.cy:g} "
            "lies outside; it was made for larger images or for a crop"
        )
