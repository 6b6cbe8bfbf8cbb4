"""Camera paths as KITTI and EuRoC write them; evo reads both.

Sources: cvlibs.net/datasets/kitti/eval_odometry.php; Burri et
al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Unit, write_kitti
from scopemap.result.result import Result

_NS_PER_S = 1e9


def write_kitti_folder(run: Result, folder: Path, unit: Unit) -> None:
    """Write `poses.txt`, a line per tracked frame, and `times.txt`, the time of each line, s.

    KITTI has no place for a comment or a frame that is lost: lines are not frame numbers where frames are left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_kitti(folder / "poses.txt", run.tracked.trajectory, unit=unit)
    np.savetxt(folder / "times.txt", run.tracked.trajectory.times_s, fmt="%.6e")


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
