"""Describes a plan before it is run: its sequences and rows, what is missing, and the hours that the rest takes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from scopemap.config import Config
from scopemap.errors import ScopemapError
from scopemap.estimators import missing_weights
from scopemap_bench.entry import Entry
from scopemap_bench.methods.method import PipelineMethod
from scopemap_bench.plan import Plan, spec_of
from scopemap_bench.runner import kept_result, method_of, planned, what_is_missing

# Seconds per frame at 400x320 px on two CPU cores: half the CPU time of random networks of full size, flow both ways.
_FLOW_S = {"dis": 0.02, "raft-small": 0.7, "raft-large": 2.6}
_DEPTH_S = {"scopenet": 0.05, "depth-anything": 1.1, "depth-pro": 100.0}
_PERCEPTUAL_S = {"lpips": 0.05, "structure": 0.01}
_TRACKING_S, _SCORING_S = 0.2, 0.1  # with reading, masks, fusion and the back end
_START_S = 20.0  # of a run: imports and kernels


def describe(plan: Plan, out: Path, data: Path | None = None) -> Iterator[str]:
    """Yield the lines that `scopemap bench PLAN --dry-run` prints; raises as `run_plan`, but writes nothing."""
    entries, notes = planned(plan, out, data)
    lengths = {entry.label: _frames(entry) for entry in entries}
    rows: defaultdict[str, list[str]] = defaultdict(list)
    hours: defaultdict[str, float] = defaultdict(float)
    lacking: set[str] = set()
    done = 0
    for entry in entries:
        if kept_result(entry) is not None:
            done += 1
        elif reason := what_is_missing(entry):
            rows[entry.method.name].append(reason)
            lacking |= set(missing_weights(config)) if (config := _config(entry)) else set()
        else:
            hours[entry.method.name] += _seconds(entry, lengths[entry.label]) / 3600
    yield f"{plan.title}: {len(lengths)} sequences, {sum(lengths.values())} frames, {len(plan.method)} methods"
    yield from (f"  {label}: {count} frames" for label, count in lengths.items())
    yield from (f"note: {note}" for note in notes)
    yield "rows:"
    for method in dict.fromkeys(entry.method.name for entry in entries):
        reasons = dict.fromkeys(rows[method])
        expected = [_duration(hours[method])] if method in hours else []
        yield f"  {method}: {'; '.join([*expected, *reasons]) or 'done'}"
    yield f"weights that are missing: {', '.join(sorted(lacking)) or 'none'}"
    waiting = sum(map(len, rows.values()))
    yield (
        f"{len(entries)} runs: {done} done, {waiting} missing, {len(entries) - done - waiting} to run in about "
        f"{_duration(sum(hours.values()))} on two CPU cores; networks take less on a GPU"
    )


def _duration(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.0f} min"


def _frames(entry: Entry) -> int:
    """Return the number of frames of an entry's sequence; 0 where its file does not state it."""
    if entry.sequence.phantom is not None:
        return spec_of(entry.sequence.phantom, entry.seed, entry.data).frames or 0
    try:
        return entry.open().count or 0
    except ScopemapError:  # the run reports it
        return 0


def _config(entry: Entry) -> Config | None:
    """Return the settings of an entry's run; None for an imported trajectory, and for a run that will fail."""
    method = method_of(entry)
    with suppress(ScopemapError):
        return method.config(entry.shared_settings()) if isinstance(method, PipelineMethod) else None
    return None


def _seconds(entry: Entry, frames: int) -> float:
    """Return the time that an entry takes, from its networks."""
    config = _config(entry)
    if config is None:
        return 0.0
    flow, networks, mapis = config.networks.flow, config.networks, config.mapis
    per_frame = _TRACKING_S + _SCORING_S + _DEPTH_S.get(config.depth.backend, 0.0)
    per_frame += _FLOW_S.get(networks.keyframe_flow, 0.0)
    if (mapis.constants.blend, mapis.constants.frame_scale) != ("none", "none"):
        per_frame += _FLOW_S.get(flow, 0.0) + _PERCEPTUAL_S[networks.perceptual]
    once = _START_S + (_DEPTH_S["depth-pro"] if config.depth.anchor == "depth-pro" else 0.0)
    return once + frames * per_frame
