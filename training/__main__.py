"""One command renders the scenes, trains, evaluates and exports: python -m training --out RUN."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path


def main() -> int:
    """Run what is not done yet; a stopped run goes on with the same command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of this training: log, checkpoint, weights")
    parser.add_argument("--scenes", type=Path, help="folder of the rendered scenes, shared by trainings (OUT/scenes)")
    parser.add_argument("--recipe", type=Path, help="TOML with settings of training/recipe.py")
    parser.add_argument("--start", type=Path, help="weights to begin from, instead of nothing: another run's result")
    parser.add_argument("--seed", type=int, help="instead of the recipe's")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="processor threads to use")
    parser.add_argument("--device", default="", help="cpu or cuda; empty: cuda where there is one")
    options = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", str(options.threads))

    # After the threads are set: the libraries read that when they are imported.
    import torch

    from training.buffers import open_store
    from training.calibrate import calibrated, fit_calibration
    from training.export import export
    from training.recipe import Recipe
    from training.render import counted, render_store
    from training.report import write_report
    from training.train import Training

    torch.set_num_threads(options.threads)
    recipe = Recipe.read(options.recipe) if options.recipe else Recipe()
    if options.seed is not None:
        recipe = replace(recipe, seed=options.seed)
    scenes = options.scenes or options.out / "scenes"
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "recipe.toml").write_text(recipe.toml(), encoding="utf-8")
    for n, part in enumerate((*recipe.parts, recipe.held_out)):
        size, seed = (part.height, part.width), recipe.scene_seed * 1000 + n
        progress = counted(f"{part.name} scenes", 1000, _say)
        render_store(scenes / part.name, part.count, size, seed, workers=options.threads, progress=progress)
    device = options.device or ("cuda" if torch.cuda.is_available() else "cpu")
    network = Training(recipe, scenes, options.out, device, _say, start=options.start).run(options.threads)
    calibration = fit_calibration(network, [open_store(scenes / part.name) for part in recipe.parts])
    _say(f"calibrated on training scenes: exponent {calibration.exponent:.3f}, spread times {calibration.spread:.3f}")
    network = calibrated(network, calibration)
    facts = {"name": "scopenet", "licence": "Apache-2.0", "seed": str(recipe.seed), "steps": str(recipe.steps)}
    export(network, options.out / "scopenet.onnx", facts)
    write_report(network, open_store(scenes / recipe.held_out.name), options.out, _say)
    return 0


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
