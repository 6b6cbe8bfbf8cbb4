"""The table of optical flow estimators. Nothing is loaded of one that is not created: the help of commands reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from scopemap.engine.errors import SettingsError

if TYPE_CHECKING:
    from scopemap.engine.flow.estimator import FlowEstimator


@dataclass(frozen=True)
class FlowModel:
    """An optical flow, a row of `FLOWS`.

    create : returns the estimator, on a device; imports it. words : about it, in the help of `--flow`. needs : returns
    the packages of a network, and its weights, of which any will do; None: no network. seconds : of one core for one
    flow, for each million pixels and each square of that.
    """

    create: Callable[[str], FlowEstimator]
    words: str = ""
    needs: Callable[[], tuple[tuple[str, ...], tuple[str, ...]]] | None = None
    seconds: tuple[float, float] = (0.0, 0.0)


def create_flow(name: str, device: str = "auto") -> FlowEstimator:
    """Return the estimator `name`, of `FLOWS`; raises `SettingsError`, `WeightsError` without a network's weights."""
    if (flow := FLOWS.get(name)) is None:
        raise SettingsError(f"unknown flow '{name}': choose one of {', '.join(FLOWS)}")
    return flow.create(device)


def flows_in_words() -> str:
    """Return the names of the estimators, with what there is to say of them."""
    return ", ".join(f"{name} ({flow.words})" if flow.words else name for name, flow in FLOWS.items())


def _dis(_: str) -> FlowEstimator:
    from scopemap.engine.flow.dis import DisFlow

    return DisFlow()


def _none(_: str) -> FlowEstimator:
    from scopemap.engine.flow.estimator import NoFlow

    return NoFlow()


def _raft(size: Literal["small", "large"], seconds: tuple[float, float]) -> FlowModel:
    def create(device: str) -> FlowEstimator:
        from scopemap.engine.flow.raft import RaftFlow

        return RaftFlow(size, device=device)

    def needs() -> tuple[tuple[str, ...], tuple[str, ...]]:
        from scopemap.engine.flow.raft import CHECKPOINTS, PACKAGES

        return PACKAGES, CHECKPOINTS[size]

    return FlowModel(create, "needs the extra networks", needs, seconds)


FLOWS = {
    "dis": FlowModel(_dis, "default", seconds=(0.16, 0.0)),
    "raft-small": _raft("small", (7.5, 2.0)),
    "raft-large": _raft("large", (26.0, 10.5)),
    "none": FlowModel(_none),
}
"""What `networks.flow` may name. Seconds: measured at 400x320 to 1350x1080 px."""
