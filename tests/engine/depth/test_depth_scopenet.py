"""ScopeNet's estimator on the real network class, small or with random weights: closed forms, files, provenance."""

from __future__ import annotations

import math
from importlib.metadata import version
from pathlib import Path

import pytest

from tests.support.extras import NETWORKS
from tests.support.places import ROOT

pytest.importorskip("torch", reason=NETWORKS)

import cv2
import numpy as np
import torch
from torch import nn

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.scopenet import estimator as module
from scopemap.engine.depth.scopenet.estimator import WEIGHTS_NAME, ScopeNetDepth
from scopemap.engine.depth.scopenet.planes import input_planes, one_colour
from scopemap.engine.errors import WeightsError
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.srgb import LINEAR
from scopemap.engine.models import weights
from scopemap.runner.depth_backends import create_depth
from training.export import export
from training.network import ScopeNet

pytestmark = pytest.mark.networks

HEIGHT, WIDTH = 50, 61  # no multiple of anything
CAMERA = PinholeCamera(40.0, 42.0, 28.0, 26.0, WIDTH, HEIGHT)
SAME = Rectifier(CAMERA, CAMERA)
UNIT_RAYS = (CAMERA.rays / np.linalg.norm(CAMERA.rays, axis=-1, keepdims=True)).astype(np.float32)


def _shaken(network: ScopeNet) -> ScopeNet:
    """Give every weight and statistic a value that shows in the output; a new network's head tells nothing."""
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        nn.init.normal_(network.head.weight, 0.0, 0.05, generator)
        for part in network.modules():
            if isinstance(part, nn.BatchNorm2d):
                part.running_mean.normal_(0.0, 0.1, generator=generator)
                part.running_var.uniform_(0.5, 2.0, generator=generator)
                part.weight.uniform_(0.5, 1.5, generator=generator)
                part.bias.normal_(0.0, 0.1, generator=generator)
    return network.eval()


def _small() -> ScopeNet:
    """A small network; its weights are numbers that float16 has."""
    torch.manual_seed(2)
    network = _shaken(ScopeNet(widths=(8, 8, 16, 16, 16)))
    network.load_state_dict({name: value.half() for name, value in network.state_dict().items()})
    return network


@pytest.fixture(scope="module")
def frame() -> Frame:
    rng = np.random.default_rng(3)
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, :9] = False
    return Frame(0, 0.0, rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8), CAMERA, valid)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "mine.onnx"
    export(_small(), path, {})
    return path


