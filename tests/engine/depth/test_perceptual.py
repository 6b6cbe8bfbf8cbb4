"""Perceptual distances: zero for equal images, symmetric, and the same as the packages they stand on."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest

from tests.support.extras import NETWORKS

pytest.importorskip("torch", reason=NETWORKS)

import cv2
import numpy as np
import torch

from scopemap.engine.depth.perceptual import LpipsAlex, create_perceptual
from scopemap.engine.errors import SettingsError, WeightsError
from scopemap.engine.geometry.similarity import structural_similarity

pytestmark = pytest.mark.networks

SHAPE = (70, 93, 3)


def _random_image(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, SHAPE).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def _alexnet_state(seed: int = 4) -> dict[str, torch.Tensor]:
    """The parameters of AlexNet's convolutions, random, under torchvision's names."""
    shapes = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
    random = torch.Generator().manual_seed(seed)
    state = {}
    for layer, (outputs, inputs, side) in shapes.items():
        weight = torch.randn(outputs, inputs, side, side, generator=random)
        state[f"features.{layer}.weight"] = weight * (2 / (inputs * side * side)) ** 0.5
        state[f"features.{layer}.bias"] = 0.1 * torch.randn(outputs, generator=random)
    return state


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random AlexNet's convolutions, and a classifier's layer as in torchvision's whole file."""
    path = tmp_path_factory.mktemp("weights") / "alexnet.pth"
    torch.save(_alexnet_state() | {"classifier.1.bias": torch.zeros(3)}, path)
    return path


@pytest.fixture(scope="module")
def random_lpips(checkpoint: Path) -> LpipsAlex:
    return LpipsAlex(device="cpu", checkpoint=checkpoint)


def _by_hand(state: dict[str, torch.Tensor], rgb_a: np.ndarray, rgb_b: np.ndarray, *, spatial: bool) -> np.ndarray:
    """LPIPS of the package itself, its backbone's parameters taken in the order in which they come."""
    import lpips

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        network = lpips.LPIPS(net="alex", pnet_rand=True, verbose=False, spatial=spatial)
    with torch.no_grad():
        for mine, theirs in zip(network.net.parameters(), state.values(), strict=True):
            mine.copy_(theirs)
        a, b = (torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255 for rgb in (rgb_a, rgb_b))
        return network(a, b, normalize=True)[0, 0].numpy()


def test_lpips_agrees_with_the_package(random_lpips: LpipsAlex) -> None:
    a, b = _random_image(1), _random_image(2)
    result = random_lpips.compare(a, b)
    np.testing.assert_allclose(result.map, _by_hand(_alexnet_state(), a, b, spatial=True), rtol=1e-3, atol=1e-5)
    score = _by_hand(_alexnet_state(), a, b, spatial=False).item()
    assert result.score == pytest.approx(score, rel=0.01)


def test_making_lpips_is_quiet_and_draws_no_random_numbers(checkpoint: Path, capfd: Any) -> None:
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        LpipsAlex(device="cpu", checkpoint=checkpoint)
    assert torch.equal(torch.rand(3), expected)
    assert capfd.readouterr() == ("", "")


def test_unfit_backbones_are_refused(tmp_path: Path) -> None:
    state = _alexnet_state()
    torch.save({name: value for name, value in state.items() if "features.8" not in name}, tmp_path / "short.pth")
    torch.save(state | {"features.12.weight": torch.zeros(1)}, tmp_path / "long.pth")
    for file in ("short.pth", "long.pth"):
        with pytest.raises(WeightsError, match="does not hold AlexNet's convolutions"):
            LpipsAlex(device="cpu", checkpoint=tmp_path / file)


def test_lpips_is_used_where_it_is_named_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path))
    assert create_perceptual("structure", "cpu").name == "structure"
    with pytest.raises(WeightsError, match="scopemap models pull alexnet"):
        create_perceptual("lpips", "cpu")
    with pytest.raises(SettingsError, match="unknown perceptual distance 'vgg'"):
        create_perceptual("vgg")
    torch.save(_alexnet_state(), tmp_path / "alexnet_features_torch.pth")
    with pytest.raises(WeightsError, match="damaged"):
        create_perceptual("lpips", "cpu")


def test_structural_similarity_is_that_of_scikit_image() -> None:
    from skimage.metrics import structural_similarity as theirs

    rng = np.random.default_rng(3)
    one = cv2.GaussianBlur(rng.integers(0, 256, (40, 53), np.uint8), (0, 0), 2)
    other = np.clip(one + rng.normal(0, 8, one.shape), 0, 255).astype(np.uint8)
    _, expected = theirs(one, other, full=True)
    np.testing.assert_allclose(structural_similarity(one, other), expected, atol=1e-10)
    np.testing.assert_allclose(structural_similarity(one, one), 1.0)
