"""What the networks of the extra `networks` will cost a run on a CPU, in one sentence before it starts.

Measured at 400x320 to 1350x1080 px; networks have their own in `NETWORKS` and `FLOWS`. RAFT compares all pairs of
pixels of an eighth of the working size: a part of its time, and nearly all of its memory, grow with their square.
"""

from __future__ import annotations

from pathlib import Path

from scopemap.engine.config import Config
from scopemap.engine.flow.flows import FLOWS
from scopemap.engine.models.device import choose_device, cpu_threads
from scopemap.input.sequence import Sequence
from scopemap.runner.depth_networks import NETWORKS

# Seconds of one core of the perceptual distance and of the other stages, for each million pixels.
_PERCEPTUAL_S = {"lpips": 0.8}
_STAGES_S = 2.3
# GB: of Python with PyTorch and kernels, of the other stages for each million pixels, and of the correlations of one
# flow for each square of a million pixels: 4 bytes a pair, and a third for its pyramid.
_START_GB = 1.3
_STAGES_GB = 0.75
_FLOW_GB = 4 * 4 / 3 / 64**2 * 1e3


def network_cost(config: Config, sequence: Sequence) -> str:
    """Return about how much time and memory a run will need; "" without such networks, and with them on a GPU."""
    networks, mapis, depth = config.networks, config.mapis, config.depth
    refines = (mapis.blend, mapis.frame_scale) != ("none", "none")
    flows = [networks.flow] * (2 if mapis.consistency_px else 1) * refines + [networks.keyframe_flow] * 2
    anchor, every_frame = [depth.anchor] * (depth.anchor != depth.backend), [depth.backend]
    perceptual = [networks.perceptual] * refines
    of_depth = {name: network for name, network in NETWORKS.items() if network.has_weights}
    of_flow = {name: flow.seconds for name, flow in FLOWS.items() if flow.needs}
    used = {*flows, *anchor, *every_frame, *perceptual} & {*of_flow, *of_depth, *_PERCEPTUAL_S}
    if not used or choose_device(networks.device) != "cpu":
        return ""
    c, cores = sequence.camera, cpu_threads()
    mpx = c.width * c.height / 1e6
    frame_s = sum(a * mpx + b * mpx**2 for a, b in (of_flow[name] for name in flows if name in of_flow))
    frame_s += sum(of_depth[name].seconds for name in every_frame if name in of_depth) + _STAGES_S * mpx
    frame_s += sum(_PERCEPTUAL_S.get(name, 0.0) * mpx for name in perceptual)
    once_s = sum(of_depth[name].seconds for name in anchor if name in of_depth)
    gb = _START_GB + _STAGES_GB * mpx + _FLOW_GB * mpx**2 * any(name in of_flow for name in flows)
    gb += sum(of_depth[name].gigabytes for name in {*anchor, *every_frame} & of_depth.keys())
    frames = sequence.used_count
    all_s = "" if frames is None else f", {(once_s + frames * frame_s) / cores / 60:.0f} min for {frames} frames,"
    free_gb = _available_gb()
    free = "" if free_gb is None else f" of {free_gb:.1f} GB that are free"
    short = " That is not enough." if free_gb is not None and gb > free_gb else ""
    return (
        f"cost of {', '.join(sorted(used))} at {c.width}x{c.height} px on {cores} core(s): about "
        f"{frame_s / cores:.1f} s a frame{all_s} and {gb:.1f} GB of memory{free}.{short} A smaller --size costs less"
    )


def _available_gb() -> float | None:
    """Return the memory that a process could still take, GB; None where the system does not tell."""
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        return int(lines["MemAvailable"].split()[0]) / 1e6
    except (OSError, KeyError, ValueError):
        return None
