"""Whether the numbers of depth files grow with distance (depth) or fall (inverse depth): what the first frames say.

Motion: windows of the first frames are adjusted twice, with the depth of their corners held to what the files say, read
as depth and as inverse depth, each with several shifts, since relative values have one. Costs are Cauchy's of
reprojection errors and of what is held, as in `focal_length.trial`; the difference is the evidence. Beside it, the rank
correlation of the numbers with scopenet's depth. Where the two contradict each other nothing is decided.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from scipy.stats import spearmanr

from scopemap.engine.config import Config, DepthSettings
from scopemap.engine.depth.anchor import depth_downscale
from scopemap.engine.depth.scopenet.estimator import ScopeNetDepth
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.least_squares import cauchy
from scopemap.engine.geometry.warp import resampled
from scopemap.input.focal_length.window_adjustment import Scene, WindowSolution, adjusted, at_rest
from scopemap.input.focal_length.windows import Window, frames_of_windows, window_of
from scopemap.input.sequence import Sequence

Numbers = Callable[[Frame], np.ndarray | None]
"""Returns what the depth file of a frame holds, (H, W) float32 of the same view, NaN = unknown; None: there is none."""

# Chosen on C3VD (Depth Anything, true depth), Hamlyn's and EndoNeRF's stereo depth, and phantoms of three scenes, each
# as depth, inverse depth and stretched inverse depth, 2026-11: the motion of the first windows was right in all, by 8.6
# (nine frames of 160 px) to 230.
_DECISIVE = 6.0  # log odds of all windows together
_AGREEING = 0.8  # share of the evidence that is for the same kind
_MOST_OF_ONE = 10.0  # log odds that one window may give
_AGAINST = 3.0  # log odds that take the network's word away
# scopenet's depth correlates with the true one by .97 to .99 in colons, but by -.8 on a phantom's abdominal wall.
_NETWORK_DECISIVE = 0.9
# Spread of ln depth over that of scopenet's, where the two correlate: .76 to 1.23 for true depth of C3VD and a phantom,
# .47 where a quarter of the picture is cut off, .22 to .39 for its logarithm (2026-11).
_FLAT = 0.45
_SPREAD_PERCENTILES = (10, 90)
_WINDOWS = 4
_FEWEST_WINDOWS = 2
_CORRELATED = 30.0  # of the errors count as one, as in `focal_length.trial`
_CAUCHY = 2.0
_SHIFTS = (0.0, 0.1, 0.3, 1.0, 3.0)  # of relative values, shares of the largest
_HELD = 0.5  # standard deviation of ln depth, over the spread that the files have there
_HELD_RANGE = (0.02, 0.3)
_LEAST_SPREAD = 0.01  # of the logarithm: files that say less are flat
_LEAST_SHARE = 1e-3  # of the median; smaller numbers count as that
_LARGEST_PERCENTILE = 98
_MAX_RESIDUAL = 0.001  # share of the width, as in `focal_length.from_motion`: tissue deforms where it is more
_OUTSIDE = 100.0  # squared residual, in variances, of a point behind a camera
_MIN_SIGMA_PX = 0.03
_MIN_CORNERS = 30
_ITERATIONS = 15
_MIN_DECREASE = 1e-3


@dataclass(frozen=True)
class KindEvidence:
    """What the first frames say of depth files; positive: their numbers are depth, negative: inverse depth.

    motion : (K,) log odds of each window. network : median rank correlation with scopenet's depth, NaN: none.
    frames : how many depth files were looked at. spread : median ratio of the spread of their logarithm to that of
    scopenet's depth, NaN: none.
    """

    motion: tuple[float, ...]
    network: float
    frames: int
    spread: float = math.nan

    @property
    def is_flat(self) -> bool:
        """Whether they vary far less than scopenet's depth, though in its order: they may be logarithms of depth."""
        return abs(self.network) >= _NETWORK_DECISIVE and self.spread < _FLAT

    @property
    def total(self) -> float:
        """Log odds of all windows."""
        return math.fsum(np.clip(self.motion, -_MOST_OF_ONE, _MOST_OF_ONE))

    @property
    def by_motion(self) -> int:
        """1: depth, -1: inverse depth, 0: the motion does not tell."""
        sign, sizes = np.sign(self.total), np.abs(np.clip(self.motion, -_MOST_OF_ONE, _MOST_OF_ONE))
        agreeing = sizes[np.sign(self.motion) == sign].sum()
        return int(sign) if abs(self.total) >= _DECISIVE and agreeing >= _AGREEING * sizes.sum() else 0

    @property
    def by_network(self) -> int:
        """1: depth, -1: inverse depth, 0: the network does not tell, or the motion speaks against it."""
        sign = int(np.sign(self.network)) if abs(self.network) >= _NETWORK_DECISIVE else 0
        return 0 if not self.by_motion and sign * self.total <= -_AGAINST else sign

    @property
    def sign(self) -> int:
        """1: depth, -1: inverse depth, 0: undecided."""
        return (self.by_motion or self.by_network) if self.by_motion * self.by_network >= 0 else 0

    @property
    def reason(self) -> str:
        """What decided, as the end of a sentence."""
        told = "the camera motion shows it" if self.by_motion else ""
        agrees = f"scopenet agrees (correlation {abs(self.network):.2f})" if self.by_network else ""
        return ", and ".join(filter(None, (told, agrees)))


