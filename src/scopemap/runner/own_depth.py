"""Depth files of the user: their kind, by the first frames where nothing states it, and whether their unit can be."""

from __future__ import annotations

from dataclasses import replace

from scopemap.engine.config import Config
from scopemap.engine.depth.estimate import DepthKind
from scopemap.engine.errors import InputError
from scopemap.engine.estimators import Estimators
from scopemap.engine.notices import Notice
from scopemap.input.depth_files import FilesDepth
from scopemap.input.depth_kind import KindEvidence, kind_evidence
from scopemap.input.depth_unit import check_common_scale, check_unit, check_values
from scopemap.input.prepared import UNKNOWN_MAKE
from scopemap.input.sequence import Sequence

_WITHOUT_FIRST_FRAMES = ("pictures", "live")  # come one at a time
_STATE_IT = (
    "state --set depth.files_kind=disparity if they are inverse depth (near is large), depth.files_kind=measured if "
    "they are depth (far is large)"
)


def with_files_judged(
    sequence: Sequence, config: Config, estimators: Estimators
) -> tuple[Config, Estimators, list[Notice]]:
    """Return settings and estimators with the kind of depth files, and a notice where the first frames decided it.

    Files of a data set are left alone: its format says what they are. Raises `InputError` where the first frames
    contradict what the files imply, or do not tell, for files without depth, and for a unit that no endoscope has.
    """
    depth = estimators.depth
    if not isinstance(depth, FilesDepth) or _is_of_data_set(sequence, depth):
        return config, estimators, []
    notices = list[Notice]()
    if not depth.kind_is_stated:
        check_values(depth)
        kind, notices = _judged(sequence, config, depth)
        if kind == "measured" and not depth.kind_reason:
            check_common_scale(depth)
        depth = depth.of_kind(kind)
        settings = config.depth.model_copy(update={"files_kind": kind})
        config, estimators = config.model_copy(update={"depth": settings}), replace(estimators, depth=depth)
    if depth.is_in_mm and (depth.kind == "measured" or (depth.kind == "depth" and not config.depth.is_anchored)):
        check_unit(depth, config.depth.near_far_mm)
    if depth.later:
        notices = [*notices, Notice("depth-files-shifted", {"folder": str(depth.folder), "shift": depth.later})]
    return config, estimators, notices


def _is_of_data_set(sequence: Sequence, depth: FilesDepth) -> bool:
    return sequence.source.name not in UNKNOWN_MAKE and depth.folder.resolve() == sequence.path.resolve()


def _judged(sequence: Sequence, config: Config, depth: FilesDepth) -> tuple[DepthKind, list[Notice]]:
    """Return the kind of files of which nothing states it, and a notice where it was a guess."""
    evidence = KindEvidence((), float("nan"), 0)
    if sequence.source.name not in _WITHOUT_FIRST_FRAMES:
        evidence = kind_evidence(sequence, config, depth.numbers)
        if not evidence.frames:
            return depth.kind, []  # the first frame without depth says so
    found: DepthKind = "measured" if evidence.sign > 0 else "disparity"
    if depth.kind_reason:
        if evidence.sign and found != depth.kind:
            raise InputError(
                f"the depth files in {depth.folder} are read as {depth.kind} because {depth.kind_reason}, but are "
                f"{_in_words(found)}: {evidence.reason}; {_STATE_IT}"
            )
        return depth.kind, []
    if sequence.source.name in _WITHOUT_FIRST_FRAMES:
        raise InputError(
            f"the depth files in {depth.folder} may hold depth or inverse depth, and frames that come one at a time do "
            f"not decide it before the first; {_STATE_IT}"
        )
    if not evidence.sign:
        raise InputError(
            f"the depth files in {depth.folder} may hold depth or inverse depth, which neither the motion of the first "
            f"frames nor scopenet's depth decides; {_STATE_IT}"
        )
    if found == "measured" and evidence.is_flat:
        raise InputError(
            f"the depth files in {depth.folder} are in the order of scopenet's depth, but vary "
            f"{1 / evidence.spread:.1f} times less: they may be logarithms of depth, or hold an offset; give depth "
            "itself, or state --set depth.files_kind=measured if they are depth"
        )
    values = {"kind": _in_words(found), "reason": evidence.reason}
    return found, [Notice("depth-files-kind", values)]


def _in_words(kind: DepthKind) -> str:
    return "inverse depth (near is large)" if kind == "disparity" else "depth (far is large)"
