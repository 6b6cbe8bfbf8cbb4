"""The lens of an unknown camera by trial: windows are adjusted through lenses of several kinds and focal lengths.

The radius of a ray at the angle t from the axis is f tan t, f t or f sin t. Depth is scopenet's, without rays. The cost
of a lens is that of its reprojection errors, px, by Cauchy's kernel, `_CORRELATED` of which count as one
(chosen on phantoms and real clips with known lenses). The costs, and what is expected of the lens, give a probability
over kinds and focal lengths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import PchipInterpolator

from scopemap.engine.geometry.least_squares import cauchy, robust_sigma_2d
from scopemap.engine.models.device import cpu_threads
from scopemap.input.focal_length.window_adjustment import Scene, Start, adjusted, at_rest
from scopemap.input.focal_length.windows import Window, with_distance
from scopemap.input.scopes import ANY_LENS, LensPrior

MAX_SHARE = 0.07
"""Standard deviation of ln fx above which a trial does not tell it, chosen with `_CORRELATED`."""

# Focal lengths over the width: pinholes of 122 to 31 degrees, equidistant fisheyes of 150 and less.
_COARSE = np.geomspace(0.28, 1.83, 12)
_FINER = (_COARSE[1] / _COARSE[0]) ** np.array([-0.75, -0.5, -0.25, 0.25, 0.5, 0.75])
_FARTHEST = 3.0  # spreads from the expected focal length
_WIDEST_RAD = math.radians(86)  # farther out a straightened picture has no end
_LEAST_SEEN = 0.6  # of the observations, within that angle
_CORRELATED = 30.0
_HOPELESS = 20.0  # times `_CORRELATED` above the lowest cost: between coarse focal lengths it may fall by some
_CAUCHY = 2.0
_OUTSIDE_PX = 50.0
_LOG_DEPTH_SIGMA = 1.0  # of a depth that is not known, and of an estimated one
_ESTIMATED_SIGMA = 0.3
_MIN_SIGMA_PX = 0.03
_FIRST = 15  # iterations, from a start without motion and from that of the lens before
_NEXT = 8
_MIN_DECREASE = 1e-3
_AXIS = 1e-9  # least distance from the axis, focal lengths
_LEAST_CERTAIN = 0.95
_MOST_AT_END = 0.02  # of the probability, within a twentieth of the range of either end
_MIN_WINDOWS = 2
_MAX_RESIDUAL = 0.0008  # share of the width that the best lens may leave: tissue deforms where it is more
_FINE = 240


@dataclass(frozen=True)
class LensTrial:
    """Result of a trial of lenses.

    kind : of the lens that fits best. focal_px : its fx, at the windows' size. share : standard
    deviation of ln fx over all kinds. fov_deg : horizontal field of view. certainty : probability of the kind.
    windows : number of windows used. reason : why this does not tell the lens, or "".
    """

    kind: str
    focal_px: float
    share: float
    fov_deg: float
    certainty: float
    windows: int
    reason: str = ""


def try_lenses(windows: Sequence[Window], prior: LensPrior = ANY_LENS) -> LensTrial | None:
    """Return what windows of one camera say of its lens; None where fewer than two show a rigid scene."""
    with ThreadPoolExecutor(cpu_threads()) as pool:
        found = pool.map(partial(_Tried, prior), windows)
        tried = [one for one in found if one.sigma_px <= _MAX_RESIDUAL * one.width_px]
    if len(tried) < _MIN_WINDOWS:
        return None
    costs = _costs(tried)
    lowest = min(min(of_kind.values()) for of_kind in costs.values())
    for kind, of_kind in costs.items():
        best = min(of_kind, key=lambda share: of_kind[share])
        # The others have no share in the probability.
        for one in tried if of_kind[best] - lowest < _HOPELESS * _CORRELATED else ():
            one.at(kind, best * _FINER)
    return _judged([_costs([one]) for one in tried], 2 * windows[0].half_width_px, prior)


class _Tried:
    """A window with the reprojection errors through each lens that was tried: by kind and focal length over width.

    All kinds that are expected are tried at once, of the `_COARSE` focal lengths that are.
    """

    def __init__(self, prior: LensPrior, window: Window) -> None:
        self.window, self.width_px = with_distance(window), 2 * window.half_width_px
        self.errors: dict[tuple[str, float], np.ndarray] = {}
        self._states: dict[tuple[str, float], Start] = {}
        for kind in prior.kinds:
            self.at(kind, _COARSE[np.abs(np.log(_COARSE / prior.focal)) <= _FARTHEST * prior.spread])

    @property
    def sigma_px(self) -> float:
        """Noise of the window: the robust standard deviation of the errors that the best lens leaves, px."""
        known = (found[np.isfinite(found)] for found in self.errors.values())
        return min(robust_sigma_2d(found, _MIN_SIGMA_PX) for found in known if len(found))

    def at(self, kind: str, shares: np.ndarray) -> None:
        """Adjust the window through lenses of a kind, each from where a lens like it ended."""
        # Small motion converges best through a wide lens, whatever is expected.
        for share in sorted(map(float, shares), key=lambda share: abs(math.log(share / ANY_LENS.focal))):
            # Of its own kind where there is one, then of the nearest focal length.
            near = min(self._states, key=lambda key: (key[0] != kind, abs(math.log(key[1] / share))), default=None)
            start = None if near is None else self._states[near]
            found = _adjusted(self.window, kind, share * self.width_px, start)
            self.errors[kind, share], self._states[kind, share] = found


def _adjusted(window: Window, kind: str, focal_px: float, start: Start | None) -> tuple[np.ndarray, Start]:
    """Return the reprojection errors (n,), picture px, NaN too far out, `_OUTSIDE_PX` if unseen; and the state."""
    unit = np.array([1.0, window.aspect])
    # The host's corners first, then those of the partners.
    pixel = np.concatenate([window.start[:, None], window.seen], 1) / (focal_px * unit)
    radius = np.maximum(np.hypot(pixel[..., 0], pixel[..., 1]), _AXIS)
    angle = _angle(kind, radius)
    tangent = np.tan(angle)
    # Where their rays meet the plane z = 1; NaN: nowhere.
    straight, reached = pixel * (tangent / radius)[..., None], tangent <= math.tan(_WIDEST_RAD)
    host, is_seen, near = straight[:, 0], np.isfinite(pixel[:, 1:, 0]), reached[:, :1] & reached[:, 1:]
    errors = np.where(np.isfinite(tangent[:, :1] + tangent[:, 1:]), np.nan, _OUTSIDE_PX)
    seen = np.where(near[..., None], focal_px * straight[:, 1:], np.nan)
    lens = np.array([math.log(focal_px), 0.0])
    scene = Scene(
        focal_px * np.nan_to_num(host), seen, *_expected(window, host), window.half_width_px, lens, np.zeros(2)
    )
    begin = at_rest(scene) if start is None else start._replace(lens=lens)
    found = adjusted(scene, begin, _FIRST if start is None else _NEXT, _MIN_DECREASE)
    with np.errstate(invalid="ignore"):  # errors of points behind the camera are infinite
        bent = unit * _bent(kind, pixel[:, 1:][near], radius[:, 1:][near], angle[:, 1:][near], found.error[near])
    errors[near] = np.where(np.isfinite(found.error[near, 0]), np.hypot(*bent.T), _OUTSIDE_PX)
    return errors[is_seen], found.state


def _expected(window: Window, host: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ln of the depth (n,) expected of a window's corners, in units of the median, and its deviation (n,)."""
    count = len(host)
    if window.log_distance is None:
        return np.zeros(count), np.full(count, _LOG_DEPTH_SIGMA)
    # Distance is what the estimator knows: depth along the axis depends on the lens.
    log_depth = window.log_distance - 0.5 * np.log1p(np.nan_to_num(host**2).sum(1))
    return log_depth - np.median(log_depth), np.full(count, _ESTIMATED_SIGMA)


