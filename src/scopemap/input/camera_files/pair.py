"""The calibration of a stereo pair: both cameras and how they lie to each other, as of OpenCV, SCARED and Kalibr."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scopemap.engine.cameras.rectification import StereoPair
from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files.calibration import Size, fitted
from scopemap.input.camera_files.parsing import Fields, calibration_bytes, read_tree
from scopemap.input.camera_files.reading import of_fields, read_calibration

NEEDS_PAIR = (
    "depth from two views (--stereo use) needs the calibration of the pair: --camera FILE with both cameras and "
    "their relative pose (K1, D1, K2, D2, R, T of OpenCV's stereo calibration or SCARED, or Kalibr's camchain)"
)
_SCARED = "camera-calibration"
_EXTRINSICS = ("extrinsics.yml", "extrinsics.yaml", "extrinsics.xml")
_OF_ONE = re.compile(r"(K|M|D|camera_?matrix_?|dist_?(?:coeffs?_?)?)([12]|[LR])", re.IGNORECASE)
_KALIBR = "T_cn_cnm1"
# Of a baseline, mm, as files have it that state no unit: more is taken as mm, less as m; between them it is neither.
_LEAST_MM = 0.5
_MOST_M = 0.1
_LEAST_M = 3e-4


def read_pair(file: Path | str, image_size: Size, fit: str = "exact") -> StereoPair:
    """Return the pair in a file for views of `image_size` (width, height), px; `fit` as `read_calibration` has it.

    R and T may also be in OpenCV's `extrinsics.yml` beside it. T is in mm, or, where it is shorter than 0.1, in m, as
    Kalibr's always is. Raises `CalibrationError` where the file holds no pair, or one whose first camera is not left.
    """
    file = Path(file)
    try:
        fields = _fields(file)
        cameras = sorted(name for name, _ in fields.pairs if re.fullmatch(r"cam\d{1,3}", name))
        if len(chain := fields.inner(cameras)) > 1:
            second, T_right_left, unit = Fields([("cam0", chain[1])]), _kalibr_transform(chain[1]), "m (Kalibr)"
        else:
            second = _second(fields)
            T_right_left, unit = _opencv_transform(fields, file)
        right = fitted(of_fields(second, image_size), image_size, fit).camera
        x, y, z = -T_right_left[:3, :3].T @ T_right_left[:3, 3]
        if x <= abs(y):
            place = f"at x {x:.2f}, y {y:.2f}, z {z:.2f} mm of the first"
            raise ValueError(f"its second camera, {place}, does not lie to the right of it")
    except ValueError as error:
        raise CalibrationError(f"the calibration {file} cannot be used: {error}; {NEEDS_PAIR}") from None
    left, baseline_mm = read_calibration(file, image_size, fit).camera, float(np.linalg.norm(T_right_left[:3, 3]))
    return StereoPair(left, right, T_right_left, f"pair in {file.name}, baseline {baseline_mm:.3f} mm, T in {unit}")


def _fields(file: Path) -> Fields:
    tree = read_tree(calibration_bytes(file).decode("utf-8-sig", errors="replace"))
    if not isinstance(tree, Fields):
        raise ValueError("it is of one camera")
    return next(iter(tree.inner((_SCARED,))), tree)


def _second(fields: Fields) -> Fields:
    """Return the mapping with the second camera's matrix and lens under the names of the first."""
    pairs, found = [], False
    for name, node in fields.pairs:
        match = _OF_ONE.fullmatch(name)
        if match is None:
            pairs.append((name, node))
        elif match[2] in "2Rr":
            found = True
            pairs.append((match[1] + ("1" if match[2] == "2" else "L"), node))
    if not found:
        raise ValueError("it is of one camera")
    return Fields(pairs)


def _opencv_transform(fields: Fields, file: Path) -> tuple[np.ndarray, str]:
    """Return T_right_left (4, 4), mm, of R and T in a mapping or a file of OpenCV's beside it, and the unit of T."""
    beside = (file.with_name(name) for name in _EXTRINSICS)
    places = [fields, *(_fields(other) for other in beside if other.is_file() and other != file)]
    for place in places:
        R, T = place.numbers(("R",), 9), place.numbers(("T",), 3)
        if R is not None and T is not None:
            length = float(np.linalg.norm(T))
            if length < _LEAST_M or _MOST_M < length < _LEAST_MM:
                raise ValueError(f"its T is {length:.3g} long, of no unit that is known: give it in mm")
            mm, unit = (1.0, "mm") if length >= _LEAST_MM else (1000.0, "m")
            return _transform(np.reshape(R, (3, 3)), mm * np.array(T)), f"{unit} (assumed by its length)"
    raise ValueError("it has no R (3x3) and T (3) between its cameras")


def _kalibr_transform(second: Fields) -> np.ndarray:
    numbers = second.numbers((_KALIBR,), 16)
    if numbers is None:
        raise ValueError(f"its second camera has no {_KALIBR} (4x4)")
    T = np.reshape(numbers, (4, 4))
    return _transform(T[:3, :3], 1000.0 * T[:3, 3])


def _transform(R: np.ndarray, t_mm: np.ndarray) -> np.ndarray:
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise ValueError("what should turn its cameras to each other (R) is no rotation")
    T_right_left = np.eye(4)
    T_right_left[:3, :3], T_right_left[:3, 3] = R, t_mm
    return T_right_left
