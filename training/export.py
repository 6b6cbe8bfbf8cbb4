"""From a trained network to the file that the package ships: float16, with what it was made from."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save_file

from scopemap.depth.scopenet.network import ScopeNet


def export(network: ScopeNet, file: Path, facts: dict[str, str]) -> None:
    """Write the weights (float16 safetensors) and `facts` in the file's header."""
    tensors = {
        name: (value.half() if torch.is_floating_point(value) else value).contiguous()
        for name, value in network.state_dict().items()
    }
    save_file(tensors, file, metadata=facts)
