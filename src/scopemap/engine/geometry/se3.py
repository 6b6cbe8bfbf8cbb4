"""Rotations and rigid motions; twists are rad, mm: wx wy wz vx vy vz (Sola et al., arXiv 1812.01537, eq. 132-180)."""

from __future__ import annotations

import numpy as np

from scopemap.engine.errors import check_shape

_SMALL_ANGLE_RAD = 1e-7  # guard: below it the series' first terms are exact in float64


def hat(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices (..., 3, 3) whose products with x are the cross products of `vectors` (..., 3) and x."""
    vectors = np.asarray(vectors, dtype=np.float64)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    K = np.zeros((*vectors.shape, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -z, y, -x
    K[..., 1, 0], K[..., 2, 0], K[..., 2, 1] = z, -y, x
    return K


def so3_exp(rotation_vectors: np.ndarray) -> np.ndarray:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3) in rad."""
    angle = np.linalg.norm(rotation_vectors, axis=-1)[..., None, None]
    small, K = angle < _SMALL_ANGLE_RAD, hat(rotation_vectors)
    angle = np.where(small, 1.0, angle)
    first, second = np.where(small, 1.0, np.sin(angle) / angle), np.where(small, 0.5, (1 - np.cos(angle)) / angle**2)
    rotations: np.ndarray = np.eye(3) + first * K + second * (K @ K)
    return rotations


def so3_log(R: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) in rad, of lengths 0..pi, of rotations (..., 3, 3)."""
    check_shape("R", R, (*(None,) * (R.ndim - 2), 3, 3))
    axis_sine = 0.5 * _antisymmetric(R)
    sine, cosine = np.linalg.norm(axis_sine, axis=-1), 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    angle = np.arctan2(sine, cosine)
    clear = sine > 1e-6
    vectors = axis_sine * np.where(clear, angle / np.where(clear, sine, 1.0), 1.0)[..., None]
    for place in map(tuple, np.argwhere(~clear & (cosine <= 0))):
        # Near pi the antisymmetric part vanishes; (R + R^T) / 2 = cos 1 + (1 - cos) a a^T holds the axis, but its sign.
        columns = 0.5 * (R[place] + R[place].T) - cosine[place] * np.eye(3)
        axis = columns[:, int(np.argmax(np.diag(columns)))]
        axis = axis / np.linalg.norm(axis)
        vectors[place] = axis * angle[place] * (1.0 if axis @ axis_sine[place] >= 0 else -1.0)
    return vectors


def rotation_angle_rad(R: np.ndarray) -> np.ndarray:
    """Return the rotation angle in rad, 0..pi, of rotations of shape (..., 3, 3)."""
    R = np.asarray(R, dtype=np.float64)
    return np.arctan2(np.linalg.norm(_antisymmetric(R), axis=-1), np.trace(R, axis1=-2, axis2=-1) - 1.0)


def _antisymmetric(R: np.ndarray) -> np.ndarray:
    """Return (..., 3), twice the sine of the angle times the axis of rotations (..., 3, 3)."""
    return np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)


def se3(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the motions (..., 4, 4) with rotations `R` (..., 3, 3) and translations `t` (..., 3)."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def _left_jacobian(rotation_vectors: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(rotation_vectors, axis=-1)[..., None, None]
    small, K = angle < 1e-5, hat(rotation_vectors)
    angle = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1 - np.cos(angle)) / angle**2)
    second = np.where(small, 1 / 6, (angle - np.sin(angle)) / angle**3)
    jacobians: np.ndarray = np.eye(3) + first * K + second * (K @ K)
    return jacobians


def se3_exp(twists: np.ndarray) -> np.ndarray:
    """Return the motions (..., 4, 4) of twists (..., 6) `[rotation rad, translation mm]`."""
    twists = np.asarray(twists, dtype=np.float64)
    check_shape("twists", twists, (*(None,) * (twists.ndim - 1), 6))
    rotations = twists[..., :3]
    return se3(so3_exp(rotations), (_left_jacobian(rotations) @ twists[..., 3:, None])[..., 0])


def se3_log(T: np.ndarray) -> np.ndarray:
    """Return the twists (..., 6) `[rotation rad, translation mm]` of motions (..., 4, 4)."""
    check_shape("T", T, (*(None,) * (T.ndim - 2), 4, 4))
    rotations = so3_log(T[..., :3, :3])
    along = np.linalg.solve(_left_jacobian(rotations), T[..., :3, 3:])[..., 0]
    return np.concatenate([rotations, along], -1)


def inverse(T: np.ndarray) -> np.ndarray:
    """Return the inverse of rigid motions of shape (..., 4, 4)."""
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    inverted = np.zeros_like(T, dtype=np.float64)
    inverted[..., :3, :3] = R_transposed
    inverted[..., :3, 3] = -(R_transposed @ T[..., :3, 3, None])[..., 0]
    inverted[..., 3, 3] = 1.0
    return inverted


def transform(T_a_b: np.ndarray, points_b: np.ndarray) -> np.ndarray:
    """Take points of shape (..., 3) in b to a with one (4, 4) motion."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def mean_near(T_base: np.ndarray, poses: list[np.ndarray], weights: list[float]) -> np.ndarray:
    """Return the weighted mean of `poses` (4, 4) in the tangent space at `T_base`: base exp(sum w log(base^-1 T))."""
    T_base_inverse = inverse(T_base)
    twist = sum((w * se3_log(T_base_inverse @ T) for T, w in zip(poses, weights, strict=True)), np.zeros(6))
    return T_base @ se3_exp(twist)


def orthonormalised(T: np.ndarray) -> np.ndarray:
    """Return motions `T` (..., 4, 4) with their rotations replaced by the nearest proper rotations."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return se3(U @ Vt, T[..., :3, 3])
