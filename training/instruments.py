"""One command trains the head that finds instruments, on a trunk that stays as it is.

    python -m training.instruments --out runs/instruments --start src/scopemap/engine/depth/scopenet/scopenet.onnx

It renders scenes and layers of instruments, trains the head, puts its threshold where hardly any tissue is taken for an
instrument, on training scenes, tells what it reaches on held-out ones, and writes the network with both outputs.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

import torch

from training.export import export, read_network
from training.instrument_training import Pictures, Recipe, figures, fit_threshold, rendered, train_head
from training.network import ScopeNet

_BEGIN_SHARE = 0.02


def main(arguments: list[str] | None = None) -> int:
    """Render what is missing, train, fit the threshold, tell figures, export."""
    parser = argparse.ArgumentParser(prog="training.instruments", description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the log, figures and the network")
    parser.add_argument("--start", type=Path, required=True, help="a scopenet.onnx, whose depth stays; its head learns")
    parser.add_argument("--scenes", type=Path, help="folder of the rendered scenes and layers (OUT/scenes)")
    parser.add_argument("--recipe", type=Path, help="TOML with settings of training/instrument_training.py")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="processor threads to use")
    given = parser.parse_args(arguments)
    torch.set_num_threads(given.threads)
    recipe = Recipe.read(given.recipe) if given.recipe else Recipe()
    given.out.mkdir(parents=True, exist_ok=True)

    def say(text: str) -> None:
        print(text, flush=True)
        with (given.out / "log.txt").open("a", encoding="utf-8") as log:
            log.write(text + "\n")

    folder = given.scenes or given.out / "scenes"
    scenes, layers = rendered(recipe, folder, given.threads, say, "train")
    torch.manual_seed(recipe.seed)
    network = read_network(given.start)
    if network.instruments is None:
        network = with_new_head(network)
    else:
        # The threshold of the training before is in its bias, from where the way back is long.
        _move_threshold(network, fit_threshold(network, scenes, recipe, _BEGIN_SHARE))
    assert network.instruments is not None
    network.instruments = train_head(network, Pictures(scenes, layers, recipe.tissue_alone, recipe.hard), recipe, say)
    threshold = fit_threshold(network, scenes, recipe, recipe.false_share)
    _move_threshold(network, threshold)
    facts = {"name": "scopenet", "licence": "Apache-2.0", "instruments": json.dumps(asdict(recipe))}
    export(network, given.out / "scopenet.onnx", facts)
    held_out = rendered(recipe, folder, given.threads, say, "held-out")
    found = {"threshold, logit": threshold} | figures(network, *held_out, recipe)
    (given.out / "figures.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    for name, value in found.items():
        say(f"{name}: {value:.4f}")
    return 0


def with_new_head(network: ScopeNet) -> ScopeNet:
    """Return a network with the trunk of another one, and a head for instruments that knows nothing yet."""
    found = ScopeNet(instruments=True)
    assert found.instruments is not None
    torch.nn.init.constant_(found.instruments.last.bias, -3.0)  # type: ignore[arg-type]
    found.load_state_dict(found.state_dict() | network.state_dict())
    return found.eval()


def _move_threshold(network: ScopeNet, logit: float) -> None:
    """Make that logit the one of probability 0.5."""
    assert network.instruments is not None
    with torch.no_grad():
        network.instruments.last.bias -= logit  # type: ignore[operator]


if __name__ == "__main__":
    sys.exit(main())
