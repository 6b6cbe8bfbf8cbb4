"""How good is depth without any download? Errors of constant depth, shading and the embedded network on real frames.

    python -m scopemap_bench.scripts.depth_without_download --data ../shared/data [--model FILE] [--json FILE]
            [--pictures FOLDER]

The scenes are described in `depth_scenes.py`, the figures in `depth_measures.py`. Several --model (weights of the
network trained with different seeds) share a row: mean (least..most). Without any, the weights in the package are
measured. The few constants of shading were chosen on these very frames; the network never saw them.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from scopemap.config import DepthSettings
from scopemap.depth.shading import ShadingDepth
from scopemap.frame import Frame

# Siblings are found where this file runs as a script; here, too, where it is loaded by its path.
from scopemap_bench.scripts.depth_measures import (
    LAPLACE_WITHIN,
    Prediction,
    SequenceScore,
    Steadiness,
    link_clip,
    score_sequence,
    steadiness,
)
from scopemap_bench.scripts.depth_pictures import draw_scene, draw_sparsification
from scopemap_bench.scripts.depth_scenes import CLIPS, SCENES, Size

SIZES: tuple[Size, ...] = ((160, 128), (320, 256))
NETWORK = "scopenet"

Estimator: TypeAlias = Callable[[Frame], Prediction]
Table: TypeAlias = dict[str, dict[str, SequenceScore]]
Column: TypeAlias = tuple[str, Callable[[SequenceScore], float], str]


def constant() -> Estimator:
    """Return depth that is the shading's prior everywhere."""
    depth_mm = DepthSettings().shading_median_mm
    return lambda frame: Prediction(np.full(frame.valid.shape, depth_mm, np.float32))


def shading() -> Estimator:
    """Return depth by shading, its scale held from a sequence's first frame on."""
    estimator = ShadingDepth(DepthSettings())
    return lambda frame: Prediction(estimator.estimate(frame).values)


def shading_as_depth() -> Estimator:
    """Return what shading takes for distance along the ray, as if it were depth."""
    estimate = shading()
    return lambda frame: Prediction(estimate(frame).depth_mm * np.linalg.norm(frame.camera.rays, axis=-1))


WITHOUT_WEIGHTS: dict[str, Callable[[], Estimator]] = {
    "constant depth": constant,
    "shading as depth": shading_as_depth,
    "shading x ray z": shading,
}
"""By name: makes the estimator anew for each sequence, as some remember its first frame."""


def networks(models: Sequence[str]) -> dict[str, Callable[[], Estimator]]:
    """Return the embedded network with each of these weights files, by default with the package's own."""
    from scopemap.depth.scopenet.estimator import ScopeNetDepth

    def make(model: str) -> Estimator:
        network = ScopeNetDepth(model)

        def estimate(frame: Frame) -> Prediction:
            found = network.estimate(frame)
            return Prediction(found.values, found.sigma)

        return estimate

    names = {model: f"{NETWORK} {Path(model).parent.name}/{Path(model).name}" for model in models} or {"": NETWORK}
    return {name: partial(make, model) for model, name in names.items()}


def measure(
    data: Path,
    size: Size = SIZES[0],
    makers: Mapping[str, Callable[[], Estimator]] = WITHOUT_WEIGHTS,
    pictures: Path | None = None,
) -> Table:
    """Return the score by scene and estimator; with `pictures`, a PNG of each goes there."""
    table: Table = {}
    for scene, pairs in SCENES.items():
        frames, truths_mm = zip(*pairs(data, size), strict=True)
        table[scene] = {}
        for name, maker in makers.items():
            made = [*map(maker(), frames)]
            table[scene][name] = score_sequence(frames, truths_mm, made)
            if pictures is not None:
                file = f"{scene} {size[0]}x{size[1]} {name}"
                draw_scene(frames, truths_mm, made, pictures / (re.sub(r"[^\w.]+", "_", file) + ".png"))
    if pictures is not None:
        draw_sparsification(table, pictures / f"sparsification_{size[0]}x{size[1]}.png")
    return table


def measure_clips(
    data: Path, size: Size, makers: Mapping[str, Callable[[], Estimator]]
) -> dict[str, dict[str, Steadiness]]:
    """Return how steady depth is on consecutive frames, by clip and estimator."""
    table: dict[str, dict[str, Steadiness]] = {}
    for clip, items in CLIPS.items():
        frames, counted = zip(*items(data, size), strict=True)
        links = link_clip(frames)
        table[clip] = {
            name: steadiness(frames[0].camera, counted, [made.depth_mm for made in map(maker(), frames)], links)
            for name, maker in makers.items()
        }
    return table


def spread(values: Iterable[float], form: str) -> str:
    """Return one value as text, or several as mean (least..most); "-" where nothing was measured."""
    known = np.array([value for value in values if math.isfinite(value)])
    if not len(known):
        return "-"
    if len(known) == 1:
        return format(known[0], form)
    return f"{known.mean():{form}} ({known.min():{form}}..{known.max():{form}})"


