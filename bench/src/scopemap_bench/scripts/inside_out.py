"""A scene that the depth network sees inside out, and what turns it round: windows, other starts, both, neither.

    python -m scopemap_bench.scripts.inside_out [--out FOLDER] [--picture FILE]

A phantom of a dark omentum before a lit wall, a narrow beam, 45 degrees, seen sideways. A row is a run: without the
adjustment of keyframes as they come ("windows"), without other starts of it, and so on. Depth: AbsRel with one median
scale a frame, and correlation of ln depth with the true one, mean over frames. --picture: a frame, its true depth, and
its depth by the first and by the last row.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.input.opening import open_sequence
from scopemap.result.evidence import notices_of
from scopemap.result.result import Result
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.clinical_phantoms import FRAMES, PHANTOMS, SEED
from scopemap_bench.scripts.real import depth_figures

NAME = "dark omentum before a lit wall, narrow beam, 45 degrees, sideways"
ROWS: dict[str, tuple[str, ...]] = {
    "neither": ("--set", "mapping.local_window=0", "--set", "mapping.other_starts=false"),
    "windows": ("--set", "mapping.other_starts=false"),
    "other starts": ("--set", "mapping.local_window=0"),
    "both (default)": (),
}
SHOWN = 60  # frame of the picture


def in_colours(depth_mm: np.ndarray) -> np.ndarray:
    """Return a relief (H, W, 3) uint8: ln depth less its median, near red, far blue; unknown black."""
    known = depth_mm > 0
    relief = np.log(np.where(known, depth_mm, 1.0))
    share = np.clip(0.5 - (relief - np.median(relief[known])) / 0.8, 0, 1)
    coloured = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)
    coloured[~known] = 0
    return coloured


def write_picture(file: Path, source: Path, first: Path, last: Path) -> None:
    """Write frame, true depth, and depth of two runs side by side."""
    frame, true = next((frame, true) for frame, true in open_sequence(source) if frame.index == SHOWN)
    assert true is not None
    assert true.depth_mm is not None
    depths = [np.nan_to_num(true.depth_mm), *(np.nan_to_num(Result(run).depth.read(SHOWN)) for run in (first, last))]
    row = np.hstack([cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), *map(in_colours, depths)])
    cv2.imwrite(str(file), row, [cv2.IMWRITE_JPEG_QUALITY, 88])


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--picture", type=Path, help="write the picture here")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        source = measuring.phantom(out / "inside-out", "--frames", FRAMES, "--seed", SEED, *PHANTOMS[NAME])
        measuring.print_head("used", "AbsRel / correlation", "ATE RMSE mm", "said")
        runs = {name: out / f"inside-out-{place}" for place, name in enumerate(ROWS)}
        for name, settings in ROWS.items():
            run = measuring.run_once(source, runs[name], *settings)
            depth = depth_figures(Result(run), source, None)
            path = measuring.evaluated(run, "--truth", source, "--align", "sim3")
            said = [n.code for n in notices_of(measuring.provenance(run)) if n.code.startswith(("shape", "mapping"))]
            cells = [measuring.cell(depth, ".3f", "abs_rel", "correlation"), measuring.cell(path, ".3f", "ate_rmse_mm")]
            measuring.print_row(name, *cells, ", ".join(said))
        if options.picture:
            write_picture(options.picture, source, *(runs[name] for name in (*ROWS,)[:: len(ROWS) - 1]))


if __name__ == "__main__":
    main()
