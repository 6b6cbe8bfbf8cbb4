"""Whether a run can be trusted: one word, what it may be used for, and the reasons.

`RULES` is the table of what is good, doubtful or not usable; docs/report.md has its limits in words. The notices of
the run are reasons, too, with their levels (`engine/notices.py`).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from scopemap.engine.notices import KINDS, Level
from scopemap.result import sentences
from scopemap.result.evidence import Evidence, evidence_of, evidence_of_segment
from scopemap.result.result import Result
from scopemap.result.surface_segments import GOOD_DISAGREEMENT, SurfaceSegment, segment_of_facts
from scopemap.result.wording import LEVEL_WORDS, WORDINGS, text_of

LEAST_FRAMES = 10
"""Fewer frames make no shape."""
_COMPARED = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}
_WORST_FIRST: tuple[Level, ...] = ("bad", "doubtful", "note", "good")


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
        return LEVEL_WORDS[self.level]

    @property
    def facts(self) -> dict[str, Any]:
        """What provenance.json says of it: `level`, `word`, and `code` and `level` of each of its `reasons`."""
        reasons = [{"code": reason.code, "level": reason.level} for reason in self.reasons]
        return {"level": self.level, "word": self.word, "reasons": reasons}


@dataclass(frozen=True)
class Limit:
    """A condition on a figure: how it compares (>=, <=, > or <) with a value."""

    sign: str
    value: float

    def holds(self, figure: float) -> bool:
        """Return whether a figure meets it; NaN never does."""
        return bool(_COMPARED[self.sign](figure, self.value))


@dataclass(frozen=True)
class Rule:
    """A row of the table: how a figure of the evidence is graded, and what a reason says of it.

    code : of the reason, or of the notice, that it grades; the worst of several rows with one code counts. figure : the
    name of a figure of `Evidence`; where that is None the row grades nothing. good : the limit within which it is good,
    doubtful : beyond that; None: never. otherwise : the level beyond both. sentence : with fields of the evidence, or a
    function of evidence and level; "": the row has no reason of its own, and grades that of another row or the notice.
    next_step : what to do about it. says_good : whether there is a reason also where it is good. unless : codes of
    notices, or of reasons of earlier rows, with which there is no reason. replaces : notices that say the same.
    """

    code: str
    figure: str
    good: Limit | None
    doubtful: Limit | None
    otherwise: Level
    sentence: str | Callable[[Evidence, Level], str] = ""
    next_step: str | Callable[[Evidence], str] = ""
    says_good: bool = False
    unless: tuple[str, ...] = ()
    replaces: tuple[str, ...] = ()

    def level(self, evidence: Evidence) -> Level | None:
        """Return the level of the figure; None where it is not known."""
        figure = getattr(evidence, self.figure)
        if figure is None:
            return None
        if self.good and self.good.holds(figure):
            return "good"
        return "doubtful" if self.doubtful and self.doubtful.holds(figure) else self.otherwise

    def reason(self, evidence: Evidence, level: Level) -> Reason:
        """Return the reason of this level."""
        text, step = self.sentence, self.next_step
        text = text.format(evidence) if isinstance(text, str) else text(evidence, level)
        return Reason(self.code, level, text, step if isinstance(step, str) else step(evidence))


_SHAPE_IS_KNOWN = ("shape-determined", "shape-decided")
_MORE_MOTION = WORDINGS["shape-not-determined"].next_step

_SURFACE_RULES = (
    Rule("surface-missing", "faces", Limit(">", 0), None, "bad", sentence="There is no surface."),
    Rule(
        "surface-coverage",
        "coverage_mean",
        Limit(">=", 0.8),
        Limit(">=", 0.5),
        "bad",
        sentence=sentences.surface_coverage,
        says_good=True,
        unless=("surface-missing",),
        replaces=("fusion-free-space",),
    ),
    Rule(
        "surface-depth",
        "depth_error",
        Limit("<=", GOOD_DISAGREEMENT),
        Limit("<=", 0.15),
        "bad",
        sentence=sentences.surface_depth,
        says_good=True,
        unless=("surface-missing",),
    ),
    # Of 74 results on real clips and phantoms those called good had 0.8 and more, an abdomen whose main organ has no
    # surface 0.60, one inside out 0.24.
    Rule("surface-depth", "within_10_percent_mean", Limit(">=", 0.75), Limit(">=", 0.3), "bad"),
)
RULES = (
    Rule(
        "interrupted",
        "interrupted_at_frame",
        None,
        None,
        "doubtful",
        sentence=sentences.interrupted,
        replaces=("input-interrupted",),
    ),
    Rule("tissue-moves", "moving_share", Limit("<", 0.5), None, "doubtful"),
    Rule(
        "depth-unconfirmed",
        "keyframes_without_observations",
        None,
        None,
        "doubtful",
        sentence="Keyframes have no common observations: no other view confirms depth and path.",
        next_step=_MORE_MOTION,
        unless=_SHAPE_IS_KNOWN,
    ),
    Rule(
        "depth-unconfirmed",
        "triangulated_share",
        Limit(">", 0.5),
        None,
        "doubtful",
        sentence="Several views agree on depth in only {0.triangulated} of {0.keyframes} keyframes.",
        next_step=_MORE_MOTION,
        unless=_SHAPE_IS_KNOWN,
    ),
    Rule(
        "frames-too-few",
        "frames_in_result",
        Limit(">=", LEAST_FRAMES),
        None,
        "bad",
        sentence=sentences.too_few_frames,
        replaces=("frames-few",),
    ),
    Rule(
        "frames-in-result",
        "usable_share",
        Limit(">=", 0.8),
        Limit(">=", 0.3),
        "bad",
        sentence=sentences.frames_in_result,
        says_good=True,
        unless=("frames-too-few",),
    ),
    Rule(
        "submaps",
        "frames_elsewhere",
        Limit("<", 1),
        None,
        "note",
        sentence="{0.frames_elsewhere} more frames form separate submaps; their relative poses are unknown.",
        next_step=sentences.look_at_submaps,
        replaces=("submaps-apart",),
    ),
    Rule(
        "submap-doubtful",
        "known_inlier_shares",
        Limit("<", 2),
        None,
        "note",
        sentence=sentences.doubtful_submap,
    ),
    Rule(
        "frames-lost",
        "frames_lost",
        Limit("<", 1),
        None,
        "note",
        sentence=sentences.frames_lost,
        next_step=sentences.against_losses,
    ),
    *_SURFACE_RULES,
    Rule(
        "segments",
        "segment_count",
        Limit("<", 2),
        None,
        "note",
        sentence=sentences.segments,
        next_step="See surfaces/segments.csv.",
    ),
    Rule(
        "camera-assumed",
        "lens_is_assumed",
        Limit("<", 1),
        None,
        "doubtful",
        sentence="The lens is assumed, not calibrated: the ratio of depth to width may be wrong.",
        next_step=WORDINGS["camera-unknown"].next_step,
        replaces=("camera-unknown",),
    ),
)
"""Of a result. Reasons of one level are in this order; those of notices come where a row grades a notice."""
SEGMENT_RULES = (
    *_SURFACE_RULES,
    Rule(
        "segment-short",
        "frames_in_result",
        Limit(">=", LEAST_FRAMES),
        None,
        "doubtful",
        sentence="So few frames confirm no shape.",
    ),
)
"""Of a segment by itself."""


def verdict(run: Result) -> Verdict:
    """Return the verdict on a run, from its evidence."""
    evidence = evidence_of(run, [level_of_submap(submap) for submap in run.others])
    place = {rule.code: number for number, rule in enumerate(RULES)}
    found = sorted(
        [*_of_notices(evidence, RULES), *_of_rules(evidence, RULES)],
        key=lambda reason: (_WORST_FIRST.index(reason.level), place.get(reason.code, place["tissue-moves"])),
    )
    level = _level_by(found)
    return Verdict(level, sentences.advice(evidence, level), sentences.main_facts(evidence), found)


def graded(segments: Sequence[dict[str, Any]]) -> list[SurfaceSegment]:
    """Return the segments of a result, each with the level of the verdict on it by itself, from what a run has of them.

    segments : as `provenance.json` has them.
    """
    return [segment_of_facts(number, facts, _level_of_segment(facts)) for number, facts in enumerate(segments)]


def state_verdict(result: Result) -> None:
    """Put the verdicts on a result and its other submaps into their provenance; that on the result rests on theirs."""
    for part in reversed(result.submaps):
        part.provenance["verdict"] = verdict(part).facts


def level_of_submap(submap: Result) -> Level:
    """Return the level of the verdict on a submap by itself, as it was stated, or else found now."""
    stated = submap.verdict
    return stated.level if stated else verdict(submap).level


def gives_reason(code: str) -> bool:
    """Return whether the notices of a code are reasons of the verdict; not where they are choices of the run, or where
    a row of the table says the same.
    """
    return KINDS[code].level != "info" and not any(code in rule.replaces for rule in RULES)


def _level_of_segment(facts: dict[str, Any]) -> Level:
    evidence = evidence_of_segment(facts)
    return _level_by([*_of_notices(evidence, SEGMENT_RULES), *_of_rules(evidence, SEGMENT_RULES)])


def _of_notices(evidence: Evidence, rules: Sequence[Rule]) -> list[Reason]:
    """Return what the run reports about itself."""
    return [
        Reason(
            notice.code,
            _graded(notice.code, notice.level, evidence, rules),
            text_of(notice, scale_known=evidence.scale_known),
            sentences.next_step(notice.code, evidence),
        )
        for notice in evidence.notices
        if gives_reason(notice.code)
    ]


def _of_rules(evidence: Evidence, rules: Sequence[Rule]) -> list[Reason]:
    """Return the reasons of the rows that have a sentence."""
    found: list[Reason] = []
    for rule in rules:
        level = rule.level(evidence)
        if not rule.sentence or level is None or {*rule.unless} & (evidence.codes | {reason.code for reason in found}):
            continue
        level = _graded(rule.code, level, evidence, rules)
        if level != "good" or rule.says_good:
            found.append(rule.reason(evidence, level))
    return found


def _graded(code: str, level: Level, evidence: Evidence, rules: Sequence[Rule]) -> Level:
    """Return the worst of the level of a reason and what rows without a sentence grade it by."""
    others = (rule.level(evidence) for rule in rules if rule.code == code and not rule.sentence)
    return min([level, *(other for other in others if other is not None)], key=_WORST_FIRST.index)


def _level_by(reasons: Iterable[Reason]) -> Level:
    """Return the level that reasons make together: the worst, which a note does not change."""
    levels = {reason.level for reason in reasons}
    return "bad" if "bad" in levels else "doubtful" if "doubtful" in levels else "good"
