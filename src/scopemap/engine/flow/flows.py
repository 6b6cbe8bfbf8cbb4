"""Creates the optical flow estimator of a name."""

from scopemap.engine.errors import SettingsError
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.flow.estimator import FlowEstimator, NoFlow

FLOWS = ("dis", "raft-small", "raft-large", "none")


def create_flow(name: str, device: str = "auto") -> FlowEstimator:
    """Return the estimator `name` (one of `FLOWS`); raises `SettingsError`, `WeightsError` without RAFT's weights."""
    match name:
        case "raft-small" | "raft-large":
            from scopemap.engine.flow.raft import RaftFlow

            return RaftFlow("small" if name == "raft-small" else "large", device=device)
        case "dis":
            return DisFlow()
        case "none":
            return NoFlow()
    raise SettingsError(f"unknown flow '{name}': choose one of {', '.join(FLOWS)}")
