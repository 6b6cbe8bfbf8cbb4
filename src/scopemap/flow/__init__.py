"""Image pair to optical flow: a contract, estimators behind it, and what both directions together tell."""

from scopemap.errors import SettingsError
from scopemap.flow.consistency import Flow, agree, pair_flow
from scopemap.flow.dis import DisFlow
from scopemap.flow.estimator import FlowEstimator
from scopemap.flow.none import NoFlow
from scopemap.flow.raft import RaftFlow

__all__ = ["DisFlow", "Flow", "FlowEstimator", "NoFlow", "RaftFlow", "agree", "create_flow", "pair_flow"]

FLOWS = ("raft-small", "raft-large", "dis", "none")


def create_flow(name: str, iterations: int = 12, device: str = "auto") -> FlowEstimator:
    """Return the estimator `name` (one of `FLOWS`); iterations and device matter to RAFT only.

    Raises `SettingsError` for an unknown name and `WeightsError` where RAFT's weights are not at hand.
    """
    match name:
        case "raft-small":
            return RaftFlow("small", iterations=iterations, device=device)
        case "raft-large":
            return RaftFlow("large", iterations=iterations, device=device)
        case "dis":
            return DisFlow()
        case "none":
            return NoFlow()
    raise SettingsError(f"unknown flow '{name}': choose one of {', '.join(FLOWS)}")
