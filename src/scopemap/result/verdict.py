"""Whether a run can be trusted: one word, what it may be used for, and the reasons; docs/report.md has the rules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scopemap.engine.notices import KINDS, Level, Notice, notices_of
from scopemap.result.frame_table import ELSEWHERE, NOT_USED, FrameTable
from scopemap.result.input_part import part_of_input
from scopemap.result.losses import losses, main_cause
from scopemap.result.result import Result
from scopemap.result.submap_summaries import doubt_words, submaps_in_time
from scopemap.result.surface_segments import GOOD_DISAGREEMENT, SurfaceSegment, segment_of_facts

WORDS: dict[Level, str] = {"good": "good", "doubtful": "doubtful", "bad": "not usable"}

LEAST_FRAMES = 10
GOOD_SHARE = 0.8
LEAST_SHARE = 0.3
"""Share of the frames that are in the result, or in submaps that stand for their part of the video."""
LEAST_SEGMENT_S = 3.0
"""Least length of a submap that stands for its part of the video."""
GOOD_COVERAGE = 0.8
LEAST_COVERAGE = 0.5
"""Mean share of what the frames see that the surface covers."""
MOST_DISAGREEMENT = 0.15
"""Median relative difference between the surface's depth and the frames' depth."""
GOOD_WITHIN = 0.75
LEAST_WITHIN = 0.3
"""Mean share of the picture in which the surface is within 10 % of the frames' depth. Of 74 results on real clips and
phantoms those called good had 0.8 and more, an abdomen whose main organ has no surface 0.60, one inside out 0.24."""
MOST_MOVING = 0.5
"""Share of the frames in which tissue moves on its own."""
LEAST_TRIANGULATED = 0.5
"""Share of the keyframes above which several views agree on depth."""
_MOST_RANGES = 3
"""Parts of the time that the verdict's sentence names, the longest."""


@dataclass(frozen=True)
class Reason:
    """One fact of a verdict: a stable code, its level ("note": it does not change the word), and a sentence.

    next_step : what to do about it, one sentence; "" where there is nothing to do.
    """

    code: str
    level: Level
    text: str
    next_step: str = ""

    def __str__(self) -> str:
        return f"{self.text} {self.next_step}".rstrip()


@dataclass(frozen=True)
class Verdict:
    """The verdict on a run.

    level : the worst of its reasons. advice : what the result may be used for. sentence : the main facts.
    reasons : the worst first; the run's notices are among them, but for those of level info.
    """

    level: Level
    advice: str
    sentence: str
    reasons: list[Reason]

    @property
    def word(self) -> str:
        """good, doubtful or not usable."""
        return WORDS[self.level]

    @property
    def facts(self) -> dict[str, Any]:
        """What provenance.json says of it: `level`, `word`, and `code` and `level` of each of its `reasons`."""
        reasons = [{"code": reason.code, "level": reason.level} for reason in self.reasons]
        return {"level": self.level, "word": self.word, "reasons": reasons}


def verdict(run: Result) -> Verdict:
    """Return the verdict on a run, from its frames, surfaces, submaps, segments and provenance."""
    found = [*_of_end(run), *_of_notices(run), *_of_adjustment(run), _of_frames(run), *_of_maps(run)]
    found += [*_of_surface(run.provenance.get("surface") or {}, len(run.mesh.faces)), *_of_segments(run)]
    found += _of_camera(run)
    order: tuple[Level, ...] = ("bad", "doubtful", "note", "good")
    reasons = sorted(found, key=lambda reason: order.index(reason.level))
    level = _worst(reasons)
    return Verdict(level, _advice(run, level), _sentence(run), reasons)


def graded(segments: Sequence[dict[str, Any]]) -> list[SurfaceSegment]:
    """Return the segments of a result, each with the level of the verdict on it by itself, from what a run has of them.

    segments : as `provenance.json` has them.
    """
    return [segment_of_facts(number, facts, _level_of_segment(facts)) for number, facts in enumerate(segments)]


def _level_of_segment(facts: dict[str, Any]) -> Level:
    reasons = [*_of_surface(facts["surface"], facts["faces"])]
    reasons += [_reason(notice, notice.level) for notice in notices_of(facts) if notice.in_verdict]
    if facts["frames"] < LEAST_FRAMES:
        reasons.append(Reason("segment-short", "doubtful", "So few frames confirm no shape."))
    return _worst(reasons)


