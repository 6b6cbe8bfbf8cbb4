"""Errors of `scopemap coverage`: the share that was not seen, its intervals, blind spots.

    python -m scopemap_bench.scripts.coverage [--out FOLDER] [--only NAME ...]
    python -m scopemap_bench.scripts.coverage --fit [--out FOLDER]
    python -m scopemap_bench.scripts.coverage --c3vd RESULT VIDEO [--c3vd RESULT VIDEO ...]

Phantoms of 50 frames, three times as fast as usual: forward, withdrawn, there and back, with the camera turned away by
30 degrees on the way, with folds of 9 mm in place of 6 mm, and cavities. None of them was used for choosing constants;
`--fit` prints the regression's weights, and the widths of intervals, from those that were. `--c3vd` measures results
of whole C3VD videos instead, each against the `coverage_mesh.obj` in the video's folder.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

from scopemap.apps.coverage.coverage import HIDDEN_AREA, Coverage, coverage
from scopemap_bench.evaluation.coverage import (
    CoverageErrors,
    coverage_errors,
    observed_faces,
    shown_faces,
    similarity_to_truth,
)
from scopemap_bench.scripts import measuring

FAST = ("--frames", 50, "--set", "speed=3")
BACK = ("--set", "route=withdrawal")
DEEP = ("--set", "fold_mm=9")
SHALLOW = ("--set", "fold_mm=4")
TURNS = ("--events", "turn:14-20,turn:34-40")
TURNS_BACK = ("--events", "turn:18-24,turn:34-40")
CAVITY = ("--scene", "laparoscopy")
PHANTOMS: dict[str, tuple[object, ...]] = {
    **{f"wander-{seed}": FAST for seed in (71, 72)},
    "loop-73": (*FAST, "--loop"),
    **{f"withdrawal-{seed}": (*FAST, *BACK) for seed in (74, 75)},
    "deep-withdrawal-76": (*FAST, *DEEP, *BACK),
    **{f"turn-{seed}": (*FAST, *TURNS) for seed in (77, 78)},
    "turn-withdrawal-79": (*FAST, *BACK, *TURNS_BACK),
    **{f"deep-{seed}": (*FAST, *DEEP) for seed in (80, 81, 82)},
    **{f"laparoscopy-{seed}": (*FAST, *CAVITY) for seed in (83, 84)},
}
_SLOW = ("--frames", 150)
_NARROW = ("--set", "fov_deg=70")
_WIDE = ("--set", "fov_deg=110")
_FITTED_WORDS: list[tuple[object, ...]] = [
    *(FAST, FAST, (*FAST, *_NARROW), (*FAST, *_WIDE), _SLOW, (*_SLOW, *BACK), (*_SLOW, *DEEP), (*FAST, *BACK)),
    *((*FAST, *BACK), (*FAST, *BACK, *_NARROW), (*FAST, *TURNS), (*FAST, *TURNS), (*FAST, *BACK, *TURNS_BACK)),
    *((*FAST, *DEEP), (*FAST, *DEEP), (*FAST, *DEEP, *_WIDE), (*FAST, *DEEP, *BACK), (*FAST, *SHALLOW)),
    *((*FAST, "--loop"), (*FAST, *CAVITY), (*FAST, *CAVITY), (*FAST, *CAVITY, "--set", "fov_deg=60")),
    *((*FAST, *CAVITY, *TURNS), (*FAST, *CAVITY, *TURNS), ("--frames", 120, *CAVITY), (*FAST, *CAVITY, *_WIDE)),
    *(("--frames", 30, *CAVITY), (*FAST, "--set", "fold_mm=8"), (*FAST, *BACK, *SHALLOW), (*FAST, *DEEP, *TURNS), FAST),
]
FITTED = {f"fitted-{101 + number}": words for number, words in enumerate(_FITTED_WORDS)}
_EVERY = 12
_STEPS = 12


def found_and_true(name: str, words: tuple[object, ...], folder: Path) -> tuple[Coverage, CoverageErrors, np.ndarray]:
    """Render and run a phantom unless that was done; return coverage, errors, and which true faces are hidden (F,)."""
    source = measuring.phantom(folder / name, *words, "--seed", name.split("-")[-1])
    run = measuring.run_once(source, folder / f"{name}-run")
    found, similarity = coverage(run), similarity_to_truth(run, source)
    mesh, shown = shown_faces(source)
    nearest = cKDTree(mesh.triangles_center).query(similarity.transform_points(found.surface.triangles_center))[1]
    return found, coverage_errors(found, similarity, mesh, shown), ~shown[nearest]


def of_c3vd(run: Path, video: Path) -> tuple[str, Coverage, CoverageErrors]:
    """Return the name of a C3VD video, the coverage of a result of it, and its errors."""
    truth, found = observed_faces(video), coverage(run)
    return video.name, found, coverage_errors(found, similarity_to_truth(run, video), *truth)


def print_fit(folder: Path) -> None:
    """Print the weights, and for lumens and cavities the odds ratio that nine in ten keep, each phantom left out."""
    parts = [found_and_true(name, words, folder) for name, words in FITTED.items()]
    apart: dict[str, list[float]] = {}
    for left_out, (found, errors, _) in enumerate(parts):
        weights, kind = fitted_weights(parts[:left_out] + parts[left_out + 1 :]), found.layout.kind
        examined = np.isfinite(found.unseen)
        area, p = found.surface.area_faces[examined], expit(found.features[examined] @ weights)
        odds = HIDDEN_AREA[kind] * (area @ p) / (area @ (1 - p))
        apart.setdefault(kind, []).append(abs(np.log(errors.share / (1 - errors.share) / odds)))
    print(np.round(fitted_weights(parts), 3).tolist())
    print({kind: round(float(np.exp(np.quantile(own, 0.9))), 1) for kind, own in apart.items()})


def fitted_weights(parts: list[tuple[Coverage, CoverageErrors, np.ndarray]]) -> np.ndarray:
    """Return the weights of the logistic regression, by Newton's method, on every 12th face of phantoms."""
    chosen = [np.flatnonzero(np.isfinite(found.unseen))[::_EVERY] for found, _, _ in parts]
    x = np.concatenate([found.features[faces] for (found, _, _), faces in zip(parts, chosen, strict=True)])
    y = np.concatenate([hidden[faces] for (_, _, hidden), faces in zip(parts, chosen, strict=True)])
    weights, weak = np.zeros(x.shape[1]), np.eye(x.shape[1])
    for _ in range(_STEPS):
        p = expit(x @ weights)
        weights += np.linalg.solve((x * (p * (1 - p))[:, None]).T @ x + weak, x.T @ (y - p) - weights)
    return weights


