"""Two examinations of a phantom: frames of the second located in the first, and polyps that went or came.

    python -m scopemap_bench.scripts.examinations [--out FOLDER] [--seeds 72 73 74]

The second examination of a colon goes another way, up to 5 mm beside the first one's, turned by up to 28 degrees, at
another pace, with automatic exposure and H.264; its wall is 5 % wider and breathes by 1 mm, fluid is on other places,
and before the lens of 10 of the 120 frames. One polyp stays, one went, one is new. A frame is located rightly
within 5 mm and 10 degrees of its true pose, after the Sim(3) of the map's own path to the truth. A change is right
within a polyp's diameter of the middle of one that went or came; all others are false.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from scopemap.evaluation.poses import match
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.locating import errors

FRAMES = 120
STAYS = "sessile:8@30"
WENT = "sessile:6@90"
CAME = "sessile:6@65"
LIGHT = ("--set", "examination=1", "--set", "auto_exposure=true", "--set", "h264_crf=26")
TISSUE = ("--set", "insufflation=0.05", "--deform", "--set", "breath_mm=1", "--events", "fluid:50-59")
RIGHT_MM = 5.0
RIGHT_DEG = 10.0


def changes(folder: Path, run: Path, first: Path, second: Path) -> tuple[bool, bool, int]:
    """Return whether the polyp that went was found, whether the new one was, and how many changes are false.

    Of examinations that do not fit no changes are listed.
    """
    S = match(read_trajectory(run), read_trajectory(first), "sim3").similarity
    found = json.loads((folder / "changes.json").read_text(encoding="utf-8"))["changes"] or []
    places = np.array([S.transform_points(np.array(change["place"])) for change in found]).reshape(-1, 3)
    near = np.zeros((2, len(places)), bool)
    for number, source in enumerate((first, second)):
        polyp = json.loads((source / "lesions" / "truth.json").read_text(encoding="utf-8"))[1]
        near[number] = np.linalg.norm(places - polyp["middle_mm"], axis=1) < polyp["diameter_mm"]
    went, came = near.any(axis=1).tolist()
    return went, came, int((~near.any(axis=0)).sum())


def print_pair(seed: int, folder: Path) -> None:
    """Render both examinations, run them, and print their row."""
    common = ("--frames", FRAMES, "--seed", seed)
    first = measuring.phantom(folder / f"{seed}-first", *common, "--polyps", f"{STAYS},{WENT}")
    second = measuring.phantom(folder / f"{seed}-second", *common, "--polyps", f"{STAYS},{CAME}", *LIGHT, *TISSUE)
    runs = [measuring.run_once(source, folder / f"{source.name}-run") for source in (first, second)]
    table = folder / f"{seed}.csv"
    measuring.scopemap("locate", runs[0], second, "--out", table, "--overwrite", "--quiet")
    mm, deg = errors(runs[0], first, table, second)
    right = (mm < RIGHT_MM) & (deg < RIGHT_DEG)
    out = folder / f"{seed}-compared"
    measuring.scopemap("compare-exams", *runs, "--out", out, "--quiet")
    went, came, false = changes(out, runs[0], first, second)
    spread = [" / ".join(f"{np.percentile(e, p):.2f}" for p in (50, 90)) if len(e) else "" for e in (mm, deg)]
    located = f"{len(mm)} of {FRAMES}", f"{right.sum()} of {len(mm)}"
    measuring.print_row(seed, *located, *spread, *("yes" if one else "no" for one in (went, came)), false)


def main() -> None:
    """Print the table."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[72, 73, 74], help="of the phantoms")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        heads = (
            "seed",
            "found",
            "right",
            "position mm",
            "rotation deg",
            "polyp that went",
            "new polyp",
            "false changes",
        )
        measuring.print_head(*heads)
        for seed in options.seeds:
            print_pair(seed, folder)


if __name__ == "__main__":
    main()
