"""Other people's pose protocols by name, each exactly as its authors compute it, quirks included.

Published figures can be compared only under the protocol that they were made with, and these differ by factors: on one
and the same trajectory the AF protocol may say 0.05 where evo says 3 mm. So every figure carries its protocol's name.

All take trajectories in mm, match them as `poses.match` does, leave lost frames out (and count them), and raise
`AlignmentError` where too little matches or a fit is degenerate.
"""

from __future__ import annotations

from collections.abc import Callable

from scopemap.evaluation.protocols.chained import simcol
from scopemap.evaluation.protocols.fitted import evo, oneslam, robust_pose_estimator
from scopemap.evaluation.protocols.report import ProtocolReport
from scopemap.evaluation.protocols.snippets import af, af_from_relative, surgcut3r
from scopemap.evaluation.protocols.world_to_camera import endogslam, free_surgs
from scopemap.trajectory.trajectory import Trajectory

Protocol = Callable[[Trajectory, Trajectory], ProtocolReport]
"""Takes estimate and reference."""

PROTOCOLS: dict[str, Protocol] = {
    "evo": evo,
    "af": af,
    "endogslam": endogslam,
    "surgcut3r": surgcut3r,
    "free-surgs": free_surgs,
    "simcol": simcol,
    "robust-pose-estimator": robust_pose_estimator,
    "oneslam": oneslam,
}
"""The protocols by the names that `ProtocolReport.protocol` carries."""

__all__ = ["PROTOCOLS", "Protocol", "ProtocolReport", "af_from_relative"]
