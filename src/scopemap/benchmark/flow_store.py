"""Flow between consecutive frames, kept on disk: all methods of a benchmark are measured with the same one.

Half precision, 0.03 px at most for flows below 64 px: what was read back and what was just estimated are the same.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.flow.consistency import pair_flow
from scopemap.flow.estimator import FlowEstimator

_CONSISTENCY_PX = 1.0


class FlowStore:
    """Estimates flow to the previous frame, or remembers it.

    estimator : for what is not there yet. folder : of one sequence and one estimator; None: nothing is kept.
    """

    def __init__(self, estimator: FlowEstimator, folder: Path | None = None) -> None:
        self.name = estimator.name
        self._estimator, self._folder = estimator, folder

    def to_previous(
        self, index: int, rgb_previous: np.ndarray, rgb_current: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return flow (H, W, 2) float32 px from frame `index` to the one before, and (H, W) bool: where to trust it."""
        file = None if self._folder is None else self._folder / f"{index:06d}.npz"
        if file is not None and file.is_file():
            with np.load(file) as kept:
                return kept["to_previous"].astype(np.float32), kept["consistent"]
        found = pair_flow(self._estimator, rgb_previous, rgb_current, _CONSISTENCY_PX)
        half = found.to_previous.astype(np.float16)
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            draft = file.with_suffix(".part.npz")
            np.savez_compressed(draft, to_previous=half, consistent=found.consistent)
            draft.replace(file)
        return half.astype(np.float32), found.consistent
