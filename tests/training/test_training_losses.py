"""The loss: zero where the network is right up to one factor, blind to what is unknown, differentiable everywhere."""

import pytest

from tests.support.extras import NETWORKS

pytest.importorskip("torch", reason=NETWORKS)

import numpy as np
import torch

from scopemap.engine.cameras.camera import PinholeCamera
from training.losses import Weights, loss_parts, total

pytestmark = pytest.mark.networks


@pytest.fixture
def scene():
    camera = PinholeCamera(30.0, 30.0, 19.5, 15.5, 40, 32)
    rays = camera.rays / np.linalg.norm(camera.rays, axis=-1, keepdims=True)
    # A slanted wall: n . X = 40 with n off the axis.
    normal = np.array([0.3, 0.2, 0.93])
    truth = np.log(40.0 / (rays @ normal)).astype(np.float32)
    return torch.from_numpy(truth)[None], torch.from_numpy(rays.transpose(2, 0, 1).astype(np.float32))[None]


def _prediction(log_distance: torch.Tensor, log_spread: float = -2.0) -> torch.Tensor:
    return torch.stack([log_distance, torch.full_like(log_distance, log_spread)], 1)


def test_a_right_answer_up_to_a_factor_costs_nothing_but_its_scale(scene):
    truth, rays = scene
    parts = loss_parts(_prediction(truth + 0.4), truth, rays)
    for name in ("l1", "gradient", "normal"):
        assert float(parts[name]) == pytest.approx(0, abs=1e-5)
    assert float(parts["scale"]) == pytest.approx(0.4, abs=1e-5)


def test_the_likelihood_is_that_of_laplace(scene):
    truth, rays = scene
    sign = torch.where(torch.arange(truth.numel()).reshape(truth.shape) % 2 == 0, 1.0, -1.0)
    parts = loss_parts(_prediction(truth + 0.1 * sign, -1.5), truth, rays)
    # The median of two equally frequent values is one of them: half the errors are 0, half 0.2.
    assert float(parts["likelihood"]) == pytest.approx(0.5 * 0.2 * np.exp(1.5) - 1.5, abs=1e-3)


def test_unknown_pixels_have_no_say(scene):
    truth, rays = scene
    wrong = truth + 0.05 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    holed = truth.clone()
    holed[:, 8:20, 10:25] = float("nan")
    spoilt = wrong.clone()
    spoilt[:, 8:20, 10:25] += 5.0
    a, b = loss_parts(_prediction(wrong), holed, rays), loss_parts(_prediction(spoilt), holed, rays)
    for name in a:
        assert float(a[name]) == pytest.approx(float(b[name]), rel=1e-5)


def test_an_image_without_any_truth_costs_nothing_and_has_a_gradient(scene):
    truth, rays = scene
    prediction = _prediction(truth).requires_grad_()
    loss = total(loss_parts(prediction, torch.full_like(truth, float("nan")), rays), Weights())
    loss.backward()
    assert float(loss) == 0
    assert torch.isfinite(prediction.grad).all()


def test_gradients_agree_with_finite_differences(scene):
    truth, rays = (tensor.double() for tensor in scene)
    generator = torch.Generator().manual_seed(1)
    prediction = _prediction(truth + 0.3 + 0.1 * torch.randn(truth.shape, generator=generator, dtype=torch.float64))
    prediction.requires_grad_()

    def cost(p):
        return total(loss_parts(p, truth, rays), Weights(scale=0.0))

    cost(prediction).backward()
    direction = torch.randn(prediction.shape, generator=generator, dtype=torch.float64)
    direction[:, 0] = 0  # of the spread alone: the median is held fixed in the other channel
    step = 1e-5 * direction
    numeric = (cost(prediction + step) - cost(prediction - step)).item() / 2e-5
    assert (prediction.grad * direction).sum().item() == pytest.approx(numeric, rel=1e-4)
