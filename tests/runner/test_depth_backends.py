"""The table of depth networks: a row is all that a run needs to know of one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.config import Config, DepthSettings
from scopemap.engine.depth.shading import ShadingDepth
from scopemap.engine.errors import SettingsError, WeightsError
from scopemap.runner.depth_backends import create_depth
from scopemap.runner.depth_networks import NETWORKS, DepthNetwork
from scopemap.runner.estimators import missing_weights
from scopemap.runner.network_cost import network_cost

CAMERA = PinholeCamera(60.0, 60.0, 39.5, 31.5, 80, 64)


def test_a_row_is_a_depth_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def create(question: Any) -> ShadingDepth:
        asked.append(question)
        return ShadingDepth(DepthSettings())

    monkeypatch.setitem(NETWORKS, "mine", DepthNetwork(create, has_weights=True, seconds=3.0, gigabytes=9.0))
    settings = DepthSettings(backend="mine")
    assert isinstance(create_depth(settings, Rectifier(CAMERA, CAMERA), "cpu", averaged=True), ShadingDepth)
    assert (asked[0].settings, asked[0].device, asked[0].averaged) == (settings, "cpu", True)
    config = Config.load(settings={"depth.backend": "mine", "networks.device": "cpu"})
    # Its weights are those of its name.
    with pytest.raises(WeightsError, match="unknown weights 'mine'"):
        missing_weights(config)
    sequence: Any = SimpleNamespace(camera=CAMERA, used_count=4)
    assert network_cost(config, sequence).startswith("cost of mine at 80x64 px")


def test_another_name_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(SettingsError, match="choose scopenet, shading, depth-anything, depth-pro or files:FOLDER"):
        create_depth(DepthSettings(backend="none"), Rectifier(CAMERA, CAMERA), "cpu")
