"""Judge: whether an adjustment is kept. All limits on that are here, and nearly all that applies them.

| what is adjusted | it is kept where | else |
|---|---|---|
| a keyframe as it comes, with the few before it | `keeps_window` | it is as tracked, with its reference's correction |
| all keyframes of a map, or of merged maps | there is no `refusal_by_views`, `_depth`, `_tracked_poses` | segments |
| several maps together | `MapErrors.fit` | they stay apart |
| successive keyframes that one scene explains | there is no `refusal_of_interval` | they are as tracked |
| two such intervals together | `union_rank` | they stay two segments |
| the same from another start | `is_clearly_less`, `is_same_shape` | the shape stays, or is not determined |
| the same with another lens | `LensTest.contradicts`, `LensKinds.better_than` (reported only) | the lens stays |

A window, a whole map and merged maps are refused first where they leave large reprojection errors. Small errors of what
was adjusted prove little, so what an adjustment has not used judges it, too:

- tracks that were left out: part of the points is adjusted, others are placed in the keyframes that were found
  (`halves`, `placed`). Their errors are compared (`left_out_px`) with those of another hypothesis, or as tracked
- other starts: none of them may explain the left-out tracks as well by another shape (`ShapeTest`)
- predicted depth away from the corners: keyframes that see the same surface must agree on it. A whole map is judged by
  it only where other starts could not (`ShapeTest.is_tested`). An interval is compared with its poses as tracked more
  strictly, by it and by left-out tracks, than a whole map: to leave a second as tracked costs little

Which loop closures are accepted is another question (`loop_closure.py`, `pose_graph.py`), and so is triangulated depth
(`multiview_depth.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.least_squares import dots, robust_sigma_2d
from scopemap.engine.mapping.bundle_adjustment import errors_px, with_points
from scopemap.engine.mapping.bundle_problem import BundleProblem, BundleState, part_of, reprojection_errors
from scopemap.engine.mapping.depth_correction import depth_disagreement
from scopemap.engine.mapping.feature_tracks import NEAR_GAPS
from scopemap.engine.notices import Notice

# ---- the limits, by the question that they answer

LEAST_COMPARED = 50  # by hand
"""Left-out points, observations or pixels: fewer tell nothing."""

# Is a scene rigid? Above `MappingSettings.max_sigma_px` (0.8 px) it is not, and no adjustment is kept.
RIGID_SIGMA_PX = 0.4
"""Robust standard deviation of reprojection errors above which the fit alone does not show that a scene is rigid.