def _angle(kind: str, radius: np.ndarray) -> np.ndarray:
    """Return the angle of rays from the axis, rad, whose pixels are `radius` focal lengths from it; NaN: none."""
    if kind == "pinhole":
        return np.arctan(radius)
    angle = radius if kind == "equidistant fisheye" else np.arcsin(np.where(radius < 1, radius, np.nan))
    return np.where(angle < math.pi / 2, angle, np.nan)


def _bent(kind: str, pixel: np.ndarray, radius: np.ndarray, angle: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return small errors (n, 2) on the plane z = 1 at pixels (n, 2), in focal lengths, as errors of the pixels.

    radius, angle : (n,) of the pixels from the middle, in focal lengths, and of their rays from the axis, rad.
    """
    out, cosine, tangent = pixel / radius[:, None], np.cos(angle), np.tan(angle)
    slope = {"pinhole": 1.0, "equidistant fisheye": cosine**2, "orthographic fisheye": cosine**3}[kind]
    along = ((error * out).sum(1) * (slope - radius / tangent))[:, None] * out
    bent: np.ndarray = along + error * (radius / tangent)[:, None]
    return bent


def _costs(tried: list[_Tried]) -> dict[str, dict[float, float]]:
    """Return the cost of every lens over all windows, by kind and focal length over width."""
    costs: dict[str, dict[float, float]] = {kind: {} for kind, _ in tried[0].errors}
    for one in tried:
        sigma_px = one.sigma_px
        for (kind, share), errors in one.errors.items():
            found, count = errors[np.isfinite(errors)], len(errors)
            mean = cauchy((found / sigma_px) ** 2, _CAUCHY)[0].mean() if len(found) >= _LEAST_SEEN * count else np.inf
            costs[kind][share] = costs[kind].get(share, 0.0) + count * float(mean)
    return costs


def _judged(costs: list[dict[str, dict[float, float]]], width_px: float, prior: LensPrior) -> LensTrial:
    """Return the mean and the spread of the focal length from the costs of all lenses in each window."""
    fine = np.linspace(math.log(_COARSE[0]), math.log(_COARSE[-1]), _FINE)
    total = {kind: {share: sum(one[kind][share] for one in costs) for share in costs[0][kind]} for kind in costs[0]}
    expected = np.exp(-0.5 * ((fine - math.log(prior.focal)) / prior.spread) ** 2)
    weight = {kind: expected * of_kind for kind, of_kind in _weights(total, fine).items()}
    every = np.sum(list(weight.values()), axis=0)
    every /= every.sum()
    kind = max(weight, key=lambda name: float(weight[name].sum()))
    own = weight[kind] / weight[kind].sum()
    mean = float(own @ fine)
    # Windows that contradict each other share an error, such as tissue that deforms, which their costs do not show.
    alone = [_weights({kind: one[kind]}, fine)[kind] for one in costs]
    scatter = float(np.std([weights @ fine / weights.sum() for weights in alone], ddof=1)) / math.sqrt(len(costs))
    share = math.hypot(math.sqrt(float(every @ (fine - mean) ** 2)), scatter)
    certainty = float(weight[kind].sum() / sum(values.sum() for values in weight.values()))
    end = _FINE // 20
    focal_px, reason = width_px * math.exp(mean), ""
    if every[:end].sum() + every[-end:].sum() > _MOST_AT_END:
        reason = "focal lengths outside the trial may fit equally well"
    elif share > MAX_SHARE or certainty < _LEAST_CERTAIN:
        reason = f"several lenses fit about equally well, best {kind}, fx uncertain by {share:.0%}"
    return LensTrial(kind, focal_px, share, _fov_deg(kind, focal_px, width_px), certainty, len(costs), reason)


def _weights(costs: dict[str, dict[float, float]], fine: np.ndarray) -> dict[str, np.ndarray]:
    """Return the probability of each kind at logarithms `fine` of the focal length over the width, up to one factor."""
    lowest = min(cost for of_kind in costs.values() for cost in of_kind.values())
    weight = {}
    for kind, of_kind in costs.items():
        shares = [share for share in sorted(of_kind) if math.isfinite(of_kind[share])]
        cost = [of_kind[share] for share in shares]
        # Costs that rise steeply where a lens does not see the picture's corners must not bend the rest.
        curve = np.full(len(fine), np.inf)
        if len(shares) > 1:
            curve = PchipInterpolator(np.log(shares), cost, extrapolate=False)(fine)
        weight[kind] = np.exp(-np.nan_to_num(curve - lowest, nan=np.inf).clip(0) / _CORRELATED)
    return weight


def _fov_deg(kind: str, focal_px: float, width_px: float) -> float:
    """Return the horizontal field of view of a lens, degrees."""
    edge = _angle(kind, np.array([width_px / 2 / focal_px]))
    return 2 * math.degrees(np.nan_to_num(edge, nan=math.pi / 2)[0])
