"""The fused kernels against finite differences and a plain numpy referee."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scopemap.geometry.se3 import se3_exp
from scopemap.tracking.residuals import Loss, View, normal_equations, residual_images

UNIT_MM = 40.0
AFFINE = np.array([1.1, 0.05])
MOTION = se3_exp(np.array([0.01, -0.02, 0.015, 0.5, -0.3, 0.8]))
HUGE = 1e6  # a Huber threshold beyond all residuals: least squares


def _view(seed: int, size: tuple[int, int] = (30, 40)) -> View:
    random = np.random.default_rng(seed)
    images = [cv2.GaussianBlur(random.normal(size=size), (0, 0), 3).astype(np.float32) * 5 for _ in range(2)]
    depth = (UNIT_MM + 8 * cv2.GaussianBlur(random.normal(size=size), (0, 0), 5) * 10).astype(np.float32)
    weight = np.ones(size, np.float32)
    weight[5:8, 10:14] = 0
    depth[20, 5:9] = np.nan
    slope = 0.002 * random.normal(size=(*size, 2)).astype(np.float32)
    return View(np.stack(images), weight, depth, slope, np.array([35.0, 36.0, 19.2, 14.8]))


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


REFERENCE, CURRENT = _view(1), _view(2)


def _moved(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    twist = parameters[:6] * np.array([1, 1, 1, UNIT_MM, UNIT_MM, UNIT_MM])
    return se3_exp(twist) @ MOTION, AFFINE + parameters[6:]


def _residuals_at(parameters: np.ndarray, loss: Loss) -> np.ndarray:
    return residual_images(REFERENCE, CURRENT, *_moved(parameters), loss).astype(np.float64)


def _by_hand(loss: Loss) -> np.ndarray:
    """Residuals by cv2.remap and plain numpy."""
    h, w = REFERENCE.weight.shape
    fx, fy, cx, cy = REFERENCE.intrinsics
    v, u = np.mgrid[:h, :w].astype(np.float64)
    points = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1) * REFERENCE.depth_mm[..., None]
    moved = points @ MOTION[:3, :3].T + MOTION[:3, 3]
    x, y = fx * moved[..., 0] / moved[..., 2] + cx, fy * moved[..., 1] / moved[..., 2] + cy
    lamp = _lamp(points, moved, MOTION, loss.gamma)
    out = []
    for c in range(2):
        i, j = np.floor(x), np.floor(y)
        inside = (i >= 0) & (j >= 0) & (x < w - 1) & (y < h - 1)
        i, j = np.where(inside, i, 0).astype(int), np.where(inside, j, 0).astype(int)
        a, b, image = x - i, y - j, CURRENT.channels[c].astype(np.float64)
        value = (1 - b) * ((1 - a) * image[j, i] + a * image[j, i + 1]) + b * (
            (1 - a) * image[j + 1, i] + a * image[j + 1, i + 1]
        )
        weights = [CURRENT.weight[j + dj, i + di] for dj in (0, 1) for di in (0, 1)]
        usable = inside & (np.min(weights, axis=0) > 0) & (REFERENCE.weight > 0) & np.isfinite(REFERENCE.depth_mm)
        expected = REFERENCE.channels[c]
        if c == 0:
            expected = AFFINE[0] * lamp * expected + AFFINE[1]
        out.append(np.where(usable, value - expected, np.nan))
    return np.stack(out)


def test_residuals_agree_with_plain_numpy() -> None:
    loss = _loss()
    np.testing.assert_allclose(_residuals_at(np.zeros(8), loss), _by_hand(loss), atol=2e-5)


@pytest.mark.parametrize("gamma", [0.0, 0.4, 1.0])
def test_jacobians_agree_with_finite_differences(gamma: float) -> None:
    loss, step = _loss(gamma=gamma), 1e-4
    here, residuals = _by_hand_jacobian(loss, step), _residuals_at(np.zeros(8), loss)
    used = np.isfinite(residuals) & np.isfinite(here).all(axis=-1)
    information = (loss.share / loss.sigma**2)[:, None, None] * np.ones_like(residuals)
    weight = np.where(np.isfinite(residuals[0]), 1, 0).sum()
    J, r, w = here[used], residuals[used], information[used]
    equations = normal_equations(REFERENCE, CURRENT, MOTION, AFFINE, loss, UNIT_MM)
    hessian, gradient = (J * w[:, None]).T @ J / weight, J.T @ (w * r) / weight
    scale = np.sqrt(np.outer(np.diag(hessian), np.diag(hessian)))
    np.testing.assert_allclose(equations.hessian / scale, hessian / scale, atol=1e-4)
    np.testing.assert_allclose(
        equations.gradient / np.sqrt(np.diag(hessian)), gradient / np.sqrt(np.diag(hessian)), atol=1e-4
    )
    assert equations.weight == weight


def _by_hand_jacobian(loss: Loss, step: float) -> np.ndarray:
    """Central differences of a float64 residual, on pixels that stay within their bilinear cell."""
    columns = []
    for k in range(8):
        ahead, behind = np.zeros(8), np.zeros(8)
        ahead[k], behind[k] = step, -step
        columns.append((_smooth_residuals(ahead, loss) - _smooth_residuals(behind, loss)) / (2 * step))
    return np.stack(columns, -1)


def _smooth_residuals(parameters: np.ndarray, loss: Loss) -> np.ndarray:
    """Residuals in float64 with the bilinear cell frozen at the unperturbed motion, so that they are smooth."""
    h, w = REFERENCE.weight.shape
    fx, fy, cx, cy = REFERENCE.intrinsics
    v, u = np.mgrid[:h, :w].astype(np.float64)
    points = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1) * REFERENCE.depth_mm[..., None]

    def land(T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        moved = points @ T[:3, :3].T + T[:3, 3]
        return moved, fx * moved[..., 0] / moved[..., 2] + cx, fy * moved[..., 1] / moved[..., 2] + cy

    _, x0, y0 = land(MOTION)
    T, affine = _moved(parameters)
    moved, x, y = land(T)
    i = np.clip(np.nan_to_num(np.floor(x0)), 0, w - 2).astype(int)
    j = np.clip(np.nan_to_num(np.floor(y0)), 0, h - 2).astype(int)
    a, b = x - i, y - j
    lamp = _lamp(points, moved, T, loss.gamma)
    out = []
    for c in range(2):
        image, expected = CURRENT.channels[c].astype(np.float64), REFERENCE.channels[c].astype(np.float64)
        top = image[j, i] + a * (image[j, i + 1] - image[j, i])
        bottom = image[j + 1, i] + a * (image[j + 1, i + 1] - image[j + 1, i])
        out.append(top + b * (bottom - top) - (affine[0] * lamp * expected + affine[1] if c == 0 else expected))
    return np.stack(out)


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
