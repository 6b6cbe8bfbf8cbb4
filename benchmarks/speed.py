"""What each part costs per frame, one part after the other, nothing in parallel.

    python benchmarks/speed.py [--input PATH] [--frames N] [--set KEY=VALUE ...]

Without an input a colon phantom of 337x270 px is rendered first. Prints median milliseconds per frame and the ratio to
one DIS flow pair in the same run: machines differ and are shared, ratios travel better. The embedded depth network is
timed on the same frames at 320x256 px, whichever depth the run uses, on one thread and on two.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.cli.options import parse_settings
from scopemap.config import Config
from scopemap.estimators import create_estimators
from scopemap.flow.dis import DisFlow
from scopemap.flow.estimator import pair_flow
from scopemap.fusion.volume import TsdfVolume
from scopemap.io.opening import open_sequence
from scopemap.mapping.submaps import corrected_frame
from scopemap.phantom.spec import PhantomSpec
from scopemap.phantom.writer import write_phantom
from scopemap.pipeline import Pipeline

PHANTOM = PhantomSpec(scene="colon", frames=60, width=337, height=270, seed=0)
NETWORK_SIZE = (320, 256)
WARM_UP = 5  # frames that compile, load and fill caches


def timed(method: Callable[..., Any], part: str, seconds: dict[str, list[float]]) -> Callable[..., Any]:
    """Return the method with its running time noted under `part`."""

    def run(*arguments: Any, **options: Any) -> Any:
        started = time.perf_counter()
        try:
            return method(*arguments, **options)
        finally:
            seconds[part].append(time.perf_counter() - started)

    return run


def measure(path: Path, frames: int, config: Config) -> tuple[dict[str, float], tuple[int, int]]:
    """Return milliseconds per frame of each part, and the working size."""
    sequence = open_sequence(path, frames=slice(0, frames))
    pipeline, seconds = Pipeline(config, create_estimators(config, sequence)), defaultdict(list)
    parts = {
        "overlays, in mask": (pipeline._masker, "_overlays"),
        "mask": (pipeline, "_masker"),
        "depth estimate": (pipeline.estimators.depth, "estimate"),
        "flow, perceptual distance": (pipeline._matcher, "match"),
        "track": (pipeline._tracker, "track"),
        "keyframe": (pipeline._tracker, "insert_keyframe"),
        "MAPIS": (pipeline._mapis, "refine"),
        "store": (pipeline.fusion, "put"),
        "fuse": (TsdfVolume, "integrate"),
    }
    if config.mapping.method == "full":
        parts["back end"] = (pipeline._mapper, "submaps")
    for part, (owner, name) in parts.items():
        setattr(owner, name, timed(getattr(owner, name), part, seconds))
    previous = None
    for frame, _ in sequence:
        pipeline.step(pipeline.preprocess(frame))
        if previous is not None:
            timed(pair_flow, "DIS", seconds)(DisFlow(), previous, frame.rgb, 1.0)
        previous = frame.rgb
    submap = pipeline.mapper.submaps()[0][0]
    stored = pipeline.fusion.store.frames(submap.frames)
    frames = (corrected_frame(frame, submap.correction) for frame in stored)
    pipeline.fusion.fuse(frames, submap.main_frames)
    seldom = ("keyframe", "back end")
    per_frame = {part: 1e3 * float(np.median(t[WARM_UP:])) for part, t in seconds.items() if part not in seldom}
    # What does not happen at every frame is spread over all.
    per_frame |= {part: 1e3 * sum(seconds[part]) / len(seconds["track"]) for part in seldom if part in seconds}
    return per_frame, (sequence.camera.width, sequence.camera.height)


def measure_network(path: Path, frames: int, model: str) -> dict[str, float]:
    """Return milliseconds per frame of the embedded depth network on the CPU, by threads; `model` as in Config."""
    from scopemap.depth.scopenet.estimator import ScopeNetDepth

    images = [frame for frame, _ in open_sequence(path, size=NETWORK_SIZE, frames=slice(0, frames))]
    seconds: dict[str, list[float]] = defaultdict(list)
    for threads, words in ((1, "1 thread"), (2, "2 threads")):
        network = ScopeNetDepth(model, threads=threads)
        for frame in images:
            timed(network.estimate, f"depth scopenet {NETWORK_SIZE[0]}x{NETWORK_SIZE[1]}, {words}", seconds)(frame)
    return {part: 1e3 * float(np.median(values[WARM_UP:])) for part, values in seconds.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--input", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--set", dest="settings", action="append", default=[])
    options = parser.parse_args()
    config = Config.load(settings=parse_settings(options.settings))
    with tempfile.TemporaryDirectory() as folder:
        if options.input is None:
            write_phantom(PHANTOM, Path(folder))
        per_frame, (width, height) = measure(options.input or Path(folder), options.frames, config)
        model = config.depth.model if config.depth.backend == "scopenet" else ""
        network = measure_network(options.input or Path(folder), options.frames, model)
    unit = per_frame.pop("DIS")
    counted = ("track", "keyframe", "MAPIS", "store", "fuse")
    both = sum(per_frame.get(part, 0.0) for part in counted)
    print(f"{width}x{height} px, median per frame; one DIS flow pair with its check: {unit:.1f} ms\n")
    print("| part | ms | in DIS pairs |\n|---|---|---|")
    for part, ms in [*per_frame.items(), ("**track + keyframe + MAPIS + store + fuse**", both), *network.items()]:
        print(f"| {part} | {ms:.1f} | {ms / unit:.2f} |")


if __name__ == "__main__":
    main()