def _worst(reasons: Sequence[Reason]) -> Level:
    levels = {reason.level for reason in reasons}
    return "bad" if "bad" in levels else "doubtful" if "doubtful" in levels else "good"


def state_verdict(result: Result) -> None:
    """Put the verdicts on a result and its other submaps into their provenance; that on the result rests on theirs."""
    for part in reversed(result.submaps):
        part.provenance["verdict"] = verdict(part).facts


def frames_in_result(frames: FrameTable) -> tuple[int, int]:
    """Return how many frames are in the result, and of how many that were used."""
    return int(np.sum(frames.submap == 0)), int(np.sum(frames.submap != NOT_USED))


def level_of_submap(submap: Result) -> Level:
    """Return the level of the verdict on a submap by itself, as it was stated, or else found now."""
    stated: Level | None = submap.provenance.get("verdict", {}).get("level")
    return stated or verdict(submap).level


def frames_per_s(result: Result) -> float | None:
    """Return the frames per second of the whole run, without compiling kernels; None where its time is unknown.

    Start-up, adjustment and fusion count, too; of a resumed run the frames and the time since then.
    """
    seconds, after = result.provenance.get("seconds", {}), result.provenance.get("resumed_after_frame")
    passed_s = seconds.get("total", 0.0) - seconds.get("compile kernels", 0.0)
    done = int(np.sum(result.frames["index"] > (-1 if after is None else after)))
    return done / passed_s if passed_s > 0 else None


def scale_is_known(provenance: dict[str, Any]) -> bool:
    """Return whether sizes were measured or anchored to a given range; predicted millimetres are a guess."""
    return bool((provenance.get("scale") or {}).get("known"))


def _scale_is_stated(provenance: dict[str, Any]) -> bool:
    return bool((provenance.get("scale") or {}).get("stated"))


def scale_source(provenance: dict[str, Any]) -> str:
    """Return what the scale comes from, in words."""
    return str((provenance.get("scale") or {}).get("source", "unknown"))


def longest_segment(outside: np.ndarray) -> int:
    """Return the length of the longest run of True in (N,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], outside.astype(np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _advice(run: Result, level: Level) -> str:
    if level == "bad":
        return "Do not use this result."
    use = _usable(run)
    if not use:
        use = _of_good(run) if level == "good" else "Use it with care: read the cautions first."
    if _scale_is_stated(run.provenance):
        return f"{use} Sizes rest on your {scale_source(run.provenance)}: check a length that you know."
    if scale_is_known(run.provenance):
        return f"{use} Sizes are known (from {scale_source(run.provenance)})."
    return f"{use} Sizes are unknown: compare shapes, do not measure."


def _of_good(run: Result) -> str:
    """Return what a good result may be used for: a lens that the motion does not test is the user's word alone."""
    if any(notice.code == "camera-unconfirmed" for notice in notices_of(run.provenance)):
        return "The shape can be used if the calibration is right: the motion does not test it."
    return "The shape can be used."


def _sentence(run: Result) -> str:
    inside, used = frames_in_result(run.frames)
    surface = run.provenance.get("surface") or {}
    judged = _submaps_in_words(run)
    facts = [
        *_usable(run),
        f"{inside} of {used} frames are in the result" + (f", others in {judged}" if judged else ""),
    ]
    known = "The scale is as you stated it" if _scale_is_stated(run.provenance) else "The scale is known"
    facts.append(known if scale_is_known(run.provenance) else "The scale is unknown")
    if not len(run.mesh.faces):
        facts.append("There is no surface")
    elif "coverage_mean" in surface:
        covered = percent_words(surface["coverage_mean"])
        facts.append(f"The surface covers {covered} of what these frames show, not of the organ")
    return "".join(f"{fact}. " for fact in facts).rstrip()


def _usable(run: Result) -> str:
    """Return which parts of the time can be used, and what for; "" where one surface stands for all frames."""
    if len(run.segments) < 2:
        return ""
    usable = [segment for segment in run.segments if segment.level != "bad"]
    if not usable:
        return "No part of the video can be used."
    ranges: list[list[float]] = []
    for before, segment in zip([None, *usable], usable, strict=False):
        if before is not None and before.segment == segment.segment - 1:
            ranges[-1][1] = segment.end_s
        else:
            ranges.append([segment.start_s, segment.end_s])
    longest = sorted(sorted(ranges, key=lambda ends: ends[0] - ends[1])[:_MOST_RANGES])
    words = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in longest)
    words += f" and {len(ranges) - len(longest)} shorter parts" if len(ranges) > len(longest) else ""
    _, used = frames_in_result(run.frames)
    share = percent_words(np.isin(run.frames["segment"], [segment.segment for segment in usable]).sum() / max(used, 1))
    good = any(segment.level == "good" for segment in usable)
    return f"Usable: {words}, {share} of the video{'' if good else ', for looking, not for measuring'}."


