"""Small randomly initialised networks of the real classes of `transformers`, and their folders as a user has them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

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

from scopemap.engine.models.weights import REGISTRY

_VIT = {
    "model_type": "dinov2",
    "hidden_size": 8,
    "num_attention_heads": 2,
    "intermediate_size": 16,
}


def small_depth_anything(kind: str = "relative") -> tuple[Any, Any]:
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


def small_depth_pro(use_fov_model: bool = True, inverse_depth: float = 1000.0) -> tuple[Any, Any]:
    """Return a network that sees a field of view of about 60 deg, at canonical inverse depth about `inverse_depth`."""
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
        # Keeps the untrained output off the ReLU's dead side.
        network.head.layers[-2].bias.fill_(inverse_depth)
        if use_fov_model:
            network.fov_model.head.layers[-1].bias.fill_(60.0)
    return network, DepthProImageProcessor(size={"height": 64, "width": 64})


def saved(pair: tuple[Any, Any], folder: Path) -> Path:
    """Save a network and its image processor as `transformers` does, and return the folder."""
    for part in pair:
        part.save_pretrained(folder)
    return folder


def write_weights(folder: Path) -> Path:
    """Write weights for every network of the presets "paper" and "paper-strict"; `use_weights` lets them be found.

    Disparity is 1 +- some tenths, metric depth some 25 mm: a scene of which something is known.
    """
    from torchvision.models import alexnet
    from torchvision.models.optical_flow import raft_large

    anything, pro = small_depth_anything(), small_depth_pro(inverse_depth=20.0)
    with torch.no_grad():
        anything[0].head.conv3.weight.mul_(1e7)
        pro[0].head.layers[-2].weight.mul_(0.02)
    for place in ("depth-anything", "LiheYoung--depth-anything-small-hf"):
        saved(anything, folder / place)
    saved(pro, folder / "depth-pro")
    torch.manual_seed(9)
    torch.save(raft_large().state_dict(), folder / REGISTRY["raft-large"].place)
    features = {name: tensor for name, tensor in alexnet().state_dict().items() if name.startswith("features.")}
    torch.save(features, folder / REGISTRY["alexnet"].place)
    return folder


def use_weights(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make `folder` the folder of weights, of whatever hash."""
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(folder))
    for name in ("depth-anything", "depth-pro", "raft-large", "alexnet"):
        place = folder / REGISTRY[name].place
        found = sorted(place.iterdir()) if place.is_dir() else [place]
        files = {file.relative_to(folder).as_posix(): "" for file in found}
        monkeypatch.setitem(REGISTRY, name, replace(REGISTRY[name], files=files))
