"""Adapters of the depth networks, on small randomly initialised models of the real classes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.support.extras import NETWORKS

pytest.importorskip("torch", reason=NETWORKS)

import numpy as np
import torch

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.anchor import AnchoredDepth
from scopemap.engine.depth.depth_anything import DepthAnything
from scopemap.engine.depth.depth_pro import DepthPro
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.errors import WeightsError
from scopemap.engine.frame import Frame
from scopemap.runner.depth_backends import create_anchor, create_depth
from tests.support.small_networks import saved, small_depth_anything, small_depth_pro

pytestmark = pytest.mark.networks

HEIGHT, WIDTH = 50, 61


@pytest.fixture(scope="module")
def frame() -> Frame:
    rgb = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    camera = PinholeCamera(40.0, 40.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    return Frame(0, 0.0, rgb, camera, np.ones((HEIGHT, WIDTH), bool))


def _by_hand(pair: tuple[Any, Any], frame: Frame) -> dict[str, Any]:
    from PIL import Image

    network, processor = pair
    with torch.no_grad():
        outputs = network(**processor(images=Image.fromarray(frame.rgb), return_tensors="pt"))
    return processor.post_process_depth_estimation(outputs, target_sizes=[(HEIGHT, WIDTH)])[0]


def test_depth_anything_gives_disparity(frame: Frame, tmp_path: Path) -> None:
    pair = small_depth_anything()
    estimator = DepthAnything.from_folder_or_hub(str(saved(pair, tmp_path)), "cpu")
    estimate = estimator.estimate(frame)
    assert estimate.kind == "disparity"
    assert estimate.focal_px is None
    assert estimate.values.shape == (HEIGHT, WIDTH)
    assert estimate.values.dtype == np.float32
    assert np.isfinite(estimate.values).all()
    assert np.ptp(estimate.values) > 0
    expected = _by_hand(pair, frame)["predicted_depth"].clamp(min=0).numpy()
    np.testing.assert_allclose(estimate.values, expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(estimator.estimate(frame).values, estimate.values)


def test_metric_depth_anything_gives_millimetres(frame: Frame) -> None:
    pair = small_depth_anything("metric")
    estimate = DepthAnything(*pair, device="cpu").estimate(frame)
    assert estimate.kind == "depth"
    np.testing.assert_allclose(estimate.values, 1000 * _by_hand(pair, frame)["predicted_depth"].numpy(), rtol=1e-4)


def test_depth_pro_scales_with_the_known_focal_length(frame: Frame) -> None:
    pair = small_depth_pro()
    own = DepthPro(*pair, device="cpu", use_known_focal=False).estimate(frame)
    known = DepthPro(*pair, device="cpu").estimate(frame)
    assert own.focal_px is not None
    assert known.focal_px == own.focal_px
    np.testing.assert_allclose(known.values, own.values * frame.camera.fx / own.focal_px, rtol=1e-4)


def test_depth_pro_without_a_field_of_view_needs_the_camera(frame: Frame) -> None:
    pair = small_depth_pro(use_fov_model=False)
    estimate = DepthPro(*pair, device="cpu").estimate(frame)
    assert estimate.focal_px is None
    canonical_depth = _by_hand(pair, frame)["predicted_depth"].numpy()
    # Without a field of view `transformers` leaves 1 / c as it is: f / W is still to be multiplied in.
    np.testing.assert_allclose(estimate.values, 1000 * canonical_depth * frame.camera.fx / WIDTH, rtol=1e-4)
    with pytest.raises(WeightsError, match="focal length"):
        DepthPro(*pair, device="cpu", use_known_focal=False)


@pytest.mark.parametrize("adapter", [DepthAnything, DepthPro])
def test_missing_weights_name_the_command(adapter: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path))
    with pytest.raises(WeightsError, match=rf"scopemap models pull {adapter.name}.*local folder"):
        adapter.from_folder_or_hub(device="cpu")
    with pytest.raises(WeightsError, match="scopemap models pull some/model"):
        adapter.from_folder_or_hub("some/model", "cpu")


def test_a_folder_of_another_model_is_refused(tmp_path: Path) -> None:
    saved(small_depth_anything(), tmp_path)
    with pytest.raises(WeightsError, match="'depth_anything', but 'depth_pro' is needed"):
        DepthPro.from_folder_or_hub(str(tmp_path), "cpu")


def test_incomplete_and_broken_weights_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    folder = saved(small_depth_anything(), tmp_path)
    file = folder / "model.safetensors"
    state = load_file(file)
    del state["head.conv3.weight"]
    save_file(state, file, metadata={"format": "pt"})
    with pytest.raises(WeightsError, match=r"head\.conv3\.weight"):
        DepthAnything.from_folder_or_hub(str(folder), "cpu")
    file.write_bytes(b"rubbish")
    with pytest.raises(WeightsError, match="cannot load"):
        DepthAnything.from_folder_or_hub(str(folder), "cpu")
    file.unlink()
    torch.save(state, folder / "pytorch_model.bin")
    with pytest.raises(WeightsError, match="cannot load"):
        DepthAnything.from_folder_or_hub(str(folder), "cpu")


def test_one_image_goes_through_depth_pro_once(frame: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run reads the focal length of frame 1 first, then its depth with the camera that follows from it."""
    network, processor = small_depth_pro()
    estimator, passes, forward = DepthPro(network, processor, device="cpu"), [], network.forward
    monkeypatch.setattr(network, "forward", lambda *args, **kwargs: passes.append(1) or forward(*args, **kwargs))
    first = estimator.estimate(frame)
    again = estimator.estimate(replace(frame, camera=replace(frame.camera, fx=80.0, fy=80.0)))
    np.testing.assert_allclose(again.values, 2 * first.values, rtol=1e-4)
    assert (len(passes), again.focal_px) == (1, first.focal_px)
    estimator.estimate(replace(frame, rgb=255 - frame.rgb))
    assert len(passes) == 2


@pytest.mark.parametrize("place", ["setting", "weights folder"])
@pytest.mark.parametrize("role", ["anchor", "depth"])
def test_depth_pro_by_hand(
    place: str, role: str, frame: Frame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder that was copied, without a record of a download: named by a setting, or in the weights folder."""
    folder = saved(small_depth_pro(), tmp_path / "depth-pro")
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path if place == "weights folder" else tmp_path / "empty"))
    model = str(folder) if place == "setting" else ""
    if role == "anchor":
        settings = DepthSettings(anchor="depth-pro", backend="depth-anything", anchor_model=model)
        estimator = create_anchor(settings, "cpu").reference
    else:
        estimator = create_depth(DepthSettings(backend="depth-pro", model=model), None, "cpu")  # type: ignore[arg-type]
    assert estimator.estimate(frame).focal_px is not None
    facts = estimator.provenance()
    assert len(facts["sha256 model.safetensors"]) == 64
    assert "revision" not in facts  # nothing tells which one was copied


def test_the_anchors_network_is_freed_once_it_has_served(frame: Frame) -> None:
    settings = DepthSettings(backend="depth-anything", anchor="depth-pro")
    anchor = AnchoredDepth(settings, DepthPro(*small_depth_pro(), device="cpu"))
    values = np.random.default_rng(1).uniform(1, 2, (HEIGHT, WIDTH)).astype(np.float32)
    before = anchor.metric(DepthEstimate(values, "depth"), frame)
    assert np.isfinite(before.depth_mm).any()
    assert anchor.reference._network is None
    np.testing.assert_array_equal(anchor.metric(DepthEstimate(values, "depth"), frame).depth_mm, before.depth_mm)
    assert anchor.reference.provenance()["depth"] == "depth-pro"
