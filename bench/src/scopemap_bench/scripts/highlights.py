"""How right is a run's depth under highlights, where it continues what is around them, and where it does not.

    python -m scopemap_bench.scripts.highlights --data FOLDER [--out FOLDER] [--only NAME ...]

Each real clip with true depth is run twice. Under small highlights and around them the logarithm of the final depth is
compared with the true one, after the median difference around them is taken away. A cell has the median error and the
90th percentile.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.depth.under_highlights import small_highlights
from scopemap.input.opening import open_sequence
from scopemap.result.result import Result
from scopemap.runner.reread_frames import open_input
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.earns import folder_name, is_wanted, run_with
from scopemap_bench.scripts.real import clips

RUNS = {"as it is": "", "as estimated": "depth.under_highlights._LARGEST=0.0"}
AROUND_PX = 7
"""How far from a highlight is around it."""
LEAST_PX = 50
"""Pixels around highlights with true depth, fewer of which give no scale."""


def errors(run: Path, truth: Path) -> dict[str, np.ndarray]:
    """Return |ln(depth / true depth)| of a run, "under" highlights and "around" them; {} where there are none."""
    result, (sequence, mask) = Result(run), open_input(run)
    true_mm = {frame.index: true.depth_mm for frame, true in open_sequence(truth) if true is not None}
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    for frame in map(mask, sequence.frames()):
        depth_mm, true = result.depth.read(frame.index), true_mm.get(frame.index)
        if depth_mm is None or true is None or frame.highlights is None:
            continue
        under = small_highlights(frame.highlights)
        near = cv2.dilate(under.astype(np.uint8), np.ones((2 * AROUND_PX + 1,) * 2, np.uint8)) > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.log(depth_mm / true)
        known = np.isfinite(error)
        around, under = near & frame.valid & known, under & known
        if around.sum() >= LEAST_PX and under.any():
            shift = np.median(error[around])
            found["around"].append(np.abs(error - shift)[around])
            found["under"].append(np.abs(error - shift)[under])
    return {where: np.concatenate(some) for where, some in found.items()}


def main() -> None:
    """Run, compare, print."""
    parser = measuring.options_of(__doc__, data=True, out=True)
    parser.add_argument("--only", nargs="+", default=["*"], help="patterns of names of clips")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        measuring.print_head("clip", *(f"{where}, {name}, %" for name in RUNS for where in ("under", "around")))
        for clip in clips(options.data):
            if not clip.has_depth or not is_wanted(clip.name, options.only):
                continue
            cells = []
            for name, switch in RUNS.items():
                run = out / folder_name(name) / folder_name(clip.name)
                run_with(clip, switch, run)
                found = errors(run, clip.truth(out / "truth" / folder_name(clip.name)))
                for where in ("under", "around"):
                    shares = found.get(where, np.full(1, np.nan))
                    cells.append("{:.1f}, {:.1f}".format(*100 * np.percentile(shares, [50, 90])))
            measuring.print_row(clip.name, *cells)


if __name__ == "__main__":
    main()