def _told(network: nn.Module, planes: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return network(torch.from_numpy(planes)[None])[0].numpy()


@pytest.mark.parametrize("rays_known", [True, False])
def test_depth_is_distance_times_the_rays_z_and_sigma_that_of_laplace(
    frame: Frame, file: Path, rays_known: bool
) -> None:
    estimate = ScopeNetDepth(str(file), rays_known=rays_known).estimate(frame)
    told = _told(_small(), input_planes(frame.rgb, UNIT_RAYS if rays_known else None, frame.valid))
    assert np.ptp(told[0]) > 0.1
    depth_mm = np.exp(told[0]) * UNIT_RAYS[..., 2]
    assert estimate.kind == "depth"
    assert estimate.focal_px is None
    np.testing.assert_allclose(estimate.values, depth_mm, rtol=1e-5)
    assert estimate.sigma is not None
    np.testing.assert_allclose(estimate.sigma, depth_mm * math.sqrt(2) * np.exp(told[1]), rtol=1e-5)


def test_averaged_depth_is_the_mean_of_two_looks_of_which_one_is_mirrored_and_larger(frame: Frame, file: Path) -> None:
    one = ScopeNetDepth(str(file)).estimate(frame)
    found = ScopeNetDepth(str(file), averaged=True).estimate(frame)
    coloured, grey = one_colour(frame.rgb, frame.valid)
    first = _told(_small(), input_planes(coloured, UNIT_RAYS, frame.valid))
    mirrored = input_planes(grey[:, ::-1], UNIT_RAYS[:, ::-1] * np.float32([-1, 1, 1]), frame.valid[:, ::-1])
    larger = np.stack([cv2.resize(np.ascontiguousarray(plane), (76, 62)) for plane in mirrored])
    second = np.stack([cv2.resize(answer, (WIDTH, HEIGHT))[:, ::-1] for answer in _told(_small(), larger)])
    log_distance, log_spread = (first + second) / 2
    np.testing.assert_allclose(found.values, np.exp(log_distance) * UNIT_RAYS[..., 2], rtol=1e-4)
    assert found.sigma is not None
    np.testing.assert_allclose(found.sigma, found.values * math.sqrt(2) * np.exp(log_spread), rtol=1e-4)
    assert np.abs(np.log(found.values / one.values)).max() > 1e-3


def test_tissues_that_differ_in_green_and_blue_alone_look_the_same_in_one_colour() -> None:
    red = np.tile(np.linspace(0.05, 0.45, 40), (30, 1))
    pale, dark = np.array([1, 0.6, 0.5]), np.array([1, 0.25, 0.2])
    light = red[..., None] * np.where(np.arange(30)[:, None, None] < 20, pale, dark)
    rgb = np.rint(np.interp(light, LINEAR, np.arange(256))).astype(np.uint8)
    valid = np.ones(red.shape, bool)
    coloured, grey = one_colour(rgb, valid)
    assert np.ptp(coloured.astype(int), axis=0).max() <= 1
    np.testing.assert_array_equal(coloured[..., 0], rgb[..., 0])
    assert np.ptp(grey.astype(int), axis=2).max() == 0
    saturated = rgb.copy()
    saturated[:5, :5] = (255, 130, 90)
    np.testing.assert_array_equal(one_colour(saturated, valid)[0][:5, :5], saturated[:5, :5])
    np.testing.assert_array_equal(one_colour(rgb, ~valid)[0], rgb)


def test_what_is_shipped_is_what_the_model_card_describes() -> None:
    card = (ROOT / "docs" / "models" / "scopenet.md").read_text()
    assert weights.sha256_of(Path(module.__file__).parent / WEIGHTS_NAME) in card


@pytest.mark.parametrize(("calibrated", "rays"), [(True, "known"), (False, "assumed")])
def test_provenance_says_whose_weights_and_whether_the_rays_were_known(file: Path, calibrated: bool, rays: str) -> None:
    settings = DepthSettings(backend="scopenet", model=str(file))
    origin = create_depth(settings, SAME, "cpu", calibrated=calibrated).provenance()
    averaged = create_depth(settings, SAME, "cpu", calibrated=calibrated, averaged=True).provenance()
    assert averaged == origin | {"answers": "mean of two"}
    assert origin == {
        "depth": "scopenet",
        "model": str(file),
        "sha256 mine.onnx": weights.sha256_of(file),
        "runtime": f"onnxruntime {version('onnxruntime')}",
        "rays": rays,
    }


def test_an_installation_without_weights_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.resources, "files", lambda package: tmp_path)
    monkeypatch.setattr(module, "__file__", str(tmp_path / "estimator.py"))
    with pytest.raises(WeightsError, match=r"installation lacks .*depth\.backend=shading"):
        ScopeNetDepth()
    with pytest.raises(WeightsError, match=r"names .*other\.onnx, which is no file"):
        ScopeNetDepth(str(tmp_path / "other.onnx"))


def test_files_that_are_no_scopenet_are_refused(file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    wrong = tmp_path / "wrong.onnx"
    wrong.write_bytes(b"rubbish")
    with pytest.raises(WeightsError, match=r"cannot load ScopeNet from .*wrong\.onnx.*depth\.model"):
        ScopeNetDepth(str(wrong))
    wrong.write_bytes(file.read_bytes().replace(b"planes", b"pictur"))
    with pytest.raises(WeightsError, match=r"cannot load ScopeNet from .*planes"):
        ScopeNetDepth(str(wrong))
    broken = _small()
    with torch.no_grad():
        broken.head.bias[1] = math.nan
    export(broken, wrong, {})
    with pytest.raises(WeightsError, match=r"network in .*wrong\.onnx is not a ScopeNet that can be used"):
        ScopeNetDepth(str(wrong))
    assert capfd.readouterr() == ("", "")
