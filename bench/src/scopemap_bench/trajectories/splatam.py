"""Gaussian SLAM of the SplaTAM family: `params.npz` of SplaTAM, EndoGSLAM and Endo-2DTAM.

All save `cam_unnorm_rots` (1, 4, N), quaternions with the scalar first and of any length, and `cam_trans` (1, 3, N);
together they take a point in the first camera to camera n (transform_to_frame in utils/slam_helpers.py). Lengths are in
the unit of the depth they were fed. On C3VD EndoGSLAM and Endo-2DTAM run with `train_or_test="train"`, which holds out
frames 7, 15, 23, ... (datasets/gradslam_datasets/c3vd.py), so that column 7 is frame 8. Their settings are in
`config.py` beside the file, which is read but never run.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.engine.errors import InputError, check_bytes, reporting
from scopemap.engine.geometry.se3 import inverse
from scopemap.input.trajectory.poses import file_of, from_quaternions, rigid, stamped
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit

PARAMS_FILE = "params.npz"
_ARRAYS = ("cam_unnorm_rots", "cam_trans")
_TRAINED_PER_HELD_OUT = 7
_LARGEST = 1_000_000_000  # number of a frame, and step
_MOST_BYTES = 64 << 20  # of an array: 4 million frames


def read_params(path: Path, unit: Unit, split: str = "") -> Trajectory:
    """Read `params.npz` of a run over every frame (`split` "all"), or over all but every eighth ("train").

    "" numbers the frames by the `config.py` beside the file; `InputError` where there is none.
    """
    file = file_of(path, (PARAMS_FILE,))
    settings = (split, 0, 1) if split else _settings_of(file.with_name("config.py"))
    if settings is None:
        raise InputError(
            f"cannot number the frames of {file}: it has no config.py of its run beside it with plain values of "
            "train_or_test, start and stride; name the kind: 'endogslam' (frames 7, 15, ... were held out, as "
            "EndoGSLAM and Endo-2DTAM do on C3VD) or 'splatam' (every frame was used)"
        )
    return _read(file, unit, *settings)


def _settings_of(config: Path) -> tuple[str, int, int] | None:
    """Return train_or_test, start and stride of a run; None where they are missing or more than plain values."""
    found: dict[str, Any] = {"train_or_test": "all", "start": 0, "stride": 1}
    if not config.is_file():
        return None
    try:
        for node in ast.walk(ast.parse(config.read_bytes())):
            if isinstance(node, ast.keyword) and node.arg in found:
                found[node.arg] = ast.literal_eval(node.value)
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    split, start, stride = found.values()
    usable = split in ("all", "train") and isinstance(start, int) and isinstance(stride, int)
    return (split, start, stride) if usable and 0 <= start < _LARGEST and 0 < stride < _LARGEST else None


def _read(path: Path, unit: Unit, split: str, start: int, stride: int) -> Trajectory:
    """Read the poses of the frames from `start` (first of those not held out) in steps of `stride`."""
    quaternions, translations = _columns(path)
    # Columns start at the identity; a checkpoint of an unfinished run still has its tail there.
    tracked = np.any(quaternions != [1, 0, 0, 0], axis=1) | np.any(translations != 0, axis=1)
    count = 1 + int(np.flatnonzero(tracked).max(initial=0))
    quaternions, translations = quaternions[:count], translations[:count]
    where = [f"{path}, column {column}" for column in range(count)]
    with np.errstate(invalid="ignore"):  # a quaternion of length 0 turns NaN, which the next line refuses
        unit_wxyz = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    T = from_quaternions(np.roll(unit_wxyz, -1, axis=1), translations * MM_PER_UNIT[unit], where)
    passed = np.arange(count) * stride
    frames = start + passed + (passed // _TRAINED_PER_HELD_OUT if split == "train" else 0)
    words = f"columns are frames {', '.join(map(str, frames[:3]))}, ..., {split}"
    source = f"SplaTAM family, world-to-camera inverted, {unit} (assumed), {words}"
    return stamped(inverse(rigid(T, where)), frames, None, source)


def _columns(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions (N, 4), scalar first, and translations (N, 3) as stored."""
    wanted = "expected the arrays cam_unnorm_rots (1, 4, N) and cam_trans (1, 3, N), and no pickled objects"
    # Pickled objects in the file stay unread: loading them could run any code.
    with reporting(f"cannot read a trajectory from {path}: {wanted}"), np.load(path, allow_pickle=False) as arrays:
        for member in arrays.zip.infolist():
            if member.filename.removesuffix(".npy") in _ARRAYS:
                check_bytes(f"{path}, {member.filename}", member.file_size, _MOST_BYTES)
        rotations, translations = (np.asarray(arrays[name], np.float64) for name in _ARRAYS)
        count = rotations.shape[-1] if rotations.ndim else 0
        if not count or rotations.shape != (1, 4, count) or translations.shape != (1, 3, count):
            raise ValueError(f"found {rotations.shape} and {translations.shape}")
        return rotations[0].T, translations[0].T
