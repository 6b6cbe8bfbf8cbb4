"""How often the intervals of `scopemap measure` hold the true distance and area, on phantoms of unknown scale.

    python -m scopemap_bench.scripts.intervals [--out FOLDER] [--count N]

In N random frames of a phantom the distance of two random pixels is measured, by a reference of two others, both 8 mm
or more in truth, and the area of a square of 30 to 80 px in which the true surface does not break off. Truth is the
frame's exact depth. Measures that are refused, for there is no surface at a pixel, do not count. Runs of `overview
--out FOLDER` are used again.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from scopemap.apps.measure.measure import measure
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.surface_measures import area_inside
from scopemap.runner.reread_frames import open_truth
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.overview import clips, drawn

NAMES = ("colon phantom", "laparoscopy phantom", "colon phantom, breathing")
LEAST_MM = 8.0
SQUARES_PX = (30, 80)
BREAK = 1.05
TRIES = 50


def random_pairs(points: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, float, float]:
    """Return four pixels (4, 2), x, y, and how far the first two and the last two of their points (H, W, 3) are."""
    while True:
        pixels = random.integers(0, points.shape[1::-1], (4, 2))
        first, second, third, fourth = points[pixels[:, 1], pixels[:, 0]]
        lengths = float(np.linalg.norm(first - second)), float(np.linalg.norm(third - fourth))
        if min(lengths) >= LEAST_MM and np.isfinite(lengths).all():
            return pixels.astype(float), *lengths


def random_square(
    points: np.ndarray, camera: PinholeCamera, random: np.random.Generator
) -> tuple[np.ndarray, float] | None:
    """Return the corners (4, 2) of a square, x, y, and the area that is seen in it; None where all are broken."""
    for _ in range(TRIES):
        side = int(random.integers(*SQUARES_PX))
        x, y = random.integers(0, (camera.width - side, camera.height - side))
        part = points[y : y + side + 1, x : x + side + 1]
        steps = [np.abs(np.diff(np.log(part[..., 2]), axis=axis)) for axis in (0, 1)]
        if all((step < np.log(BREAK)).all() for step in steps):
            break
    else:
        return None
    here = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = here[:-1, :-1], here[:-1, 1:], here[1:, 1:], here[1:, :-1]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    square = np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]], float)
    surface = trimesh.Trimesh(part.reshape(-1, 3), faces, process=False)
    return square, area_inside(surface, square, camera, np.eye(4))


def print_phantom(name: str, out: Path, count: int) -> None:
    """Run a phantom unless its run is there, measure in it, and print its row."""
    clip, random = drawn(clips(Path(), out)[name]), np.random.default_rng(0)
    run = measuring.run_once(clip.source, clip.run_folder(out))
    found: dict[str, list[tuple[float, float, float, float]]] = {"straight": [], "area": []}
    views = list(open_truth(run, clip.source))
    for frame, truth in (views[number] for number in random.integers(0, len(views), count)):
        camera, depth_mm = frame.camera, np.asarray(truth.depth_mm)
        grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
        points = camera.unproject(grid.astype(float)) * depth_mm[..., None]
        pixels, length, known = random_pairs(points, random)
        asked = [("straight", pixels[:2], length)]
        if (square := random_square(points, camera, random)) is not None:
            asked.append(("area", *square))
        for what, places, true in asked:
            try:
                one = measure(run, frame.index, places, pixels[2:], known)[0]
            except InputError:
                continue
            found[what].append((true, one.value, one.low, one.high))
    cells: list[object] = [name]
    for rows in found.values():
        true, value, low, high = np.array(rows).T
        error, half = np.median(np.abs(value / true - 1)), np.median((high - low) / 2 / value)
        cells += [f"{((low <= true) & (true <= high)).sum()} of {len(rows)}", f"{error:.1%}", f"{half:.0%}"]
    measuring.print_row(*cells)


def main() -> None:
    """Measure, print."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--count", type=int, default=60, help="frames of each phantom that are measured in")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        figures = ("inside", "error", "half interval")
        measuring.print_head("clip", *(f"{what}: {one}" for what in ("distance", "area") for one in figures))
        for name in NAMES:
            print_phantom(name, out, options.count)


if __name__ == "__main__":
    main()
