"""Frames until poses are contradicted: true, standing still, jumping, growing and missing ones on a known scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import plane_scene
import pytest
from plane_scene import CAMERA, EVERYWHERE

from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import se3_exp, so3_exp
from scopemap_bench.evaluation.failure import FailureMeter

FRAMES, AT = 24, 12
TRUTH = [
    plane_scene.pose(at_mm=(8 * np.sin(0.15 * n), 0.8 * n, 0.3 * n), turn_rad=(0.004 * n, 0.0, 0.0))
    for n in range(FRAMES)
]
VIEWS = [plane_scene.see(pose).rgb for pose in TRUTH]
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
    "not before it begins": (lambda n, pose: pose if n > 5 else None, FRAMES, FRAMES),
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


def test_pictures_that_tell_nothing_contradict_nothing() -> None:
    meter, grey = FailureMeter(CAMERA), np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
    for pose in TRUTH:
        meter.add(grey, ~EVERYWHERE, pose)
    assert meter.figures()["frames_until_contradicted"] == FRAMES
