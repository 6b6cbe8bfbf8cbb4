"""The maps of a run beside each other: their order in time, and the one that agrees least with its own frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.report.kept_run import KeptRun


@dataclass(frozen=True)
class Piece:
    """A map of a run.

    number : of the map, 0 for the result and N for `maps/N`. frames : how many it has. first, last : numbers of its
    first and its last frame. inlier_share : median over its frames of the share of compared pixels that agree with the
    keyframe, NaN = unknown.
    """

    number: int
    frames: int
    first: int
    last: int
    inlier_share: float

    @property
    def name(self) -> str:
        """The folder that holds it, or "the result"."""
        return f"maps/{self.number}" if self.number else "the result"

    @property
    def inliers(self) -> str:
        """Its inliers in words, "" where they are unknown."""
        return "" if np.isnan(self.inlier_share) else f"{self.inlier_share:.0%} inliers"


def pieces_in_time(run: KeptRun) -> list[Piece]:
    """Return the maps of a run in the order of their first frames."""
    shares, found = run.column("inlier_share"), []
    for number in range(len(run.maps)):
        inside = run.place == number
        if inside.any():
            indices, known = run.indices[inside], shares[inside & np.isfinite(shares)]
            share = float(np.median(known)) if len(known) else float("nan")
            found.append(Piece(number, len(indices), int(indices.min()), int(indices.max()), share))
    return sorted(found, key=lambda piece: piece.first)


def most_doubtful(pieces: list[Piece]) -> Piece | None:
    """Return the piece of the lowest inlier share, None where fewer than two are known."""
    known = [piece for piece in pieces if not np.isnan(piece.inlier_share)]
    return min(known, key=lambda piece: piece.inlier_share) if len(known) > 1 else None


def doubt_words(pieces: list[Piece]) -> str:
    """Return which piece is the most doubtful and why, one phrase; "" where that cannot be told."""
    worst = most_doubtful(pieces)
    if worst is None:
        return ""
    others = [piece.inlier_share for piece in pieces if piece is not worst and not np.isnan(piece.inlier_share)]
    rest = f"{min(others):.0%}" + (f" to {max(others):.0%}" if len(others) > 1 else "")
    where = f"{worst.name}, frames {worst.first} to {worst.last}"
    return f"{where}, with {worst.inlier_share:.0%} inliers against {rest}"
