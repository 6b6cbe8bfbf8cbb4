"""Camera paths as TUM, KITTI and EuRoC write them; evo reads both.

Sources: cvlibs.net/datasets/kitti/eval_odometry.php; Burri et
al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Unit, numbers_file, write_kitti, write_tum
from scopemap.result.result import Result

_NS_PER_S = 1e9


def write_tum_file(run: Result, file: Path, unit: Unit) -> None:
    """Write a line per tracked frame, with its time, and the scale as a comment."""
    write_tum(file, run.tracked.trajectory, unit=unit, comment=run.scale)


def write_kitti_folder(run: Result, folder: Path, unit: Unit) -> None:
    """Write `poses.txt` as `write_kitti_file` does, and `times.txt`, the time of each line, s."""
    folder.mkdir(parents=True, exist_ok=True)
    write_kitti_file(run, folder / "poses.txt", unit)
    np.savetxt(folder / "times.txt", run.tracked.trajectory.times_s, fmt="%.6e")


def write_kitti_file(run: Result, file: Path, unit: Unit) -> None:
    """Write a line per tracked frame, and the frames' numbers beside it where they are not those of the lines.

    KITTI has no place for a comment or a frame that is lost.
    """
    write_kitti(file, run.tracked.trajectory, unit=unit)
    write_frame_numbers(run, file)


def write_frame_numbers(run: Result, file: Path) -> None:
    """Write the frame of each line of a file of poses beside it, where that is not the line's number from 0."""
    if lines_in_words(run, file):
        head = f"number in the input, from 0, of the frame of each line of {file.name}"
        np.savetxt(numbers_file(file), run.tracked.trajectory.indices, fmt="%d", header=head)


def lines_in_words(run: Result, file: Path) -> str:
    """Return which frames the lines of a file of poses belong to; "" where lines are numbered as the frames."""
    numbers = run.tracked.trajectory.indices
    if np.array_equal(numbers, np.arange(len(numbers))):
        return ""
    lines = f"the {len(numbers)} lines of {file.name} are frames {numbers[0]} to {numbers[-1]} of the input"
    return f"{lines}; {numbers_file(file).name} states the frame of each line"


def write_euroc_file(run: Result, file: Path) -> None:
    """Write EuRoC's `data.csv`: time in ns, position in m, quaternion with qw first; the body is the camera."""
    poses = run.tracked.trajectory.T_world_camera
    wxyz = np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True), 1, axis=1)
    rows = np.column_stack([poses[:, :3, 3] / MM_PER_UNIT["m"], wxyz])
    columns = "timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    lines = [f"#{columns}", f"# {run.scale}"]
    for time_s, values in zip(run.tracked.trajectory.times_s, rows, strict=True):
        lines.append(f"{round(time_s * _NS_PER_S)},{','.join(f'{value:.12g}' for value in values)}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
