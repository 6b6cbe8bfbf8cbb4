"""True depth of a sequence's frames at the working size, read once from its data set and kept for all methods.

A SCARED keyframe's scene points are gigabytes in an archive that is decompressed to reach any of them. Every method and
every measure of a benchmark needs the same few hundred kilobytes of each frame.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from scopemap.input.sequence import Sequence


class TrueDepths:
    """Returns the true depth of a frame by its number; `folder` keeps what was read (default: for this object's life).

    In ascending order an archive is decompressed once.
    """

    def __init__(self, sequence: Sequence, folder: Path | None = None) -> None:
        self._sequence = sequence
        self._temporary = tempfile.TemporaryDirectory() if folder is None else None
        self._folder = Path(self._temporary.name) if self._temporary else Path(folder or "")

    def __call__(self, index: int) -> np.ndarray | None:
        """Return depth (H, W) float32, mm, NaN = unknown, or None; `InputError` where its file cannot be used."""
        file = self._folder / f"{index:06d}.npz"
        if file.is_file():
            with np.load(file) as kept:
                return kept["depth_mm"]
        truth = self._sequence.source.truth(index)
        if truth is None or truth.depth_mm is None:
            return None
        depth_mm = self._sequence.depth_rectifier.nearest(truth.depth_mm).astype(np.float32)
        self._folder.mkdir(parents=True, exist_ok=True)
        draft = file.with_suffix(".part.npz")
        np.savez_compressed(draft, depth_mm=depth_mm)
        draft.replace(file)
        return depth_mm

    def numbers(self) -> list[int]:
        """Return the numbers of the sequence's frames."""
        stamps = self._sequence.source.stamps(self._sequence.selection)
        if stamps is None:
            return [frame.index for frame in self._sequence.frames()]
        return [index for index, _ in stamps]
