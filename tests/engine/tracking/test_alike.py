"""ALIKE-t as the package runs it: against the network it is made of, and against what it gave when it was made."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest

from scopemap.engine.errors import WeightsError
from scopemap.engine.frame import Frame
from scopemap.engine.tracking import alike
from scopemap.engine.tracking.alike import AlikeFeatures, descriptors_at, network_answer
from tests.support import plane_scene
from tests.support.places import ROOT
from tests.support.plane_scene import CAMERA

pytestmark = pytest.mark.networks

FILE = ROOT / "src" / "scopemap" / "engine" / "tracking" / "alike.onnx"
RGB = plane_scene.see(plane_scene.pose()).rgb
# What it gave when the weights were converted.
EXPECTED_PIXELS = [[75.546, 26.454], [124.884, 75.129], [188.462, 81.918]]
EXPECTED_DESCRIPTOR = [-0.1598, -0.0977, -0.0227, -0.0145]


def test_the_graph_is_the_network() -> None:
    """Scores and descriptors of the graph, whose head is applied before the maps are enlarged, are the network's."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from training.alike import read_alike

    network = read_alike(FILE)
    assert sum(value.numel() for value in network.parameters()) > 70_000
    scores, maps, head = network_answer(RGB)
    padded = np.pad(
        RGB, [(0, own - side) for own, side in zip(scores.shape, RGB.shape, strict=False)] + [(0, 0)], "edge"
    )
    with torch.no_grad():
        expected, dense = network(torch.from_numpy(padded.transpose(2, 0, 1)[None].astype(np.float32) / 255))
    np.testing.assert_allclose(scores, expected[0, 0], atol=1e-4)
    assert scores.max() > 0.5
    pixels = np.random.default_rng(0).integers(0, min(scores.shape), (200, 2))
    found = descriptors_at(pixels.astype(float), maps, head)
    np.testing.assert_allclose(found, dense[0].numpy()[:, pixels[:, 1], pixels[:, 0]].T, atol=1e-4)


def test_features_are_those_of_before() -> None:
    features = AlikeFeatures().detect(_frame(RGB))
    assert features.descriptors.shape == (len(features.pixels), 64)
    np.testing.assert_allclose(features.pixels[:3], EXPECTED_PIXELS, atol=0.02)
    np.testing.assert_allclose(features.descriptors[0, :4], EXPECTED_DESCRIPTOR, atol=2e-3)


def test_a_picture_is_described_once(monkeypatch: pytest.MonkeyPatch) -> None:
    answers, network = list[np.ndarray](), alike.network_answer

    def answer(rgb: np.ndarray, device: str) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
        answers.append(rgb)
        return network(rgb, device)

    monkeypatch.setattr(alike, "network_answer", answer)
    detector, frame = AlikeFeatures(), _frame(RGB)
    blind = detector.detect(replace(frame, depth_mm=None))
    seeing = detector.detect(frame)
    assert len(answers) == 1
    assert np.isnan(blind.points_mm).all()
    assert np.isfinite(seeing.points_mm).any()
    np.testing.assert_array_equal(blind.descriptors, seeing.descriptors)
    masked = detector.detect(replace(frame, valid=frame.valid & (np.arange(frame.valid.shape[1]) > 60)))
    assert len(answers) == 2
    assert masked.pixels[:, 0].min() > 55


def test_an_installation_without_the_network_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alike, "_NETWORK", "none.onnx")
    alike._network.cache_clear()
    with pytest.raises(WeightsError, match=r"lacks .*none\.onnx.*networks\.features=sift"):
        AlikeFeatures().detect(_frame(RGB))
    assert AlikeFeatures().provenance()["sha256 none.onnx"] == "missing"
    monkeypatch.undo()
    alike._network.cache_clear()
    assert len(AlikeFeatures().detect(replace(_frame(RGB), depth_mm=None)).pixels)


def test_the_notice_comes_with_the_weights() -> None:
    notice = (resources.files("scopemap.engine.tracking") / "alike.LICENSE.txt").read_text(encoding="utf-8")
    assert "BSD 3-Clause" in notice
    assert "Copyright (c) 2022, Zhao Xiaoming" in notice
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    shipped = setup["tool"]["setuptools"]["package-data"]["scopemap"]
    assert {"engine/tracking/alike.onnx", "engine/tracking/alike.LICENSE.txt"} <= set(shipped)


def _frame(rgb: np.ndarray) -> Frame:
    depth_mm = np.full(rgb.shape[:2], 50.0, np.float32)
    return Frame(0, 0.0, rgb, CAMERA, plane_scene.EVERYWHERE, depth_mm)
