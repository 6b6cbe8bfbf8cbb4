"""How much of the instruments is in the surface, on phantoms with exact truth, and how much tissue is lost.

    python -m scopemap_bench.scripts.instruments [--out FOLDER] [--seeds 51 52 53] [--data ../shared/data]

Phantoms of 80 frames in which instruments enter, work and leave twice. Runs without and with free-space evidence, by
`fusion.method`, where the depth network's masks of instruments are off and on (`mask.instruments`). A pixel is in the
surface where its depth is fused. Lost tissue: pixels that show tissue and are fused without masks and evidence
alone. With --data: what a run with `mask.instruments=auto` leaves out of EndoNeRF's `pulling_soft_tissues`, against its
masks, among usable pixels.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np

from scopemap.apps.evaluate.against_video import RunFrames
from scopemap.input.mask_files import MaskFiles
from scopemap.runner.reread_frames import open_input
from scopemap_bench.scripts import measuring

EVENTS = "instrument:10-40,instrument:50-75"
METHODS = {"without": "no-free-space", "with": "scopemap"}


def fused_pixels(run: Path) -> dict[int, np.ndarray]:
    """Return which pixels (H, W) bool of a run's frames are fused, by number."""
    with closing(RunFrames(run)) as frames:
        found = {}
        for frame in frames.frames():
            assert frame.highlights is not None
            assert frame.depth_mm is not None
            found[frame.index] = (frame.valid | frame.highlights) & (frame.depth_mm > 0)
        return found


def tools(source: Path, indices: Iterable[int]) -> dict[int, np.ndarray]:
    """Return which pixels (H, W) bool of a phantom's frames show an instrument: 0 in its depth files, by number."""
    return {n: np.asarray(cv2.imread(str(source / f"{n:04d}_depth.tiff"), cv2.IMREAD_UNCHANGED)) == 0 for n in indices}


def print_phantom(scene: str, seed: int, folder: Path) -> None:
    """Render a phantom, run it in all ways unless that was done, and print its rows."""
    stem, fused = f"{scene}-{seed}", dict[tuple[str, str], dict[int, np.ndarray]]()
    words = ("--scene", scene, "--frames", 80, "--seed", seed, "--events", EVENTS)
    source = measuring.phantom(folder / stem, *words)
    for masks in ("files", "auto"):
        errors = []
        for name, method in METHODS.items():
            settings = ("--set", f"mask.instruments={masks}", "--set", f"fusion.method={method}")
            run = measuring.run_once(source, folder / f"{stem}-{masks}-{name}", *settings)
            fused[masks, name] = fused_pixels(run)
            figures = measuring.evaluated(run, "--truth", source, "--align", "sim3", "--depth", "none")
            errors.append(measuring.cell(figures, ".2f", "mesh_accuracy_mm"))
        tool, every = tools(source, fused[masks, "with"]), fused["files", "without"]
        shares = []
        for name in METHODS:
            kept = fused[masks, name]
            in_surface = sum((kept[n] & tool[n]).sum() for n in kept if n in tool) / sum(tool[n].sum() for n in tool)
            lost = [(every[n] & ~tool[n] & ~kept[n]).sum() for n in kept if n in every]
            tissue = [(every[n] & ~tool[n]).sum() for n in kept if n in every]
            shares.append((f"{in_surface:.1%}", f"{sum(lost) / sum(tissue):.1%}"))
        in_surface_of, lost_of = (" / ".join(column) for column in zip(*shares, strict=True))
        measuring.print_row(f"{scene}, seed {seed}", masks, in_surface_of, lost_of, " / ".join(errors))


def print_pulling(source: Path, folder: Path) -> None:
    """Run `pulling_soft_tissues` unless that was done, and print IoU with its masks, and how much tissue is lost."""
    settings = ("--camera-at-rest", "--set", "mask.files=none", "--set", "mask.instruments=auto")
    run = measuring.run_once(source, folder / "pulling", *settings)
    fused, (sequence, mask) = fused_pixels(run), open_input(run, source)
    masks, counts = MaskFiles(source / "gt_masks", sequence.rectifier), np.zeros(4)
    for frame in map(mask, sequence.frames()):
        tool = masks.covered(frame.index)
        if tool is not None and frame.highlights is not None and frame.index in fused:
            usable = frame.valid | frame.highlights
            left, tool = usable & ~fused[frame.index], usable & tool
            counts += [(left & tool).sum(), (left | tool).sum(), (left & ~tool).sum(), (usable & ~tool).sum()]
    both, either, lost, tissue = counts
    print(f"\npulling_soft_tissues: IoU {both / either:.3f}, tissue lost {lost / tissue:.1%}")


def main() -> None:
    """Print the table."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[51, 52, 53], help="seeds of the phantoms")
    parser.add_argument("--data", type=Path, help="folder of the real data")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        print("Without / with free-space evidence:\n")
        heads = ("tool pixels in the surface", "tissue pixels lost", "mesh to truth mm")
        measuring.print_head("phantom", "mask.instruments", *heads)
        for scene in ("laparoscopy", "colon"):
            for seed in options.seeds:
                print_phantom(scene, seed, folder)
        if options.data:
            print_pulling(options.data / "endoscopy" / "endonerf" / "pulling_soft_tissues", folder)


if __name__ == "__main__":
    main()
