"""How probable it is that no frame saw a face of the closed surface.

That a smooth sheet is there does not mean that it was seen: predicted depth bridges what a fold hides. A logistic
regression tells it, by how the frames see the face; it was fitted on phantoms, whose truth is known (docs/coverage.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from scipy.sparse import coo_matrix, eye_array
from scipy.special import expit

from scopemap.apps.coverage.layout import Layout
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.result.result import Result

MOST_FRAMES = 200
_SAME_DEPTH = 0.05
_JUMP_RAD = 1 / 32
_JUMPS = (0.01, 2.0)
_MOST_RADII = 8.0
_SMOOTHING_STEPS = 30
# Of a constant, the cosine, the logarithm of the jump, the surface's presence, the distance in radii, and of wall that
# is seen in a cavity, where folds hide less.
WEIGHTS = np.array([2.165, -5.401, 0.102, -0.571, -0.147, -1.902])


@dataclass(frozen=True)
class FaceVisibility:
    """How frames see the faces (F,) of a surface.

    cosine : the largest of the angle between normal and line of sight, 0 where none sees the face. jump : the smallest
    range of the logarithm of depth within 1/32 of a radian around it. distance_mm : the smallest, infinite where none
    sees it. share : of the frames that see it. A frame sees a face whose depth it has within 5 %.
    """

    cosine: np.ndarray
    jump: np.ndarray
    distance_mm: np.ndarray
    share: np.ndarray


def face_visibility(run: Result, surface: trimesh.Trimesh) -> FaceVisibility:
    """Return how the tracked frames of a run whose depth it kept, at most 200 of them, see a surface, world mm."""
    centres, normals, camera = surface.triangles_center, surface.face_normals, run.camera
    cosine, share = np.zeros((2, len(centres)))
    jump, distance_mm = np.full((2, len(centres)), np.inf)
    tracked = run.frames.only(run.frames.tracked)
    frames = [index for index in tracked["index"].tolist() if run.depth.has(index)]
    frames = frames[:: max(1, -(-len(frames) // MOST_FRAMES))]
    pose_of = dict(zip(tracked["index"].tolist(), tracked["T_world_camera"], strict=True))
    for index in frames:
        depth_mm, T_world_camera = run.depth.read(index), pose_of[index]
        if depth_mm is None:  # a live session has just removed it
            continue
        points = transform(inverse(T_world_camera), centres)
        ahead = np.flatnonzero(points[:, 2] > 0)
        column, row = np.round(camera.project(points[ahead])).astype(int).T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        pixel, ahead = (row[inside], column[inside]), ahead[inside]
        with np.errstate(invalid="ignore"):
            agrees = np.abs(depth_mm[pixel] / points[ahead, 2] - 1) < _SAME_DEPTH
        seen, pixel = ahead[agrees], (pixel[0][agrees], pixel[1][agrees])
        rays = points[seen]
        length = np.linalg.norm(rays, axis=1)
        facing = -(rays * (normals[seen] @ T_world_camera[:3, :3])).sum(1) / length
        cosine[seen] = np.maximum(cosine[seen], facing)
        distance_mm[seen] = np.minimum(distance_mm[seen], length)
        jump[seen] = np.minimum(jump[seen], _depth_range(depth_mm, camera.fx)[pixel])
        share[seen] += 1 / len(frames)
    return FaceVisibility(cosine, jump, distance_mm, share)


def _depth_range(depth_mm: np.ndarray, focal_px: float) -> np.ndarray:
    """Return the range (H, W) of the logarithm of depth within 1/32 of a radian around each pixel.

    In pictures whose pixels are too coarse for that, it is in proportion to the range within 3 pixels.
    """
    size = max(3, 2 * round((_JUMP_RAD * focal_px - 1) / 2) + 1)
    known, around = depth_mm > 0, np.ones((size, size), np.uint8)
    logarithm = np.log(np.where(known, depth_mm, 1)).astype(np.float32)
    high = cv2.dilate(np.where(known, logarithm, -99).astype(np.float32), around)
    low = cv2.erode(np.where(known, logarithm, 99).astype(np.float32), around)
    return np.asarray((high - low) * (_JUMP_RAD * focal_px / size))


def features(surface: trimesh.Trimesh, seen: FaceVisibility, present: np.ndarray, layout: Layout) -> np.ndarray:
    """Return what the regression is of, (F, 6): the first three but the constant are means over a face's surroundings.

    present : (F,) bool, whether the run's own surface is there. layout : its radius is the unit of distances.
    """
    jump = np.log(np.clip(seen.jump, *_JUMPS))
    around = _smoothed(surface, np.column_stack([seen.cosine, jump, present]))
    radii = np.minimum(seen.distance_mm / layout.radius_mm, _MOST_RADII)
    in_cavity = present & (seen.share > 0) & (layout.kind == "cavity")
    return np.column_stack([np.ones(len(radii)), around, radii, in_cavity])


def unseen_probability(of: np.ndarray) -> np.ndarray:
    """Return the probability (F,) that no frame saw a face, by its `features`."""
    return np.asarray(expit(of @ WEIGHTS))


def _smoothed(surface: trimesh.Trimesh, values: np.ndarray) -> np.ndarray:
    """Return means of values (F, n) over faces and their neighbours, by area, 30 times."""
    first, second = surface.face_adjacency.T
    shape = (len(values), len(values))
    neighbours = coo_matrix((np.ones(len(first)), (first, second)), shape).tocsr()
    mean_of = neighbours + neighbours.T + eye_array(len(values), format="csr")
    area = surface.area_faces[:, None] + 1e-12
    total = mean_of @ area
    for _ in range(_SMOOTHING_STEPS):
        values = (mean_of @ (area * values)) / total
    return values
