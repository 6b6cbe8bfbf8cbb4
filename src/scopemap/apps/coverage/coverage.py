"""The share of the tissue of a result that was never seen, with an interval, and where: a map and blind spots.

The tissue that there should be is the result's surface, closed smoothly where it has gaps (`fusion/watertight.py`),
in a lumen with 1.3 times the area where it was not seen: what a fold hides has more area than the sheet in front of it.
"""

from __future__ import annotations

import csv
import json
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter, label
from scipy.spatial import cKDTree

from scopemap.apps.coverage.layout import CLOCK_BINS, Layout, binned, column_of, examined_space
from scopemap.apps.coverage.unseen import FaceVisibility, face_visibility, features, unseen_probability
from scopemap.apps.measure.measure import Measure
from scopemap.apps.measure.surface_finding import SurfaceFinding
from scopemap.engine.errors import InputError, reporting
from scopemap.report.coverage_picture import COLOURS, OUTSIDE, DrawnMap, draw_coverage
from scopemap.report.sheet import rgb_of
from scopemap.result.frame_table import FrameTable
from scopemap.result.json_numbers import without_nan
from scopemap.result.result import Result, opened
from scopemap.result.verdict import verdict

HIDDEN_AREA = {"lumen": 1.3, "cavity": 1.0}
BLIND = 0.3
"""Share not seen of a bin from which it belongs to a blind spot; the regression is cautious about single faces."""
ODDS = {"lumen": 1.5, "cavity": 5.3}
SEGMENT_ODDS = {"lumen": 2.0, "cavity": 6.0}
"""Factors of the odds of a share at the ends of its interval: of the whole, and of one segment."""
_NOTHING_HIDDEN = 0.1
"""By so much the low end of a segment is lower still: where wall is seen from afar only, nothing may be hidden."""
SEEN = 1
SEEN_BADLY = 2
NOT_SEEN = 3
"""Classes of the map: seen; from afar or obliquely only; probably not seen. 0 is outside of what was examined."""
CAUTION = "The lens is assumed and tissue moves: much of this may have been seen."
NO_SPOT = "There is no blind spot: the share sums small probabilities over the wall."
_MISLEADING = frozenset({"camera-assumed", "tissue-moves"})
"""Reasons of the verdict that together make a share far too large, as on one real colonoscopy."""
_GOOD_COSINE = 0.5
_GOOD_RADII = 2.0
_SMOOTHING_BINS = 0.7
_SEGMENT_RADII = 2.0
_SEGMENT_DEG = 20.0
_LEAST_SPOT_RADII = 0.25  # square root of the smallest area listed
_SHOWN = 10
_ALL_ROUND = 0.35  # length of the mean direction below which a blind spot is all round


FILES = ("coverage.json", "map.csv", "map.png", "coverage.ply")
"""What `Coverage.save` writes."""


class Share(NamedTuple):
    """A share not seen, the ends of its 90 % interval, and the area of all tissue from `start` to `end`."""

    start: float
    end: float
    share: float
    low: float
    high: float
    area: float


@dataclass(frozen=True)
class BlindSpot:
    """A region that was probably not seen.

    area : of what was not seen of it. along, clock : place of its middle; clock None: all round. position_mm : of its
    middle, in the result's world. frame, time_s : of the frame whose camera was nearest.
    """

    area: float
    along: float
    clock: float | None
    position_mm: tuple[float, float, float]
    frame: int
    time_s: float

    def where(self, unit: str) -> str:
        """Return its place and when the camera was nearest, in words; unit : of places along."""
        hours = "all round" if self.clock is None else f"{round(self.clock) or 12} o'clock"
        return f"at {self.along:.0f} {unit}, {hours}; camera nearest at {self.time_s:.1f} s (frame {self.frame})"


