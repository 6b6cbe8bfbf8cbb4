"""Rotations and rigid motions; twists are rad, mm: wx wy wz vx vy vz (Sola et al., arXiv 1812.01537, eq. 132-180)."""

from __future__ import annotations

import numpy as np

from scopemap.engine.errors import check_shape

_SMALL_ANGLE_RAD = 1e-7  # guard: below it the series' first terms are exact in float64


def hat(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) matrix whose product with x is the cross product `vector` x x."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(rotation_vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation of a (3,) rotation vector in rad."""
    angle = float(np.linalg.norm(rotation_vector))
    K = hat(np.asarray(rotation_vector, dtype=np.float64))
    if angle < _SMALL_ANGLE_RAD:
        return np.eye(3) + K + 0.5 * K @ K
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * K @ K


def so3_log(R: np.ndarray) -> np.ndarray:
    """Return the (3,) rotation vector in rad, of length 0..pi, of a (3, 3) rotation."""
    check_shape("R", R, (3, 3))
    axis_sine = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = float(np.linalg.norm(axis_sine)), 0.5 * (float(np.trace(R)) - 1.0)
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-6:
        return axis_sine * (angle / sine)
    if cosine > 0:
        return axis_sine
    # Near pi the antisymmetric part vanishes; (R + R^T) / 2 = cos 1 + (1 - cos) a a^T holds the axis a up to its sign.
    columns = 0.5 * (R + R.T) - cosine * np.eye(3)
    axis = columns[:, int(np.argmax(np.diag(columns)))]
    axis = axis / np.linalg.norm(axis)
    return axis * angle * (1.0 if axis @ axis_sine >= 0 else -1.0)


def rotation_angle_rad(R: np.ndarray) -> np.ndarray:
    """Return the rotation angle in rad, 0..pi, of rotations of shape (..., 3, 3)."""
    R = np.asarray(R, dtype=np.float64)
    sine = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    return np.arctan2(np.linalg.norm(sine, axis=-1), np.trace(R, axis1=-2, axis2=-1) - 1.0)


def se3(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the (4, 4) motion with rotation `R` (3, 3) and translation `t` (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def _left_jacobian(rotation_vector: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(rotation_vector))
    K = hat(rotation_vector)
    if angle < 1e-5:
        return np.eye(3) + 0.5 * K + K @ K / 6
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * K @ K


def se3_exp(twist: np.ndarray) -> np.ndarray:
    """Return the (4, 4) motion of a (6,) twist `[rotation rad, translation mm]`."""
    check_shape("twist", twist, (6,))
    twist = np.asarray(twist, dtype=np.float64)
    return se3(so3_exp(twist[:3]), _left_jacobian(twist[:3]) @ twist[3:])


def se3_log(T: np.ndarray) -> np.ndarray:
    """Return the (6,) twist `[rotation rad, translation mm]` of a (4, 4) motion."""
    check_shape("T", T, (4, 4))
    rotation_vector = so3_log(T[:3, :3])
    return np.concatenate([rotation_vector, np.linalg.solve(_left_jacobian(rotation_vector), T[:3, 3])])


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
    """Return `T` (4, 4) with its rotation replaced by the nearest proper rotation."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return se3(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, T[:3, 3])
