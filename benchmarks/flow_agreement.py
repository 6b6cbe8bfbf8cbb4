"""How well do poses explain what optical flow sees? A check that needs no truth: any video, as tracked, frame by frame.

    python benchmarks/flow_agreement.py --input VIDEO_OR_FOLDER [--frames 60] [--set KEY=VALUE ...]

Points of each frame, lifted by its depth, are moved by the estimated motion to the next one and compared with where
flow finds them (px of the working size). Frames of which flow links less than a tenth are left out. Flow errs, too: it
is a witness, not the truth.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scopemap.cli.options import parse_settings
from scopemap.config import Config
from scopemap.estimators import create_estimators
from scopemap.geometry.se3 import inverse
from scopemap.geometry.warp import carried_points
from scopemap.io.opening import open_sequence
from scopemap.pipeline import Pipeline, Step
from scopemap.tracking.flow_pose import flow_error_px

LEAST_SHARE = 0.1
LIGHT = {"networks.flow": "dis", "networks.perceptual": "structure"}


class Agreement(NamedTuple):
    """Median over the frames of how far tissue moves, and of how far the poses are from that, px; counts of frames."""

    moved_px: float
    off_px: float
    compared: int
    by_flow: int
    lost: int
    frames: int


def measure(path: Path, frames: int, config: Config) -> Agreement:
    """Track a sequence and compare its poses with the flow."""
    sequence = open_sequence(path, frames=slice(0, frames))
    pipeline = Pipeline(config, create_estimators(config, sequence))
    moved, off, steps = [], [], []
    last: Step | None = None
    for frame in sequence.frames():
        percept = pipeline.perceive(frame)
        step = pipeline.step(percept)
        if last is not None and percept.link is not None and "lost" not in (step.track.status, last.track.status):
            link, camera = percept.link, frame.camera
            seen = carried_points(last.refined.depth_mm, link.to_previous, link.consistent, camera)
            if seen.share >= LEAST_SHARE:
                T_current_last = inverse(step.track.T_world_camera) @ last.track.T_world_camera
                moved.append(flow_error_px(seen, camera, np.eye(4)))
                off.append(flow_error_px(seen, camera, T_current_last))
        last = step
        steps.append(step.track)
    counts = (sum(track.reason == "flow decided" for track in steps), sum(track.status == "lost" for track in steps))
    medians = (float(np.median(values)) if values else float("nan") for values in (moved, off))
    return Agreement(*medians, len(off), *counts, len(steps))


def main(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--input", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--set", dest="settings", action="append", default=[])
    options = parser.parse_args(arguments)
    fixed = {"mapping.method": "none", "fusion.enabled": "false"}
    config = Config.load(settings=LIGHT | fixed | parse_settings(options.settings))
    found = measure(options.input, options.frames, config)
    print(
        f"{options.input.name}: tissue moves by {found.moved_px:.1f} px a frame, poses are {found.off_px:.2f} px from "
        f"that ({found.compared} pairs); of {found.frames} frames flow decided {found.by_flow}, {found.lost} were lost"
    )


if __name__ == "__main__":
    main()