@dataclass(frozen=True, eq=False)
class CoverageMap:
    """What is known of each bin (S, 36) of place along and clock direction; NaN where nothing was examined.

    along : (S,) middle of each row. area : of all tissue. unseen : share not seen. cosine, distance, frames : means of
    the best cosine to the surface's normal, the smallest distance, and the share of the frames that see it. spot : the
    blind spot's number from 1 in the list; 0: none. radius : distances up to twice as far are near.
    """

    along: np.ndarray
    area: np.ndarray
    unseen: np.ndarray
    cosine: np.ndarray
    distance: np.ndarray
    frames: np.ndarray
    spot: np.ndarray
    radius: float

    @property
    def classes(self) -> np.ndarray:
        """(S, 36) uint8, by `SEEN`, `SEEN_BADLY`, `NOT_SEEN`, 0."""
        well = (self.cosine >= _GOOD_COSINE) & (self.distance <= _GOOD_RADII * self.radius)
        classes = np.where(self.unseen > BLIND, NOT_SEEN, np.where(well, SEEN, SEEN_BADLY))
        return np.where(np.isfinite(self.unseen), classes, 0).astype(np.uint8)

    def write(self, file: Path) -> None:
        """Write a table with a row for each bin that was examined; raises `InputError` where that fails."""
        names = ["along", "clock", "class", "unseen", "area", "cosine", "distance", "frames", "spot"]
        classes = self.classes
        with reporting(f"cannot write {file}"), file.open("w", newline="", encoding="utf-8") as table:
            rows = csv.writer(table)
            rows.writerow(names)
            for row, column in np.argwhere(classes > 0).tolist():
                figures = [x[row, column] for x in (self.unseen, self.area, self.cosine, self.distance, self.frames)]
                place = [f"{self.along[row]:.4g}", f"{(column + 0.5) * 12 / CLOCK_BINS:.3f}", classes[row, column]]
                rows.writerow([*place, *(f"{figure:.4g}" for figure in figures), self.spot[row, column]])


