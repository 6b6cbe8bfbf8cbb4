"""Whether an alignment by positions determines its rotation: a bound of its turn.

Errors of a few tenths of a mm turn the alignment of a short or nearly straight path by tens of degrees. What is then
measured after it is the alignment's own error, not the method's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.engine.geometry.se3 import rotation_angle_rad

NOT_DETERMINED = "not determined"
"""The word for figures that may be the alignment's own error."""

# A turn that changes rotations by less leaves them as they are.
_LIMIT_RAD = float(np.radians(0.5))
# The bound in units of ATE over the path's extent. Of 500 drawn odometries along tubes and lines whose relative poses
# err, by noise and by a bias, the turn was within two of these in 97 %, within three in more than 99 %. A unit is no
# standard deviation: turns by errors that drift are mostly less, by white errors far less (test_turn.py).
_UNITS = 3.0


@dataclass(frozen=True)
class Turn:
    """The turn of an alignment.

    bound_rad : what errors of the positions may turn it by, rad; 0 where positions did not decide it. off_rad : the
    angle to the alignment by which the orientations agree best. centre_mm : what it turns about, (3,), mm.
    """

    bound_rad: float
    off_rad: float
    centre_mm: np.ndarray

    @classmethod
    def of(cls, aligned: np.ndarray, reference: np.ndarray, *, by_positions: bool, straight: bool) -> Turn:
        """Return the turn of an alignment that was fitted to these poses (N, 4, 4), mm.

        by_positions : whether positions decided it; straight : but for the turn about the path.
        """
        fitted, truth = aligned[:, :3, 3], reference[:, :3, 3]
        U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", reference[:, :3, :3], aligned[:, :3, :3]))
        best = U * [1.0, 1.0, np.linalg.det(U @ Vt)] @ Vt
        bound = turn_bound_rad(fitted, truth, about_path=not straight) if by_positions else 0.0
        return cls(bound, float(rotation_angle_rad(best)), truth.mean(axis=0))

    def determines_rotation(self, error_rad: float) -> bool:
        """Return whether a rotation error that was measured after the alignment is the method's."""
        return self.determines(self.off_rad, max(_LIMIT_RAD, error_rad / 2))

    def determines(self, share: float, harmless: float) -> bool:
        """Return whether the turn's `share` of an error is harmless, or none: more than positions can be off by."""
        return share <= harmless or self.off_rad > self.bound_rad


def turn_bound_rad(aligned_mm: np.ndarray, reference_mm: np.ndarray, *, about_path: bool = True) -> float:
    """Return what errors of positions (N, 3), mm, may turn a least-squares alignment of them by, rad.

    about_path : whether the positions decided the turn about the path's longest axis, too.

    Three times ATE over the path's extent: a small turn w moves x by w x x, so by the normal equations errors that all
    count as one, since those along a path drift, turn it about principal axis k by the square root of ATE^2 / (s_i^2 +
    s_j^2), s the root-mean-square extents along the other two axes; the squares of the three add up. The best scale is
    taken out first; it does not change the turn.
    """
    aligned, reference = aligned_mm - aligned_mm.mean(axis=0), reference_mm - reference_mm.mean(axis=0)
    errors = aligned * (np.sum(aligned * reference) / np.sum(aligned**2)) - reference
    squares = np.linalg.svd(reference, compute_uv=False) ** 2
    across = (squares.sum() - squares)[0 if about_path else 1 :]
    if not errors.any():
        return 0.0
    with np.errstate(divide="ignore"):
        return _UNITS * float(np.sqrt(np.sum(errors**2) * np.sum(1 / across)))
