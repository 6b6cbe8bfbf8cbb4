"""A row of the table of flows is all that creating, refusing and describing one needs."""

from __future__ import annotations

import pytest

from scopemap.engine.config import Config
from scopemap.engine.errors import SettingsError
from scopemap.engine.flow.estimator import FlowEstimator, NoFlow
from scopemap.engine.flow.flows import FLOWS, FlowModel, create_flow, flows_in_words
from scopemap.runner.estimators import missing_packages


def test_a_row_is_a_flow(monkeypatch: pytest.MonkeyPatch) -> None:
    devices: list[str] = []

    def create(device: str) -> FlowEstimator:
        devices.append(device)
        return NoFlow()

    needs = (("no_such_package",), ("mine",))
    monkeypatch.setitem(FLOWS, "mine", FlowModel(create, "on trial", lambda: needs, (1.0, 2.0)))
    assert isinstance(create_flow("mine", "cpu"), NoFlow)
    assert devices == ["cpu"]
    assert flows_in_words().endswith("none, mine (on trial)")
    assert "no_such_package" in missing_packages(Config.load(settings={"networks.flow": "mine"}))


def test_another_name_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(SettingsError, match="choose one of dis, raft-small, raft-large, none"):
        create_flow("optical")
