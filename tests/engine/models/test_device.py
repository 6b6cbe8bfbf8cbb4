"""Where the networks of the package run: which provider is asked for, and what is said where it is missing."""

from __future__ import annotations

from importlib import resources
from typing import Any

import onnxruntime
import pytest

from scopemap.engine.errors import SettingsError
from scopemap.engine.models.device import open_network, runtime_of

GRAPH = (resources.files("scopemap.engine.tracking") / "alike.onnx").read_bytes()
CPU, CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"


class Session:
    """A session that has the providers that it is asked for, without those in `broken`."""

    broken: tuple[str, ...] = ()

    def __init__(self, content: bytes, options: Any, providers: list[Any]) -> None:
        assert content == GRAPH
        self.asked = providers

    def get_providers(self) -> list[str]:
        names = [one if isinstance(one, str) else one[0] for one in self.asked]
        return [name for name in names if name not in self.broken]


@pytest.fixture
def with_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [CUDA, CPU])
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)


@pytest.mark.usefixtures("with_cuda")
@pytest.mark.parametrize(
    ("device", "asked"),
    [
        ("auto", [(CUDA, {"device_id": "0"}), CPU]),
        ("cuda", [(CUDA, {"device_id": "0"}), CPU]),
        ("cuda:1", [(CUDA, {"device_id": "1"}), CPU]),
        ("cpu", [CPU]),
        ("mps", [CPU]),
    ],
)
def test_cuda_is_asked_for_where_the_runtime_has_it(device: str, asked: list[Any]) -> None:
    session: Any = open_network(GRAPH, device=device)
    assert session.asked == asked
    assert runtime_of(session).endswith(", CUDA") == (len(asked) == 2)


@pytest.mark.usefixtures("with_cuda")
def test_a_provider_that_does_not_load_is_no_fault_unless_it_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Session, "broken", (CUDA,))
    assert not runtime_of(open_network(GRAPH, device="auto")).endswith("CUDA")
    with pytest.raises(SettingsError, match="'cuda' was asked for, but ONNX Runtime cannot use CUDA: libraries"):
        open_network(GRAPH, device="cuda")


def test_a_build_without_cuda_runs_on_the_cpu_and_says_so_where_cuda_was_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [CPU])
    assert open_network(GRAPH, device="auto").get_providers() == [CPU]
    with pytest.raises(SettingsError, match=r"build of ONNX Runtime has no CUDA: install onnxruntime-gpu .* use auto"):
        open_network(GRAPH, device="cuda:0")
