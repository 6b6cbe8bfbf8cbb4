"""How well do poses explain what optical flow sees? A check that needs no truth: any video, as tracked, frame by frame.

    python -m scopemap_bench.scripts.flow_agreement --input VIDEO_OR_FOLDER [--frames 60] [--set KEY=VALUE ...]

Points of each frame, lifted by its depth, are moved by the estimated motion to the next one and compared with where
flow finds them (px of the working size). Frames of which flow links less than a tenth are left out. Flow errs, too: it
is a witness, not the truth.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.cli.options import parse_settings
from scopemap.config import Config
from scopemap.depth.mapis import DenseCorrespondence
from scopemap.estimators import create_estimators
from scopemap.geometry.se3 import inverse, transform
from scopemap.io.opening import open_sequence
from scopemap.odometry import Step
from scopemap.pipeline import Pipeline
from scopemap.tracking.track import FrameTracker

LEAST_SHARE = 0.1


class Agreement(NamedTuple):
    """Median over the frames of how far tissue moves, and of how far the poses are from that, px; counts of frames."""

    moved_px: float
    off_px: float
    compared: int
    lost: int
    frames: int


def measure(path: Path, frames: int, config: Config, tracker: FrameTracker | None = None) -> Agreement:
    """Track a sequence and compare its poses with the flow."""
    sequence = open_sequence(path, frames=slice(0, frames))
    pipeline = Pipeline(config, create_estimators(config, sequence), tracker=tracker)
    moved, off, lost = [], [], []
    last: Step | None = None
    for frame in sequence.frames():
        preprocessed = pipeline.preprocess(frame)
        step = pipeline.step(preprocessed)
        if (
            last is not None
            and preprocessed.correspondence is not None
            and "lost" not in (step.track.status, last.track.status)
        ):
            # Flow and refined depth are of the size of the depth estimate.
            camera = preprocessed.small.camera
            points_mm, pixels = observed(last, preprocessed.correspondence, camera)
            if len(pixels) >= LEAST_SHARE * preprocessed.small.valid.size:
                T_current_last = inverse(step.track.T_world_camera) @ last.track.T_world_camera
                for errors, T in ((moved, np.eye(4)), (off, T_current_last)):
                    projected = camera.project(transform(T, points_mm))
                    error_px = float(np.median(np.linalg.norm(projected - pixels, axis=1)))
                    errors.append(error_px * frame.camera.width / camera.width)
        last = step
        lost.append(step.track.status == "lost")
    medians = (float(np.median(values)) if values else float("nan") for values in (moved, off))
    return Agreement(*medians, len(off), sum(lost), len(lost))


def observed(last: Step, link: DenseCorrespondence, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) of the last frame, mm, and the pixels (N, 2) of the current frame where flow finds them.

    camera : of the size of the flow.
    """
    rows, columns = np.nonzero(link.consistent)
    pixels = np.column_stack([columns, rows])
    there = pixels + link.to_previous[rows, columns]
    depth_mm = last.refined.depth_mm
    nearest = np.clip(np.rint(there), 0, [camera.width - 1, camera.height - 1]).astype(int)
    found_mm = depth_mm[nearest[:, 1], nearest[:, 0]]
    known = np.isfinite(found_mm)
    return camera.unproject(there[known]) * found_mm[known, None], pixels[known]


def main(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--input", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--set", dest="settings", action="append", default=[])
    options = parser.parse_args(arguments)
    fixed = {"mapping.method": "none", "fusion.enabled": "false"}
    config = Config.load(settings=fixed | parse_settings(options.settings))
    found = measure(options.input, options.frames, config)
    print(
        f"{options.input.name}: tissue moves by {found.moved_px:.1f} px a frame, poses are {found.off_px:.2f} px from "
        f"that ({found.compared} pairs); of {found.frames} frames {found.lost} were lost"
    )


if __name__ == "__main__":
    main()
