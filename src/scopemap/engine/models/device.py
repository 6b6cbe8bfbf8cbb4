"""Where networks run, and what they need to be installed."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import TYPE_CHECKING

from scopemap.engine.errors import SettingsError

if TYPE_CHECKING:
    import onnxruntime


_CUDA = "CUDAExecutionProvider"  # ONNX Runtime's name


def cpu_threads() -> int:
    """Return how many threads a network gets on the CPU: OMP_NUM_THREADS, else the cores that this process may use."""
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    if wanted.isdecimal() and int(wanted):
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def open_network(content: bytes, threads: int = 0, device: str = "auto") -> onnxruntime.InferenceSession:
    """Return the session of an ONNX graph; raises what the runtime raises.

    threads : on the CPU; 0: one a core. device : "auto": the first CUDA device where the runtime finds one, else the
    CPU; "cuda", "cuda:N": there, or `SettingsError`; others are torch's alone, and the graph runs on the CPU.
    """
    import onnxruntime

    kind, _, number = device.partition(":")
    providers: list[str | tuple[str, dict[str, str]]] = ["CPUExecutionProvider"]
    has_cuda = _CUDA in onnxruntime.get_available_providers()
    if kind == "cuda" and not has_cuda:
        raise SettingsError(_without_cuda(device, "this build of ONNX Runtime has no CUDA"))
    if has_cuda and kind in ("auto", "cuda"):
        providers.insert(0, (_CUDA, {"device_id": number or "0"}))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or cpu_threads()
    # Threads that wait must sleep: the tracker needs the cores.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.enable_cpu_mem_arena = False  # which keeps the most that was ever needed: 50 MB, and saves no time
    options.log_severity_level = 4  # what is wrong is raised, not printed
    session = onnxruntime.InferenceSession(content, options, providers=providers)
    # The runtime goes on with the CPU, without a word, where CUDA's libraries or the device are missing.
    if kind == "cuda" and _CUDA not in session.get_providers():
        raise SettingsError(_without_cuda(device, "ONNX Runtime cannot use CUDA: libraries or device are missing"))
    return session


def runtime_of(session: onnxruntime.InferenceSession) -> str:
    """Return the runtime of an ONNX graph, its version, and CUDA where it runs there, as provenance has it."""
    import onnxruntime

    return f"onnxruntime {onnxruntime.__version__}" + (", CUDA" if _CUDA in session.get_providers() else "")


def _without_cuda(device: str, reason: str) -> str:
    return (
        f"device '{device}' was asked for, but {reason}: install onnxruntime-gpu in place of onnxruntime, or use auto, "
        "by which each network runs where it can"
    )


def missing_packages(what: str, *packages: str) -> str:
    """Return which of the packages that `what` needs are not installed and how to install them; "" where all are.

    what : "" for words that begin with "needs".
    """
    missing = [package for package in packages if find_spec(package) is None]
    install = "pip install -c constraints.txt -e '.[networks]'"
    return f"{what} needs {' and '.join(missing)}: {install}".lstrip() if missing else ""


def need_packages(what: str, *packages: str) -> None:
    """Raise `SettingsError` where one of the packages that `what` needs is not installed."""
    if fault := missing_packages(what, *packages):
        raise SettingsError(fault)


def choose_device(device: str) -> str:
    """Return the torch device for a setting, "auto": the first CUDA device, else the CPU; raises `SettingsError`."""
    if device == "cpu":
        return device
    if device != "auto":
        need_packages(f"the device '{device}' (networks.device)", "torch")
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(device).type
    except RuntimeError:
        raise SettingsError(f"unknown device '{device}': use auto, cpu or cuda") from None
    if kind == "cuda" and not torch.cuda.is_available():
        raise SettingsError(f"device '{device}' was asked for but torch sees no CUDA device: use auto or cpu")
    backend = getattr(torch, kind, None)
    if kind in ("mps", "xpu") and not (backend is not None and backend.is_available()):
        raise SettingsError(f"device '{device}' was asked for but torch sees none: use auto or cpu")
    return device
