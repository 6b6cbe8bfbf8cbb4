"""Load a depth network of `transformers` from a folder, loudly where anything is amiss."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from scopemap.errors import WeightsError
from scopemap.io import weights
from scopemap.io.weights import REGISTRY

if TYPE_CHECKING:
    from transformers import PreTrainedModel


def load_pretrained(model_class: type[PreTrainedModel], model: str) -> tuple[Any, Any, dict[str, str]]:
    """Return the network, its image processor and where they came from.

    `model` is a local folder, a name of the weights registry or a hub id; the latter two must have been pulled: nothing
    is downloaded here, and only safetensors are read. Raises `WeightsError` if they are missing, damaged, of another
    model, or leave a parameter of the network unset.
    """
    import torch
    from safetensors import SafetensorError
    from transformers import AutoConfig, AutoImageProcessor

    untyped: Any = model_class
    folder = Path(model) if _is_local(model) else weights.locate(model)
    try:
        found = AutoConfig.from_pretrained(folder, local_files_only=True).model_type
        wanted = untyped.config_class.model_type
        if found != wanted:
            raise WeightsError(
                f"{folder} holds a model of type '{found}', but '{wanted}' is needed: name another folder"
            )
        processor = AutoImageProcessor.from_pretrained(folder, local_files_only=True)
        network, report = untyped.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, dtype=torch.float32, output_loading_info=True
        )
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise WeightsError(
            f"cannot load '{model}' from {folder}: {error}. Pull it again or name another folder"
        ) from error
    amiss = {kind: sorted(map(str, report[kind])) for kind in ("missing_keys", "mismatched_keys") if report[kind]}
    if amiss:
        raise WeightsError(f"the weights in {folder} do not fit the network: {amiss}. Pull them again")
    return network, processor, {"model": model, **_origin(folder, model)}


def _is_local(model: str) -> bool:
    """Return whether `model` is a folder; a name of the registry is never taken for a folder."""
    return model not in REGISTRY and Path(model).is_dir()


def _origin(folder: Path, model: str) -> dict[str, str]:
    """Return the commit, if the model was pulled, and the hash of each file of weights."""
    hashes = {f"sha256 {file.name}": weights.sha256_of(file) for file in sorted(folder.glob("*.safetensors"))}
    revision = "" if _is_local(model) else weights.recorded_revision(model)
    return ({"revision": revision} if revision else {}) | hashes
