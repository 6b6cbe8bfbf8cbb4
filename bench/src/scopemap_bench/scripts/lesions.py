"""How large polyps of known size are by `scopemap measure --lesion`, on phantoms of unknown scale.

    python -m scopemap_bench.scripts.lesions [--out FOLDER] [--seeds 401 402 ... 415]

Colons of 48 frames with four polyps each, of 3 to 18 mm by the logarithm, run with `default`. Each polyp is measured by
its masks in all frames, and by the mask of one frame, which is carried to the others. The scale is that of two points
of the wall beside it, 5 to 15 mm apart in truth and across the view, in one frame that sees it whole. Seeds of the
constants: 202 to 227 and 301 to 312, those that have room for four polyps.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.apps.measure.lesion import measure_lesion
from scopemap.apps.measure.measure import Known, Measure
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.runner.reread_frames import open_truth
from scopemap_bench.scripts import measuring

SEEDS = (*range(401, 410), 411, 413, 415)
FRAMES = 48
AT = (8, 20, 32, 44)
KINDS = ("sessile", "flat", "pedunculated")
LARGEST_MM = (18.0, 18.0, 10.0)
LEAST_PX = 150
EDGE_PX = 3
BESIDE = 1.5
TRIES = 2000
REFERENCE_MM = (5.0, 15.0)
SAME_DEPTH = 1.25
LEAST_REFERENCE_PX = 20
LEVEL = 0.3
SMOOTH_PX = 7
BREAK = 1.1
TRUTHS = {
    "largest diameter": "diameter_mm",
    "diameter across it": "cross_diameter_mm",
    "area": "area_mm2",
    "height": "height_mm",
}


class Result(NamedTuple):
    """A figure of a polyp by one way: truth, value and interval, mm or mm2."""

    true: float
    value: float
    low: float
    high: float

    @property
    def error(self) -> float:
        """Error over the truth."""
        return self.value / self.true - 1

    @property
    def holds(self) -> bool:
        """Whether the interval holds the truth."""
        return self.low <= self.true <= self.high

    @property
    def half(self) -> float:
        """Half of the interval over the value."""
        return (self.high - self.low) / 2 / self.value if self.value else np.inf


def polyps_of(seed: int) -> str:
    """Return the polyps of a phantom, as `scopemap phantom --polyps` reads them."""
    random, found = np.random.default_rng((seed, 1)), []
    for number, frame in enumerate(AT):
        kind = (seed + number) % len(KINDS)
        size = float(np.exp(random.uniform(np.log(3.0), np.log(LARGEST_MM[kind]))))
        found.append(f"{KINDS[kind]}:{size:.1f}@{frame}")
    return ",".join(found)


def whole_masks(folder: Path) -> dict[int, np.ndarray]:
    """Return the masks (H, W) bool of a polyp in the frames that see it whole and large enough."""
    found = {}
    for file in sorted(folder.glob("*.png")):
        mask = np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)) > 0
        inner = mask[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX]
        if mask.sum() >= LEAST_PX and inner.sum() == mask.sum():
            found[int(file.stem)] = mask
    return found


def reference_beside(frame: Frame, depth_mm: np.ndarray, mask: np.ndarray, random: np.random.Generator) -> Known | None:
    """Return two points of the wall beside a polyp and their true distance; None where none are found."""
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    nearby = (away > 2) & (away < BESIDE * np.sqrt(mask.sum())) & frame.valid
    nearby &= np.abs(np.log(depth_mm / np.median(depth_mm[mask]))) < np.log(SAME_DEPTH)
    log, around = np.log(depth_mm), np.ones((SMOOTH_PX, SMOOTH_PX))
    nearby &= cv2.dilate(log, around) - cv2.erode(log, around) < np.log(BREAK)
    places = np.argwhere(nearby)[:, ::-1].astype(float)
    for _ in range(TRIES if len(places) > 1 else 0):
        pixels = places[random.choice(len(places), 2, replace=False)]
        column, row = pixels.astype(int).T
        first, second = frame.camera.unproject(pixels) * depth_mm[row, column, None]
        length = float(np.linalg.norm(first - second))
        wide = float(np.linalg.norm(pixels[1] - pixels[0])) > LEAST_REFERENCE_PX
        across = abs(float(first[2] - second[2])) < LEVEL * length
        if wide and across and REFERENCE_MM[0] <= length <= REFERENCE_MM[1]:
            return Known(frame.index, pixels, length)
    return None


def results_of(found: list[Measure], truth: dict[str, float]) -> dict[str, Result]:
    """Return the figures that have a truth, by their names."""
    true = {name: truth[key] for name, key in TRUTHS.items()}
    return {one.what: Result(true[one.what], one.value, one.low, one.high) for one in found if one.what in true}


def measured(source: Path, run: Path) -> list[tuple[str, dict[str, dict[str, Result]]]]:
    """Return what each polyp of a phantom is called, and its figures by each way; print a row for each."""
    views = {
        frame.index: (frame, np.asarray(true.depth_mm)) for frame, true in open_truth(run, source) if true is not None
    }
    rows = []
    for number, truth in enumerate(json.loads((source / "lesions" / "truth.json").read_text()), start=1):
        folder, random = source / "lesions" / str(number), np.random.default_rng((number, 2))
        masks = whole_masks(folder)
        name = f"{source.name}, {number}, {truth['kind']}"
        chosen = max(masks, key=lambda index: masks[index].sum(), default=-1)
        at = int(random.choice(list(masks))) if masks else -1
        known = reference_beside(*views[at], masks[at], random) if masks else None
        if known is None:
            measuring.print_row(name, f"{truth['diameter_mm']:.1f}", "not seen well", "")
            continue
        ways = {"all masks": (folder, None), "one mask": (folder / f"{chosen:04d}.png", chosen)}
        found = {way: results_of(_measure(run, *lesion, known), truth) for way, lesion in ways.items()}
        refused = _refused(run, folder)
        cells = [_cell(results.get("largest diameter")) for results in found.values()]
        measuring.print_row(name, f"{truth['diameter_mm']:.1f}", *cells, "refused" if refused else "NOT REFUSED")
        rows.append((name, found))
    return rows


def _measure(run: Path, masks: Path, frame: int | None, known: Known) -> list[Measure]:
    reference = {"reference": known.pixels, "reference_frame": known.frame, "reference_mm": known.length_mm}
    try:
        return measure_lesion(run, masks, frame, **reference).measures  # type: ignore[arg-type]
    except InputError as refusal:
        print(refusal)
        return []


def _refused(run: Path, masks: Path) -> bool:
    """Return whether nothing is said without a reference."""
    try:
        measure_lesion(run, masks)
    except InputError:
        return True
    return False


def _cell(one: Result | None) -> str:
    return "none" if one is None else f"{one.value:.1f} ({one.low:.1f} to {one.high:.1f}), {one.error:+.0%}"


def main() -> None:
    """Measure, print."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS), help="seeds of the phantoms")
    options = parser.parse_args()
    rows = []
    with measuring.folder_or_scratch(options.out) as out:
        heads = ("phantom, polyp", "diameter mm", "by all masks", "by one mask, carried", "without a reference")
        measuring.print_head(*heads)
        for seed in options.seeds:
            words = ("--frames", FRAMES, "--seed", seed, "--polyps", polyps_of(seed))
            source = measuring.phantom(out / str(seed), *words)
            rows += measured(source, measuring.run_once(source, out / f"{seed}-run"))
    print()
    measuring.print_head("figure", "masks", "polyps", "median error", "intervals hold", "median half interval")
    for what in TRUTHS:
        for way in ("all masks", "one mask"):
            every = [found[way][what] for _, found in rows if what in found[way]]
            errors, halves = [abs(one.error) for one in every], [one.half for one in every]
            holds = f"{sum(one.holds for one in every)} of {len(every)}"
            measuring.print_row(what, way, len(every), f"{np.median(errors):.1%}", holds, f"{np.median(halves):.0%}")


if __name__ == "__main__":
    main()