def _of_frames(run: Result) -> Reason:
    inside, used = frames_in_result(run.frames)
    part = part_of_input(run.provenance)
    chosen, which = (" chosen", f" Chosen: {part}.") if part else ("", "")
    if inside < LEAST_FRAMES:
        few = f"Only {inside} of {used}{chosen} frames are in the result: too few for a shape.{which}"
        return Reason("frames-too-few", "bad", few)
    submap = run.frames.submap[run.frames.submap != NOT_USED]
    found = np.isin(submap, [0, *_long_submaps(run)])
    apart = int(found.sum()) - inside
    bad = [segment.segment for segment in run.segments if segment.level == "bad"]
    if len(bad) < len(run.segments):  # that no surface can be used is another reason
        found &= ~((submap == 0) & np.isin(run.frames["segment"][run.frames.submap != NOT_USED], bad))
    share = found.mean()
    lost_in_a_row = longest_segment(~found)
    longest = f"; the longest gap is {lost_in_a_row} frames" if lost_in_a_row else ""
    last = run.provenance.get("interrupted_at_frame")
    until = "" if last is None else f" until frame {last}"
    inside = int(found.sum()) - apart
    where, counted = "in usable segments" if bad else "in the result", f"{inside} of {used}"
    if apart:
        where += f" or in usable submaps of {LEAST_SEGMENT_S:g} s and more"
        counted = f"{inside} and {apart} of {used}"
    text = f"{percent_words(share)} of the{chosen} frames{until} are {where} ({counted}){longest}.{which}"
    return Reason("frames-in-result", _level(-share, -GOOD_SHARE, -LEAST_SHARE), text)


def _long_submaps(run: Result) -> list[int]:
    """Return the numbers of the submaps that stand for their part of the video."""
    submap, times_s = run.frames.submap, run.frames["time_s"]
    period_s = np.median(np.diff(times_s)) if len(times_s) > 1 else np.nan
    long = (n for n in range(1, len(run.submaps)) if (submap == n).sum() * period_s >= LEAST_SEGMENT_S)
    return [number for number in long if level_of_submap(run.submaps[number]) != "bad"]


def _submaps_in_words(run: Result) -> str:
    """Return how many other submaps there are and how they are judged by themselves; "" where there are none."""
    levels = [level_of_submap(submap) for submap in run.submaps[1:]]
    judged = ", ".join(f"{levels.count(level)} {word}" for level, word in WORDS.items() if level in levels)
    return f"{len(levels)} {'submap' if len(levels) == 1 else 'submaps'} ({judged})" if levels else ""


def _of_maps(run: Result) -> list[Reason]:
    frames, found = run.frames, []
    other = int(np.sum((frames.submap > 0) | (frames.submap == ELSEWHERE)))
    lost, rotated = frames.counts["lost"], frames.counts["rotation_only"]
    if other:
        judged = _submaps_in_words(run)
        text = f"{other} more frames form separate submaps; their relative poses are unknown."
        step = f"Look at the {judged} in maps/." if judged else ""
        found.append(Reason("submaps", "note", text, step))
    doubt = doubt_words(submaps_in_time(frames))
    if doubt:
        found.append(Reason("submap-doubtful", "note", f"The most doubtful submap is {doubt}."))
    if lost:
        how = f", with known rotation in {rotated}" if rotated else ""
        cause, step = main_cause(losses(frames))
        why = f", mostly due to this: {cause}" if cause else ""
        found.append(
            Reason(
                "frames-lost",
                "note",
                f"The camera was lost in {lost} {'frame' if lost == 1 else 'frames'}{how}{why}.",
                step,
            )
        )
    return found


def _of_segments(run: Result) -> list[Reason]:
    """Return that several surfaces, each for a part of the time, make up the result."""
    if len(run.segments) < 2:
        return []
    levels = [segment.level for segment in run.segments]
    counts = ", ".join(f"{levels.count(level)} {word}" for level, word in WORDS.items() if level in levels)
    text = f"The scene changes, so {len(levels)} segments of the video have a surface each ({counts})."
    loose = sum(not facts.get("joined", True) for facts in run.provenance.get("segments", []))
    text += f" {loose} are joined by tracking alone." if loose else ""
    return [Reason("segments", "note", text, "See surfaces/segments.csv.")]


