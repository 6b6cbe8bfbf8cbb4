"""What a resumed run has in common with one that was not killed."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from scopemap.result.result import Result

# Of a resumed run: the stored pictures are JPEG, the stored depth has steps of .03 %. Shares of the median depth, a
# pixel is .007 of it; rotation in rad.
_MOST_SHIFT, _MOST_TURN = 0.01, 0.01
# Of the distance between the surfaces, over the median depth: the median vertex, and nearly all.
_MOST_APART = {50: 0.01, 95: 0.05}


def check_alike(found: Result, wanted: Result, depth_mm: float | None = None) -> None:
    """Compare frames, path and, where there is one, surface; depth_mm : typical one, by default that of the surface."""
    for column in ("index", "status", "map", "name"):
        np.testing.assert_array_equal(found.frames[column], wanted.frames[column])
    if depth_mm is None:
        depth_mm = float(np.median(np.linalg.norm(wanted.mesh.vertices, axis=1)))  # from the first camera
    one, other = found.frames["T_world_camera"], wanted.frames["T_world_camera"]
    np.testing.assert_allclose(one[:, :3, 3], other[:, :3, 3], rtol=0, atol=_MOST_SHIFT * depth_mm)
    np.testing.assert_allclose(one[:, :3, :3], other[:, :3, :3], rtol=0, atol=_MOST_TURN)
    assert bool(len(found.mesh.vertices)) == bool(len(wanted.mesh.vertices))
    if len(wanted.mesh.vertices):
        apart_mm = KDTree(wanted.mesh.vertices).query(found.mesh.vertices)[0]
        for percentile, most in _MOST_APART.items():
            assert np.percentile(apart_mm, percentile) <= most * depth_mm
    assert found.provenance["scale"] == wanted.provenance["scale"]