Rigid scenes leave at most 0.3 px, but 0.45 in a fast, interlaced video (C3VD trans_t2_a); moving tissue 0.4 to 1.5. The
ranges overlap: windows of keyframes, other starts and the merging of segments use this limit, all keyframes the larger
`MappingSettings.max_sigma_px`."""

# Between two neighbouring keyframes, over `max_sigma_px`. Worst neighbours of adjusted clips: rigid .28 to .48, fast
# and interlaced 1.03 (C3VD trans_t2_a), a laparoscopy .78; a push that was let go 1.3, fluid on the lens 2.2.
_MOST_NEAR = 1.2

# Windows of keyframes as they come.
_LEAST_SEEN = 0.1  # by hand: of a keyframe's points that those before it must observe: else nothing corrects its depth
_MOST_REFUSED = 0.1  # by hand: of the keyframes: with more, the scene is not rigid

# Does predicted depth agree?
_DEPTH_ERROR = 0.05  # by hand: disagreement, ln, that a right adjustment may leave: errors of networks themselves
_MAX_DEPTH_FACTOR = 1.1  # by hand: depths of keyframes that disagree by less than so much more agree as well as before

# Is it the shape? Two shapes meet. Real clips: the same valley .96 to 1.00 and .003 to .07; another one at most .84,
# and .07 to .39.
_LEAST_CORRELATION = 0.9
_MOST_DIFFERENCE = 0.1  # see above
KNOWN_SIGMA = 0.2  # by hand
"""Standard deviation of ln depth below which a left-out point tells of the shape."""
# Errors of left-out tracks over those of the other shape. In the right valley of a laparoscopy .75; where both are
# wrong, since tissue moves, .93 to 1.1.
_CLEARLY_LESS = 0.85

# Is it the lens? A right one leaves the same errors with the focal length held and free: the ratio of both was 0.998 to
# 1.002 on three real clips with their calibration (C3VD cecum_t1_a and trans_t2_a, Hamlyn), and 0.94 with a lens 15 %
# too short on cecum_t1_a. The limit is between; for another kind of lens it is the same.
MOST_LENS_RATIO = 0.97
"""Of left-out errors through another lens over those through this one."""
_SIGNIFICANT = 3.0  # standard deviations that the focal length must change by
_LEAST_CHANGE = 0.02  # of ln f: changes the shape of a colon by 1.5 %, by which surfaces are off with a right lens
# Of left-out tracks with the focal length free: rigid clips that constrain the lens had 0.14 to 0.41 px, moving ones
# 0.53 (laparoscopy_rvim) and 1.03 (colonoscopy_nflba_03).
_MOST_FREE_PX = 0.45
_FOCAL_SIGMA = 0.05  # by hand: of ln f, above which the motion says too little of the lens to confirm it

# Are the tracked poses better? Of left-out errors by an adjustment over those as tracked: rigid real clips .88 to .99,
# a sinus whose scale of errors ran away 1.4.
_MOST_OVER_TRACKED = 1.05
_NOISE_PX = 0.05  # by hand; of either: that of exact phantoms, whose poses as tracked are as good

# Do maps fit together? Merged maps may increase the reprojection errors within the main map by this factor, plus noise.
_MOST_OVER_ALONE = 1.5  # by hand
# Keyframes of either map with loops to the other, where errors between maps are larger than within or untested.
_MIN_LOOPED = 4  # by hand
_MAX_FEATURE_PX = 1.2  # learned features are matched to a pixel: between maps of one place up to 0.96, of two from 1.38

# Does one scene explain an interval? Left-out errors of a union over those of its parts, where these are not those of a
# rigid scene.
_MOST_OVER_PARTS = 1.1
# Of ln depth between keyframes as tracked up to which their surface can be used, whatever its parts do: surfaces of
# such segments differ by 2.5 % from their frames (`scripts.real`, laparoscopies).
_GOOD_AGREEMENT = 0.025
# The same after an adjustment: what is left before views triangulate depth, which ends at half of it. Accepted ones of
# laparoscopies .04 to .056, one whose surface is worse than as tracked .063.
_MOST_AFTER = 0.055

# ---- tracks that were left out

_RESCALINGS = 3  # by hand: of the robust standard deviation


def halves(problem: BundleProblem, most: int | None = None) -> tuple[BundleProblem, BundleProblem]:
    """Return the problems of points to adjust and of as many others to judge by.

    most : of a keyframe in each; None: half of all.
    """
    observed = np.unique(problem.observations.point)
    step = 2 if most is None else max(2, -(-len(observed) // (most * len(problem.T_camera_world))))
    adjusted, left_out = np.zeros((2, len(problem.points.host)), bool)
    adjusted[observed[::step]] = left_out[observed[step // 2 :: step]] = True
    return part_of(problem, adjusted), part_of(problem, left_out)


def placed(left_out: BundleProblem, keyframes: BundleState) -> BundleState:
    """Return the state of points that their own observations place in the keyframes of a solution."""
    state = keyframes._replace(log_depth=left_out.points.log_depth + keyframes.log_scale[left_out.points.host])
    for _ in range(_RESCALINGS):
        seen = reprojection_errors(left_out, state)
        sigma_px = robust_sigma_2d(np.sqrt(dots(seen.error, seen.error)), left_out.least_sigma_px)
        state = with_points(left_out, state._replace(sigma_px=sigma_px))
    return state


def left_out_px(left_out: BundleProblem, state: BundleState, unit: np.ndarray | float = 1.0, least: int = 0) -> float:
    """Return the robust standard deviation of the errors of left-out points, px; NaN of fewer than `least`.

    state : as `placed` returns it. unit : (N,) what each error is multiplied by.
    """
    lengths_px = errors_px(left_out, state) * unit
    lengths_px = lengths_px[np.isfinite(lengths_px)]
    return robust_sigma_2d(lengths_px) if len(lengths_px) >= least else math.nan


# ---- all keyframes: why an adjustment is refused; None: it is not


def refusal_by_views(
    sigma_px: float, near_px: float, max_sigma_px: float, shape: ShapeTest, keyframes: int
) -> Notice | None:
    """Return why the views refuse an adjustment of so many keyframes.

    sigma_px : of its reprojection errors, robust standard deviation; NaN without observations. near_px : the largest of
    neighbours alone: a second in which tissue moves is a small part of a long map.
    """
    largest_px = near_px if near_px > _MOST_NEAR * max_sigma_px else sigma_px
    if not_rigid := _not_rigid(largest_px, max_sigma_px, keyframes):
        return not_rigid
    if shape.refuses(sigma_px):
        return Notice("mapping-not-determined", {"error_px": shape.error_px, "other_px": shape.other_px})
    return None


def refusal_by_depth(
    camera: PinholeCamera,
    before: tuple[np.ndarray, Sequence[np.ndarray]],
    after: tuple[np.ndarray, Sequence[np.ndarray]],
) -> Notice | None:
    """Return that the depths of near keyframes agree clearly less than before.

    before, after : poses T_world_camera (K, 4, 4) and K depths, mm, as `depth_disagreement` takes them.
    """
    both = (depth_disagreement(camera, *each, NEAR_GAPS) for each in (before, after))
    for was, now in zip(*both, strict=True):
        if now > _MAX_DEPTH_FACTOR * max(was, _DEPTH_ERROR):
            return Notice("mapping-depth-disagrees", {"tracked": was, "adjusted": now})
    return None


def refusal_by_tracked_poses(lens: LensTest) -> Notice | None:
    """Return that the poses as tracked explain left-out tracks better."""
    if not lens.adjustment_is_worse:
        return None
    return Notice("mapping-worse", {"error_px": lens.held_px, "tracked_px": lens.tracked_px})


def _not_rigid(sigma_px: float, most_px: float, keyframes: int) -> Notice | None:
    """Return that no rigid scene leaves such errors, or, where they are NaN, that so many keyframes share nothing."""
    if math.isnan(sigma_px):
        return Notice("mapping-without-observations", {"keyframes": keyframes})
    return None if sigma_px <= most_px else Notice("mapping-not-rigid", {"sigma_px": sigma_px})


Outcome = Literal["determined", "decided", "not determined", "not tested"]
"""decided: not all starts meet, but the shape with clearly smaller errors was met by a second one. not tested: the
camera hardly moved."""


class ShapeTest(NamedTuple):
    """What other starts tell of a shape.

    replaced : whether another start's shape was taken. correlation, difference : of the relief, ln depth less its
    median in each keyframe, with that of the start that meets the shape, or comes nearest to it: correlation, and mean
    absolute difference. error_px, other_px : errors of left-out tracks, robust standard deviation, of the shape and of
    the best of those that end elsewhere; NaN without one.
    """

    outcome: Outcome = "not tested"
    replaced: bool = False
    correlation: float = float("nan")
    difference: float = float("nan")
    error_px: float = float("nan")
    other_px: float = float("nan")

    @property
    def is_tested(self) -> bool:
        """Whether the starts have judged the shape: the predicted depth, which it may contradict, does not then."""
        return self.outcome != "not tested"

    @property
    def refuses_window(self) -> bool:
        """Whether the keyframes of a window stay as tracked: a later one, with more motion, may determine the shape."""
        return self.outcome == "not determined"

    @property
    def is_contradicted(self) -> bool:
        """Whether another start, which ends elsewhere, explains the views about as well, or better."""
        return self.outcome == "not determined" and not is_clearly_less(self.error_px, self.other_px)

    def refuses(self, sigma_px: float) -> bool:
        """Whether all keyframes stay as tracked; sigma_px : of the reprojection errors; small ones keep the poses."""
        return self.is_contradicted and sigma_px > RIGID_SIGMA_PX

    @property
    def notices(self) -> list[Notice]:
        """What determines the shape; [] where that was not tested."""
        if self.outcome == "determined":
            return [Notice("shape-determined", {"correlation": self.correlation})]
        errors = {"error_px": self.error_px, "other_px": self.other_px}
        if self.outcome == "decided":
            return [Notice("shape-decided", errors)]
        return [] if self.outcome == "not tested" else [Notice("shape-not-determined", errors)]


def is_clearly_less(error_px: float, other_px: float) -> bool:
    """Return whether one shape explains left-out tracks clearly better than another one; NaN: it does not."""
    return error_px < _CLEARLY_LESS * other_px


def is_same_shape(correlation: float, difference: float) -> bool:
    """Return whether two reliefs are the same, by their correlation and mean absolute difference, ln; NaN: unknown."""
    return correlation >= _LEAST_CORRELATION and difference <= _MOST_DIFFERENCE


class LensTest(NamedTuple):
    """What left-out tracks tell of the focal length; NaN: not tested.

    held_px, free_px, tracked_px : their errors, robust standard deviation, with the focal length held and free, and as
    tracked. log_focal : change of ln f that the adjusted half fits. sigma : its standard deviation. kind : of the lens
    that they fit, "": the present one.
    """

    held_px: float = math.nan
    free_px: float = math.nan
    log_focal: float = math.nan
    sigma: float = math.nan
    tracked_px: float = math.nan
    kind: str = ""

    @property
    def ratio(self) -> float:
        """Error of left-out tracks with the focal length free over that with it held."""
        return self.free_px / self.held_px

    @property
    def differs(self) -> bool:
        """Whether a rigid scene fits another lens."""
        is_significant = bool(self.kind) or abs(self.log_focal) > max(_LEAST_CHANGE, _SIGNIFICANT * self.sigma)
        return self.free_px <= _MOST_FREE_PX and is_significant

    @property
    def adjustment_is_worse(self) -> bool:
        """Whether the poses as tracked explain the left-out tracks better than the adjustment with the lens held."""
        return self.held_px > _MOST_OVER_TRACKED * self.tracked_px + _NOISE_PX

    @property
    def contradicts(self) -> bool:
        """Whether a rigid scene fits another lens clearly better."""
        return self.differs and self.ratio < MOST_LENS_RATIO

    @property
    def notices(self) -> list[Notice]:
        """Whether the tracks contradict the lens, or the motion does not constrain it."""
        if self.contradicts:
            return [Notice("camera-contradicted", {"change": math.expm1(self.log_focal), "gain": 1 - self.ratio})]
        return [Notice("camera-unconfirmed", {"sigma": self.sigma})] if self.sigma > _FOCAL_SIGMA else []


# ---- several maps


class MapErrors(NamedTuple):
    """What merged maps are judged by: robust standard deviations of reprojection errors, px; NaN without observations.

    is_adjusted : whether the adjustment was kept. main_px : within the main map. largest_px : the largest within one
    map; graph_px : the same from the pose graph, infinite where the depths of keyframes agree less there than as
    tracked. between_px : the largest between another map and all others. loops : number of accepted loop closures.
    support : keyframes on either side of them, of the least supported map.
    """

    is_adjusted: bool
    main_px: float
    largest_px: float
    graph_px: float
    between_px: float
    loops: int
    support: int

    def fit(self, alone: MapErrors, max_sigma_px: float) -> bool:
        """Whether merged maps fit together: each is rigid, all fit, the main one as well as alone.

        Where not even the main map is adjusted, the pose graph merges them: loops of several keyframes agree with each
        other and with both maps as tracked, which fit as well as alone.
        """
        if not alone.is_adjusted and not self.is_adjusted:
            fits = self.graph_px <= _MOST_OVER_ALONE * alone.graph_px + _NOISE_PX
            return fits and self.support >= _MIN_LOOPED
        rigid = self.is_adjusted and self.largest_px <= max_sigma_px
        by_features = self.support >= _MIN_LOOPED and self.between_px <= _MAX_FEATURE_PX
        connected = self.loops > 0 and (self.between_px <= max_sigma_px or by_features)
        return rigid and connected and self.main_px <= _MOST_OVER_ALONE * alone.main_px + _NOISE_PX


# ---- windows, intervals


def observes_enough(log_depth_sigma: np.ndarray) -> bool:
    """Return whether a window observes enough of a keyframe's points; log_depth_sigma : (n,), infinite: unobserved."""
    return bool(np.isfinite(log_depth_sigma).sum() > _LEAST_SEEN * len(log_depth_sigma))


