"""How long the rows of a benchmark will take on this machine, as `scopemap bench PLAN --dry-run` says it.

A short run of the packaged clip, in a process of its own as every row is, measures the machine: what a run takes once,
and a frame of the preset `default`. All else is in proportion to this: networks by the ratios below, pictures by their
pixels.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from scopemap.apps.demo.demo import CLIP, prepare_out
from scopemap.engine.config import Config
from scopemap.engine.flow.flows import FLOWS
from scopemap.runner.depth_networks import NETWORKS
from scopemap_bench.entry import Entry, worker_command
from scopemap_bench.plan import MethodPlan, ProtocolPlan, SequencePlan
from scopemap_bench.result import RunResult

# Seconds per frame of 400x320 px on two CPU cores of one machine, as half the CPU time; those of depth and flow are in
# `NETWORKS` and `FLOWS`. Only their ratios count.
_CORES = 2
_PERCEPTUAL_S = {"lpips": 0.05, "structure": 0.01}
_TRACKING_S = 0.2  # with reading, masks, fusion and the back end
_SCORING_S = 0.1
_SURFACE_S = 10.0  # a surface against the true one
_RENDERING_S = 1.0  # of a phantom
_PIXELS = 400 * 320
_MEASURED_FRAMES = 24


@dataclass(frozen=True)
class Pace:
    """How fast a machine is: what a run takes once, s, and its time over that of the machine of the ratios."""

    once_s: float
    ratio: float

    def rendering_s(self, frames: int, pixels: int) -> float:
        """Return the time that a phantom takes to be rendered."""
        return self.ratio * frames * pixels / _PIXELS * _RENDERING_S

    def seconds(self, config: Config | None, frames: int, pixels: int, *, surface: bool) -> float:
        """Return the time of a run and of its measures; `config` : None for a run that is only measured."""
        share = pixels / _PIXELS
        scored_s = frames * share * _SCORING_S + _SURFACE_S * surface
        if config is None:
            return self.once_s + self.ratio * scored_s
        anchor_s = _depth_s("depth-pro") if config.depth.anchor == "depth-pro" else 0.0
        return self.once_s + self.ratio * (scored_s + anchor_s + frames * _frame_s(config, share))


def _frame_s(config: Config, share: float) -> float:
    networks, mapis = config.networks, config.mapis
    by_pixels = _TRACKING_S + _flow_s(networks.keyframe_flow)
    if (mapis.blend, mapis.frame_scale) != ("none", "none"):
        by_pixels += _flow_s(networks.flow) + _PERCEPTUAL_S[networks.perceptual]
    return share * by_pixels + _depth_s(config.depth.backend)


def _flow_s(name: str) -> float:
    """Return the time of a flow both ways."""
    by_pixels, by_square = FLOWS[name].seconds if name in FLOWS else (0.0, 0.0)
    mpx = _PIXELS / 1e6
    return 2 * (by_pixels * mpx + by_square * mpx**2) / _CORES


def _depth_s(backend: str) -> float:
    """Return the time of a network, which sees pictures of a size of its own; files and two views: 0."""
    return NETWORKS[backend].seconds / _CORES if backend in NETWORKS else 0.0


def measured_pace() -> Pace:
    """Measure this machine, some 15 s."""
    with tempfile.TemporaryDirectory() as temporary:
        clip = prepare_out(Path(temporary), overwrite=False)
        sequence = SequencePlan(path=CLIP, frames=(0, _MEASURED_FRAMES))
        entry = Entry(
            sequence=sequence,
            method=MethodPlan(name="default"),
            protocol=ProtocolPlan(surface=False, depth=False),
            settings={},
            seed=0,
            data=clip,
            out=Path(temporary),
        )
        camera, command = entry.open().camera, worker_command(entry.save())
        started = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)  # noqa: S603 - this program
        passed_s = time.perf_counter() - started
        frame_s = RunResult.load(entry.folder).timing["ms_per_frame"] / 1e3
    once_s = max(passed_s - _MEASURED_FRAMES * frame_s, 0.0)
    return Pace(once_s, frame_s / _frame_s(Config(), camera.width * camera.height / _PIXELS))
