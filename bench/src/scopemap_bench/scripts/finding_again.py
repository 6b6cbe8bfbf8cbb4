"""How often do features find a frame again some frames later, by PnP with the depth of the first? Needs no truth.

    python -m scopemap_bench.scripts.finding_again --input VIDEO_OR_FOLDER [--frames 247] [--gaps 1 2 3 5 8] [--set
            KEY=VALUE ...]

Of all pairs of frames so far apart: the share in which PnP has at least 25 inliers, and the median of the inliers.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from scopemap.cli.options import parse_settings
from scopemap.config import Config
from scopemap.estimators import create_estimators
from scopemap.frame import Frame
from scopemap.io.opening import open_sequence
from scopemap.pipeline import Pipeline
from scopemap.tracking.alike import AlikeFeatures
from scopemap.tracking.features import FeatureDetector, SiftFeatures, relative_pose_pnp

ENOUGH, FEWEST = 25, 6
DETECTORS: tuple[tuple[str, FeatureDetector], ...] = (("RootSIFT", SiftFeatures()), ("ALIKE-t", AlikeFeatures()))


def inliers(frames: list[Frame], detector: FeatureDetector, gaps: list[int]) -> tuple[list[np.ndarray], float, float]:
    """Return the inliers of all pairs by gap, and milliseconds of the detection in a frame and of the PnP of a pair."""
    started = time.process_time()
    features = [detector.detect(frame) for frame in frames]
    detected = time.process_time()
    found = []
    for gap in gaps:
        pairs = zip(features, features[gap:], strict=False)
        poses = [relative_pose_pnp(one, other, frames[0].camera, FEWEST) for one, other in pairs]
        found.append(np.array([0 if pose is None else len(pose.pairs) for pose in poses]))
    ended = time.process_time()
    return found, 1e3 * (detected - started) / len(frames), 1e3 * (ended - detected) / sum(map(len, found))


def main(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--input", type=Path, required=True)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--gaps", type=int, nargs="+", default=[1, 2, 3, 5, 8])
    parser.add_argument("--set", dest="settings", action="append", default=[])
    options = parser.parse_args(arguments)
    config = Config.load(
        settings={"mapping.method": "none", "fusion.enabled": "false"} | parse_settings(options.settings)
    )
    sequence = open_sequence(options.input, frames=slice(0, options.frames))
    pipeline = Pipeline(config, create_estimators(config, sequence))
    frames = [pipeline.estimate(frame).frame for frame in sequence.frames()]
    size = f"{frames[0].camera.width}x{frames[0].camera.height} px"
    print(f"{options.input.name}, {len(frames)} frames, {size}: share of pairs with {ENOUGH} inliers, median inliers\n")
    print("| features |", *(f"gap {gap} |" for gap in options.gaps), "detection, ms | matching and PnP, ms |")
    print("|---|" + (len(options.gaps) + 2) * "---|")
    for name, detector in DETECTORS:
        found, detection_ms, pose_ms = inliers(frames, detector, options.gaps)
        cells = [f"{(some >= ENOUGH).mean():.2f}, {np.median(some):.0f}" for some in found]
        print("|", " | ".join([name, *cells, f"{detection_ms:.0f}", f"{pose_ms:.0f}"]), "|")


if __name__ == "__main__":
    main()
