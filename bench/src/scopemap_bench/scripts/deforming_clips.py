"""Results of clips of tissue that deforms against what is known before and after: STIR's points of dye, D4D's light.

    python -m scopemap_bench.scripts.deforming_clips --runs RESULT ... --clips CLIP ...

Accuracy is that of STIR's challenge (`evaluation/tattoos.py`); differences from structured light are those of
`structured_light_errors`, mm. Each is printed beside that of nothing moved.
"""

from __future__ import annotations

from pathlib import Path

from scopemap.input.opening import open_source
from scopemap_bench.datasets.stir import StirClip
from scopemap_bench.evaluation.structured_light import structured_light_errors
from scopemap_bench.evaluation.tattoos import THRESHOLDS_PX, accuracy, followed
from scopemap_bench.scripts import measuring

_SHARES = [f"within_{limit}_px" for limit in THRESHOLDS_PX]


def print_points(run: Path, clip: StirClip) -> None:
    """Print the figures of a clip of STIR, if nothing moves / by the result's depth and poses."""
    start, end = clip.tattoos()
    both = [accuracy(points, end) for points in (start, followed(run, clip.path, start))]
    names = ("accuracy", *_SHARES, "median_px")
    cells = (f"{name} " + " / ".join(f"{figures[name]:.2f}" for figures in both) for name in names)
    measuring.print_row(clip.path.name, f"{len(start)} points", *cells)


def main() -> None:
    """Print a row for each clip."""
    parser = measuring.options_of(__doc__)
    parser.add_argument("--runs", type=Path, nargs="+", required=True, help="results of `scopemap run`")
    parser.add_argument("--clips", type=Path, nargs="+", required=True, help="their clips, in the same order")
    options = parser.parse_args()
    for run, path in zip(options.runs, options.clips, strict=True):
        source = open_source(path)
        if isinstance(source, StirClip):
            print_points(run, source)
        else:
            errors = structured_light_errors(run, path)
            measuring.print_row(path.name, *(f"{name} {error:.2f}" for name, error in errors.items()))


if __name__ == "__main__":
    main()
