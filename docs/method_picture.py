"""The diagram of the method, figure 1 of the paper, docs/pictures/method.svg: `python docs/method_picture.py`.

Each box is a step, with what the paper has there and what `default` has. Both texts come from the settings of the
presets `paper-strict` and `default`: a setting without a text here is an error, so that the diagram cannot go stale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from xml.sax.saxutils import escape

from scopemap.engine.config import Config

FILE = Path(__file__).parent / "pictures" / "method.svg"
LETTERS = 29
"""Of a line that fits into a box in any usual font."""

_WIDTH, _HEIGHT, _GAP_X, _GAP_Y = 226, 80, 24, 20
_MARGIN, _HEAD, _BAND, _LINE = 30, 64, 36, 16
_SAME, _OTHER, _NEW = "#ffffff", "#fff1e0", "#e6f4e9"
_INK, _SOFT, _HERE = "#17202b", "#566373", "#a34a00"
_NONE = ""

Point = tuple[float, float]
Words = Callable[[Config], str]


@dataclass(frozen=True)
class Box:
    """A step at a column and row of the grid, as many rows high; words : what a preset does there, "" for nothing."""

    name: str
    column: int
    row: int
    words: Words
    rows: int = 1


def _frames(config: Config) -> str:
    is_masked = not config.mask.has("no-highlights")
    return "also a mask: no highlights, no border, no burned-in text" if is_masked else "pictures J"


def _depth(config: Config) -> str:
    return {"depth-anything": "Depth Anything: disparity d", "scopenet": "scopenet: mm, and its error"}[
        config.depth.backend
    ]


def _anchor(config: Config) -> str:
    return {"depth-pro": "Depth Pro: depth D1, focal f", "auto": "none; the network has mm"}[config.depth.anchor]


def _fit(config: Config) -> str:
    fits = {
        "pseudo-stereo-all": "least mean of (D1-fB/d1)^2 over B, by L-BFGS-B; then D=fB/d",
        "scale-and-shift": "none for mm; of disparity a scale and a shift",
    }
    return fits[config.depth.fit]


def _flow(config: Config) -> str:
    checked = ", checked both ways" if config.mapis.consistency_px else ""
    return {"raft-large": "RAFT", "dis": "DIS"}[config.networks.flow] + checked


def _warp(config: Config) -> str:
    moved = {"refine-first": "remap, bilateral filter", "track-first": "also moved by the tracked motion"}
    return moved[config.mapis.order]


def _distance(config: Config) -> str:
    kinds = {
        ("lpips", "raw"): "S: LPIPS of both, one score",
        ("structure", "refined"): "S: structure, a map, after the warp",
    }
    return kinds[config.networks.perceptual, config.mapis.previous]


def _scale(config: Config) -> str:
    return {"none": _NONE, "auto": "median ratio to the warped"}[config.mapis.frame_scale]


def _blend(config: Config) -> str:
    weights = {
        ("linear", "raw"): "weight 1 - S of the warped depth, S of the new one",
        ("auto", "refined"): "each pixel by its S and by the variances; the refined previous depth is warped",
    }
    return weights[config.mapis.blend, config.mapis.previous]


def _keyframes(config: Config) -> str:
    moved = ", once moved" if config.tracking.keyframes_wait else ""
    return f"every {config.tracking.keyframe_every}th frame{moved}".replace("2th", "2nd")


def _corners(config: Config) -> str:
    return "first; alignment where it fails" if config.tracking.corner_depth_sigma else _NONE


def _rotation(config: Config) -> str:
    start = {"paper": "identity", "scopemap": "the last pose"}[config.tracking.photometric]
    return f"from {start}, coarsest of {config.tracking.levels}" if config.tracking.rotation_first else _NONE


def _motion(config: Config) -> str:
    compared = {"paper": "grey values", "scopemap": "with lamp, gain and bias"}
    solver = {"dogleg": "dog-leg"}[config.tracking.solver]
    return f"{solver}; {compared[config.tracking.photometric]}"


def _smoothing(config: Config) -> str:
    return {"wema": "WEMA: mean of three poses", "none": "none, since it lags"}[config.smoothing.method]


def _window(config: Config) -> str:
    before = config.mapping.local_window - 1
    return f"with the {before} before, as it comes" if before > 0 else _NONE


def _lost(config: Config) -> str:
    return "by features; tracked backwards" if config.tracking.relocalisation_keyframes else _NONE


def _adjustment(config: Config) -> str:
    return "all keyframes, loops, segments" if config.mapping.global_adjustment else _NONE


def _triangulation(config: Config) -> str:
    is_used = config.mapping.triangulate_depth and config.mapping.global_adjustment
    return "of keyframes, from several views" if is_used else _NONE


def _all_frames(config: Config) -> str:
    return "poses, depth, between keyframes" if config.mapping.global_adjustment else _NONE


def _chosen(config: Config) -> str:
    return {1: "every frame, as it comes", 0: "at the end: what shows tissue anew"}[config.fusion.every]


def _tsdf(config: Config) -> str:
    return "running mean, with weights" if config.fusion.weighted else "running mean"


def _level(config: Config) -> str:
    return "where the mean is 0"


def _mesh(config: Config) -> str:
    colours = {"raw": "the video's colours", "texture": "texture of few frames", "albedo": "colours without the lamp"}[
        config.fusion.colours
    ]
    return colours + {"none": "", "small": ", small holes closed"}[config.fusion.holes]


BANDS: dict[str, tuple[Box, ...]] = {
    "MAPIS-Depth: each frame": (
        Box("Frames", 0, 0, _frames, rows=3),
        Box("Anchor, on frame 1", 1, 0, _anchor),
        Box("Depth of each frame", 1, 1, _depth),
        Box("Flow to the frame before", 1, 2, _flow),
        Box("Fit to the anchor", 2, 0, _fit, rows=2),
        Box("Previous depth, warped", 2, 2, _warp),
        Box("Perceptual distance", 3, 0, _distance),
        Box("Scale of the frame", 3, 1, _scale),
        Box("Blend", 4, 0, _blend, rows=3),
    ),
    "WEMA-RTDL: the pose of each frame, against its keyframe": (
        Box("Keyframes", 0, 3, _keyframes),
        Box("Pose by corners", 1, 3, _corners),
        Box("Rotation, SO(3)", 2, 3, _rotation),
        Box("Full motion, SE(3)", 3, 3, _motion),
        Box("Smoothing", 4, 3, _smoothing),
    ),
    "Mapping: keyframes as they come, and all frames after the last one": (
        Box("Each keyframe adjusted", 0, 4, _window),
        Box("Lost frames found again", 1, 4, _lost),
        Box("Bundle adjustment", 2, 4, _adjustment),
        Box("Depth triangulated", 3, 4, _triangulation),
        Box("All frames corrected", 4, 4, _all_frames),
    ),
    "Volumetric fusion": (
        Box("Frames that are fused", 1, 5, _chosen),
        Box("TSDF", 2, 5, _tsdf),
        Box("Marching cubes", 3, 5, _level),
        Box("Mesh", 4, 5, _mesh),
    ),
}


def method_picture() -> str:
    """Return the diagram as the text of an SVG file."""
    paper, default = Config.load("paper-strict"), Config.load("default")
    width, height = _left(5) - _GAP_X + _MARGIN, _top(5) + _HEIGHT + _MARGIN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        "<title>The method of the paper, and where scopemap's default departs from it</title>",
        *(_marker(name, colour) for name, colour in (("paper", _SOFT), ("here", _HERE))),
        f'<rect width="{width}" height="{height}" fill="#f6f8fa"/>',
        *_legend(),
    ]
    for title, boxes in BANDS.items():
        top, end = _top(boxes[0].row), _top(boxes[-1].row + boxes[-1].rows - 1) + _HEIGHT
        box = f'x="{_MARGIN / 2}" y="{top - _BAND + 8}" width="{width - _MARGIN}" height="{end - top + _BAND + 2}"'
        parts.append(f'<rect {box} rx="6" fill="#e7ebf0"/>')
        parts.append(_text((_left(1 - boxes[0].column), top - 12), title, _SOFT, bold=True))
    parts += _arrows(width)
    for box in (box for boxes in BANDS.values() for box in boxes):
        parts += _drawn(box, box.words(paper), box.words(default))
    return "\n".join([*parts, "</svg>"]) + "\n"


def lines_of(box: Box, paper: str, default: str) -> list[tuple[str, str]]:
    """Return the lines of text in a box below its name, with their colours; paper, default : what each has there."""
    if paper == default:
        return [(line, _INK) for line in _wrapped(paper)]
    own = [(line, _INK) for line in _wrapped(paper or "not in the paper")]
    return own + [(line, _HERE) for line in _wrapped(f"here: {default}")]


def _wrapped(words: str) -> list[str]:
    return wrap(words, LETTERS, break_on_hyphens=False)


def _left(column: int) -> int:
    return _MARGIN + column * (_WIDTH + _GAP_X)


def _top(row: int) -> int:
    bands = sum(boxes[0].row <= row for boxes in BANDS.values())
    return _HEAD + row * (_HEIGHT + _GAP_Y) + bands * _BAND


def _middle(row: int) -> float:
    return _top(row) + _HEIGHT / 2


def _text(at: Point, words: str, colour: str = _INK, size: int = 13, *, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{at[0]}" y="{at[1]}" font-size="{size}" fill="{colour}"{weight}>{escape(words)}</text>'


def _marker(name: str, colour: str) -> str:
    head = f'<path d="M0 0L8 4L0 8z" fill="{colour}"/>'
    size = 'viewBox="0 0 8 8" refX="7" refY="4" markerWidth="9" markerHeight="9" markerUnits="userSpaceOnUse"'
    return f'<defs><marker id="{name}" {size} orient="auto">{head}</marker></defs>'


def _legend() -> list[str]:
    parts = [
        _text((_MARGIN, 26), "The method of arXiv 2508.11282, and what scopemap does by default", size=17, bold=True)
    ]
    meanings = {
        _SAME: "as in the paper",
        _OTHER: "the paper; here: the preset default instead",
        _NEW: "not in the paper, in the preset default",
    }
    x = _MARGIN
    for colour, words in meanings.items():
        parts.append(f'<rect x="{x}" y="40" width="22" height="16" rx="3" fill="{colour}" stroke="{_SOFT}"/>')
        parts.append(_text((x + 30, 53), words))
        x += 70 + 8 * len(words)
    return [*parts, _arrow([(x, 48), (x + 40, 48)], here=True), _text((x + 48, 53), "only in the preset default")]


def _drawn(box: Box, paper: str, default: str) -> list[str]:
    x, y = _left(box.column), _top(box.row)
    fill = _SAME if paper == default else _OTHER if paper else _NEW
    height = _top(box.row + box.rows - 1) + _HEIGHT - y
    lines = lines_of(box, paper, default)
    first = y + (height - _LINE * (len(lines) + 1)) / 2 + _LINE - 3
    return [
        f'<rect x="{x}" y="{y}" width="{_WIDTH}" height="{height}" rx="6" fill="{fill}" stroke="{_SOFT}"/>',
        _text((x + 9, first), box.name, bold=True),
        *(_text((x + 9, first + _LINE * (n + 1)), line, colour) for n, (line, colour) in enumerate(lines)),
    ]


def _arrow(points: list[Point], *, here: bool = False) -> str:
    way = " ".join(f"{x:g},{y:g}" for x, y in points)
    colour, dashes = (_HERE, ' stroke-dasharray="5 3"') if here else (_SOFT, "")
    end = f'marker-end="url(#{"here" if here else "paper"})"'
    return f'<polyline points="{way}" fill="none" stroke="{colour}" stroke-width="1.6"{dashes} {end}/>'


def _across(first: int, last: int, row: int, *, here: bool = False) -> list[str]:
    """Return the arrows from each column to the next."""
    y = _middle(row)
    return [_arrow([(_left(c) + _WIDTH, y), (_left(c + 1), y)], here=here) for c in range(first, last)]


def _arrows(width: float) -> list[str]:
    def below(row: int, shift: float = 0) -> float:
        return _top(row) + _HEIGHT + 14 + shift

    def centre(column: int) -> float:
        return _left(column) + _WIDTH / 2

    above, beside = _top(0) - 5, width - _MARGIN / 2 + 7
    parts = [*_across(0, 4, 1), *_across(0, 2, 0), *_across(3, 4, 0), *_across(0, 2, 2)]
    # The distance is of pictures; the warped depth goes past it.
    parts.append(_arrow([(centre(0), _top(0)), (centre(0), above), (centre(3), above), (centre(3), _top(0))]))
    parts.append(_arrow([(_left(3) - _GAP_X, _middle(2)), (_left(4), _middle(2))]))
    parts.append(
        _arrow([(centre(4), _top(2) + _HEIGHT), (centre(4), below(2)), (centre(0), below(2)), (centre(0), _top(3))])
    )
    parts += [*_across(0, 4, 3), *_across(0, 4, 4, here=True), *_across(1, 4, 5)]
    parts.append(_arrow([(_left(3) + 30, _top(3)), (_left(2) + _WIDTH - 30, _top(2) + _HEIGHT)], here=True))
    # The paper fuses what is tracked; default what the mapping has corrected.
    fused = centre(1), _top(5)
    right = _left(4) + _WIDTH
    parts.append(
        _arrow(
            [
                (right, _middle(3)),
                (beside, _middle(3)),
                (beside, below(4, -4)),
                (fused[0] - 30, below(4, -4)),
                (fused[0] - 30, fused[1]),
            ]
        )
    )
    way = [(centre(4), _top(3) + _HEIGHT), (centre(4), below(3)), (centre(0), below(3)), (centre(0), _top(4))]
    parts.append(_arrow(way, here=True))
    way = [
        (centre(4), _top(4) + _HEIGHT),
        (centre(4), below(4, 4)),
        (fused[0] + 30, below(4, 4)),
        (fused[0] + 30, fused[1]),
    ]
    return [*parts, _arrow(way, here=True)]


if __name__ == "__main__":
    FILE.write_text(method_picture(), encoding="utf-8")