@dataclass(frozen=True, eq=False)
class Coverage:
    """Which share of the tissue was not seen, and where.

    unit : of lengths, "mm", or "unit" where the scale is unknown; scale : what is known of it. Places along are
    distances on the centreline of a lumen from the beginning of the examined part, or degrees from a cavity's mean
    direction of view; 12 o'clock is up in the first picture. spots : the largest first. surface : the closed mesh.
    unseen : (F,) probability that no frame saw a face, by its features (F, 6); NaN outside of what was examined.
    layout : where points are on the map; first : its row that is the map's first. classes : (F,) uint8, that of the
    map's bin in which a face is. caution : why the share may be far too large, as a sentence; "": nothing says so.
    """

    unit: str
    scale: str
    total: Share
    segments: list[Share]
    spots: list[BlindSpot]
    map: CoverageMap
    surface: trimesh.Trimesh
    unseen: np.ndarray
    features: np.ndarray
    layout: Layout
    first: int
    classes: np.ndarray
    caution: str = ""

    @property
    def facts(self) -> dict[str, Any]:
        """All but map and surface, as plain values."""
        along = self.unit if self.layout.kind == "lumen" else "deg"
        shares = {"total": self.total._asdict(), "segments": [segment._asdict() for segment in self.segments]}
        spots = [asdict(spot) for spot in self.spots]
        known = {"kind": self.layout.kind, "unit": self.unit, "along_unit": along, "scale": self.scale}
        known |= {"statement": self.statement, "caution": self.caution}
        return known | shares | {"blind_spots": spots}

    @property
    def _units(self) -> tuple[str, str]:
        """The units of places along and of areas, in words; without a scale they are the surface's own."""
        length, area = ("mm", "mm2") if self.unit == "mm" else ("units", "square units")
        return ("deg" if self.layout.kind == "cavity" else length), area

    @property
    def sentence(self) -> str:
        """The share not seen with its interval, as the end of a sentence."""
        low, share, high = (f"{100 * value:.0f}" for value in (self.total.low, self.total.share, self.total.high))
        return f"{share} % was not seen, with a probability of 90 % between {low} and {high} %: an estimate."

    @property
    def statement(self) -> str:
        """The share not seen with its interval, what makes it doubtful, and how many blind spots there are."""
        low, share, high = (f"{100 * value:.0f}" for value in (self.total.low, self.total.share, self.total.high))
        what = "between the first and the last place that was examined"
        if self.layout.kind != "lumen":
            what = "in the directions that were examined"
        said = f"{share} % of the wall {what} was not seen, estimated (90 % interval {low} to {high} %)."
        count = "There is 1 blind spot." if len(self.spots) == 1 else f"There are {len(self.spots)} blind spots."
        return " ".join(filter(None, (said, self.caution, count if self.spots else NO_SPOT)))

    def __str__(self) -> str:
        """The figures in a few lines: the whole, the segments, and the largest blind spots."""
        along, area = self._units[0], self._units[1].replace("mm2", "mm²")
        of = "a lumen" if self.layout.kind == "lumen" else "a cavity, by angles from the mean direction of view"
        lines = [f"not seen: {_percent(self.total)} of {_three_digits(self.total.area)} {area} of {of}; {self.scale}"]
        lines += [f"  {self.caution}"] if self.caution else []
        lines += [f"  {part.start:.0f} to {part.end:.0f} {along}: {_percent(part)}" for part in self.segments]
        lines += [f"blind spots: {len(self.spots)}" + (", the largest:" if self.spots else "")]
        spots = enumerate(self.spots[:_SHOWN], 1)
        lines += [f"  {number}. {_three_digits(spot.area)} {area} {spot.where(along)}" for number, spot in spots]
        return "\n".join(lines)

    @property
    def findings(self) -> list[SurfaceFinding]:
        """The blind spots, for `write_findings`."""
        along, area = self._units
        return [
            SurfaceFinding(
                f"blind spot {number} {spot.where(along)}",
                np.array([spot.position_mm]),
                [Measure("area not seen", spot.area, np.nan, np.nan, area)],
            )
            for number, spot in enumerate(self.spots, 1)
        ]

    def draw(self, file: Path) -> None:
        """Draw the map as an image; raises `InputError` where it cannot be written."""
        spots = [(spot.along, spot.clock) for spot in self.spots[:_SHOWN]]
        ends, (along, _) = (self.total.start, self.total.end), self._units
        title = f"not seen: {_percent(self.total)}, estimated"
        draw_coverage(DrawnMap(self.layout.kind, along, self.map.classes, self.map.frames, ends, spots, title), file)

    @property
    def painted(self) -> trimesh.Trimesh:
        """The closed surface, its faces in the map's colours, grey outside of what was examined."""
        colours = np.array([rgb_of(OUTSIDE), *map(rgb_of, COLOURS.values())], np.uint8)[self.classes]
        return trimesh.Trimesh(self.surface.vertices, self.surface.faces, face_colors=colours, process=False)

    def save(self, folder: Path) -> None:
        """Write `FILES` into a folder; raises `InputError` where that fails."""
        facts, table, picture, surface = (folder / name for name in FILES)
        with reporting(f"cannot write to {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
            facts.write_text(json.dumps(without_nan(self.facts), indent=2) + "\n", encoding="utf-8")
            self.painted.export(surface)
        self.map.write(table)
        self.draw(picture)

    @property
    def unseen_faces(self) -> np.ndarray:
        """Which faces (F,) of the closed surface were probably not seen, as the map has it."""
        found: np.ndarray = self.classes == NOT_SEEN
        return found


def coverage(result: Result | Path | str) -> Coverage:
    """Return which share of the tissue of a result, or of a submap in `maps/N`, no frame saw, and where.

    `total` and `segments` are shares with intervals of 90 %, `spots` the blind spots, the largest first, `map` the
    map of what was seen; `print` shows it in words (docs/coverage.md). result : opened, or its folder.
    Raises `InputError` where it holds no finished run, no surface or no depth, where its verdict is "not usable", and
    where no part of the space was seen enough.
    """
    run = _checked(result)
    space = examined_space(run)
    surface, layout, row, hours, inside = space.surface, space.layout, space.row, space.hours, space.inside
    tracked, views = run.frames.only(run.frames.tracked), face_visibility(run, surface)
    known = features(surface, views, space.present, layout)
    counted = np.flatnonzero((row >= 0) & (row < len(inside)) & (space.area > 0))
    counted = counted[inside[row[counted], column_of(hours[counted])]]
    unseen = np.full(len(row), np.nan)
    unseen[counted] = unseen_probability(known[counted])
    parts = space.area * (1 - unseen), HIDDEN_AREA[layout.kind] * space.area * unseen
    faces = _Faces(*(values[counted] for values in (surface.triangles_center, row, hours, space.area, *parts)))
    chart = _chart(faces, inside, views, counted, layout)
    spots = _spots(chart, faces, tracked, layout)
    every = max(1, round((_SEGMENT_RADII * layout.radius_mm if layout.kind == "lumen" else _SEGMENT_DEG) / layout.step))
    ends = [*range(0, max(len(inside) - every // 2, 1), every), len(inside)]
    odds, step = SEGMENT_ODDS[layout.kind], layout.step
    shares = [_share(faces, start, end, step, odds, _NOTHING_HIDDEN) for start, end in pairwise(ends)]
    total = _share(faces, 0, len(inside), layout.step, ODDS[layout.kind])
    unit = "mm" if run.scale_known else "unit"
    caution = CAUTION if {reason.code for reason in verdict(run).reasons} >= _MISLEADING else ""
    classes = np.zeros(len(row), np.uint8)
    classes[counted] = chart.classes[row[counted], column_of(hours[counted])]
    first = space.first
    return Coverage(
        unit, run.scale, total, shares, spots, chart, surface, unseen, known, layout, first, classes, caution
    )


def _percent(share: Share) -> str:
    return f"{share.share:.0%} ({share.low:.0%} to {share.high:.0%})"


def _three_digits(number: float) -> str:
    return np.format_float_positional(float(f"{number:.3g}"), trim="-")


class _Faces(NamedTuple):
    """The faces (N,) that were examined: middle (N, 3), row, clock, area, and expected areas that frames saw or not."""

    middle: np.ndarray
    row: np.ndarray
    hours: np.ndarray
    area: np.ndarray
    seen: np.ndarray
    hidden: np.ndarray


def _checked(result: Result | Path | str) -> Result:
    run = opened(result)
    folder = run.folder
    if not len(run.mesh.faces):
        raise InputError(f"the run {folder} has no surface")
    if not any(map(run.depth.has, run.frames["index"][run.frames.tracked].tolist())):
        raise InputError(f"the run {folder} kept no depth maps")
    if verdict(run).level == "bad":
        raise InputError(f"the run {folder} is not usable by its verdict, so it cannot show what was not seen")
    return run


def _share(faces: _Faces, first: int, last: int, step: float, odds: float, lower: float = 0.0) -> Share:
    """Return the share not seen of the rows from `first` up to `last`; its odds are uncertain by a factor.

    lower : by so much its low end is lower still.
    """
    inside = (faces.row >= first) & (faces.row < last)
    hidden = float(faces.hidden[inside].sum())
    seen = float(faces.seen[inside].sum())
    low, share, high = (hidden * f / max(hidden * f + seen, 1e-12) for f in (1 / odds, 1.0, odds))
    return Share(first * step, last * step, share, max(low - lower, 0.0), high, hidden + seen)


def _chart(
    faces: _Faces, inside: np.ndarray, views: FaceVisibility, counted: np.ndarray, layout: Layout
) -> CoverageMap:
    """Return the map, whose spots are numbered in no order; counted : numbers of the faces in the views."""

    def sums(weights: np.ndarray) -> np.ndarray:
        return smoothed(binned(faces.row, faces.hours, weights, len(inside)))

    hidden, seen = sums(faces.hidden), sums(faces.seen)
    shown = faces.area * (views.cosine[counted] > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(inside, hidden / (hidden + seen), np.nan)
        known = [views.cosine, np.where(np.isfinite(views.distance_mm), views.distance_mm, 0), views.share]
        cosine, distance, frames = (sums(shown * values[counted]) / sums(shown) for values in known)
    along = (np.arange(len(inside)) + 0.5) * layout.step
    area = np.where(inside, hidden + seen, np.nan)
    return CoverageMap(along, area, share, cosine, distance, frames, regions(share > BLIND), layout.radius_mm)


def smoothed(table: np.ndarray) -> np.ndarray:
    """Return sums (S, 36), blurred a little."""
    return np.asarray(gaussian_filter(table, _SMOOTHING_BINS, mode=("nearest", "wrap")))


def regions(chosen: np.ndarray) -> np.ndarray:
    """Return the numbers (S, 36) of connected regions of bins, from 1; the clock has no end."""
    numbers = label(chosen)[0]
    for left, right in zip(numbers[:, 0], numbers[:, -1], strict=True):
        if left and right:
            numbers[numbers == right] = left
    return np.asarray(numbers)


def _spots(chart: CoverageMap, faces: _Faces, tracked: FrameTable, layout: Layout) -> list[BlindSpot]:
    """Return the blind spots, the largest first, and number them so on the map; the smallest are left out."""
    region = chart.spot[faces.row, column_of(faces.hours)]
    area = np.bincount(region, faces.hidden, chart.spot.max() + 1)
    area[0] = 0
    order = [n for n in np.argsort(-area) if area[n] > (_LEAST_SPOT_RADII * layout.radius_mm) ** 2]
    ranks = np.zeros(len(area), int)
    ranks[order] = np.arange(1, len(order) + 1)
    chart.spot[:] = ranks[chart.spot]
    cameras, spots = cKDTree(tracked["T_world_camera"][:, :3, 3]), []
    for number in order:
        own = np.flatnonzero(region == number)
        weights = faces.hidden[own] / area[number]
        middle = weights @ faces.middle[own]
        direction = weights @ np.exp(2j * np.pi / 12 * faces.hours[own])
        hours = None if abs(direction) < _ALL_ROUND else float(np.angle(direction) * 6 / np.pi % 12)
        nearest = int(cameras.query(middle)[1])
        place = float(weights @ (faces.row[own] + 0.5)) * layout.step
        when = int(tracked["index"][nearest]), float(tracked["time_s"][nearest])
        spots.append(BlindSpot(float(area[number]), place, hours, tuple(middle.tolist()), *when))
    return spots
