"""The final score of a submission to the CLiMB challenge: the mean over its clips of their scores.

A clip's figures are means over its five runs. A clip that is missing, has no valid map or a TFR of 50 % or less counts
as failed, and is not left out. Source: EndoCartoScope/climb-challenge, README.md, "Final score and ranking".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scopemap.engine.errors import AlignmentError, InputError
from scopemap_bench.climb.figures import ClimbScore, climb_figures, climb_score, is_failed
from scopemap_bench.climb.submission import RUNS, with_score
from scopemap_bench.trajectories.climb import read_climb, read_climb_reference

_TIE = 1.05  # scores that differ by at most 5 % are ordered by rotation
_FIGURES = ("ate_mean_mm", "rpe_40_mean_deg", "tfr_percent", "duration_share")


@dataclass(frozen=True)
class Ranking:
    """Scores of a submission.

    clips : of each clip of the references, by its name. failed : names of the clips that count as
    failed.
    """

    clips: dict[str, ClimbScore]
    failed: tuple[str, ...]

    @property
    def final(self) -> ClimbScore:
        """The mean over all clips."""
        scores = self.clips.values()
        return ClimbScore(*(float(np.mean([getattr(one, name) for one in scores])) for name in ("ate", "rotation")))


def ranked(finals: Mapping[str, ClimbScore]) -> list[str]:
    """Return the names of methods from the best to the worst, by their final scores.

    The best by ATE and all that are at most 5 % above it are ordered by rotation, then the best of the others and those
    at most 5 % above that, and so on. The rule alone has no order where A ties with B, and B with C, but A not with C.
    """
    left, order = sorted(finals, key=lambda name: finals[name].ate), list[str]()
    while left:
        tied = [name for name in left if finals[name].ate <= _TIE * finals[left[0]].ate]
        order += sorted(tied, key=lambda name: finals[name].rotation)
        left = left[len(tied) :]
    return order


def ranking_of(submission: Path, references: Path) -> Ranking:
    """Return the scores of a submission against the references in a folder, CLIP/results_txt/images.txt.

    Raises `InputError` where there is none.
    """
    clips = sorted(file.parents[1] for file in references.glob("*/results_txt/images.txt"))
    if not clips:
        raise InputError(f"scoring {submission}: no reference in {references} (CLIP/results_txt/images.txt)")
    found = {clip.name: _means_over_runs(submission / clip.name, clip) for clip in clips}
    failed = tuple(name for name, (ate_mm, _, tfr_percent, _) in found.items() if is_failed(ate_mm, tfr_percent))
    return Ranking({name: climb_score(*means) for name, means in found.items()}, failed)


def _means_over_runs(clip: Path, reference: Path) -> tuple[float, float, float, float]:
    """Return `_FIGURES`, means over the runs of a clip; a run that does not say how long it took finds no frame."""
    truth, rows = read_climb_reference(reference), []
    for name in RUNS:
        with suppress(InputError, AlignmentError):
            run = read_climb(clip / name, "mm")
            figures = {f"climb_{key}": value for key, value in climb_figures(run, truth).items()}
            scored = with_score(figures, clip / name, run, truth)
            if scored is not figures and figures["climb_submaps"]:
                rows.append([scored[f"climb_{key}"] for key in _FIGURES])
    if not rows:
        return math.nan, math.nan, 0.0, math.inf
    ate_mm, rpe_deg, tfr_percent, share = np.mean(rows, axis=0).tolist()
    return ate_mm, rpe_deg, tfr_percent * len(rows) / len(RUNS), share
