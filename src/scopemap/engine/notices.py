"""What a run reports about itself: typed notices, and the one place that words each of them.

Programs read `code` and `values` (docs/formats.md lists them); people read `text` and `next_step`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from string import Formatter
from typing import Any, Literal

Level = Literal["good", "info", "note", "doubtful", "bad"]
"""Of a notice, or of a reason of the verdict. info: an assumption or a choice. note: a shortcoming. doubtful: one that
makes the result doubtful. Of the verdict alone: good, and bad, not usable."""


@dataclass(frozen=True)
class _Kind:
    """Level and words of a code.

    text : one sentence of at most 120 characters. next_step : an imperative of at most 80, or "". unsaid : values that
    programs read and the sentence leaves out. in_verdict : False where another reason of the verdict says the same.
    """

    level: Level
    text: str
    next_step: str = ""
    unsaid: tuple[str, ...] = ()
    in_verdict: bool = True


_HOLDS_STILL = "Use the segments in which it holds still, or a part with --frames A:B."
_MORE_MOTION = "Do not trust the relief; try a part with sideways motion (--frames A:B)."

KINDS: dict[str, _Kind] = {
    # What readers of files found: free text, by which nothing is decided.
    "input-note": _Kind("info", "{text}."),
    "input-warning": _Kind("note", "{text}."),
    "input-changed": _Kind(
        "note",
        "The input {path} changed while it was read, so frames may be missing.",
        "Wait until the file is complete, then run again.",
    ),
    "checkpoint-damaged": _Kind("info", "The run began again at its first frame instead of resuming: {reason}."),
    "input-interlaced": _Kind(
        "doubtful", "The video is interlaced, and you chose to use both fields: moving edges look like combs."
    ),
    "input-deinterlaced": _Kind(
        "info", "One field of each picture is used, and the missing rows are interpolated: {why}."
    ),
    "input-interlaced-averaged": _Kind(
        "info",
        "The video is interlaced: the working size averages both fields, and fast motion is blurred.",
    ),
    "input-resized": _Kind(
        "info", "{frames} pictures differ from {size} px by at most 1 % and were cut or completed (first: {first})."
    ),
    "input-other-size": _Kind(
        "note",
        "{frames} pictures of another size were left out (first: {first}, {reason}).",
        "See frames.csv for their names.",
    ),
    "input-text-burned-in": _Kind(
        "note",
        "The file states that text, perhaps a patient's name, is burned into its images.",
        "Do not share images of this result; --redact blackens parts of them.",
    ),
    "input-interrupted": _Kind(
        "note", "The run was stopped at frame {frame}: later frames are missing.", in_verdict=False
    ),
    "camera-assumed": _Kind("info", "The camera is {source}."),
    "camera-unknown": _Kind(
        "note",
        "The focal length is assumed: {reason}.",
        "Calibrate (--camera), or run again with --fov or --scope.",
        in_verdict=False,
    ),
    "camera-distorted": _Kind(
        "doubtful",
        "The lens has radial distortion, about {share:.0%} at half the image width from the centre, which bends "
        "shapes.",
        "Calibrate, and run again with --camera.",
    ),
    "camera-contradicted": _Kind(
        "doubtful",
        "The motion fits another lens (focal length {change:+.0%}): left-out tracks then fit {gain:.0%} better.",
        "Check calibration and cropping; tissue motion can look the same.",
    ),
    "camera-aspect": _Kind(
        "doubtful",
        "fx and fy of the lens differ by {share:.0%} ({fx:.0f} and {fy:.0f} px): few cameras have such pixels.",
        "Check fx and fy in the calibration.",
    ),
    "camera-unconfirmed": _Kind(
        "note",
        "The motion does not constrain the focal length (standard deviation {sigma:.0%}): a wrong one would not show.",
        "Check the calibration.",
    ),
    "camera-at-rest": _Kind(
        "doubtful",
        "The data set states that the camera is at rest while the tissue moves: the estimated path means little.",
    ),
    "camera-at-rest-stated": _Kind(
        "note", "You stated that the camera is at rest: each frame has its own surface, wrong if the camera moved."
    ),
    "masks-missing": _Kind(
        "doubtful",
        "{missing} of {frames} frames have no mask in {folder}: instruments may be part of the surface.",
        "Name each mask so that its last number is the frame's number.",
    ),
    "masks-shifted": _Kind(
        "info", "The masks in {folder} begin and end one number from the frames: each is used {shift:+d} frame from it."
    ),
    "masks-late": _Kind(
        "note",
        "The frames begin at {frame} and the masks in {folder} at {mask}: each mask may be one frame late.",
        "Name each mask so that its last number is the frame's number.",
    ),
    "masks-unused": _Kind(
        "note",
        "{masks} masks in {folder} have no frame of their number (first: {first}).",
        "Name each mask so that its last number is the frame's number.",
    ),
    "masks-empty": _Kind("note", "No mask in {folder} hides a pixel: all are black.", unsaid=("level",)),
    "masks-faint": _Kind(
        "doubtful",
        "No mask in {folder} hides a pixel: of a JPEG levels above 127 count, and the largest is {level}.",
        "Write the masks as PNG, or with levels of 0 and 255.",
    ),
    "frames-failed": _Kind("note", "Processing failed in {frames:frame}, first in frame {first}: {reason}."),
    "frames-without-depth": _Kind("note", "The network returned no depth for {frames:frame}, first for frame {first}."),
    "depth-propagated": _Kind(
        "info", "The network estimated depth in one frame in {every}; optical flow propagated it to {frames:frame}."
    ),
    "frames-skipped": _Kind("info", "{frames:frame} without usable texture were skipped: {causes}."),
    "frames-few": _Kind("note", "Only {frames:frame} are in the result: too few to judge it.", in_verdict=False),
    "frames-forgotten": _Kind("note", "The result keeps the last {kept} frames; {frames} older ones are not in it."),
    "frames-dropped": _Kind("info", "{dropped} of {read} live frames were dropped to keep the latency low."),
    "submaps-apart": _Kind(
        "note",
        "The camera was lost and {submaps} submaps stay apart: {frames} of {tracked} tracked frames are in the result.",
        "Look at the others in maps/; their relative poses are unknown.",
        unsaid=("saved", "least"),
        in_verdict=False,
    ),
    "tissue-moves": _Kind(
        "note",
        "Tissue moves on its own in {frames} of {measured} frames, most in frame {most} ({share:.0%} of the picture).",
        _HOLDS_STILL,
        unsaid=("threshold", "x", "y"),
    ),
    "mapping-none": _Kind(
        "doubtful",
        "Keyframes were not adjusted: no other view confirms depth and path.",
        "Run again with --set mapping.method=local.",
    ),
    "mapping-local": _Kind(
        "info", "{adjusted:keyframe} were adjusted, each with those before it; {refused} kept their tracked poses."
    ),
    "mapping-local-not-rigid": _Kind(
        "doubtful",
        "The tissue moves: {refused:keyframe} could not be adjusted ({adjusted} were).",
        _HOLDS_STILL,
    ),
    "mapping-adjusted": _Kind(
        "info",
        "Bundle adjustment of {keyframes:keyframe} left {sigma_px:.2f} px reprojection error and closed {loops:loop} "
        "in {maps:map}.",
        unsaid=("rotation_deg", "depth_change"),
    ),
    "mapping-without-observations": _Kind(
        "info", "Bundle adjustment was not possible: the {keyframes:keyframe} have no common observations."
    ),
    "mapping-not-rigid": _Kind(
        "doubtful",
        "The tissue moves: no rigid scene fits the views ({sigma_px:.2f} px error), so bundle adjustment was rejected.",
        _HOLDS_STILL,
        unsaid=("merged",),
    ),
    "shape-determined": _Kind(
        "info", "The motion determines the shape: another start finds it, too (correlation {correlation:.2f})."
    ),
    "shape-decided": _Kind(
        "note",
        "Two shapes fit the views; the result has the better one ({error_px:.2f} against {other_px:.2f} px error).",
    ),
    "shape-not-determined": _Kind(
        "doubtful",
        "The motion does not determine the shape: no other start confirms it ({error_px:.2f} and {other_px:.2f} "
        "px error).",
        _MORE_MOTION,
    ),
    "mapping-not-determined": _Kind(
        "doubtful",
        "The motion does not determine the shape, which rests on the depth network alone.",
        _MORE_MOTION,
        unsaid=("error_px", "other_px", "merged"),
    ),
    "mapping-worse": _Kind(
        "doubtful",
        "Bundle adjustment was rejected: tracks left out of it fit worse ({error_px:.2f} px) than as tracked "
        "({tracked_px:.2f} px).",
        unsaid=("merged",),
    ),
    "mapping-depth-disagrees": _Kind(
        "doubtful",
        "Bundle adjustment was rejected: keyframe depths would differ by {adjusted:.0%} ({tracked:.0%} before).",
        unsaid=("merged",),
    ),
    "depth-triangulated": _Kind(
        "info", "Several views measured depth in {triangulated} of {keyframes:keyframe}; the others keep the network's."
    ),
    "fusion-scaled": _Kind(
        "info",
        "Voxels measure {voxel_mm:g} mm, 1/{divisor} of the median depth; pixels beyond {max_depth_mm:g} mm are not "
        "fused.",
        "Set fusion.voxel_mm for another size.",
    ),
    "fusion-farther": _Kind(
        "info",
        "Pixels up to {max_depth_mm:g} mm are fused, beyond 200 voxels: the median depth is {median_mm:.0f} mm.",
    ),
    "fusion-coarsened": _Kind(
        "info",
        "Voxels measure {voxel_mm:g} mm instead of {finest_mm:g} mm: finer ones do not fit into memory, or are far "
        "finer than a pixel.",
        "Allow more memory with --memory.",
    ),
    "fusion-free-space": _Kind(
        "note",
        "{share:.1%} of the pixels in {frames:frame} were not fused: others look through there, or an instrument "
        "is near.",
        in_verdict=False,
    ),
    "fusion-too-far": _Kind(
        "doubtful",
        "Most of the scene is not fused: its median depth is {median_mm:.0f} mm, and fusion ends at "
        "{max_depth_mm:g} mm.",
        "Leave fusion.max_depth_mm and fusion.voxel_mm out: they then follow the scene.",
    ),
    "memory-limited": _Kind(
        "info",
        "To limit memory, {observations} observations, {blocks} blocks of 8^3 voxels and {ahead:frame} ahead are "
        "kept at "
        "most.",
    ),
}
"""Every code with its level and its words."""


class _Words(Formatter):
    """Formats shares as "6 %", and counts by their noun: `{frames:frame}` is "1 frame" or "12 frames"."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if len(format_spec) > 1 and format_spec.isalpha():
            return f"{value} {format_spec}" + "s" * (value != 1)
        text = format(value, format_spec)
        return f"{text[:-1]} %" if format_spec.endswith("%") else text


