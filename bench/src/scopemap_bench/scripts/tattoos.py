"""Accuracy of points of dye that results of STIR's clips follow from the first frame to the last, beside nothing moves.

    python -m scopemap_bench.scripts.tattoos --runs RESULT ... --clips CLIP ...

The accuracy is that of STIR's challenge; see `evaluation/tattoos.py`.
"""

from __future__ import annotations

from pathlib import Path

from scopemap_bench.datasets.stir import StirClip
from scopemap_bench.evaluation.tattoos import THRESHOLDS_PX, accuracy, followed
from scopemap_bench.scripts import measuring


def main() -> None:
    """Print the table."""
    parser = measuring.options_of(__doc__)
    parser.add_argument("--runs", type=Path, nargs="+", required=True, help="results of `scopemap run`")
    parser.add_argument("--clips", type=Path, nargs="+", required=True, help="their clips, in the same order")
    options = parser.parse_args()
    names = [f"within_{limit}_px" for limit in THRESHOLDS_PX]
    print("Nothing moves / as the result has it:\n")
    measuring.print_head("clip", "points", "accuracy", *(name.replace("_", " ") for name in names), "median px")
    for run, clip in zip(options.runs, options.clips, strict=True):
        start, end = StirClip(clip).tattoos()
        both = [accuracy(points, end) for points in (start, followed(run, clip, start))]
        cells = (" / ".join(f"{figures[name]:.2f}" for figures in both) for name in ("accuracy", *names, "median_px"))
        measuring.print_row(clip.name, len(start), *cells)


if __name__ == "__main__":
    main()
