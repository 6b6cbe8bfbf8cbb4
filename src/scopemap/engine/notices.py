"""What a run reports about itself: typed notices. `result/wording.py` words them; docs/formats.md lists them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Level = Literal["good", "info", "note", "doubtful", "bad"]
"""Of a notice, or of a reason of the verdict. info: an assumption or a choice. note: a shortcoming. doubtful: one that
makes the result doubtful. Of the verdict alone: good, and bad, not usable."""


@dataclass(frozen=True)
class _Kind:
    """Level of a code, and the names of its values."""

    level: Level
    values: tuple[str, ...] = ()


KINDS: dict[str, _Kind] = {
    # What readers of files found: free text, by which nothing is decided.
    "input-note": _Kind("info", ("text",)),
    "input-warning": _Kind("note", ("text",)),
    "input-changed": _Kind("note", ("path",)),
    "checkpoint-damaged": _Kind("info", ("reason",)),
    "input-interlaced": _Kind("doubtful"),
    "input-deinterlaced": _Kind("info", ("why",)),
    "input-interlaced-averaged": _Kind("info"),
    "input-resized": _Kind("info", ("frames", "size", "first")),
    "input-other-size": _Kind("note", ("frames", "first", "reason")),
    "input-text-burned-in": _Kind("note"),
    "input-interrupted": _Kind("note", ("frame",)),
    "camera-assumed": _Kind("info", ("source",)),
    "camera-unknown": _Kind("note", ("reason",)),
    "camera-distorted": _Kind("doubtful", ("share",)),
    "camera-contradicted": _Kind("doubtful", ("change", "gain")),
    "camera-aspect": _Kind("doubtful", ("share", "fx", "fy")),
    "camera-unconfirmed": _Kind("note", ("sigma",)),
    "camera-at-rest": _Kind("doubtful"),
    "camera-at-rest-stated": _Kind("note"),
    "masks-missing": _Kind("doubtful", ("missing", "frames", "folder")),
    "masks-shifted": _Kind("info", ("folder", "shift")),
    "masks-late": _Kind("note", ("frame", "folder", "mask")),
    "masks-unused": _Kind("note", ("masks", "folder", "first")),
    "masks-empty": _Kind("note", ("folder", "level")),
    "masks-faint": _Kind("doubtful", ("folder", "level")),
    "masks-large": _Kind("doubtful", ("folder", "share")),
    "frames-failed": _Kind("note", ("frames", "first", "reason")),
    "frames-without-depth": _Kind("note", ("frames", "first")),
    "depth-propagated": _Kind("info", ("every", "frames")),
    "depth-files-kind": _Kind("info", ("kind", "reason")),
    "depth-files-shifted": _Kind("info", ("folder", "shift")),
    "frames-skipped": _Kind("info", ("frames", "causes")),
    "frames-few": _Kind("note", ("frames",)),
    "frames-forgotten": _Kind("note", ("kept", "frames")),
    "frames-dropped": _Kind("info", ("dropped", "read")),
    "submaps-apart": _Kind("note", ("submaps", "frames", "tracked", "saved", "least")),
    "tissue-moves": _Kind("note", ("frames", "measured", "most", "share", "threshold", "x", "y")),
    "mapping-none": _Kind("doubtful"),
    "mapping-local": _Kind("info", ("adjusted", "refused")),
    "mapping-local-not-rigid": _Kind("doubtful", ("refused", "adjusted")),
    "mapping-adjusted": _Kind("info", ("keyframes", "sigma_px", "loops", "maps", "rotation_deg", "depth_change")),
    "mapping-without-observations": _Kind("info", ("keyframes",)),
    "mapping-not-rigid": _Kind("doubtful", ("sigma_px",)),
    "shape-determined": _Kind("info", ("correlation",)),
    "shape-decided": _Kind("note", ("error_px", "other_px")),
    "shape-not-determined": _Kind("doubtful", ("error_px", "other_px")),
    "mapping-not-determined": _Kind("doubtful", ("error_px", "other_px")),
    "mapping-worse": _Kind("doubtful", ("error_px", "tracked_px")),
    "mapping-depth-disagrees": _Kind("doubtful", ("adjusted", "tracked")),
    "depth-triangulated": _Kind("info", ("triangulated", "keyframes")),
    "fusion-scaled": _Kind("info", ("voxel_mm", "divisor", "max_depth_mm")),
    "fusion-farther": _Kind("info", ("max_depth_mm", "median_mm")),
    "fusion-coarsened": _Kind("info", ("voxel_mm", "finest_mm")),
    "fusion-free-space": _Kind("note", ("share", "frames")),
    "fusion-too-far": _Kind("doubtful", ("median_mm", "max_depth_mm")),
    "memory-limited": _Kind("info", ("observations", "blocks", "ahead")),
}
"""Every code of a notice."""


@dataclass(frozen=True)
class Notice:
    """One thing that a run reports about itself.

    code : a key of `KINDS`, stable between versions. values : numbers and texts, by the names that the code has.
    """

    code: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        wanted = KINDS[self.code].values
        if set(self.values) != set(wanted):
            raise ValueError(f"notice {self.code}: values {sorted(self.values)} instead of {sorted(wanted)}")

    @property
    def level(self) -> Level:
        """How much it matters."""
        return KINDS[self.code].level


def of_input(notes: Iterable[str | Notice], warnings: Iterable[str | Notice]) -> list[Notice]:
    """Return what a reader noted as notices: its plain texts are `input-note` and `input-warning`."""
    both = (("input-note", notes), ("input-warning", warnings))
    return [said if isinstance(said, Notice) else Notice(code, {"text": said}) for code, all_ in both for said in all_]
