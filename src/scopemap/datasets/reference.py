"""The true trajectory of a sequence, for scores: no image is decoded and no depth is read for it."""

from __future__ import annotations

import numpy as np

from scopemap.datasets.sequence import Sequence
from scopemap.trajectory import Trajectory


def reference_trajectory(sequence: Sequence) -> Trajectory | None:
    """Return the true poses of the sequence's selected frames; None where none, or not which frames, are known.

    `indices` and `times_s` are those of the frames; a frame without a true pose is left out. What the data set holds is
    what is returned: frames that later turn out unreadable are among it. Raises `InputError` for unreadable poses.
    """
    source = sequence.source
    stamped = [(*stamp, source.pose(stamp[0])) for stamp in source.stamps(sequence.selection) or []]
    known = [(index, time_s, pose) for index, time_s, pose in stamped if pose is not None]
    if not known:
        return None
    indices, times_s, poses = zip(*known, strict=True)
    status = np.array(["initial"] + ["ok"] * (len(known) - 1))
    return Trajectory(np.array(indices, dtype=np.int64), np.array(times_s, dtype=np.float64), np.stack(poses), status)
