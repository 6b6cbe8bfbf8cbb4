"""Local bundle adjustment: each new keyframe with the few before it, before frames are tracked against it.

What ORB-SLAM's local mapping does, but in the tracker's thread, so that a result does not depend on the machine. Frames
that are tracked against a keyframe take over the correction of its depth. Loops are not closed, maps not merged.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.mapping.bundle_adjustment import BundleSolution, adjust
from scopemap.engine.mapping.bundle_problem import (
    CORRELATED,
    TRACKED,
    BundleProblem,
    BundleState,
    Observations,
    Points,
    held_to_result,
)
from scopemap.engine.mapping.correction import KeyframeCorrection, KeyframeStep
from scopemap.engine.mapping.depth_correction import fit_depth_corrections
from scopemap.engine.mapping.feature_tracks import FeatureTracks, KeyframeMatches
from scopemap.engine.mapping.judge import RIGID_SIGMA_PX, ShapeTest, keeps_window, observes_enough, tissue_moves
from scopemap.engine.mapping.other_starts import with_other_starts
from scopemap.engine.notices import Notice

_GAPS = (1, 2)  # by hand: a keyframe's corners are matched in those so many before
_FREE = 3  # by hand: last keyframes of the window that move
_ITERATIONS = 10  # by hand: steps of a window's adjustment
_REMEMBERED = 1000  # by hand: keyframes whose correction is kept: the tracker returns to fewer


class AdjustedKeyframe(NamedTuple):
    """A keyframe as adjusted, what was matched of it, and by how much it was moved."""

    keyframe: Frame
    matches: KeyframeMatches
    step: KeyframeStep


class _WindowKeyframe(NamedTuple):
    """A keyframe of the window: its frame's number and that of the keyframe it was tracked against, and its state.

    log_depth, sigma : (n,) of its points, ln mm, and the standard deviation of that as in `BundleSolution`.
    """

    frame: int
    reference: int
    T_camera_world: np.ndarray
    log_scale: float
    log_depth: np.ndarray
    sigma: np.ndarray


class LocalAdjustment:
    """Takes keyframes as they are tracked; corrects them, and the depth of the frames tracked against them.

    settings : with `local_window`, keyframes that are adjusted together. flow : between keyframes, in one thread.
    """

    def __init__(self, settings: MappingSettings, flow: FlowEstimator) -> None:
        self._settings, self._flow = settings, flow
        self._tracks = FeatureTracks(flow, gaps=_GAPS)
        self._window = deque[_WindowKeyframe](maxlen=settings.local_window)
        self._corrections, self._shapes = dict[int, KeyframeCorrection](), dict[int, ShapeTest]()
        self._is_determined = False
        self._replayed = deque[tuple[Frame, int]](maxlen=settings.local_window)  # keyframes, and their references
        self._adjusted, self._refused = Counter[int](), Counter[int]()

    def corrected(self, frame: Frame, reference: int) -> Frame:
        """Return a frame, tracked against the keyframe of frame `reference`, with its depth corrected as that one's."""
        return self._correction(reference).corrected(frame)

    def adjusted(self, keyframe: Frame, reference: int, map_number: int) -> AdjustedKeyframe:
        """Return a new keyframe with its pose adjusted and its depth corrected.

        keyframe : with its pose as aligned, against the keyframe of frame `reference`, and its depth as estimated. It
        is adjusted with those before it where one of them, or what one of them was tracked against, is the reference.
        Elsewhere, where these observe hardly any of its points, and where no rigid scene explains the observations, it
        takes over the correction of the reference.
        """
        if reference not in {number for one in self._window for number in (one.frame, one.reference)}:
            self._begin()
        matches = self._take(keyframe, reference)
        correction = self._correction(reference)
        if len(self._window) > 1:
            points, observations = self._tracks.collected(self._numbers)
            found = adjust(self._problem(points, observations, keyframe.camera.fx), max_iterations=_ITERATIONS)
            found, shape = self._with_other_starts(points, observations, found, keyframe.camera.fx, map_number)
            is_seen = observes_enough(found.log_depth_sigma[points.host == len(self._window) - 1])
            if not (is_seen and keeps_window(found.sigma_px, shape)):
                self._refused[map_number] += int(is_seen)
                self._begin()
                self._take(keyframe, reference, matches)
            else:
                self._adjusted[map_number] += 1
                correction = self._update(points, found, keyframe.camera)
        self._remember(keyframe.index, correction)
        T_camera_world = self._window[-1].T_camera_world
        moved = correction.corrected(replace(keyframe, T_world_camera=inverse(T_camera_world)))
        arrived = T_camera_world @ np.asarray(keyframe.T_world_camera)
        step = KeyframeStep(arrived, self._correction(reference), correction)
        return AdjustedKeyframe(moved, matches, step)

    def record(self) -> dict[str, Any]:
        """Return what was adjusted of each map, for `resume`, as JSON holds it."""
        return {"adjusted": dict(self._adjusted), "refused": dict(self._refused), "shapes": dict(self._shapes)}

    def resume(self, record: dict[str, Any]) -> None:
        """Go on from a record, with a new window."""
        self._adjusted, self._refused = (
            Counter({int(number): count for number, count in record[name].items()}) for name in ("adjusted", "refused")
        )
        self._shapes = {int(number): ShapeTest(*shape) for number, shape in record["shapes"].items()}

    def replay(self, keyframe: Frame, reference: int, step: KeyframeStep) -> KeyframeStep:
        """Take a keyframe as it was adjusted before the run was resumed, and its step, but for `step.before`.

        Returns all of the step. reference : as `adjusted` takes it.
        """
        before = self._correction(reference)
        self._remember(keyframe.index, step.after)
        self._replayed.append((keyframe, reference))
        return step._replace(before=before)

    def resume_window(self) -> None:
        """Make the window of the keyframes that were replayed last."""
        for keyframe, reference in self._replayed:
            if reference not in {number for one in self._window for number in (one.frame, one.reference)}:
                self._begin()
            correction = self._correction(keyframe.index)
            self._take(correction.undone(keyframe), reference)
            last = self._window[-1]
            log_depth = last.log_depth + correction.log_scale - last.log_scale
            self._window[-1] = last._replace(log_scale=correction.log_scale, log_depth=log_depth)
        self._replayed.clear()

    def undone(self, frame: Frame, reference: int) -> Frame:
        """Return a frame that was handed on, tracked against the keyframe of `reference`, with depth as estimated."""
        return self._correction(frame.index if frame.index in self._corrections else reference).undone(frame)

    def take_over(self, index: int, reference: int) -> None:
        """Have frames be tracked against frame `index` too, which was tracked against the keyframe of `reference`."""
        self._corrections[index] = self._correction(reference)
        if self._window and self._window[-1].frame == reference:
            self._window[-1] = self._window[-1]._replace(reference=index)

    def notices(self, map_number: int) -> list[Notice]:
        """Return what was adjusted of a map, and what determines its shape; [] where nothing was."""
        adjusted, refused = self._adjusted[map_number], self._refused[map_number]
        if not adjusted + refused:
            return []
        values = {"adjusted": adjusted, "refused": refused}
        shape = self._shapes.get(map_number, ShapeTest()).notices
        code = "mapping-local-not-rigid" if tissue_moves(adjusted, refused) else "mapping-local"
        return [Notice(code, values), *shape]

    @property
    def _numbers(self) -> range:
        """Numbers of the window's keyframes among those of the feature tracks."""
        return range(self._tracks.keyframe_count - len(self._window), self._tracks.keyframe_count)

    def _begin(self) -> None:
        """Begin a window without keyframes."""
        self._tracks = FeatureTracks(self._flow, gaps=_GAPS)
        self._window.clear()
        self._is_determined = False

    def _correction(self, reference: int) -> KeyframeCorrection:
        return self._corrections.get(reference, KeyframeCorrection())

    def _remember(self, index: int, correction: KeyframeCorrection) -> None:
        self._corrections[index] = correction
        while len(self._corrections) > _REMEMBERED:
            del self._corrections[next(iter(self._corrections))]

    def _take(self, keyframe: Frame, reference: int, known: KeyframeMatches | None = None) -> KeyframeMatches:
        """Put a keyframe in the window, as aligned; return its matches. known : what was matched of it before."""
        assert keyframe.T_world_camera is not None
        matches = self._tracks.add(keyframe, known=known)
        points, _ = self._tracks.collected([self._tracks.keyframe_count - 1])
        log_scale = self._correction(reference).log_scale
        state = log_scale, points.log_depth + log_scale, np.full(len(points.host), np.inf)
        self._window.append(_WindowKeyframe(keyframe.index, reference, inverse(keyframe.T_world_camera), *state))
        self._tracks.keep_last(len(self._window))
        return matches

    def _problem(self, points: Points, observations: Observations, focal_px: float) -> BundleProblem:
        """Return the adjustment of the window, from where its keyframes are; the first ones are held."""
        count = len(self._window)
        _, _, T_camera_world, log_scale, log_depth, found_sigma = map(list, zip(*self._window, strict=True))
        T = np.stack(T_camera_world)
        start = BundleState(T, np.array(log_scale), np.concatenate(log_depth), math.log(focal_px))
        held = max(count - _FREE, 0)
        host_scale, found = start.log_scale[points.host], np.concatenate(found_sigma)
        points = held_to_result(points, points.host < held, start.log_depth, host_scale, found)
        facts = (points, observations, TRACKED, np.arange(count - 1)[:, None] + [0, 1], focal_px)
        return BundleProblem(T, *facts, start=start, correlated=CORRELATED, held=held)

    def _with_other_starts(
        self, points: Points, observations: Observations, found: BundleSolution, focal_px: float, map_number: int
    ) -> tuple[BundleSolution, ShapeTest]:
        """Return the solution of the start that wins in a full window, until one determines the shape; and the test."""
        is_due = len(self._window) == self._window.maxlen and not self._is_determined
        if not (is_due and self._settings.other_starts):
            return found, ShapeTest()
        problem = replace(self._problem(points, observations, focal_px), points=points, held=0)
        best, test = with_other_starts(problem, found, is_rigid=found.sigma_px <= RIGID_SIGMA_PX)
        if test.is_tested:
            self._is_determined = not test.refuses_window
            self._shapes[map_number] = test
        return best, test

    def _update(self, points: Points, found: BundleSolution, camera: PinholeCamera) -> KeyframeCorrection:
        """Take over an adjustment; return the correction of the window's last keyframe."""
        state, sigma, last = found.state, found.log_depth_sigma, len(self._window) - 1
        for k, keyframe in enumerate(self._window):
            own = points.host == k
            T, log_scale, log_depth = state.T_camera_world[k], float(state.log_scale[k]), state.log_depth[own]
            changed = {"T_camera_world": T, "log_scale": log_scale, "log_depth": log_depth, "sigma": sigma[own]}
            self._window[k] = keyframe._replace(**changed)
        alone = Points(points.host[own] - last, points.pixel[own], points.log_depth[own], points.sigma[own])
        error = state.log_depth[own] - alone.log_depth - log_scale
        step_sigma = self._settings.depth_step_sigma
        fields = fit_depth_corrections(camera, alone, 1, error, sigma[own], step_sigma)
        return KeyframeCorrection(log_scale, *fields)