def rows(scores: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return the scores by row of a table: the network's weights share one."""
    shared: dict[str, list[Any]] = {}
    for name, score in scores.items():
        shared.setdefault(NETWORK if name.startswith(NETWORK) else name, []).append(score)
    return shared


def aligned(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Return a table as text: the first column to the left, the others to the right."""
    widths = [max(len(line[i]) for line in [head, *body]) + (2 if i else 1) for i in range(len(head))]
    lines = [[line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])] for line in [head, *body]]
    return "\n".join("".join(line).rstrip() for line in lines)


def summary(table: Table) -> str:
    """Return median-scaled AbsRel / delta of all scenes as one table."""
    body = [
        [
            name,
            *(
                f"{spread([s.abs_rel for s in group], '.3f')} / {spread([s.delta for s in group], '.2f')}"
                for group in (rows(scores)[name] for scores in table.values())
            ),
        ]
        for name in rows(next(iter(table.values())))
    ]
    return aligned(["AbsRel / delta<1.25", *(scene.rjust(16) for scene in table)], body)


SCALE_COLUMNS: tuple[Column, ...] = (
    ("metric AbsRel", lambda s: s.mean.metric_abs_rel, ".3f"),
    ("true/predicted", lambda s: s.mean.scale, ".2f"),
    ("std ln scale", lambda s: s.scale_log_std, ".3f"),
    ("one scale", lambda s: s.one_scale.abs_rel, ".3f"),
    ("+ exponent", lambda s: s.scale_and_exponent.abs_rel, ".3f"),
    ("delta", lambda s: s.scale_and_exponent.delta, ".2f"),
    ("exponent", lambda s: s.scale_and_exponent.exponent, ".2f"),
    ("exponent, medians", lambda s: s.exponent_and_medians.abs_rel, ".3f"),
)
PLACE_COLUMNS: tuple[Column, ...] = (
    ("saturated share", lambda s: s.mean.saturated_share, ".3f"),
    ("AbsRel there", lambda s: s.mean.saturated_abs_rel, ".3f"),
    ("elsewhere", lambda s: s.mean.unsaturated_abs_rel, ".3f"),
    ("edge share", lambda s: s.mean.edge_share, ".3f"),
    ("AbsRel there", lambda s: s.mean.edge_abs_rel, ".3f"),
    ("elsewhere", lambda s: s.mean.smooth_abs_rel, ".3f"),
)
UNCERTAINTY_COLUMNS: tuple[Column, ...] = (
    ("rank", lambda s: s.mean.rank, ".2f"),
    ("AUSE", lambda s: s.mean.ause, ".3f"),
    ("AUSE / random's", lambda s: s.mean.ause_share, ".2f"),
    (f"1 sigma (ideal {LAPLACE_WITHIN[0]:.2f})", lambda s: s.mean.within_1_sigma, ".2f"),
    (f"2 sigma (ideal {LAPLACE_WITHIN[1]:.2f})", lambda s: s.mean.within_2_sigma, ".2f"),
    ("error / b", lambda s: s.mean.error_over_b, ".2f"),
)


def scene_table(
    title: str, scores: Mapping[str, Any], columns: Sequence[tuple[str, Callable[[Any], float], str]]
) -> str:
    """Return the figures of one scene as a table, a row per estimator."""
    body = [
        [name, *(spread(map(value, group), form) for _, value, form in columns)] for name, group in rows(scores).items()
    ]
    return aligned([title, *(column[0] for column in columns)], body)


STEADY_COLUMNS: tuple[tuple[str, Callable[[Steadiness], float], str], ...] = (
    ("std ln step", lambda s: s.log_step_std, ".4f"),
    ("change", lambda s: s.change, ".4f"),
    ("below 1 %", lambda s: s.rtc, ".3f"),
    ("same colour", lambda s: s.opw_change, ".4f"),
)


def report(table: Table, clips: Mapping[str, Mapping[str, Steadiness]]) -> str:
    """Return all tables of one size as text."""
    parts = [summary(table)]
    for scene, scores in table.items():
        parts.append(scene_table(scene, scores, SCALE_COLUMNS))
        parts.append(scene_table(f"{scene}, where", scores, PLACE_COLUMNS))
        told = {name: score for name, score in scores.items() if score.sparsification}
        if told:
            parts.append(scene_table(f"{scene}, uncertainty", told, UNCERTAINTY_COLUMNS))
    parts += [scene_table(f"{clip}, frame to frame", scores, STEADY_COLUMNS) for clip, scores in clips.items()]
    return "\n\n".join(parts)


def strict(value: Any) -> Any:
    """Return nested dictionaries and sequences of figures with None for NaN, which JSON does not know."""
    if isinstance(value, dict):
        return {key: strict(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [strict(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _size(text: str) -> Size:
    width, height = map(int, text.split("x"))
    return width, height


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the real data")
    parser.add_argument("--model", action="append", default=[], help="weights of the network (file); repeatable")
    parser.add_argument("--no-network", action="store_true", help="measure constant depth and shading only")
    parser.add_argument("--size", type=_size, nargs="+", default=SIZES, metavar="WxH", help="sizes of the frames, px")
    parser.add_argument("--json", type=Path, help="write every figure to this file")
    parser.add_argument("--pictures", type=Path, help="draw depth, errors and sparsification into this folder")
    options = parser.parse_args()
    makers = WITHOUT_WEIGHTS | ({} if options.no_network else networks(options.model))
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    kept: dict[str, Any] = {}
    for size in options.size:
        table = measure(options.data, size, makers, options.pictures)
        clips = measure_clips(options.data, size, makers)
        print(f"{size[0]}x{size[1]} px\n\n{report(table, clips)}\n", flush=True)
        kept[f"{size[0]}x{size[1]}"] = {
            part: {key: {name: asdict(score) for name, score in scores.items()} for key, scores in found.items()}
            for part, found in (("scenes", table), ("clips", clips))
        }
    if options.json:
        options.json.write_text(json.dumps(strict(kept), indent=1, allow_nan=False) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
