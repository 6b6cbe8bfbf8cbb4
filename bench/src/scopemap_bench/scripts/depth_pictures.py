"""Pictures of predicted depth beside the truth, and sparsification curves, as PNG files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from scopemap.frame import Frame
from scopemap.report.canvas import new_figure
from scopemap.report.depth_figures import colour_depth
from scopemap_bench.scripts.depth_measures import REMOVED, Prediction, SequenceScore

_ROWS = 5
_LARGEST_ERROR = 0.5
_HEADS = ("image", "predicted, median-scaled", "true", "relative error -50..50 %", "sigma / depth 0..50 %")


def draw_scene(
    frames: Sequence[Frame], truths_mm: Sequence[np.ndarray], made: Sequence[Prediction], file: Path
) -> None:
    """Draw up to five frames, a row each: image, predicted and true depth on one scale, relative error, sigma.

    Depths are (H, W) mm; too far is red, too near blue, unknown black (depth) or grey (error, sigma).
    """
    shown = np.unique(np.linspace(0, len(frames) - 1, min(_ROWS, len(frames))).round().astype(int))
    figure = new_figure(3.1 * len(_HEADS), 2.6 * len(shown) + 0.4)
    grid = figure.subplots(len(shown), len(_HEADS), squeeze=False)
    for axes, head in zip(grid[0], _HEADS, strict=True):
        axes.set_title(head, fontsize=10)
    for row, k in zip(grid, shown, strict=True):
        frame, truth_mm, depth_mm = frames[k], truths_mm[k], made[k].depth_mm
        known = np.isfinite(truth_mm) & (depth_mm > 0)
        scaled_mm = depth_mm * np.median(truth_mm[known]) / np.median(depth_mm[known])
        near_mm, far_mm = np.percentile(truth_mm[known], (1, 99))
        for axes, depth in zip(row[1:3], (scaled_mm, truth_mm), strict=True):
            axes.imshow(colour_depth(depth, near_mm, max(far_mm, near_mm + 1e-3)))
        row[0].imshow(frame.rgb)
        row[0].text(2, 4, f"frame {frame.index}", color="white", va="top", fontsize=9)
        error = np.where(known, scaled_mm / truth_mm - 1, np.nan)
        row[3].imshow(error, cmap="coolwarm", vmin=-_LARGEST_ERROR, vmax=_LARGEST_ERROR)
        row[3].text(2, 4, f"AbsRel {np.nanmean(np.abs(error)):.3f}", va="top", fontsize=9)
        sigma_mm = made[k].sigma_mm
        share = np.full_like(depth_mm, np.nan) if sigma_mm is None else sigma_mm / depth_mm
        row[4].imshow(share, cmap="viridis", vmin=0, vmax=_LARGEST_ERROR)
        for axes in row:
            axes.set(xticks=[], yticks=[], facecolor="0.6")
    figure.savefig(file)


def draw_sparsification(scenes: Mapping[str, Mapping[str, SequenceScore]], file: Path) -> None:
    """Draw AbsRel over the share of removed pixels: one panel per scene, a colour per estimator, its oracle dashed."""
    figure = new_figure(4.2 * len(scenes), 3.8)
    for axes, (scene, scores) in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes.items(), strict=True):
        told = {name: score for name, score in scores.items() if score.sparsification}
        for number, (name, score) in enumerate(told.items()):
            colour = f"C{number}"
            axes.plot(100 * REMOVED, score.sparsification, color=colour, label=f"{name}, AUSE {score.mean.ause:.2f}")
            axes.plot(100 * REMOVED, score.oracle, "--", color=colour, linewidth=0.9)
        axes.set(title=scene, xlabel="most uncertain pixels removed, %", ylabel="AbsRel of the rest")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        if told:
            axes.legend(fontsize=8, title="dashed: the largest errors removed", title_fontsize=8)
    figure.savefig(file)