def print_table(parts: Iterable[tuple[str, Coverage, CoverageErrors]]) -> None:
    """Print a row for each result, by its name, and the sums over lumens and cavities."""
    heads = ("not seen, true", "estimated", "error, points", "segments inside", "spots right", "spots found")
    measuring.print_head("result", *heads)
    everything: dict[str, list[tuple[Coverage, CoverageErrors]]] = {}
    for name, found, errors in parts:
        everything.setdefault(found.layout.kind, []).append((found, errors))
        total, inside = found.total, _inside(found, errors)
        estimated = f"{total.share:.1%} ({total.low:.0%} to {total.high:.0%})"
        cells = [_of(values) for values in (inside[1:], errors.right, errors.found)]
        measuring.print_row(name, f"{errors.share:.1%}", estimated, f"{_points(found, errors):+.1f}", *cells)
    for kind, own in everything.items():
        points = [abs(_points(*part)) for part in own]
        held = [_inside(*part) for part in own]
        lists = [
            [one[1:] for one in held],
            [errors.right for _, errors in own],
            [errors.found for _, errors in own],
        ]
        cells = [_of([*chain(*values)]) for values in lists]
        error = f"{np.median(points):.1f} median, {max(points):.1f} most"
        measuring.print_row(f"all: {kind}", "", f"{_of([one[0] for one in held])} inside", error, *cells)


def _points(found: Coverage, errors: CoverageErrors) -> float:
    return 100 * (found.total.share - errors.share)


def _inside(found: Coverage, errors: CoverageErrors) -> list[bool]:
    """Return whether the true share is in the interval: of the whole, then of each segment."""
    shares = zip([found.total, *found.segments], [errors.share, *errors.segments], strict=True)
    return [bool(part.low <= true <= part.high) for part, true in shares]


def _of(values: list[bool]) -> str:
    return f"{sum(values)} of {len(values)}"


def main() -> None:
    """Print the table, or the weights."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--only", nargs="+", choices=PHANTOMS, default=list(PHANTOMS), metavar="NAME")
    parser.add_argument("--fit", action="store_true", help="print the regression's weights")
    places, help_c3vd = ("RESULT", "VIDEO"), "measure a result of a C3VD video, which is the second folder"
    parser.add_argument("--c3vd", nargs=2, type=Path, action="append", metavar=places, help=help_c3vd)
    options = parser.parse_args()
    if options.c3vd:
        print_table(of_c3vd(*pair) for pair in options.c3vd)
        return
    with measuring.folder_or_scratch(options.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        if options.fit:
            print_fit(folder)
        else:
            print_table((name, *found_and_true(name, PHANTOMS[name], folder)[:2]) for name in options.only)


if __name__ == "__main__":
    main()
