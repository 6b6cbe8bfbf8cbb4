"""The protocol that chains relative motions from the identity."""

from __future__ import annotations

import numpy as np

from scopemap.evaluation.pose_errors import frame_pairs, relative_errors, translation_errors_mm
from scopemap.evaluation.protocols.report import MatchedPoses, ProtocolReport
from scopemap.evaluation.protocols.snippets import least_squares_scale
from scopemap.geometry.se3 import inverse
from scopemap.trajectory.trajectory import Trajectory


def simcol(estimate: Trajectory, reference: Trajectory) -> ProtocolReport:
    """Measure as the SimCol3D challenge does: one scale from the relative translations, then medians.

    Motions between neighbouring frames are chained from the identity, which is the path seen from its own first camera.
    The scale is the least-squares one between the *relative* translations, `sum(q . p) / sum(p . p)`. ATE, RTE and ROT
    are medians. The challenge prints cm, here it is mm.
    Source: anitarau/simcol, evaluation/eval_synthetic_pose.py (get_scale, compute_errors).
    """
    poses = MatchedPoses.of(estimate, reference)
    estimated = inverse(poses.estimated[0]) @ poses.estimated
    truth = inverse(poses.reference[0]) @ poses.reference
    steps = inverse(estimated[:-1]) @ estimated[1:], inverse(truth[:-1]) @ truth[1:]
    scale = least_squares_scale(steps[0][:, :3, 3], steps[1][:, :3, 3])
    scaled = estimated.copy()
    scaled[:, :3, 3] *= scale
    rte_mm, rot_rad = relative_errors(scaled, truth, frame_pairs(len(scaled), 1))
    return poses.report(
        "simcol",
        {
            "ate_median_mm": float(np.median(np.linalg.norm(translation_errors_mm(scaled, truth), axis=1))),
            "rte_median_mm": float(np.median(rte_mm)),
            "rot_median_deg": float(np.degrees(np.median(rot_rad))),
            "scale": scale,
        },
        "First cameras put onto each other, one least-squares scale between the translations from frame to frame, "
        "median position error, median relative error over 1 frame in mm and deg.",
        "anitarau/simcol: evaluation/eval_synthetic_pose.py",
    )
