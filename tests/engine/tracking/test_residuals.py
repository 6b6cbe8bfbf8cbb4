"""The fused kernels against finite differences and a plain numpy referee."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scopemap.engine.geometry.se3 import se3_exp
from scopemap.engine.tracking.residuals import Loss, PyramidLevel, normal_equations, residual_images

UNIT_MM = 40.0
AFFINE = np.array([1.1, 0.05])
MOTION = se3_exp(np.array([0.01, -0.02, 0.015, 0.5, -0.3, 0.8]))
HUGE = 1e6  # a Huber threshold beyond all residuals: least squares


def _level(seed: int, size: tuple[int, int] = (30, 40)) -> PyramidLevel:
    random = np.random.default_rng(seed)
    images = [cv2.GaussianBlur(random.normal(size=size), (0, 0), 3).astype(np.float32) * 5 for _ in range(2)]
    depth = (UNIT_MM + 8 * cv2.GaussianBlur(random.normal(size=size), (0, 0), 5) * 10).astype(np.float32)
    weight = np.ones(size, np.float32)
    weight[5:8, 10:14] = 0
    depth[20, 5:9] = np.nan
    slope = 0.002 * random.normal(size=(*size, 2)).astype(np.float32)
    return PyramidLevel(np.stack(images), weight, depth, slope, np.array([35.0, 36.0, 19.2, 14.8]))


def _loss(threshold: float = HUGE, gamma: float = 0.4, sigma: tuple[float, float] = (1.0, 0.5)) -> Loss:
    return Loss(np.array(sigma), threshold, np.array([0.3, 1.0]), np.array([True, False]), gamma)


def _lamp(points: np.ndarray, moved: np.ndarray, T: np.ndarray, gamma: float) -> np.ndarray:
    """Lambert's law for a lamp in the camera, from normals and distances."""
    fx, fy, cx, cy = REFERENCE.intrinsics
    h, w = REFERENCE.weight.shape
    v, u = np.mgrid[:h, :w].astype(np.float64)
    a, b = REFERENCE.slope[..., 0].astype(np.float64), REFERENCE.slope[..., 1].astype(np.float64)
    plane = np.stack([a, b, 1 / REFERENCE.depth_mm.astype(np.float64) - a * (u - cx) / fx - b * (v - cy) / fy], -1)
    normal = plane / np.linalg.norm(plane, axis=-1, keepdims=True)

    def light(X: np.ndarray, n: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(X, axis=-1)
        return (n * X).sum(-1) / distance / distance**2

    return (light(moved, normal @ T[:3, :3].T) / light(points, normal)) ** gamma


REFERENCE, CURRENT = _level(1), _level(2)


def _moved(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    twist = parameters[:6] * np.array([1, 1, 1, UNIT_MM, UNIT_MM, UNIT_MM])
    return se3_exp(twist) @ MOTION, AFFINE + parameters[6:]


def _by_hand(loss: Loss, parameters: np.ndarray | None = None) -> np.ndarray:
    """Residuals in plain numpy, in the bilinear cell of the unperturbed motion, so that they are smooth."""
    h, w = REFERENCE.weight.shape
    fx, fy, cx, cy = REFERENCE.intrinsics
    v, u = np.mgrid[:h, :w].astype(np.float64)
    points = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1) * REFERENCE.depth_mm[..., None]

    def land(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved = points @ T[:3, :3].T + T[:3, 3]
        return moved, moved[..., :2] / moved[..., 2:] * [fx, fy] + [cx, cy]

    T, affine = _moved(np.zeros(8) if parameters is None else parameters)
    (_, unperturbed), (moved, pixel) = land(MOTION), land(T)
    inside = ((unperturbed >= 0) & (unperturbed < [w - 1, h - 1])).all(-1)
    i, j = np.moveaxis(np.where(inside[..., None], np.floor(unperturbed), 0).astype(int), -1, 0)
    a, b = pixel[..., 0] - i, pixel[..., 1] - j
    there = np.min([CURRENT.weight[j + dj, i + di] for dj in (0, 1) for di in (0, 1)], axis=0)
    used = inside & (there > 0) & (REFERENCE.weight > 0) & np.isfinite(REFERENCE.depth_mm)
    lamp, out = _lamp(points, moved, T, loss.gamma), []
    for c in range(2):
        image, expected = CURRENT.channels[c].astype(np.float64), REFERENCE.channels[c].astype(np.float64)
        top = image[j, i] + a * (image[j, i + 1] - image[j, i])
        bottom = image[j + 1, i] + a * (image[j + 1, i + 1] - image[j + 1, i])
        expected = affine[0] * lamp * expected + affine[1] if c == 0 else expected
        out.append(np.where(used, top + b * (bottom - top) - expected, np.nan))
    return np.stack(out)


def test_residuals_agree_with_plain_numpy() -> None:
    found = residual_images(REFERENCE, CURRENT, MOTION, AFFINE, _loss())
    np.testing.assert_allclose(found, _by_hand(_loss()), atol=2e-5)


@pytest.mark.parametrize("gamma", [0.0, 0.4])
def test_jacobians_agree_with_finite_differences(gamma: float) -> None:
    loss, residuals = _loss(gamma=gamma), _by_hand(_loss(gamma=gamma))
    ahead, behind = (np.stack([_by_hand(loss, side * d) for d in 1e-4 * np.eye(8)], -1) for side in (1, -1))
    used = np.isfinite(residuals)
    J, r = ((ahead - behind) / 2e-4)[used], residuals[used]
    w = ((loss.share / loss.sigma**2)[:, None, None] * np.ones_like(residuals))[used]
    weight = used[0].sum()
    equations = normal_equations(REFERENCE, CURRENT, MOTION, AFFINE, loss, UNIT_MM)
    hessian, gradient = (J * w[:, None]).T @ J / weight, J.T @ (w * r) / weight
    scale = np.sqrt(np.diag(hessian))
    np.testing.assert_allclose(equations.hessian / np.outer(scale, scale), hessian / np.outer(scale, scale), atol=1e-4)
    np.testing.assert_allclose(equations.gradient / scale, gradient / scale, atol=1e-4)
    assert equations.weight == weight


def test_gradient_is_that_of_the_huber_loss() -> None:
    loss = _loss(threshold=0.8)
    equations = normal_equations(REFERENCE, CURRENT, MOTION, AFFINE, loss, UNIT_MM)
    step = 1e-5
    for k in range(8):
        d = np.zeros(8)
        d[k] = step
        ahead, behind = (normal_equations(REFERENCE, CURRENT, *_moved(side * d), loss, UNIT_MM) for side in (1, -1))
        slope = (ahead.cost - behind.cost) / (2 * step)
        assert equations.gradient[k] == pytest.approx(slope, rel=2e-3, abs=2e-3 * np.sqrt(equations.hessian[k, k]))


def test_cost_is_the_huber_loss_of_the_residuals() -> None:
    loss = _loss(threshold=0.8)
    r = _by_hand(loss) / loss.sigma[:, None, None]
    huber = np.where(np.abs(r) <= 0.8, 0.5 * r**2, 0.8 * (np.abs(r) - 0.4))
    expected = np.nansum(loss.share[:, None, None] * huber) / np.isfinite(r[0]).sum()
    assert normal_equations(REFERENCE, CURRENT, MOTION, AFFINE, loss, UNIT_MM).cost == pytest.approx(expected, rel=1e-5)


def test_masked_pixels_change_nothing() -> None:
    spoilt = REFERENCE.channels.copy()
    spoilt[:, REFERENCE.weight == 0] = 1e6
    spoilt[:, np.isnan(REFERENCE.depth_mm)] = -1e6
    twin = REFERENCE._replace(channels=spoilt)
    one = normal_equations(REFERENCE, CURRENT, MOTION, AFFINE, _loss(), UNIT_MM)
    two = normal_equations(twin, CURRENT, MOTION, AFFINE, _loss(), UNIT_MM)
    np.testing.assert_array_equal(one.hessian, two.hessian)
    assert one.cost == two.cost


def test_behind_the_camera_is_not_used() -> None:
    away = np.eye(4)
    away[2, 3] = -10 * UNIT_MM
    assert np.isnan(residual_images(REFERENCE, CURRENT, away, AFFINE, _loss())).all()
    assert normal_equations(REFERENCE, CURRENT, away, AFFINE, _loss(), UNIT_MM).weight == 0