def _of_surface(surface: dict[str, float], faces: int) -> list[Reason]:
    """Return how well a surface agrees with its frames."""
    if not faces:
        return [Reason("surface-missing", "bad", "There is no surface.")]
    found = []
    if "coverage_mean" in surface:
        coverage, least = float(surface["coverage_mean"]), percent_words(float(surface["coverage_least"]))
        text = f"The surface covers {percent_words(coverage)} of the tissue in its own frames (worst frame: {least})"
        text += ", not of the organ."
        found.append(Reason("surface-coverage", _level(-coverage, -GOOD_COVERAGE, -LEAST_COVERAGE), text))
    if "depth_error" in surface:
        error = float(surface["depth_error"])
        levels, seen = [_level(error, GOOD_DISAGREEMENT, MOST_DISAGREEMENT)], ""
        if "within_10_percent_mean" in surface:
            mean, least_share = (float(surface[f"within_10_percent_{name}"]) for name in ("mean", "least"))
            levels.append(_level(-mean, -GOOD_WITHIN, -LEAST_WITHIN))
            seen = (
                f"; {percent_words(mean)} of the picture agrees within 10 % (worst frame: {percent_words(least_share)})"
            )
        level = max(levels, key=("good", "doubtful", "bad").index)
        words = {"good": "fits", "doubtful": "only roughly fits", "bad": "contradicts"}[level]
        text = f"The surface {words} the frames: depth differs by {percent_words(error, 1)} (median){seen}."
        found.append(Reason("surface-depth", level, text))
    return found


def _of_camera(run: Result) -> list[Reason]:
    if run.provenance.get("camera", {}).get("origin") != "assumed":
        return []
    text = "The lens is assumed, not calibrated: the ratio of depth to width may be wrong."
    return [Reason("camera-assumed", "doubtful", text, KINDS["camera-unknown"].next_step)]


def _of_notices(run: Result) -> list[Reason]:
    """Return what the run reports about itself, each once, unless another reason says the same."""
    found = [notice for notice in notices_of(run.provenance) if notice.in_verdict]
    codes = {notice.code for notice in notices_of(run.provenance)}
    if "camera-at-rest-stated" in codes:
        return [_reason(n, n.level) for n in found if n.code != "camera-at-rest"]
    return [_reason(n, _level_of(n)) for n in found]


def _reason(notice: Notice, level: Level) -> Reason:
    return Reason(notice.code, level, notice.text, notice.next_step)


def _level_of(notice: Notice) -> Level:
    """Return the level of a notice: what moves in most of the frames is no shortcoming of a few."""
    values = notice.values
    most_move = notice.code == "tissue-moves" and values["frames"] >= MOST_MOVING * values["measured"]
    return "doubtful" if most_move else notice.level


def _of_adjustment(run: Result) -> list[Reason]:
    """Return whether several views agree on depth, unless other starts of the adjustment confirm the shape."""
    notices, found = notices_of(run.provenance), []
    if {"shape-determined", "shape-decided"} & {notice.code for notice in notices}:
        return []
    more_motion = KINDS["shape-not-determined"].next_step
    for notice in notices:
        values = notice.values
        if notice.code == "mapping-without-observations":
            text = "Keyframes have no common observations: no other view confirms depth and path."
            found.append(Reason("depth-unconfirmed", "doubtful", text, more_motion))
        if notice.code == "depth-triangulated":
            count, keyframes = values["triangulated"], values["keyframes"]
            if count <= LEAST_TRIANGULATED * keyframes:
                text = f"Several views agree on depth in only {count} of {keyframes} keyframes."
                found.append(Reason("depth-unconfirmed", "doubtful", text, more_motion))
    return found


def _of_end(run: Result) -> list[Reason]:
    last = run.provenance.get("interrupted_at_frame")
    if last is None:
        return []
    return [Reason("interrupted", "doubtful", Notice("input-interrupted", {"frame": last}).text)]


def _level(value: float, good: float, bad: float) -> Level:
    """Return the level of a value of which less is better; the limits themselves belong to the better side."""
    return "good" if value <= good else "doubtful" if value <= bad else "bad"


def percent_words(share: float, digits: int = 0) -> str:
    """Return a share as text, the same everywhere; rounded down, so that not even a pixel short of all is all."""
    factor = 10.0**digits
    return f"{np.floor(100 * share * factor + 1e-9) / factor:.{digits}f} %"
