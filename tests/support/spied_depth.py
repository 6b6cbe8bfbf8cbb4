"""A depth estimator that keeps what it was asked, put into the runs of a test."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import pytest

from scopemap import Config
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.anchor import AnchoredDepth
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.estimators import Estimators
from scopemap.engine.frame import Frame
from scopemap.runner.estimators import create_estimators


class SpyDepth:
    """Asks another estimator, and keeps what it was asked."""

    def __init__(self, inner: Any, name: str = "spy", focal_px: float | None = None) -> None:
        self.inner, self.name, self.focal_px = inner, name, focal_px
        self.seen: list[Frame] = []
        self.threads: set[str] = set()
        self.fails_at: int | None = None
        self.error: Exception = RuntimeError("the network broke")

    def estimate(self, frame: Frame) -> DepthEstimate:
        self.seen.append(frame)
        self.threads.add(threading.current_thread().name)
        if len(self.seen) == self.fails_at:
            raise self.error
        return replace(self.inner.estimate(frame), focal_px=self.focal_px)

    def provenance(self) -> dict[str, str]:
        return {"depth": self.name}


def spied(monkeypatch: pytest.MonkeyPatch, anchor_too: bool = False, **spy: Any) -> list[SpyDepth]:
    """Put a spy into every run from here on, as its depth or as its anchor's reference; they appear in the list."""
    create, spies = create_estimators, []

    def spying(config: Config, sequence: Any, own: Any) -> Estimators:
        parts = create(config, sequence)
        if anchor_too:
            spies.append(SpyDepth(parts.anchor.reference, **spy))
            return replace(parts, anchor=AnchoredDepth(DepthSettings(anchor="depth-pro"), spies[-1]))
        spies.append(SpyDepth(parts.depth, **spy))
        return replace(parts, depth=spies[-1])

    monkeypatch.setattr("scopemap.runner.preparation.create_estimators", spying)
    return spies
