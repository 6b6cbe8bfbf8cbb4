"""What a protocol returns, and the matched poses that all of them start from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.evaluation.poses import match
from scopemap.trajectory.trajectory import Trajectory


@dataclass(frozen=True)
class ProtocolReport:
    """Figures of one protocol.

    Attributes
    ----------
    protocol : its name, as in `PROTOCOLS`.
    figures : value by name; every name begins with the protocol's (`-` as `_`) and ends with its unit. NaN where too
        few frames give a figure.
    frames, lost : frames that were used, and matched frames that were left out because they are lost.
    description : one sentence: alignment, pairs, unit, quirks.
    source : the repository and file that define it.
    """

    protocol: str
    figures: dict[str, float]
    frames: int
    lost: int
    description: str
    source: str

    def __post_init__(self) -> None:
        prefix = self.protocol.replace("-", "_") + "_"
        foreign = [name for name in self.figures if not name.startswith(prefix)]
        if foreign:
            raise ValueError(f"ProtocolReport.figures: {', '.join(foreign)} not named after '{self.protocol}'")


@dataclass(frozen=True)
class MatchedPoses:
    """Tracked camera-to-world poses, (N, 4, 4) float64 mm each, row by row; `lost` matched frames are left out."""

    estimated: np.ndarray
    reference: np.ndarray
    lost: int

    @classmethod
    def of(cls, estimate: Trajectory, reference: Trajectory) -> MatchedPoses:
        """Match two trajectories; raises `AlignmentError` where fewer than 3 tracked frames match."""
        matched = match(estimate, reference, "none")
        ok = matched.tracked
        return cls(matched.estimated[ok], matched.reference[ok], int(np.count_nonzero(~ok)))

    def report(self, protocol: str, figures: dict[str, float], description: str, source: str) -> ProtocolReport:
        """Return the report of `protocol`, whose name is put before each figure's."""
        prefix = protocol.replace("-", "_")
        named = {f"{prefix}_{name}": float(value) for name, value in figures.items()}
        return ProtocolReport(protocol, named, len(self.estimated), self.lost, description, source)
