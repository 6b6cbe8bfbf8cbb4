"""Where networks run."""

from __future__ import annotations

from scopemap.errors import SettingsError


def choose_device(device: str) -> str:
    """Return the torch device for a setting: "auto" is the first CUDA device if there is one, else the CPU.

    Raises `SettingsError` for a name that torch does not know or a device that is not there.
    """
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(device).type
    except RuntimeError:
        raise SettingsError(f"unknown device '{device}': use auto, cpu or cuda") from None
    if kind == "cuda" and not torch.cuda.is_available():
        raise SettingsError(f"device '{device}' was asked for but torch sees no CUDA device: use auto or cpu")
    return device
