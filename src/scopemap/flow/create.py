"""Creates the optical flow estimator of a name."""

from scopemap.errors import SettingsError
from scopemap.flow.dis import DisFlow
from scopemap.flow.estimator import FlowEstimator, NoFlow
from scopemap.flow.raft import CHECKPOINTS, RaftFlow
from scopemap.io import weights

FLOWS = ("auto", "raft-small", "raft-large", "dis", "none")


def create_flow(name: str, device: str = "auto") -> FlowEstimator:
    """Return the estimator `name` (one of `FLOWS`); device matters to RAFT only.

    "auto" is RAFT small where its weights are present, else DIS. Raises `SettingsError` for an unknown name and
    `WeightsError` where RAFT is named and its weights are missing.
    """
    if name == "auto":
        name = "raft-small" if weights.is_present(*CHECKPOINTS["small"]) else "dis"
    match name:
        case "raft-small":
            return RaftFlow("small", device=device)
        case "raft-large":
            return RaftFlow("large", device=device)
        case "dis":
            return DisFlow()
        case "none":
            return NoFlow()
    raise SettingsError(f"unknown flow '{name}': choose one of {', '.join(FLOWS)}")