def keeps_window(sigma_px: float, shape: ShapeTest) -> bool:
    """Return whether the adjustment of a window is kept; sigma_px : robust, of its reprojection errors."""
    return sigma_px <= RIGID_SIGMA_PX and not shape.refuses_window


def tissue_moves(adjusted: int, refused: int) -> bool:
    """Return whether so many windows were refused that no rigid scene explains a map."""
    return refused > _MOST_REFUSED * (adjusted + refused)


class Interval(NamedTuple):
    """Successive keyframes, the first and the last of them, and how well one scene explains them.

    error_px, tracked_px : of left-out tracks, robust standard deviation, after an adjustment of the others and as
    tracked; of a union those that connect its parts, NaN where hardly any does. disagreement, tracked_disagreement : of
    ln depth between keyframes, mean of the medians of pairs; NaN without any.
    """

    first: int
    last: int
    error_px: float
    tracked_px: float
    disagreement: float
    tracked_disagreement: float

    @property
    def prefers_adjustment(self) -> bool:
        """Whether left-out tracks and depth prefer the adjustment to the poses as tracked."""
        agrees = self.disagreement <= max(_MOST_AFTER, self.tracked_disagreement)
        return self.error_px <= self.tracked_px and agrees


def refusal_of_interval(interval: Interval, max_sigma_px: float) -> Notice | None:
    """Return that no rigid scene explains an interval, so that its keyframes stay as tracked; None: one does.

    Where left-out tracks or depth prefer the poses as tracked, none does either; no second adjustment is paid for.
    """
    most_px = max_sigma_px if interval.prefers_adjustment else -math.inf
    return _not_rigid(interval.error_px, most_px, interval.last - interval.first + 1)


def union_rank(union: Interval, parts: Sequence[Interval], max_sigma_px: float) -> tuple[bool, float] | None:
    """Return the rank of a union in the order of merging, the least first; None where no one scene explains it."""
    growth = union.error_px / max(mean_of_known([part.error_px for part in parts]), 1e-9)
    fits = union.error_px <= RIGID_SIGMA_PX or (union.error_px <= max_sigma_px and growth <= _MOST_OVER_PARTS)
    if fits and union.prefers_adjustment:
        return False, union.error_px
    agreed = max(mean_of_known([part.tracked_disagreement for part in parts]), _GOOD_AGREEMENT)
    return (True, union.tracked_disagreement) if union.tracked_disagreement <= agreed else None


def mean_of_known(values: Sequence[float]) -> float:
    """Return the mean of the values that are known; NaN without any."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")
