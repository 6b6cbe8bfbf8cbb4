"""The summary of a result in words: its verdict, five facts, and what speaks against it with what to do."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from scopemap.result.input_part import part_of_input
from scopemap.result.result import Result
from scopemap.result.sentences import percent_words
from scopemap.result.verdict import verdict

_SKIPPED = {"repeated": "skipped as repeats", "thinned": "skipped by --fps", "size": "skipped: of another size"}
_MOST_REASONS = 6
"""Notes are left to the report where there are more cautions and notes."""


def summary_lines(result: Result) -> list[str]:
    """Return the summary of a run: the verdict, five facts, and what speaks against it with what to do."""
    found = verdict(result)
    cautions = [reason for reason in found.reasons if reason.level in ("bad", "doubtful")]
    notes = [reason for reason in found.reasons if reason.level == "note"]
    shown = notes[: max(_MOST_REASONS - len(cautions), 0)]
    lines = [f"{found.word.capitalize()}. {found.advice}"]
    lines += [f"  {name:8s} {fact}" for name, fact in summary_facts(result).items()]
    lines += [f"Caution: {reason}" for reason in cautions] + [f"Note: {reason}" for reason in shown]
    left = len(notes) - len(shown)
    return lines + [f"{left} more notes are in the report."] * bool(left)


def summary_facts(result: Result) -> dict[str, str]:
    """Return the facts of a summary in words, by what they are about: frames, scale, camera, surface, time."""
    facts = result.frames.counts | result.provenance
    unit = " mm" if result.scale_known else " (scale unknown)"
    part = part_of_input(facts)
    return {
        "frames": f"{_frames(facts)}{f' ({part})' if part else ''}; path {result.trajectory.path_length_mm:.1f}{unit}",
        "scale": result.scale.removeprefix("scale").lstrip(": "),
        "camera": facts["camera"]["source"].partition("; ")[0],
        "surface": f"{len(result.mesh.faces):,} triangles{_surface(facts.get('surface') or {})}",
        "time": time_words(result) + compiling_words(facts.get("seconds", {}).get("compile kernels", 0.0)),
    }


def _frames(facts: dict[str, Any]) -> str:
    """Return how many frames were tracked, and what became of the others."""
    others = [(facts["lost"], "lost"), (facts["in_other_maps"], "in other submaps")]
    others += [(count, _SKIPPED[kind]) for kind, count in facts.get("skipped", {}).items()]
    return ", ".join([f"{facts['tracked']} of {facts['frames']} tracked"] + [f"{n} {how}" for n, how in others if n])


def time_words(result: Result) -> str:
    """Return how long the run took and its frames per second; of a resumed one since then."""
    facts = result.provenance
    seconds, after = facts.get("seconds", {}).get("total", 0.0), facts.get("resumed_after_frame")
    since = "" if after is None else f" since it was resumed after frame {after}"
    return f"{seconds:.1f} s{since}, {frames_per_s(result) or 0.0:.1f} frames/s"


def frames_per_s(result: Result) -> float | None:
    """Return the frames per second of the whole run, without compiling kernels; None where its time is unknown.

    Start-up, adjustment and fusion count, too; of a resumed run the frames and the time since then.
    """
    seconds, after = result.provenance.get("seconds", {}), result.provenance.get("resumed_after_frame")
    passed_s = seconds.get("total", 0.0) - seconds.get("compile kernels", 0.0)
    done = int(np.sum(result.frames["index"] > (-1 if after is None else after)))
    return done / passed_s if passed_s > 0 else None


def compiling_words(seconds: float) -> str:
    """Return what compiling the kernels took, and that it was for this process alone where they cannot be cached."""
    if seconds < 0.1:
        return ""
    is_cached = os.environ.get("NUMBA_CACHE_DIR") != ""
    how = "once" if is_cached else "in every run: set NUMBA_CACHE_DIR to a folder to keep them"
    return f" (without {seconds:.1f} s of compiling kernels, {how})"


def _surface(figures: dict[str, float]) -> str:
    """Return how well the surface agrees with the frames that it was made of, "" where that is not known."""
    if "depth_error" not in figures:
        return ""
    covered = f", covers {percent_words(figures['coverage_mean'])} of what its frames see"
    return f"{covered}, depth differs by {percent_words(figures['depth_error'], 1)}"
