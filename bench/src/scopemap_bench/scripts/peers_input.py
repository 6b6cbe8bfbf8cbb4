"""The baselines on the input that figures of theirs measured elsewhere were made with, to see that they agree.

    python -m scopemap_bench.scripts.peers_input --data FOLDER [--frames N]

FOLDER is the real data's (README, "Real data"). Input: cecum_t1_a rectified to 337x270 px with the camera below, no
mask, depth = 15.6 / (disparity / 255 + 0.156) mm. Printed: ATE after Sim(3), TLR, rotation since the first frame.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from scopemap import open_sequence, read_trajectory
from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.rectification import Rectifier
from scopemap.depth.files import depth_files
from scopemap.evaluation.poses import match, pose_report
from scopemap.frame import Frame
from scopemap.tracking.track import FrameTracker
from scopemap.trajectory.trajectory import Trajectory
from scopemap_bench.methods.method import BASELINES

CAMERA = PinholeCamera(200.58, 200.47, 167.0, 136.7, 337, 270)


def frames(clip: Path, count: int | None) -> Iterator[Frame]:
    """Yield the frames with their depth."""
    source = open_sequence(clip).source
    rectifier = Rectifier(source.camera, CAMERA)
    files = depth_files(clip.with_name(clip.name + "_depth_anything"))
    everywhere = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
    for item in source.frames(slice(count)):
        disparity = rectifier.smooth(cv2.imread(str(files[item.index]), cv2.IMREAD_GRAYSCALE).astype(np.float32))
        depth_mm = (15.6 / (disparity / 255 + 0.156)).astype(np.float32)
        yield Frame(item.index, item.time_s, rectifier.image(item.rgb), CAMERA, everywhere, depth_mm)


def tracked(clip: Path, count: int | None, tracker: FrameTracker) -> tuple[Trajectory, float]:
    """Return the trajectory of one odometry, and its milliseconds per frame."""
    rows, seconds = [], 0.0
    for frame in frames(clip, count):
        started = time.perf_counter()
        track = tracker.track(frame)
        if track.status != "lost" and tracker.needs_keyframe():
            tracker.insert_keyframe(replace(frame, T_world_camera=track.T_world_camera), measured=False)
        seconds += time.perf_counter() - started
        rows.append((frame.index, frame.time_s, track.T_world_camera, track.status))
    indices, times_s, poses, status = zip(*rows, strict=True)
    trajectory = Trajectory(np.array(indices), np.array(times_s), np.stack(poses), np.array(status))
    return trajectory, 1e3 * seconds / len(rows)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--frames", type=int)
    options = parser.parse_args()
    clip = options.data / "endoscopy/c3vd/cecum_t1_a"
    print("| method | ATE | TLR | rotation mean / max | tracking ms |\n|---|---|---|---|---|", flush=True)
    for name in sorted(set(BASELINES) - {"standing-still"}):
        trajectory, ms = tracked(clip, options.frames, BASELINES[name]())
        report = pose_report(match(trajectory, read_trajectory(clip), "sim3"))
        rotation = f"{report['rotation_unaligned_mean_deg']:.1f} / {report['rotation_unaligned_max_deg']:.1f}"
        print(f"| {name} | {report['ate_rmse_mm']:.2f} | {report['tlr']:.2f} | {rotation} | {ms:.0f} |", flush=True)


if __name__ == "__main__":
    main()
