"""Adapters of the depth networks, on small randomly initialised models of the real classes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from transformers import (
    DepthAnythingConfig,
    DepthAnythingForDepthEstimation,
    DepthProConfig,
    DepthProForDepthEstimation,
    DepthProImageProcessor,
    DPTImageProcessor,
)

from scopemap.cameras.camera import PinholeCamera
from scopemap.depth.depth_anything import DepthAnything
from scopemap.depth.depth_pro import DepthPro
from scopemap.errors import WeightsError
from scopemap.frame import Frame

HEIGHT, WIDTH = 50, 61
_VIT = {
    "model_type": "dinov2",
    "hidden_size": 8,
    "num_attention_heads": 2,
    "intermediate_size": 16,
}


@pytest.fixture(scope="module")
def frame() -> Frame:
    rgb = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    camera = PinholeCamera(40.0, 40.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    return Frame(0, 0.0, rgb, camera, np.ones((HEIGHT, WIDTH), bool))


def _anything(kind: str = "relative") -> tuple[Any, Any]:
    torch.manual_seed(5)
    backbone = _VIT | {
        "num_hidden_layers": 4,
        "patch_size": 14,
        "image_size": 28,
        "out_indices": [1, 2, 3, 4],
        "reshape_hidden_states": False,
    }
    config = DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=8,
        neck_hidden_sizes=[4, 4, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=4,
        depth_estimation_type=kind,
        max_depth=20 if kind == "metric" else 1,
    )
    processor = DPTImageProcessor(size={"height": 56, "width": 56}, keep_aspect_ratio=True, ensure_multiple_of=14)
    network = DepthAnythingForDepthEstimation(config).eval()
    with torch.no_grad():
        network.head.conv3.bias.fill_(1.0)  # keeps the untrained output off the ReLU's dead side
    return network, processor


def _pro(use_fov_model: bool = True) -> tuple[Any, Any]:
    torch.manual_seed(7)
    vit = _VIT | {"num_hidden_layers": 2, "patch_size": 4, "image_size": 16}
    config = DepthProConfig(
        patch_size=16,
        fusion_hidden_size=16,
        intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[8, 8],
        scaled_images_feature_dims=[8, 8, 8],
        image_model_config=dict(vit),
        patch_model_config=dict(vit),
        fov_model_config=dict(vit),
        use_fov_model=use_fov_model,
    )
    network = DepthProForDepthEstimation(config).eval()
    with torch.no_grad():
        network.head.layers[-2].bias.fill_(1000.0)  # keeps the untrained output off the ReLU's dead side
        if use_fov_model:
            network.fov_model.head.layers[-1].bias.fill_(60.0)
    return network, DepthProImageProcessor(size={"height": 64, "width": 64})


def _saved(pair: tuple[Any, Any], folder: Path) -> Path:
    for part in pair:
        part.save_pretrained(folder)
    return folder


def _by_hand(pair: tuple[Any, Any], frame: Frame) -> dict[str, Any]:
    from PIL import Image

    network, processor = pair
    with torch.no_grad():
        outputs = network(**processor(images=Image.fromarray(frame.rgb), return_tensors="pt"))
    return processor.post_process_depth_estimation(outputs, target_sizes=[(HEIGHT, WIDTH)])[0]


def test_depth_anything_gives_disparity(frame: Frame, tmp_path: Path) -> None:
    pair = _anything()
    estimator = DepthAnything.from_folder_or_hub(str(_saved(pair, tmp_path)), "cpu")
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
    pair = _anything("metric")
    estimate = DepthAnything(*pair, device="cpu").estimate(frame)
    assert estimate.kind == "depth"
    np.testing.assert_allclose(estimate.values, 1000 * _by_hand(pair, frame)["predicted_depth"].numpy(), rtol=1e-4)


def test_depth_pro_with_its_own_focal_length(frame: Frame, tmp_path: Path) -> None:
    pair = _pro()
    estimator = DepthPro.from_folder_or_hub(str(_saved(pair, tmp_path)), "cpu", use_known_focal=False)
    estimate = estimator.estimate(frame)
    expected = _by_hand(pair, frame)
    assert estimate.kind == "depth"
    assert estimate.values.dtype == np.float32
    assert estimate.values.shape == (HEIGHT, WIDTH)
    assert np.isfinite(estimate.values).all()
    assert np.ptp(estimate.values) > 0
    np.testing.assert_allclose(estimate.values, 1000 * expected["predicted_depth"].numpy(), rtol=1e-4)
    assert estimate.focal_px == pytest.approx(float(expected["focal_length"]), rel=1e-5)
    np.testing.assert_array_equal(estimator.estimate(frame).values, estimate.values)


def test_depth_pro_scales_with_the_known_focal_length(frame: Frame) -> None:
    pair = _pro()
    own = DepthPro(*pair, device="cpu", use_known_focal=False).estimate(frame)
    known = DepthPro(*pair, device="cpu").estimate(frame)
    assert own.focal_px is not None
    assert known.focal_px == own.focal_px
    np.testing.assert_allclose(known.values, own.values * frame.camera.fx / own.focal_px, rtol=1e-4)


def test_depth_pro_without_a_field_of_view_needs_the_camera(frame: Frame) -> None:
    pair = _pro(use_fov_model=False)
    estimate = DepthPro(*pair, device="cpu").estimate(frame)
    assert estimate.focal_px is None
    canonical_depth = _by_hand(pair, frame)["predicted_depth"].numpy()
    # Without a field of view `transformers` leaves 1 / c as it is: f / W is still to be multiplied in.
    np.testing.assert_allclose(estimate.values, 1000 * canonical_depth * frame.camera.fx / WIDTH, rtol=1e-4)
    with pytest.raises(WeightsError, match="focal length"):
        DepthPro(*pair, device="cpu", use_known_focal=False)


def test_provenance_names_the_weights(tmp_path: Path) -> None:
    estimator = DepthAnything.from_folder_or_hub(str(_saved(_anything(), tmp_path)), "cpu")
    provenance = estimator.provenance()
    assert provenance["depth"] == "depth-anything"
    assert len(provenance["sha256 model.safetensors"]) == 64
    assert DepthPro(*_pro(), device="cpu").provenance()["focal"] == "camera"


@pytest.mark.parametrize("adapter", [DepthAnything, DepthPro])
def test_missing_weights_name_the_command(adapter: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path))
    with pytest.raises(WeightsError, match=rf"scopemap models pull {adapter.name}.*local folder"):
        adapter.from_folder_or_hub(device="cpu")
    with pytest.raises(WeightsError, match="scopemap models pull some/model"):
        adapter.from_folder_or_hub("some/model", "cpu")


def test_a_folder_of_another_model_is_refused(tmp_path: Path) -> None:
    _saved(_anything(), tmp_path)
    with pytest.raises(WeightsError, match="'depth_anything', but 'depth_pro' is needed"):
        DepthPro.from_folder_or_hub(str(tmp_path), "cpu")


def test_incomplete_and_broken_weights_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    folder = _saved(_anything(), tmp_path)
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


def test_the_hub_s_own_name_of_the_processor_loads(frame: Frame, tmp_path: Path) -> None:
    folder = _saved(_pro(), tmp_path)
    settings = folder / "preprocessor_config.json"
    content = json.loads(settings.read_text()) | {"image_processor_type": "DepthProImageProcessorFast"}
    settings.write_text(json.dumps(content))
    assert DepthPro.from_folder_or_hub(str(folder), "cpu").estimate(frame).values.shape == (HEIGHT, WIDTH)