@dataclass(frozen=True)
class Notice:
    """One thing that a run reports about itself.

    code : a key of `KINDS`, stable between versions. values : numbers and texts, as `fields_of_kind` names them.
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
        """One sentence: what was found, and what it means for the result."""
        words = _Words().vformat(KINDS[self.code].text, (), self.values)
        return re.sub(r"^[a-z](?=[a-z-]*[\s:,])", lambda first: first[0].upper(), words.rstrip(".")) + "."

    @property
    def next_step(self) -> str:
        """What to do about it, one sentence; "" where there is nothing to do."""
        return KINDS[self.code].next_step

    @property
    def in_verdict(self) -> bool:
        """Whether it is a reason of the verdict; False: an assumption, or another reason says the same."""
        return self.level != "info" and KINDS[self.code].in_verdict

    def __str__(self) -> str:
        return f"{self.text} {self.next_step}".rstrip()

    def as_json(self) -> dict[str, Any]:
        """Return code, level, values, text and next step, as `provenance.json` holds them."""
        facts = {"code": self.code, "level": self.level, "values": dict(self.values)}
        return facts | {"text": self.text, "next_step": self.next_step}

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> Notice:
        """Return the notice that `as_json` wrote. Raises `KeyError` and `ValueError` for what it did not write."""
        return cls(found["code"], found["values"])


def fields_of_kind(code: str) -> set[str]:
    """Return the names of the values of a code."""
    kind = KINDS[code]
    return {name for _, name, _, _ in Formatter().parse(kind.text) if name} | set(kind.unsaid)


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
    return f"scale unknown ({scale['source']}): compare shapes, not sizes"
