"""ScopeNet's estimator on the real network class, small or with random weights: closed forms, files, provenance."""

from __future__ import annotations

import copy
import math
import os
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch
from chosen_settings import chosen
from torch import nn

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.rectification import Rectifier
from scopemap.config import Config, DepthSettings
from scopemap.depth.create import create_anchor, create_depth
from scopemap.depth.scopenet import estimator as module
from scopemap.depth.scopenet.estimator import WEIGHTS_NAME, ScopeNetDepth, load_network
from scopemap.depth.scopenet.planes import input_planes
from scopemap.errors import WeightsError
from scopemap.frame import Frame
from scopemap.io import weights
from scopemap.io.device import cpu_threads
from training.export import export, read_network
from training.network import ScopeNet

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


def test_the_answer_has_the_frames_size_and_is_repeatable_and_whole(frame: Frame, file: Path) -> None:
    estimator = ScopeNetDepth(str(file))
    estimate, again = estimator.estimate(frame), estimator.estimate(frame)
    for array, twin in ((estimate.values, again.values), (estimate.sigma, again.sigma)):
        assert array is not None
        assert array.shape == (HEIGHT, WIDTH)
        assert array.dtype == np.float32
        assert np.isfinite(array).all()
        assert (array > 0).all()
        np.testing.assert_array_equal(array, twin)


def test_the_network_is_told_the_mask_and_the_rays(frame: Frame, file: Path) -> None:
    estimator = ScopeNetDepth(str(file))
    plain = estimator.estimate(frame).values
    masked = estimator.estimate(replace(frame, valid=np.zeros_like(frame.valid))).values
    wide = replace(CAMERA, fx=20.0, fy=21.0)
    elsewhere = estimator.estimate(replace(frame, camera=wide)).values
    assert np.abs(masked / plain - 1).max() > 1e-3
    assert np.isfinite(masked).all()
    unit_z = 1 / np.linalg.norm(wide.rays, axis=-1)
    assert np.abs(elsewhere / unit_z / (plain / UNIT_RAYS[..., 2]) - 1).max() > 1e-3
    blind = ScopeNetDepth(str(file), rays_known=False)
    one, two = blind.estimate(frame).values, blind.estimate(replace(frame, camera=wide)).values
    np.testing.assert_allclose(two / unit_z, one / UNIT_RAYS[..., 2], rtol=1e-5)


def test_the_package_s_network_answers_as_torch_does(frame: Frame) -> None:
    shipped = Path(module.__file__).parent / WEIGHTS_NAME
    told = _told(read_network(shipped), input_planes(frame.rgb, UNIT_RAYS, frame.valid))
    estimate = ScopeNetDepth().estimate(frame)
    assert estimate.sigma is not None
    np.testing.assert_allclose(np.log(estimate.values / UNIT_RAYS[..., 2]), told[0], atol=1e-5)
    np.testing.assert_allclose(np.log(estimate.sigma / estimate.values / math.sqrt(2)), told[1], atol=1e-5)


def test_threads_change_nothing(frame: Frame, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = (ScopeNetDepth(str(file), threads=n).estimate(frame).values for n in (1, 2))
    np.testing.assert_array_equal(one, two)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert cpu_threads() == 3
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert 1 <= cpu_threads() <= (os.cpu_count() or 1)


def test_the_weights_of_the_package_are_the_default(
    frame: Frame, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / WEIGHTS_NAME).write_bytes(file.read_bytes())
    monkeypatch.setattr(module.resources, "files", lambda package: tmp_path)
    estimator = create_depth(chosen(DepthSettings, backend="scopenet"), SAME, "cpu")
    origin = estimator.provenance()
    assert origin["model"] == "that come with the package"
    assert origin[f"sha256 {WEIGHTS_NAME}"] == weights.sha256_of(file)
    named = ScopeNetDepth(str(file)).estimate(frame)
    np.testing.assert_array_equal(estimator.estimate(frame).values, named.values)


def test_what_is_shipped_is_small_and_fits() -> None:
    shipped = Path(module.__file__).parent / WEIGHTS_NAME
    assert shipped.stat().st_size <= 8_000_000
    assert load_network(shipped).get_modelmeta().custom_metadata_map["name"] == "scopenet"


def test_what_is_shipped_is_what_the_model_card_describes() -> None:
    card = (Path(__file__).parents[1] / "docs" / "models" / "scopenet.md").read_text()
    assert weights.sha256_of(Path(module.__file__).parent / WEIGHTS_NAME) in card


def test_the_package_lists_its_weights() -> None:
    import tomllib

    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    listed = project["tool"]["setuptools"]["package-data"]["scopemap"]
    assert any(Path(f"depth/scopenet/{WEIGHTS_NAME}").match(pattern) for pattern in listed)


@pytest.mark.parametrize(("calibrated", "rays"), [(True, "known"), (False, "assumed")])
def test_provenance_says_whose_weights_and_whether_the_rays_were_known(file: Path, calibrated: bool, rays: str) -> None:
    settings = chosen(DepthSettings, backend="scopenet", model=str(file))
    origin = create_depth(settings, SAME, "cpu", calibrated=calibrated).provenance()
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


def test_its_millimetres_are_its_anchor_unless_another_is_asked_for(frame: Frame, file: Path) -> None:
    estimate = ScopeNetDepth(str(file)).estimate(frame)
    lit = replace(frame, rgb=np.full_like(frame.rgb, 120))
    own = create_anchor(chosen(DepthSettings, backend="scopenet"), "cpu")
    np.testing.assert_array_equal(own.depth_mm(estimate, lit), estimate.values)
    assert own.description == "millimetres as scopenet gives them"
    shaded = create_anchor(chosen(DepthSettings, backend="scopenet", anchor="shading", shading_median_mm=50.0), "cpu")
    metric = shaded.metric(estimate, lit)
    assert shaded.description == "shading prior, median distance 50 mm"
    factor = np.nanmedian(metric.depth_mm / estimate.values)
    assert factor != pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(metric.depth_mm, factor * estimate.values, rtol=1e-5)
    assert metric.sigma_mm is not None
    np.testing.assert_allclose(metric.sigma_mm, factor * estimate.sigma, rtol=1e-5)


def test_the_paper_names_its_own_depth() -> None:
    assert Config.load("paper").depth.backend == "depth-anything"


def test_what_was_given_is_not_changed_by_the_answer(frame: Frame, file: Path) -> None:
    before = copy.deepcopy(frame)
    ScopeNetDepth(str(file)).estimate(frame)
    np.testing.assert_array_equal(frame.rgb, before.rgb)
    np.testing.assert_array_equal(frame.valid, before.valid)
