"""What a training leaves behind for people: figures by kind of scene, and the curves of the log."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from scopemap.depth.scopenet.network import ScopeNet
from training.buffers import Store
from training.evaluate import Summary, score_pictures
from training.scene import KINDS


def write_report(network: ScopeNet, store: Store, folder: Path, say: Callable[[str], None]) -> None:
    """Write held_out.json and curves.png, and say the figures."""
    scores = score_pictures(network, store)
    table = {"all": Summary.of(scores)}
    for number, name in KINDS.items():
        if ours := [score for score in scores if score.kind == number]:
            table[name] = Summary.of(ours)
    (folder / "held_out.json").write_text(json.dumps({k: asdict(v) for k, v in table.items()}, indent=2) + "\n")
    for name, row in table.items():
        say(
            f"{name:12s} {row.pictures:4d} pictures: AbsRel {row.abs_rel:.3f} (tissue {row.tissue:.3f}), delta<1.25 "
            f"{row.delta:.3f}, unscaled AbsRel {row.unscaled:.3f}, rank {row.rank:.2f} (pooled {row.pooled_rank:.2f})"
        )
    _draw_curves(folder)


def _draw_curves(folder: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with (folder / "log.csv").open(encoding="utf-8") as stream:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(stream)]
    figure = Figure(figsize=(7, 4))
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name in ("l1", "held_out", "gradient", "normal"):
        axes.plot([row["step"] for row in rows], [row[name] for row in rows], label=name.replace("_", "-"))
    axes.set_xlabel("step")
    axes.set_yscale("log")
    axes.legend()
    figure.savefig(folder / "curves.png", dpi=120)
