"""The sentences of a verdict, from the evidence: its reasons, the main facts, and what the result may be used for."""

from __future__ import annotations

import numpy as np

from scopemap.engine.notices import Level, Notice
from scopemap.result.evidence import LEAST_SUBMAP_S, Evidence
from scopemap.result.losses import ADVICE
from scopemap.result.submap_summaries import doubt_words
from scopemap.result.surface_segments import SurfaceSegment
from scopemap.result.wording import LEVEL_WORDS, STILL_PART, WORDINGS, text_of

_MOST_RANGES = 3
"""Parts of the time that the verdict's sentence names, the longest."""


def interrupted(evidence: Evidence, level: Level) -> str:
    """Return that the run was stopped, and where."""
    return text_of(Notice("input-interrupted", {"frame": evidence.interrupted_at_frame}))


def too_few_frames(evidence: Evidence, level: Level) -> str:
    """Return how few frames are in the result."""
    chosen, which = _chosen(evidence)
    counted = f"{evidence.frames_in_result} of {evidence.frames_used}{chosen}"
    return f"Only {counted} frames are in the result: too few for a shape.{which}"


def frames_in_result(evidence: Evidence, level: Level) -> str:
    """Return which share of the frames is usable."""
    chosen, which = _chosen(evidence)
    longest = f"; the longest gap is {evidence.longest_gap} frames" if evidence.longest_gap else ""
    last = evidence.interrupted_at_frame
    until = "" if last is None else f" until frame {last}"
    in_segments = any(segment.level == "bad" for segment in evidence.segments)
    where = "in usable segments" if in_segments else "in the result"
    counted = f"{evidence.frames_usable} of {evidence.frames_used}"
    if evidence.frames_in_usable_submaps:
        where += f" or in usable submaps of {LEAST_SUBMAP_S:g} s and more"
        counted = f"{evidence.frames_usable} and {evidence.frames_in_usable_submaps} of {evidence.frames_used}"
    share = percent_words(evidence.usable_share or 0.0)
    return f"{share} of the{chosen} frames{until} are {where} ({counted}){longest}.{which}"


def look_at_submaps(evidence: Evidence) -> str:
    """Return which submaps there are to look at; "" where none was kept."""
    judged = _submaps_in_words(evidence)
    return f"Look at the {judged} in maps/." if judged else ""


def doubtful_submap(evidence: Evidence, level: Level) -> str:
    """Return which submap agrees least with its own frames."""
    return f"The most doubtful submap is {doubt_words([*evidence.submaps])}."


def frames_lost(evidence: Evidence, level: Level) -> str:
    """Return in how many frames the camera was lost, and mostly why."""
    lost, rotated = evidence.frames_lost, evidence.frames_rotation_only
    how = f", with known rotation in {rotated}" if rotated else ""
    why = f", mostly due to this: {evidence.loss_cause.value}" if evidence.loss_cause else ""
    return f"The camera was lost in {lost} {'frame' if lost == 1 else 'frames'}{how}{why}."


def against_losses(evidence: Evidence) -> str:
    """Return what the operator can do against the cause of most losses; "" where it is unknown."""
    return ADVICE.get(evidence.loss_cause, "")


def surface_coverage(evidence: Evidence, level: Level) -> str:
    """Return how much the surface covers."""
    mean, least = percent_words(evidence.coverage_mean or 0.0), percent_words(evidence.coverage_least or 0.0)
    return f"The surface covers {mean} of the tissue in its own frames (worst frame: {least}), not of the organ."


def surface_depth(evidence: Evidence, level: Level) -> str:
    """Return how well the surface fits the depth of its frames."""
    words = {"good": "fits", "doubtful": "only roughly fits", "bad": "contradicts"}[level]
    seen, mean = "", evidence.within_10_percent_mean
    if mean is not None:
        least = percent_words(evidence.within_10_percent_least or 0.0)
        seen = f"; {percent_words(mean)} of the picture agrees within 10 % (worst frame: {least})"
    error = percent_words(evidence.depth_error or 0.0, 1)
    return f"The surface {words} the frames: depth differs by {error} (median){seen}."


def segments(evidence: Evidence, level: Level) -> str:
    """Return that several surfaces, each for a part of the time, make up the result."""
    levels = [segment.level for segment in evidence.segments]
    text = f"The scene changes, so {len(levels)} segments of the video have a surface each ({_counted(levels)})."
    good = _good_parts(evidence)
    text += f" Good: {good}." if good else ""
    loose = evidence.loose_segments
    return text + (f" {loose} are joined by tracking alone." if loose else "")


