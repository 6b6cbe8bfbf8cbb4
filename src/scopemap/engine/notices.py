"""What a run has to say about itself: typed notices, and the one place where each is put into words.

Programs read `code` and `values` (docs/formats.md lists them); people read `text`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from string import Formatter
from typing import Any, Literal

Level = Literal["info", "note", "doubtful"]
"""info: an assumption or a choice. note: a shortcoming. doubtful: one that makes the result doubtful."""


@dataclass(frozen=True)
class _Kind:
    """Level and words of a code. plain : what the report says; None: `text`; "": another reason says the same."""

    level: Level
    text: str
    plain: str | None = None


KINDS: dict[str, _Kind] = {
    # What readers of files found: free text, by which nothing is decided.
    "input-note": _Kind("info", "{text}"),
    "input-warning": _Kind("note", "{text}"),
    "input-changed": _Kind("note", "the input {path} changed while it was read: this may be a part of it"),
    "checkpoint-damaged": _Kind("info", "a killed run here could not be resumed, and this one began anew: {reason}"),
    "input-interlaced": _Kind(
        "doubtful",
        "the pictures are interlaced: their even and odd rows were taken at two times, and edges that move look like "
        "combs; --deinterlace (input.deinterlace=true) uses one field of each",
        "The video is interlaced: what moves has combed edges (see --deinterlace)",
    ),
    "input-interlaced-averaged": _Kind(
        "info",
        "the pictures are interlaced: their even and odd rows were taken at two times; the working size averages both, "
        "and what moves fast is blurred; --deinterlace (input.deinterlace=true) uses one field of each",
    ),
    "input-resized": _Kind(
        "info",
        "{frames} picture(s) differ from {size} px by at most 1 % and were cut or completed at their right and bottom "
        "edge (first: {first})",
    ),
    "input-other-size": _Kind(
        "note",
        "{frames} picture(s) of another size were left out (first: {first}, {reason}); frames.csv names them",
        "{frames} picture(s) of another size were left out",
    ),
    "input-text-burned-in": _Kind(
        "note",
        "by its header notes, perhaps a patient's name, are burned into the images",
        "Text is burned into the images, perhaps a patient's name: hand none on",
    ),
    "input-interrupted": _Kind("note", "interrupted at frame {frame}: the result is of the frames until then", ""),
    "camera-assumed": _Kind("info", "camera {source}"),
    "camera-unknown": _Kind(
        "note",
        "{reason}; a calibration (--camera) or the field of view (--fov) makes the camera known, "
        "the kind of endoscope (--scope) the guess better",
        "",
    ),
    "camera-distorted": _Kind(
        "doubtful",
        "focal length: the lens has radial distortion, about {share:.0%} at half the image's width from the centre; "
        "only a calibration corrects it (--camera)",
        "The lens bends straight lines: shapes are bent, too. A calibration mends it",
    ),
    "camera-contradicted": _Kind(
        "doubtful",
        "mapping: the views ask for another lens: focal length {change:+.0%}, principal point {x:+.0%} and {y:+.0%} of "
        "it, which would change the surface by {surface:.0%} and the path by {path:.0%} of its length; check the "
        "calibration and whether the pictures were cut after it, or the tissue moves",
        "The motion asks for another lens (focal length {change:+.0%}), which would change the surface by "
        "{surface:.0%}. Check the calibration, and whether the pictures were cut after it; or the tissue moves",
    ),
    "camera-unconfirmed": _Kind(
        "doubtful",
        "mapping: the views do not tell the focal length (standard deviation {sigma:.0%}): nothing but the calibration "
        "supports it",
        "The motion does not tell the focal length: were the calibration wrong, this result would not show it",
    ),
    "camera-at-rest": _Kind(
        "doubtful",
        "the camera is at rest while the tissue moves: errors of the path say little here",
        "The camera hardly moves while the tissue does: the path means little",
    ),
    "camera-at-rest-stated": _Kind(
        "note",
        "tracking: the camera is at rest, as stated: all motion is the tissue's",
        "The camera was stated to be at rest: each frame has a surface of its own. Had it moved, all were wrong",
    ),
    "masks-missing": _Kind(
        "doubtful",
        "masks: {missing} of {frames} frames have none in {folder}; the last number in a mask's name must be "
        "the frame's",
        "Most frames have no mask: instruments may be part of the surface",
    ),
    "frames-failed": _Kind("note", "{frames} frame(s) could not be processed whole (first: frame {first}, {reason})"),
    "frames-without-depth": _Kind("note", "{frames} frame(s) got no depth from the network (first: frame {first})"),
    "depth-propagated": _Kind(
        "info", "depth: the network saw one frame in {every}; flow propagated it to {frames} others"
    ),
    "frames-skipped": _Kind(
        "info",
        "{frames} frame(s) were skipped, without depth, because nothing in them can be followed: {causes}",
    ),
    "frames-few": _Kind(
        "note", "frames in the result: {frames}, too few to judge it by; the surface is a glimpse from one place", ""
    ),
    "frames-forgotten": _Kind("note", "{frames} of the older frames are not in the result: it keeps {kept}"),
    "frames-dropped": _Kind("info", "live: {dropped} of {read} frames were dropped, because newer ones were there"),
    "submaps-apart": _Kind(
        "note",
        "{submaps} submaps: the camera was lost, and nothing connects what it saw before and after; {frames} of "
        "{tracked} tracked frames are in the result; the relative pose of the others is unknown; {saved} with at least "
        "{least} frames are saved in maps/",
        "",
    ),
    "tissue-moves": _Kind(
        "note",
        "tissue: in {frames} of {measured} frames more than {threshold:.0%} of the picture moves on its own; most in "
        "frame {most}: {share:.0%}, around {x:.2f} of the width and {y:.2f} of the height",
        "Tissue moves on its own in {frames} of {measured} frames",
    ),
    "mapping-none": _Kind(
        "doubtful",
        "mapping: poses are as tracked; keyframes were not adjusted (--set mapping.method=local adjusts them, by flow)",
        "Keyframes were not adjusted: no other view confirms depth and path",
    ),
    "mapping-local": _Kind(
        "info", "mapping: {adjusted} keyframes adjusted as they came, each with those before it; {refused} as tracked"
    ),
    "mapping-local-not-rigid": _Kind(
        "doubtful",
        "mapping: {adjusted} keyframes adjusted as they came, {refused} as tracked: there the scene is not rigid or "
        "the focal length is wrong",
        "The views do not fit one rigid shape: the tissue moved, or the lens is other than assumed",
    ),
    "mapping-adjusted": _Kind(
        "info",
        "mapping: {keyframes} keyframes adjusted, rotations by up to {rotation_deg:.1f} deg, {loops} loops closed in "
        "{maps} map(s); reprojection errors {sigma_px:.2f} px (robust standard deviation); depth corrected by "
        "{depth_change:.0%} on average",
    ),
    "mapping-without-observations": _Kind(
        "info", "mapping: poses are as tracked; the {keyframes} keyframes have no common observations"
    ),
    "mapping-not-rigid": _Kind(
        "doubtful",
        "mapping: poses are as tracked{merged}; the scene is not rigid or the focal length is wrong: reprojection "
        "errors stay at {sigma_px:.2f} px (robust standard deviation)",
        "The views do not fit one rigid shape: the tissue moved, or the lens is other than assumed",
    ),
    "shape-determined": _Kind(
        "info",
        "mapping: the motion determines the shape; the adjustment finds it from another start, too (correlation of the "
        "relief {correlation:.2f})",
    ),
    "shape-decided": _Kind(
        "note",
        "mapping: starts of the adjustment end in different shapes; two of them in the one taken, with clearly smaller "
        "errors of tracks left out: {error_px:.2f} px, {other_px:.2f} px for the other",
        "Two shapes fit the views; the one that was taken fits them clearly better",
    ),
    "shape-not-determined": _Kind(
        "doubtful",
        "mapping: starts of the adjustment end in different shapes; the one from the network's depth was taken (errors "
        "of tracks left out {error_px:.2f} px, of the other {other_px:.2f} px)",
        "The motion does not determine the shape: another one fits the views about as well",
    ),
    "mapping-not-determined": _Kind(
        "doubtful",
        "mapping: poses are as tracked{merged}, and the depth network decides the shape; starts of the adjustment end "
        "in different shapes (errors of tracks left out {error_px:.2f} and {other_px:.2f} px)",
        "The motion does not determine the shape: it rests on the depth network alone",
    ),
    "mapping-tissue-moves": _Kind(
        "doubtful",
        "mapping: {keyframes} keyframes adjusted with tissue that moves, at {nodes} nodes by up to {moved:.0%} of the "
        "median depth{periodic}; errors of tracks left out {px:.2f} px, {rigid_px:.2f} px if it were rigid",
        "The tissue moved while it was filmed{periodic}: the surface is one state of it",
    ),
    "mapping-depth-disagrees": _Kind(
        "doubtful",
        "mapping: poses are as tracked{merged}; depths of keyframes would disagree by {adjusted:.0%}, as tracked by "
        "{tracked:.0%}",
        "The path is as tracked: an adjustment of all views would have made distances disagree",
    ),
    "depth-triangulated": _Kind(
        "info",
        "depth: {triangulated} of {keyframes} keyframes triangulated against frames around them; where views disagree "
        "(moving tissue, uncertain poses) or are too few the predicted depth stays",
    ),
    "fusion-scaled": _Kind(
        "info",
        "fusion: voxels of {voxel_mm:g} mm, 1/{divisor} of the clip's median depth, and depth up to {max_depth_mm:g} "
        "mm; set fusion.voxel_mm for others",
    ),
    "fusion-coarsened": _Kind(
        "info",
        "fusion: voxels of {voxel_mm:g} mm in place of {finest_mm:g} mm, so that the surface is within run.memory_mb",
    ),
    "fusion-at-one-moment": _Kind(
        "note",
        "fusion: as seen at second {second:g} where tissue moves on its own, {where}",
        "",
    ),
    "fusion-free-space": _Kind(
        "note",
        "fusion: {share:.1%} of the pixels, in {frames} frames, are left out: other frames look through there, or "
        "instruments touch them",
        "",
    ),
    "fusion-in-one-state": _Kind(
        "info",
        "fusion: what was seen of moving tissue was moved into its state at second {second:.2f}; mesh_over_time.glb "
        "has its other states",
    ),
    "fusion-too-far": _Kind(
        "doubtful",
        "most of the scene is not fused: its median depth is {median_mm:.0f} mm, fusion.max_depth_mm {max_depth_mm:g}; "
        "raise fusion.max_depth_mm and fusion.voxel_mm",
        "Most of what was seen is too far away to be in the surface",
    ),
    "memory-limited": _Kind(
        "info",
        "memory: at most {observations} observations adjusted, {blocks} blocks of 8^3 voxels, stages {ahead} frame(s) "
        "ahead (run.memory_mb)",
    ),
}
"""Every code with its level and its words."""


@dataclass(frozen=True)
class Notice:
    """One thing that a run says about itself.

    code : a key of `KINDS`, stable between versions. values : numbers and texts, those that the code's words name.
    """

    code: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        wanted = fields_of_kind(self.code)
        if set(self.values) != wanted:
            raise ValueError(f"notice {self.code}: values {sorted(self.values)} instead of {sorted(wanted)}")

    @property
    def level(self) -> Level:
        """How much it matters."""
        return KINDS[self.code].level

    @property
    def text(self) -> str:
        """One phrase, as in the summary of a run."""
        return KINDS[self.code].text.format(**self.values)

    @property
    def plain(self) -> str:
        """One sentence for the reader of a report; "" where another reason of the verdict says the same."""
        kind = KINDS[self.code]
        said = self.text if kind.plain is None else kind.plain.format(**self.values)
        return f"{said[0].upper()}{said[1:].rstrip('.')}." if said else ""

    def __str__(self) -> str:
        return self.text

    def as_json(self) -> dict[str, Any]:
        """Return code, level, values and text, as `provenance.json` holds them."""
        return {"code": self.code, "level": self.level, "values": dict(self.values), "text": self.text}

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> Notice:
        """Return the notice that `as_json` wrote. Raises `KeyError` and `ValueError` for what it did not write."""
        return cls(found["code"], found["values"])


def fields_of_kind(code: str) -> set[str]:
    """Return the names of the values of a code."""
    kind = KINDS[code]
    words = f"{kind.text} {kind.plain or ''}"
    return {name for _, name, _, _ in Formatter().parse(words) if name}


def of_input(notes: Iterable[str | Notice], warnings: Iterable[str | Notice]) -> list[Notice]:
    """Return what a reader noted as notices: its plain texts are `input-note` and `input-warning`."""
    both = (("input-note", notes), ("input-warning", warnings))
    return [said if isinstance(said, Notice) else Notice(code, {"text": said}) for code, all_ in both for said in all_]


def notices_of(provenance: Mapping[str, Any]) -> list[Notice]:
    """Return the notices in a run's provenance, each once."""
    found = (Notice.from_json(one) for one in provenance.get("notices", []))
    return list({(notice.code, notice.text): notice for notice in found}.values())


def scale_words(scale: Mapping[str, Any]) -> str:
    """Return what is known of a result's scale in words, from "scale" of its provenance; "" where that is empty."""
    if not scale:
        return ""
    if scale.get("stated"):
        return f"scale: sizes rest on the stated {scale['source']}"
    if scale["known"]:
        return f"scale: {scale['source']}"
    return f"scale unknown ({scale['source']}): sizes are a guess, compare shapes"
