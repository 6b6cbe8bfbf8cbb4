"""Depth networks of `transformers`: loaded from a folder, with an error where anything does not fit, and applied."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scopemap.engine.errors import WeightsError
from scopemap.engine.frame import Frame
from scopemap.engine.models import weights
from scopemap.engine.models.device import choose_device, need_packages
from scopemap.engine.models.weights import REGISTRY

if TYPE_CHECKING:
    from transformers import BaseImageProcessor, PreTrainedModel

PACKAGES = ("torch", "torchvision", "transformers", "safetensors")
MM_PER_M = 1000.0  # a unit


class PretrainedNetwork:
    """A network and its image processor. origin : as `load_pretrained` returns it."""

    name = ""

    def __init__(
        self,
        network: PreTrainedModel,
        processor: BaseImageProcessor,
        *,
        device: str = "auto",
        origin: dict[str, str] | None = None,
    ) -> None:
        self._device = choose_device(device)
        untyped: Any = network
        self._network: Any = untyped.to(self._device).eval()
        self._processor: Any = processor
        self._origin = origin or {}

    def _answer(self, rgb: np.ndarray) -> Any:
        """Return the network's outputs for a picture (H, W, 3) uint8."""
        import torch

        inputs = self._processor(images=rgb, input_data_format="channels_last", return_tensors="pt")
        with torch.inference_mode():
            return self._network(inputs["pixel_values"].to(self._device))

    def _values(self, outputs: Any, frame: Frame) -> np.ndarray:
        """Return the outputs' depth or disparity, (H, W) float32, at the frame's size."""
        size = (frame.camera.height, frame.camera.width)
        result = self._processor.post_process_depth_estimation(outputs, target_sizes=[size])[0]
        values: np.ndarray = result["predicted_depth"].float().cpu().numpy()
        return values

    def release(self) -> None:
        """Free the network's memory; nothing can be estimated any more."""
        self._network = None

    def provenance(self) -> dict[str, str]:
        """Return the name, the model, its commit if it was pulled, and the hashes of its weights."""
        return {"depth": self.name, **self._origin}


def load_pretrained(class_name: str, model: str, name: str) -> tuple[Any, Any, dict[str, str]]:
    """Return a network, its image processor and where they came from.

    class_name : of the network in `transformers`. model : a local folder, a name of the weights registry or a hub id;
    "": `name`, that of the estimator. The latter two must have been pulled: nothing is downloaded, and only safetensors
    are read. Raises `WeightsError` if they are missing, damaged, of another model, or leave a parameter unset.
    """
    need_packages(f"depth by {name}", *PACKAGES)
    import torch
    import transformers
    from safetensors import SafetensorError

    model, model_class = model or name, getattr(transformers, class_name)
    folder = Path(model) if _is_local(model) else weights.locate(model)
    try:
        found = transformers.AutoConfig.from_pretrained(folder, local_files_only=True).model_type
        wanted = model_class.config_class.model_type
        if found != wanted:
            raise WeightsError(
                f"{folder} holds a model of type '{found}', but '{wanted}' is needed: name another folder"
            )
        processor = transformers.AutoImageProcessor.from_pretrained(folder, local_files_only=True)
        network, report = model_class.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, dtype=torch.float32, output_loading_info=True
        )
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise WeightsError(
            f"cannot load '{model}' from {folder}: {error}. Pull it again or name another folder"
        ) from error
    unfit = {kind: sorted(map(str, report[kind])) for kind in ("missing_keys", "mismatched_keys") if report[kind]}
    if unfit:
        raise WeightsError(f"the weights in {folder} do not fit the network: {unfit}. Pull them again")
    revision = "" if _is_local(model) else weights.recorded_revision(model)
    hashes = {f"sha256 {file.name}": weights.sha256_of(file) for file in sorted(folder.glob("*.safetensors"))}
    origin = {"model": model, "revision": revision} if revision else {"model": model}
    return network, processor, origin | hashes


def _is_local(model: str) -> bool:
    """Return whether `model` is a folder; a name of the registry is never taken for a folder."""
    return model not in REGISTRY and Path(model).is_dir()
