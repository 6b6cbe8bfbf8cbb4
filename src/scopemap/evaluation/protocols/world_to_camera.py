"""Protocols that compare world-to-camera matrices: their translation column is not where the camera is.

Of a world-to-camera matrix the translation is `-R^T c`: the camera centre `c` seen from the turning camera. It depends
on the choice of world, so that both repositories' way of storing matters: world = first camera, for estimate and
reference alike. These figures cannot be compared with evo's.
"""

from __future__ import annotations

import numpy as np

from scopemap.evaluation.pose_errors import ErrorSummary, frame_pairs, relative_errors, translation_errors_mm
from scopemap.evaluation.protocols.report import MatchedPoses, ProtocolReport
from scopemap.geometry.align import align_trajectories
from scopemap.geometry.se3 import inverse
from scopemap.trajectory.trajectory import Trajectory


def endogslam(estimate: Trajectory, reference: Trajectory) -> ProtocolReport:
    """Measure as EndoGSLAM and Endo-2DTAM do: mean residual of world-to-camera translations after Horn's SE3.

    Its "ATE RMSE" is the mean of the norms, not their root mean square. The loader makes the reference relative to its
    first frame (`relative_pose=True`), where the estimate begins, too: `endogslam_ate_mean_mm` does that.
    `endogslam_ate_mean_as_stored_mm` takes both worlds as the trajectories have them, which the formula permits and
    which makes a difference. Both papers use 7 of 8 frames of C3VD; here all that match are used.
    Source: Loping151/EndoGSLAM, utils/eval_helpers.py (align, evaluate_ate), datasets/gradslam_datasets/basedataset.py.
    """
    poses = MatchedPoses.of(estimate, reference)
    relative = _from_first_camera(poses.estimated), _from_first_camera(poses.reference)
    stored = inverse(poses.estimated), inverse(poses.reference)
    return poses.report(
        "endogslam",
        {"ate_mean_mm": _rigid_mean_mm(*relative), "ate_mean_as_stored_mm": _rigid_mean_mm(*stored)},
        "Horn's SE3 alignment (no scale) of the translation columns of world-to-camera matrices, world = first camera "
        "(as stored: whatever worlds the files have), mean of the residual norms in mm, not RMSE.",
        "Loping151/EndoGSLAM: utils/eval_helpers.py",
    )


def free_surgs(estimate: Trajectory, reference: Trajectory) -> ProtocolReport:
    """Measure as Free-SurGS does: Sim3, ATE RMSE, mean RPE over 1 frame in mm and deg, on world-to-camera matrices.

    Its validation aligns the optimised world-to-camera matrices to SCARED's `camera-pose`, which is world-to-camera,
    too (world = keyframe, the first frame), and treats both as poses. `free_surgs_c2w_...` are the same figures on
    camera-to-world poses, as the words "ATE" and "RPE" would have it.
    Source: wrld/Free-SurGS, train.py (eval_pose), utils/geometry_utils.py (align_pose).
    """
    poses = MatchedPoses.of(estimate, reference)
    theirs = _sim3_figures(_from_first_camera(poses.estimated), _from_first_camera(poses.reference))
    centres = _sim3_figures(poses.estimated, poses.reference)
    return poses.report(
        "free-surgs",
        theirs | {f"c2w_{name}": value for name, value in centres.items()},
        "Sim3 alignment of world-to-camera matrices taken as poses, world = first camera (c2w: of camera-to-world "
        "poses), ATE RMSE in mm, mean RPE over 1 frame in mm and deg.",
        "wrld/Free-SurGS: train.py, utils/geometry_utils.py",
    )


def _from_first_camera(T_world_camera: np.ndarray) -> np.ndarray:
    """Return the world-to-camera matrices of a world that is the first camera."""
    return inverse(T_world_camera) @ T_world_camera[0]


def _rigid_mean_mm(estimated: np.ndarray, reference: np.ndarray) -> float:
    aligned, _ = align_trajectories(estimated, reference, "se3")
    return ErrorSummary.of(np.linalg.norm(translation_errors_mm(aligned, reference), axis=1)).mean


def _sim3_figures(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    aligned, _ = align_trajectories(estimated, reference, "sim3")
    rpe_mm, rpe_rad = relative_errors(aligned, reference, frame_pairs(len(aligned), 1))
    return {
        "ate_rmse_mm": ErrorSummary.of(np.linalg.norm(translation_errors_mm(aligned, reference), axis=1)).rmse,
        "rpe_1_frame_mean_mm": ErrorSummary.of(rpe_mm).mean,
        "rpe_1_frame_mean_deg": float(np.degrees(ErrorSummary.of(rpe_rad).mean)),
    }
