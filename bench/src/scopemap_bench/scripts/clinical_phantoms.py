"""What clinical video does to a run, on phantoms with exact truth; as Markdown.

    python -m scopemap_bench.scripts.clinical_phantoms [--only NAME ...] [--seeds N] [--preset NAME] [--out FOLDER]

Each phantom (160 frames of 320x256) has one difficulty: ten pixels a frame, with two turns of 30 degrees
(fast), the same turn between two frames (cut), an instrument that comes and goes twice (instruments), contact with the
wall under automatic exposure (contact), fluid over the lens (fluid), tissue that is pushed two ways and stays so
(pushed), and that breathes (breathing). One run of the command line each, with scopenet. ATE is that of the largest map
after a Sim(3) alignment; other maps of at least ten frames are counted. Phantoms in --out are rendered once: to compare
with another version, run this file with that version first on the path and the same folder.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from scopemap_bench.scripts.overview import scopemap

FRAMES = 160
PHANTOMS = {
    "fast": ("--scene", "colon", "--set", "speed=6", "--events", "turn:50-58,turn:100-108"),
    "cut": ("--scene", "colon", "--events", "turn:80-80"),
    "instruments": ("--scene", "laparoscopy", "--events", "instrument:20-80,instrument:95-150"),
    "contact": (
        *("--scene", "colon", "--events", "contact:60-100"),
        *("--set", "auto_exposure=true", "--set", "exposure_lag_frames=4"),
    ),
    "fluid": ("--scene", "colon", "--events", "fluid:50-100"),
    "pushed": ("--scene", "laparoscopy", "--events", "push:50-90"),
    "breathing": ("--scene", "colon", "--deform"),
}
HEADER = (
    "| phantom, seed | frames tracked | frames in the largest map | maps of >= 10 frames | ATE RMSE mm "
    "| rotation mean / max deg | mesh to truth mm |\n|---|---|---|---|---|---|---|"
)


def row(name: str, phantom: Path, out: Path, preset: str) -> str:
    """Return the row of one run."""
    scopemap("run", str(phantom), "--out", str(out), "--preset", preset, "--quiet", "--overwrite")
    told = json.loads((out / "provenance.json").read_text())
    arguments = ("evaluate", str(out), "--truth", str(phantom), "--align", "sim3", "--json")
    printed = scopemap(*arguments, check=False)
    found = json.loads(printed) if printed else {}
    cells = [f"{told['tracked'] + told.get('in_other_maps', 0)} of {FRAMES}", str(told["tracked"])]
    cells.append(str(1 + len(list((out / "maps").glob("*")))))
    cells.append(f"{found['ate_rmse_mm']:.3f}" if found else "")
    angles = ("rotation_unaligned_mean_deg", "rotation_unaligned_max_deg")
    cells.append(" / ".join(f"{found[angle]:.2f}" for angle in angles) if found else "")
    mesh = found.get("mesh_accuracy_mm")
    return f"| {name} | {' | '.join(cells)} | {'' if mesh is None else f'{mesh:.2f}'} |"


def main() -> None:
    """Render, run, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PHANTOMS, default=list(PHANTOMS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--out", type=Path, help="keep phantoms and results here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        print(HEADER, flush=True)
        for name in options.only:
            for seed in range(21, 21 + options.seeds):
                phantom = folder / f"{name}-{seed}"
                if not (phantom / "mesh_truth.ply").is_file():
                    numbers = ("--frames", str(FRAMES), "--seed", str(seed))
                    scopemap("phantom", str(phantom), *PHANTOMS[name], *numbers, "--quiet")
                print(row(f"{name}, {seed}", phantom, folder / f"{name}-{seed}-run", options.preset), flush=True)


if __name__ == "__main__":
    main()
