"""Gaussian SLAM of the SplaTAM family: `params.npz` of SplaTAM, EndoGSLAM and Endo-2DTAM.

All three save `cam_unnorm_rots` (1, 4, N), quaternions with the scalar first and of any length, and `cam_trans`
(1, 3, N); together they take a point in the first camera to camera n (spla-tam/SplaTAM scripts/splatam.py,
Loping151/EndoGSLAM scripts/main.py, lastbasket/Endo-2DTAM utils/slam_helpers.py, transform_to_frame). `w2c` (4, 4) is
the first camera, the identity, as they load the truth relative to it. Lengths are in the unit of the depth they were
fed: on C3VD, for EndoGSLAM and Endo-2DTAM, mm (8-bit depth / 2.55, configs/data/c3vd.yaml); on SplaTAM's own data, m.

Which frame a column is, the file does not say. On C3VD EndoGSLAM and Endo-2DTAM run with `train_or_test="train"`, which
holds out frames 7, 15, 23, ... for rendering (datasets/gradslam_datasets/c3vd.py): column 7 is frame 8. All three copy
their settings to `config.py` beside the file; it is searched for constants and never run.
"""

from __future__ import annotations

import ast
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse
from scopemap.trajectory.formats.poses import file_of, from_quaternions, rigid, stamped
from scopemap.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit

PARAMS_FILE = "params.npz"
_TRAINED_PER_HELD_OUT = 7
_IDENTITY_TOLERANCE = 1e-2


@dataclass(frozen=True)
class _Split:
    """Which frames a run used: those not held out, from `start` (first of them) in steps of `stride`."""

    held_out: bool = False
    start: int = 0
    stride: int = 1

    def frames(self, count: int) -> np.ndarray:
        """Return the frame numbers (count,) of the columns."""
        passed = np.arange(count) * self.stride
        return self.start + passed + (passed // _TRAINED_PER_HELD_OUT if self.held_out else 0)

    @property
    def words(self) -> str:
        """The split in words."""
        without = f" without {self.start + 7}, {self.start + 15}, ..." if self.held_out else ""
        return f"columns are frames {', '.join(map(str, self.frames(3)))}, ...{without}"


def read_endogslam(path: Path, unit: Unit) -> Trajectory:
    """Read `params.npz` of a run that held out every eighth frame, as EndoGSLAM and Endo-2DTAM do on C3VD."""
    return _read(file_of(path, (PARAMS_FILE,)), unit, _Split(held_out=True))


def read_splatam(path: Path, unit: Unit) -> Trajectory:
    """Read `params.npz` of a run over every frame from the first."""
    return _read(file_of(path, (PARAMS_FILE,)), unit, _Split())


def read_params(path: Path, unit: Unit) -> Trajectory:
    """Read `params.npz`, its frames numbered by the `config.py` beside it; `InputError` where there is none."""
    file = file_of(path, (PARAMS_FILE,))
    split = _split_of_run(file.with_name("config.py"))
    if split is None:
        raise InputError(
            f"cannot number the frames of {file}: it has no config.py of its run beside it with plain values of "
            "train_or_test, start and stride; name the kind: 'endogslam' (frames 7, 15, ... were held out, as "
            "EndoGSLAM and Endo-2DTAM do on C3VD) or 'splatam' (every frame was used)"
        )
    return _read(file, unit, split)


def _split_of_run(config: Path) -> _Split | None:
    """Return the split that the settings of a run name; None where they are missing or more than plain values."""
    try:
        tree = ast.parse(config.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return None
    split = _plain_value(tree, "train_or_test", "all")
    start, stride = _plain_value(tree, "start", 0), _plain_value(tree, "stride", 1)
    if split not in ("all", "train") or not isinstance(start, int) or not isinstance(stride, int):
        return None
    return _Split(split == "train", start, stride) if start >= 0 and stride > 0 else None


def _plain_value(tree: ast.AST, name: str, assumed: str | int) -> object:
    """Return the constant that a keyword argument has wherever it is given; None where it differs or is computed."""
    given = [node.value for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == name]
    values = {value.value if isinstance(value, ast.Constant) else None for value in given} or {assumed}
    return values.pop() if len(values) == 1 else None


def _read(path: Path, unit: Unit, split: _Split) -> Trajectory:
    quaternions, translations = _columns(path)
    # Columns start at the identity; a checkpoint of an unfinished run still has its tail there.
    tracked = np.any(quaternions != [1, 0, 0, 0], axis=1) | np.any(translations != 0, axis=1)
    count = 1 + int(np.flatnonzero(tracked).max(initial=0))
    quaternions, translations = quaternions[:count], translations[:count]
    where = [f"{path}, column {column}" for column in range(count)]
    with np.errstate(invalid="ignore"):  # a quaternion of length 0 turns NaN, which the next line refuses
        unit_wxyz = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    T = from_quaternions(np.roll(unit_wxyz, -1, axis=1), translations * MM_PER_UNIT[unit], where)
    source = f"SplaTAM family, world-to-camera inverted, {unit} (assumed), {split.words}"
    return stamped(inverse(rigid(T, where)), split.frames(count), None, source)


def _columns(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions (N, 4), scalar first, and translations (N, 3) as stored."""
    try:
        # Pickled objects in the file stay unread: loading them could run any code.
        with np.load(path, allow_pickle=False) as arrays:
            missing = [key for key in ("cam_unnorm_rots", "cam_trans") if key not in arrays.files]
            if missing:
                raise InputError(f"cannot read a trajectory from {path}: it holds no {' and no '.join(missing)}")
            rotations = np.asarray(arrays["cam_unnorm_rots"], dtype=np.float64)
            translations = np.asarray(arrays["cam_trans"], dtype=np.float64)
            first = np.asarray(arrays["w2c"], dtype=np.float64) if "w2c" in arrays.files else np.eye(4)
    except (OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error):
        raise InputError(
            f"cannot read a trajectory from {path}: its arrays are damaged, or pickled objects, which are never loaded"
        ) from None
    count = rotations.shape[-1] if rotations.ndim else 0
    if not count or rotations.shape != (1, 4, count) or translations.shape != (1, 3, count):
        raise InputError(
            f"cannot read a trajectory from {path}: expected cam_unnorm_rots (1, 4, N) and cam_trans (1, 3, N), found "
            f"{rotations.shape} and {translations.shape}"
        )
    if first.shape != (4, 4) or not np.abs(first - np.eye(4)).max() <= _IDENTITY_TOLERANCE:
        raise InputError(f"cannot read a trajectory from {path}: w2c is not the identity, so the world is not known")
    return rotations[0].T, translations[0].T
