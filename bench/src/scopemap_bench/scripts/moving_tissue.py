"""What tissue that moves does to a run with a rigid and with a non-rigid adjustment, on phantoms with exact truth.

    python -m scopemap_bench.scripts.moving_tissue [--out FOLDER] [--seeds 31 32 33] [--only PHANTOM ...]

Phantoms of 100 frames: tissue pushed two ways, breathing of 4 mm twice, a part that is poked, tissue at rest, tissue
that breathes while contractions pass, a push that is let go, an instrument that pulls. Shape and displacement are
those of `evaluation/deformation.py`, at every tenth frame. ATE is after a Sim(3) of the path.
"""

from __future__ import annotations

from pathlib import Path

from scopemap_bench.evaluation.deformation import displacement_error, shape_over_time
from scopemap_bench.scripts import measuring

PHANTOMS = {
    "pushed": ("--scene", "laparoscopy", "--events", "push:30-60"),
    "breath": ("--scene", "colon", "--deform", "--set", "breath_mm=4", "--set", "breath_frames=60"),
    "poked": ("--scene", "laparoscopy", "--events", "poke:30-60"),
    "still": ("--scene", "laparoscopy"),
    "several": ("--scene", "colon", "--deform", "--set", "breath_frames=45", "--events", "peristalsis:0-99"),
    "rebound": ("--scene", "laparoscopy", "--events", "rebound:20-80"),
    "pulled": ("--scene", "laparoscopy", "--events", "grasp:10-90"),
}
FRAMES = 100
CODES = {
    "mapping-adjusted": "rigid",
    "mapping-not-rigid": "as tracked",
    "mapping-depth-disagrees": "as tracked",
    "mapping-tissue-moves": "moving",
}
_COLUMNS = ("taken as", "ATE RMSE mm", "shape over time mm", "displacement mm", "all, rms", "mesh to truth mm")


def print_phantom(name: str, seed: int, folder: Path) -> None:
    """Render a phantom, run it both ways unless that was done, and print its row."""
    stem = f"{name}-{seed}"
    source = measuring.phantom(folder / stem, "--frames", FRAMES, "--seed", seed, *PHANTOMS[name])
    cells: list[list[str]] = []
    for method in ("rigid", "full"):
        run = measuring.run_once(source, folder / f"{stem}-{method}", "--set", f"mapping.method={method}")
        codes = [notice["code"] for notice in measuring.provenance(run)["notices"]]
        figures = measuring.evaluated(run, "--truth", source, "--align", "sim3", "--depth", "none")
        done = next((CODES[code] for code in codes if code in CODES), "as tracked")
        ate, mesh = (measuring.cell(figures, ".2f", name) for name in ("ate_rmse_mm", "mesh_accuracy_mm"))
        shape = shape_over_time(run, source)
        moved = displacement_error(run, source, shape.S_truth_run)
        if not cells:
            cells.append(["", "", "", f"{moved.still_mm:.2f}", f"{moved.still_rms_mm:.2f}", ""])
        cells.append([done, ate, f"{shape.median_mm:.2f}", f"{moved.median_mm:.2f}", f"{moved.rms_mm:.2f}", mesh])
    columns = (" / ".join(filter(None, column)) for column in zip(*cells, strict=True))
    measuring.print_row(f"{name}, seed {seed}", *columns)


def main() -> None:
    """Print the table."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[31, 32, 33], help="seeds of the phantoms")
    parser.add_argument("--only", nargs="+", choices=PHANTOMS, default=[*PHANTOMS], help="phantoms, all by default")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        print("With mapping.method=rigid / by default; displacement: if nothing moved / rigid / by default:\n")
        measuring.print_head("phantom", *_COLUMNS)
        for name in options.only:
            for seed in options.seeds:
                print_phantom(name, seed, folder)


if __name__ == "__main__":
    main()
