"""MonoGS (Matsuki et al., CVPR 2024): the keyframes' poses in `plot/trj_final.json`, camera-to-world.

`eval_ate` in utils/eval_utils.py (github.com/muskie82/MonoGS) writes `trj_id`, the frames' numbers in the data set, and
`trj_est` and `trj_gt`, a 4x4 matrix each. Lengths have the data set's unit; of a monocular run the scale is arbitrary.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError, check_bytes, reporting
from scopemap.input.trajectory.poses import file_of, rigid, stamped
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit

MONOGS_FILES = ("plot/trj_final.json", "trj_final.json")
_FIRST_BYTES = 64  # the first key is the third word of the file
_MOST_BYTES = 64 << 20  # 50 thousand keyframes
_MOST_FRAMES = 1e9


def is_monogs(path: Path) -> bool:
    """Return whether a file begins as MonoGS' does."""
    with reporting(f"cannot read {path}"), path.open("rb") as file:
        return b'"trj_id"' in file.read(_FIRST_BYTES)


def read_monogs(path: Path, unit: Unit) -> Trajectory:
    """Read the estimated poses of the keyframes; frames between them have none. The true ones are left out."""
    file = file_of(path, MONOGS_FILES)
    with reporting(f"cannot read {file}: expected trj_id and 4x4 matrices in trj_est, as MonoGS writes them"):
        check_bytes(str(file), file.stat().st_size, _MOST_BYTES)
        found = json.loads(file.read_bytes())
        numbers, T = np.array(found["trj_id"], dtype=np.float64), np.array(found["trj_est"], dtype=np.float64)
        if not len(numbers) or T.shape != (*numbers.shape, 4, 4):
            raise ValueError(f"found the shapes {numbers.shape} and {T.shape}")
    whole = np.isfinite(numbers) & (numbers == np.round(numbers)) & (numbers >= 0) & (numbers < _MOST_FRAMES)
    order = np.argsort(numbers, kind="stable")
    if not whole.all() or not np.all(np.diff(numbers[order]) > 0):
        raise InputError(f"cannot read {file}: trj_id holds other numbers than those of frames, each once")
    where = [f"{file}, frame {number:.0f}" for number in numbers[order]]
    T = T[order]
    T[:, :3, 3] *= MM_PER_UNIT[unit]
    return stamped(rigid(T, where), numbers[order], None, f"MonoGS keyframes, camera-to-world, {unit} (assumed)")
