"""Frames until poses are contradicted: true, standing still, jumping, growing and missing ones on a known scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.config import MaskSettings
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import se3_exp, so3_exp
from scopemap.engine.masking.masker import Masker
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence
from scopemap_bench.evaluation.failure import FailureMeter
from scopemap_bench.plan import ProtocolPlan
from scopemap_bench.scoring import score
from tests.support import plane_scene
from tests.support.drawn_benchmarks import as_scared, seen
from tests.support.plane_scene import CAMERA, EVERYWHERE
from tests.support.sample_trajectories import as_trajectory, write_c3vd, write_run
from tests.support.tiny_phantom import write_tiny

FRAMES, AT = 16, 8
TRUTH = [
    plane_scene.pose(at_mm=(8 * np.sin(0.15 * n), 0.8 * n, 0.3 * n), turn_rad=(0.004 * n, 0.0, 0.0))
    for n in range(FRAMES)
]
VIEWS = [plane_scene.see(pose).rgb for pose in TRUTH]
SLOW_PX = np.concatenate([0.15 * np.arange(60), 9 + 0.4 * np.arange(30)])
Change = Callable[[int, np.ndarray], np.ndarray | None]


def grown(number: int, pose: np.ndarray) -> np.ndarray:
    """Steps are eight times as long from `AT` on."""
    found = pose.copy()
    found[:3, 3] += 7 * (pose[:3, 3] - TRUTH[AT][:3, 3]) * (number > AT)
    return found


CHANGES: dict[str, tuple[Change, int, int]] = {
    "true": (lambda _, pose: pose, FRAMES, FRAMES),
    "in another world": (
        lambda _, pose: Similarity(2.3, so3_exp(np.array([0.3, -1, 0.4])), np.ones(3)).transform_poses(pose),
        FRAMES,
        FRAMES,
    ),
    "standing still": (lambda *_: np.eye(4), 1, 8),
    "a jump of 6 degrees": (lambda n, pose: pose @ se3_exp(np.array([0, 0.1, 0, 0, 0, 0.0]) * (n >= AT)), AT, AT),
    "growing": (grown, AT, AT + 4),
    "missing": (lambda n, pose: None if n >= AT else pose, AT, AT),
    "missing at first": (lambda n, pose: pose if n > 5 else None, 0, 0),
    "every third alone": (lambda n, pose: pose if n % 3 == 0 else None, 1, 1),
    "every second alone": (lambda n, pose: pose if n % 2 else None, 0, 0),
    "every third, and wrong": (
        lambda n, pose: pose @ se3_exp(np.array([3.0 * n, 0, 0, 0, 0.3 * n, 0.0])) if n % 3 == 0 else None,
        1,
        1,
    ),
    "never": (lambda *_: None, 0, 0),
    "missing twice": (lambda n, pose: None if n in (AT, AT + 1) else pose, FRAMES, FRAMES),
}


@pytest.mark.parametrize("name", CHANGES)
def test_frames_until_poses_are_contradicted(name: str) -> None:
    change, least, most = CHANGES[name]
    meter = FailureMeter(CAMERA)
    for number, (rgb, pose) in enumerate(zip(VIEWS, TRUTH, strict=True)):
        meter.add(rgb, EVERYWHERE, change(number, pose))
    figures = meter.figures()
    assert least <= figures["frames_until_contradicted"] <= most
    assert figures["frames_until_contradicted_at_3_px"] == figures["frames_until_contradicted"]
    counts = [figures[f"frames_until_contradicted_at_{limit}_px"] for limit in (1, 2, 4, 8)]
    assert counts == sorted(counts)


@pytest.mark.slow
def test_standing_still_is_contradicted_in_a_slow_clip() -> None:
    """Flow over five frames stays below the limit: what has moved since an earlier frame tells."""
    path = [plane_scene.pose(at_mm=(plane_scene.SIX_PIXELS_MM / 6 * x, 0, 0)) for x in SLOW_PX]
    counts = {}
    for name, poses in {"true": path, "standing still": [np.eye(4)] * len(path)}.items():
        meter = FailureMeter(CAMERA)
        for pose, true in zip(poses, path, strict=True):
            meter.add(plane_scene.see(true).rgb, EVERYWHERE, pose)
        counts[name] = meter.figures()["frames_until_contradicted"]
        assert meter.is_contradicted == (name == "standing still")
    assert counts["true"] == len(path)
    assert counts["standing still"] < 40


def test_pictures_that_tell_nothing_contradict_nothing() -> None:
    meter, grey = FailureMeter(CAMERA), np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
    for pose in TRUTH:
        meter.add(grey, ~EVERYWHERE, pose)
    assert meter.figures()["frames_until_contradicted"] == FRAMES


@pytest.mark.parametrize("holds_still", [True, False])
def test_a_clip_that_contradicts_the_true_poses_counts_nobody(holds_still: bool, tmp_path: Path) -> None:
    """True poses that stand still before a picture that moves, and those that the pictures were seen from."""
    truth = np.stack([np.eye(4)] * FRAMES if holds_still else TRUTH)
    clip = write_c3vd(tmp_path / "clip", truth)
    for number, rgb in enumerate(VIEWS):
        cv2.imwrite(str(clip / f"{number:04d}_color.png"), rgb[..., ::-1])
    sides = f"fx: {CAMERA.fx}\nfy: {CAMERA.fy}\ncx: {CAMERA.cx}\ncy: {CAMERA.cy}\n"
    (clip / "camera.yaml").write_text(f"{sides}width: {CAMERA.width}\nheight: {CAMERA.height}\n")
    sequence = open_sequence(clip, dataset="c3vd", size=(CAMERA.width, CAMERA.height))
    run = write_run(tmp_path / "run", as_trajectory(np.stack(TRUTH)))
    poses = score(run, sequence, ProtocolPlan(contradiction=True, align="origin", depth=False, surface=False))["poses"]
    assert poses.get("contradiction", "") == ("true poses contradicted" if holds_still else "")
    assert poses.get("frames_until_contradicted", 0) == (0 if holds_still else FRAMES)


def counts_of(sequence: Sequence) -> dict[str, int]:
    """Frames until poses are contradicted: the true ones, and those of four who evade the measure."""
    masker, rng = Masker(MaskSettings()), np.random.default_rng(0)
    names = ("true", "still", "every third", "every third, at random", "late")
    meters = {name: FailureMeter(sequence.camera) for name in names}
    for n, frame in enumerate(sequence.frames()):
        valid, true = masker(frame).valid, sequence.source.pose(frame.index)
        random = se3_exp(rng.normal(size=6) * [5, 5, 5, 0.1, 0.1, 0.1])
        poses = {"true": true, "still": np.eye(4), "late": np.eye(4) if n >= 35 else None}
        poses |= {"every third": None if n % 3 else true, "every third, at random": None if n % 3 else random}
        for name, pose in poses.items():
            meters[name].add(frame.rgb, valid, pose)
    return {name: int(meter.figures()["frames_until_contradicted"]) for name, meter in meters.items()}


@pytest.mark.real
@pytest.mark.parametrize("clip", ["c3vd/cecum_t1_a", "hamlyn/rectified01_part"])
def test_on_real_clips_the_truth_holds_longest_and_who_stands_still_or_answers_seldom_does_not(
    clip: str, real_data: Path
) -> None:
    counts = counts_of(open_sequence(real_data / "endoscopy" / clip, frames=slice(0, 45)))
    # Hamlyn has no true poses.
    assert counts.pop("true") == (45 if "c3vd" in clip else 0)
    assert counts.pop("still") < 20
    assert max(counts.values()) <= 1


@pytest.mark.slow
def test_in_a_layout_of_scared_the_truth_holds_longest(tmp_path: Path) -> None:
    """Its video is compressed, its poses are those of the left eye and inverted."""
    frames = seen(write_tiny(tmp_path / "phantom", frames=30))
    counts = counts_of(open_sequence(as_scared(frames, tmp_path / "dataset_1" / "keyframe_1"), dataset="scared"))
    assert counts.pop("true") == 30
    assert counts.pop("still") < 20
    assert max(counts.values()) <= 1
