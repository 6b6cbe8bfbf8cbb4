"""What a training leaves behind for people: figures by kind of scene, and the curves of the log."""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from training.buffers import Store, open_store
from training.evaluate import Look, PictureScore, Summary, score_pictures
from training.export import read_network
from training.network import ScopeNet
from training.scene import KINDS

LOOKS = {
    "whole size": Look(),
    "whole size, nothing strange": Look(strange=False),
    "half size": Look(stride=2),
    "half size, nothing strange": Look(stride=2, strange=False),
}


def write_report(network: ScopeNet, store: Store, folder: Path, say: Callable[[str], None]) -> None:
    """Write held_out.json, by look and kind of scene, and curves.png, and say the figures."""
    tables = {words: _by_kind(score_pictures(network, store, look)) for words, look in LOOKS.items()}
    plain = {words: {kind: asdict(row) for kind, row in table.items()} for words, table in tables.items()}
    (folder / "held_out.json").write_text(json.dumps(plain, indent=2) + "\n", encoding="utf-8")
    for words, table in tables.items():
        say(f"held-out scenes, {words}:")
        for kind, row in table.items():
            errors = f"AbsRel {row.abs_rel:.3f} (tissue {row.tissue:.3f}), unscaled {row.unscaled:.3f}"
            others = f"delta<1.25 {row.delta:.3f}, rank {row.rank:.2f} (pooled {row.pooled_rank:.2f})"
            say(f"{kind:12s} {row.pictures:4d} pictures: {errors}, {others}")
    if (folder / "log.csv").is_file():
        _draw_curves(folder)


def _by_kind(scores: list[PictureScore]) -> dict[str, Summary]:
    found = {name: [score for score in scores if score.kind == number] for number, name in KINDS.items()}
    return {"all": Summary.of(scores)} | {name: Summary.of(some) for name, some in found.items() if some}


def main(arguments: list[str] | None = None) -> None:
    """Command line: `python -m training.report --model FILE --scenes FOLDER --out FOLDER`."""
    parser = argparse.ArgumentParser(prog="training.report", description="Figures of weights on held-out scenes.")
    parser.add_argument("--model", type=Path, required=True, help="weights, as `python -m training` exports them")
    parser.add_argument("--scenes", type=Path, required=True, help="store of the held-out scenes")
    parser.add_argument("--out", type=Path, required=True, help="folder for held_out.json")
    options = parser.parse_args(arguments)
    network = read_network(options.model)
    options.out.mkdir(parents=True, exist_ok=True)
    write_report(network, open_store(options.scenes), options.out, print)


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


if __name__ == "__main__":
    main()
