"""The focal lengths and the principal point in a mapping of usual names: a matrix, a name for each, or lists."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scopemap.input.camera_files.parsing import Fields

_MATRIX_NAMES = (
    "camera_matrix", "K", "K1", "M1", "M", "cam_K", "intrinsic_matrix", "KL", "mtx", "camera_matrix_1",
    "intrinsics_matrix", "intrinsics", "intrinsic", "camera_intrinsics",
)  # fmt: skip
_MATRIX_SHAPES = ((3, 3), (4, 4), (3, 4))
_NAMES = {
    "fx": ("fx", "fl_x", "focal_x", "focal_length_x", "fc_x", "mu"),
    "fy": ("fy", "fl_y", "focal_y", "focal_length_y", "fc_y", "mv"),
    "cx": ("cx", "ppx", "cc_x", "u0", "principal_point_x"),
    "cy": ("cy", "ppy", "cc_y", "v0", "principal_point_y"),
}
_FOCAL_LENGTHS = ("fc", "focal_length", "focal", "f")
_CENTRES = ("cc", "principal_point", "optical_center", "principal", "pp", "c")
_SKEW = "skew"
_SKEW_OF_FX = "alpha_c"
# A skew is passed over up to the first share of the focal length, with a note up to the second.
_SLIGHT_SKEW = 1e-3
_MOST_SKEW = 1e-2


def has_camera(place: Fields) -> bool:
    """Return whether a mapping may hold a camera: a matrix, or names of intrinsics."""
    named = (*_MATRIX_NAMES, *_NAMES["fx"], "fc", "polynomial", "a0")
    return any(not isinstance(node, Fields) for _, node in place.nodes(named))


def intrinsics_in(levels: Sequence[Fields]) -> tuple[list[float], str]:
    """Return fx fy cx cy, and a note: of a matrix, else by name, else of lists, Bouguet's or Kalibr's.

    Raises `ValueError` where they are not there, or are no camera's.
    """
    for level in levels:
        for rows, columns in _MATRIX_SHAPES:
            if (matrix := level.numbers(_MATRIX_NAMES, rows * columns)) is not None:
                return _of_matrix(np.reshape(matrix, (rows, columns)))
    for level in levels:
        found = {name: level.number(spellings) for name, spellings in _NAMES.items()}
        if found["fx"] is not None or _from_lists(level, found):
            return _of_names(level, found)
    listed = next((four for level in levels if (four := level.numbers(("intrinsics",), 4)) is not None), None)
    if listed is None:
        raise ValueError("it has no 3x3 camera matrix under any usual name (camera_matrix, K), and no fx fy cx cy")
    return listed, ""


def has_last_row(K: np.ndarray) -> bool:
    """Return whether a matrix (3, 3) ends as camera matrices do: 0 before fy, and 0 0 1."""
    return np.allclose([K[1, 0], *K[2]], [0, 0, 0, 1])


def _of_matrix(K: np.ndarray) -> tuple[list[float], str]:
    """Return fx fy cx cy of a camera matrix, transposed or not, and a note; of (3, 4) or (4, 4) the upper left."""
    K, note = K[:3, :3], ""
    if not K.any():
        raise ValueError("its camera matrix is all zero, which ROS writes for a camera that was not calibrated")
    if not has_last_row(K) and has_last_row(K.T):
        K, note = K.T, ", its matrix transposed"
    if not has_last_row(K):
        rows = "; ".join(" ".join(f"{value:g}" for value in row) for row in K)
        raise ValueError(f"its matrix is no camera matrix [fx 0 cx; 0 fy cy; 0 0 1], found {rows}")
    (fx, skew, cx), (_, fy, cy) = K[:2].tolist()
    return [fx, fy, cx, cy], note + _without_skew(skew, fx)


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
    return intrinsics, _without_skew(skew, fx)


def _without_skew(skew: float, fx: float) -> str:
    """Return the note on a skew, px, that is left out, "" where it is nothing; `ValueError` where it is too large."""
    if abs(skew) > _MOST_SKEW * abs(fx):
        raise ValueError(f"its camera matrix has a skew of {skew:g}, which no camera here has")
    return f", its skew of {skew:g} px left out" if abs(skew) > _SLIGHT_SKEW * abs(fx) else ""