def next_step(code: str, evidence: Evidence) -> str:
    """Return what to do about a notice of the run; where tissue moves and segments differ, which of them are good.

    "" where there is nothing to do: segments that are all alike give no choice, and of a camera at rest each frame has
    a surface.
    """
    step = WORDINGS[code].next_step
    if step == STILL_PART and "camera-at-rest-stated" in evidence.codes:
        return ""
    if step != STILL_PART or evidence.segment_count < 2:
        return step
    good = _good_parts(evidence)
    return f"Use the good segments: {good}." if good else ""


def advice(evidence: Evidence, level: Level) -> str:
    """Return what a result of this level may be used for."""
    if level == "bad":
        return "Do not use this result."
    use = _usable_parts(evidence)
    if not use:
        use = _of_good(evidence) if level == "good" else "Use it with care: read the cautions first."
    if evidence.scale_stated:
        return f"{use} Sizes rest on your {evidence.scale_source}: check a length that you know."
    if evidence.scale_known:
        return f"{use} Sizes are known (from {evidence.scale_source})."
    return f"{use} Sizes are unknown: compare shapes, do not measure."


def main_facts(evidence: Evidence) -> str:
    """Return the main facts of a result: frames, scale and surface."""
    judged, usable = _submaps_in_words(evidence), _usable_parts(evidence).rstrip(".")
    counted = f"{evidence.frames_in_result} of {evidence.frames_used} frames are in the result"
    facts = [*([usable] if usable else []), counted + (f", others in {judged}" if judged else "")]
    known = "The scale is as you stated it" if evidence.scale_stated else "The scale is known"
    facts.append(known if evidence.scale_known else "The scale is unknown")
    if not evidence.faces:
        facts.append("There is no surface")
    elif evidence.coverage_mean is not None:
        covered = percent_words(evidence.coverage_mean)
        facts.append(f"The surface covers {covered} of what these frames show, not of the organ")
    return "".join(f"{fact}. " for fact in facts).rstrip()


def _of_good(evidence: Evidence) -> str:
    """Return what a good result may be used for: a lens that the motion does not test is the user's word alone."""
    if "camera-unconfirmed" in evidence.codes:
        return "The shape can be used if the calibration is right: the motion does not test it."
    return "The shape can be used."


def _usable_parts(evidence: Evidence) -> str:
    """Return which parts of the time can be used, and what for; "" where one surface stands for all frames."""
    if evidence.segment_count < 2:
        return ""
    usable = [segment for segment in evidence.segments if segment.level != "bad"]
    if not usable:
        return "No part of the video can be used."
    share = percent_words(evidence.frames_usable / max(evidence.frames_used, 1))
    good = [segment for segment in usable if segment.level == "good"]
    which = f" (good: {_times(good)})" if 0 < len(good) < len(usable) else ""
    return f"Usable: {_times(usable)}{which}, {share} of the video{'' if good else ', for looking, not for measuring'}."


def _good_parts(evidence: Evidence) -> str:
    """Return the times of the good segments; "" where none is good, or all are."""
    good = [segment for segment in evidence.segments if segment.level == "good"]
    return _times(good) if len(good) < len(evidence.segments) else ""


def _times(segments: list[SurfaceSegment]) -> str:
    """Return the times of segments in words, successive ones together; of many the longest. "" for none."""
    ranges = _ranges_s(segments)
    longest = sorted(sorted(ranges, key=lambda ends: ends[0] - ends[1])[:_MOST_RANGES])
    words = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in longest)
    left = len(ranges) - len(longest)
    return words + (f" and {left} shorter {'part' if left == 1 else 'parts'}" if left else "")


def _ranges_s(usable: list[SurfaceSegment]) -> list[list[float]]:
    """Return start and end, s, of successive segments together."""
    ranges: list[list[float]] = []
    for before, segment in zip([None, *usable], usable, strict=False):
        if before is not None and before.segment == segment.segment - 1:
            ranges[-1][1] = segment.end_s
        else:
            ranges.append([segment.start_s, segment.end_s])
    return ranges


def _chosen(evidence: Evidence) -> tuple[str, str]:
    """Return what a sentence says where a part of the frames was chosen, and which part; "" where all were used."""
    return (" chosen", f" Chosen: {evidence.chosen_frames}.") if evidence.chosen_frames else ("", "")


def _submaps_in_words(evidence: Evidence) -> str:
    """Return how many other submaps there are and how they are judged by themselves; "" where there are none."""
    levels = [*evidence.submap_levels]
    return f"{len(levels)} {'submap' if len(levels) == 1 else 'submaps'} ({_counted(levels)})" if levels else ""


def _counted(levels: list[Level]) -> str:
    """Return how many of each level there are, in words."""
    return ", ".join(f"{levels.count(level)} {word}" for level, word in LEVEL_WORDS.items() if level in levels)


def percent_words(share: float, digits: int = 0) -> str:
    """Return a share as text, the same everywhere; rounded down, so that not even a pixel short of all is all."""
    factor = 10.0**digits
    return f"{np.floor(100 * share * factor + 1e-9) / factor:.{digits}f} %"