def kind_evidence(sequence: Sequence, config: Config, numbers: Numbers) -> KindEvidence:
    """Return what the motion of a sequence's first frames and scopenet say of the numbers of its depth files.

    No more windows are looked at than it takes for both to say the same.
    """
    motion, compared, network = (
        list[float](),
        list[tuple[float, float]](),
        ScopeNetDepth(rays_known=sequence.calibrated),
    )
    evidence = KindEvidence((), math.nan, 0)
    for frames, found in islice(_with_numbers(sequence, config, numbers), _WINDOWS):
        compared.append(_compared(network, frames[0], found))
        if (window := window_of(frames)) is not None:
            motion.append(_log_odds(window, resampled(found, frames[0].camera)))
        rank, spread = np.median([one for one in compared if math.isfinite(one[0])] or [(math.nan, math.nan)], axis=0)
        evidence = KindEvidence(tuple(motion), float(rank), len(compared), float(spread))
        if len(motion) >= _FEWEST_WINDOWS and evidence.by_motion * evidence.by_network > 0:
            break
    return evidence


def _with_numbers(sequence: Sequence, config: Config, numbers: Numbers) -> Iterator[tuple[list[Frame], np.ndarray]]:
    for frames in frames_of_windows(sequence, config):
        if (found := numbers(frames[0])) is not None:
            yield frames, found


def _compared(network: ScopeNetDepth, frame: Frame, found: np.ndarray) -> tuple[float, float]:
    """Return Spearman's correlation of a file's numbers with scopenet's depth, and the spread of their logarithm in
    units of that of scopenet's; NaN where one of them is constant.
    """
    small = frame.downscaled(depth_downscale(DepthSettings(), max(frame.valid.shape)))
    values = resampled(found, small.camera)
    known = small.valid & (values > 0)
    if known.sum() < _MIN_CORNERS or np.ptp(values[known]) == 0:
        return math.nan, math.nan
    predicted = network.estimate(small).values[known]
    of_network, of_file = (
        np.ptp(np.percentile(np.log(one), _SPREAD_PERCENTILES)) for one in (predicted, values[known])
    )
    return float(spearmanr(predicted, values[known]).statistic), float(of_file / of_network)


def _log_odds(window: Window, found: np.ndarray) -> float:
    """Return the log odds of depth against inverse depth by one window; 0 where it does not tell."""
    assert window.host is not None
    camera = window.host.camera
    column, row = np.rint(window.start + np.array([camera.cx, camera.cy])).astype(int).T
    values = found[row, column].astype(np.float64)
    known = values > 0
    if known.sum() < _MIN_CORNERS or np.std(np.log(values[known])) < _LEAST_SPREAD:
        return 0.0
    tried = {
        (sign, shift): _adjusted(window, known, sign * _log_shifted(values[known], shift))
        for sign in (1, -1)
        for shift in _SHIFTS
    }
    sigma_px = max(min(one.sigma_px for one, _ in tried.values()), _MIN_SIGMA_PX)
    if sigma_px > _MAX_RESIDUAL * 2 * window.half_width_px:
        return 0.0
    depth, inverse = (min(_cost(*tried[sign, shift], sigma_px) for shift in _SHIFTS) for sign in (1, -1))
    return (inverse - depth) / _CORRELATED


def _log_shifted(values: np.ndarray, shift: float) -> np.ndarray:
    shifted = values + shift * np.percentile(values, _LARGEST_PERCENTILE)
    return np.log(np.maximum(shifted, _LEAST_SHARE * np.median(shifted)))


def _adjusted(window: Window, known: np.ndarray, log_depth: np.ndarray) -> tuple[WindowSolution, Scene]:
    """Return the adjustment of a window whose corners (N,) are held to a ln depth (N,) where it is known."""
    assert window.host is not None
    expected, unit = log_depth - np.median(log_depth), np.array([1.0, window.aspect])
    sigma = np.full(len(expected), np.clip(_HELD * np.std(expected), *_HELD_RANGE))
    lens = np.array([math.log(window.host.camera.fx), 0.0])
    pixels = window.start[known] / unit, window.seen[known] / unit
    scene = Scene(*pixels, expected, sigma, window.half_width_px, lens, np.zeros(2))
    return adjusted(scene, at_rest(scene), _ITERATIONS, _MIN_DECREASE), scene


def _cost(found: WindowSolution, scene: Scene, sigma_px: float) -> float:
    """Return the cost of an adjustment: of its reprojection errors, and of depths that left what they are held to."""
    square = (found.error**2).sum(-1) / sigma_px**2
    square = np.where(np.isinf(square), _OUTSIDE, square)[~np.isnan(square)]
    off = (found.state.log_depth - scene.expected) / scene.sigma
    return float(cauchy(square, _CAUCHY)[0].sum() + cauchy(off**2, _CAUCHY)[0].sum())
