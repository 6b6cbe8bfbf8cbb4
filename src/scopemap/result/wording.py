"""The words of verdicts, of notices and of the scale, for people; programs read codes, levels and values."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from string import Formatter
from typing import Any

from scopemap.engine.notices import Level, Notice

LEVEL_WORDS: dict[Level, str] = {"good": "good", "doubtful": "doubtful", "bad": "not usable"}
"""The word of a verdict, by its level."""


@dataclass(frozen=True)
class Wording:
    """The words of a code.

    text : one sentence of at most 120 characters, with the values that it names. next_step : an imperative of at most
    80, or "" where there is nothing to do.
    """

    text: str
    next_step: str = ""


STILL_PART = "Reconstruct a part in which it holds still (--frames A:B)."
"""Next step where tissue moves and one surface stands for all frames; of several the verdict names the good ones."""
_MORE_MOTION = "Do not trust the relief; try a part with sideways motion (--frames A:B)."

WORDINGS: dict[str, Wording] = {
    "input-note": Wording("{text}."),
    "input-warning": Wording("{text}."),
    "input-changed": Wording(
        "The input {path} changed while it was read, so frames may be missing.",
        "Wait until the file is complete, then run again.",
    ),
    "checkpoint-damaged": Wording("The run began again at its first frame instead of resuming: {reason}."),
    "input-interlaced": Wording(
        "The video is interlaced, and you chose to use both fields: moving edges look like combs."
    ),
    "input-deinterlaced": Wording("One field of each picture is used, and the missing rows are interpolated: {why}."),
    "input-interlaced-averaged": Wording(
        "The video is interlaced: the working size averages both fields, and fast motion is blurred.",
    ),
    "input-resized": Wording(
        "{frames} pictures differ from {size} px by at most 1 % and were cut or completed (first: {first})."
    ),
    "input-other-size": Wording(
        "{frames} pictures of another size were left out (first: {first}, {reason}).",
        "See frames.csv for their names.",
    ),
    "input-text-burned-in": Wording(
        "The file states that text, perhaps a patient's name, is burned into its images.",
        "Do not share images of this result; --redact blackens parts of them.",
    ),
    "input-interrupted": Wording("The run was stopped at frame {frame}: later frames are missing."),
    "camera-assumed": Wording("The camera is {source}."),
    "camera-unknown": Wording(
        "The focal length is assumed: {reason}.",
        "Calibrate (--camera), or run again with --fov or --scope.",
    ),
    "camera-distorted": Wording(
        "The lens has radial distortion, about {share:.0%} at half the image width from the centre, which bends "
        "shapes.",
        "Calibrate, and run again with --camera.",
    ),
    "camera-contradicted": Wording(
        "The motion fits another lens (focal length {change:+.0%}): left-out tracks then fit {gain:.0%} better.",
        "Check calibration and cropping; tissue motion can look the same.",
    ),
    "camera-aspect": Wording(
        "fx and fy of the lens differ by {share:.0%} ({fx:.0f} and {fy:.0f} px): few cameras have such pixels.",
        "Check fx and fy in the calibration.",
    ),
    "camera-unconfirmed": Wording(
        "The motion does not constrain the focal length (standard deviation {sigma:.0%}): a wrong one would not show.",
        "Check the calibration.",
    ),
    "camera-at-rest": Wording(
        "The data set states that the camera is at rest while the tissue moves: an estimated path means little.",
    ),
    "camera-at-rest-stated": Wording(
        "The camera is stated to be at rest: each frame has its own surface, wrong if the camera moved."
    ),
    "masks-missing": Wording(
        "{missing} of {frames} frames have no mask in {folder}: instruments may be part of the surface.",
        "Name each mask so that its last number is the frame's number.",
    ),
    "masks-shifted": Wording(
        "The masks in {folder} begin and end one number from the frames: each is used {shift:+.0f} frame from it."
    ),
    "masks-late": Wording(
        "The frames begin at {frame} and the masks in {folder} at {mask}: each mask may be one frame late.",
        "Name each mask so that its last number is the frame's number.",
    ),
    "masks-unused": Wording(
        "{masks} masks in {folder} have no frame of their number (first: {first}).",
        "Name each mask so that its last number is the frame's number.",
    ),
    "masks-empty": Wording("No mask in {folder} hides a pixel: all are black."),
    "masks-faint": Wording(
        "No mask in {folder} hides a pixel: of a JPEG levels above 127 count, and the largest is {level}.",
        "Write the masks as PNG, or with levels of 0 and 255.",
    ),
    "masks-large": Wording(
        "The masks in {folder} hide {share:.0%} of the pictures on average: what is not 0 is hidden.",
        "If the masks are white at tissue, invert them.",
    ),
    "frames-failed": Wording("Processing failed in {frames:frame}, first in frame {first}: {reason}."),
    "frames-without-depth": Wording("The network returned no depth for {frames:frame}, first for frame {first}."),
    "depth-propagated": Wording(
        "The network estimated depth in one frame in {every}; optical flow propagated it to {frames:frame}."
    ),
    "depth-files-shifted": Wording(
        "The depth files in {folder} begin and end one number from the frames: each is used {shift:+.0f} frame from it."
    ),
    "depth-files-kind": Wording("The depth files hold {kind}: {reason}.", "If that is wrong, set depth.files_kind."),
    "frames-skipped": Wording("{frames:frame} without usable texture were skipped: {causes}."),
    "frames-few": Wording("Only {frames:frame} are in the result: too few to judge it."),
    "frames-forgotten": Wording("The result keeps the last {kept} frames; {frames} older ones are not in it."),
    "frames-dropped": Wording("{dropped} of {read} live frames were dropped to keep the latency low."),
    "submaps-apart": Wording(
        "The camera was lost and {submaps} submaps stay apart: {frames} of {tracked} tracked frames are in the result.",
        "Look at the others in maps/; their relative poses are unknown.",
    ),
    "tissue-moves": Wording(
        "Tissue moves on its own in {frames} of {measured} frames, most in frame {most} ({share:.0%} of the picture).",
        STILL_PART,
    ),
    "mapping-none": Wording(
        "Keyframes were not adjusted: no other view confirms depth and path.",
        "Run again with --set mapping.method=local.",
    ),
    "mapping-local": Wording(
        "{adjusted:keyframe} were adjusted, each with those before it; {refused} kept their tracked poses."
    ),
    "mapping-local-not-rigid": Wording(
        "The tissue moves: {refused:keyframe} could not be adjusted ({adjusted} were).",
        STILL_PART,
    ),
    "mapping-adjusted": Wording(
        "Bundle adjustment of {keyframes:keyframe} left {sigma_px:.2f} px reprojection error and closed {loops:loop} "
        "in {maps:map}.",
    ),
    "mapping-without-observations": Wording(
        "Bundle adjustment was not possible: the {keyframes:keyframe} have no common observations."
    ),
    "mapping-not-rigid": Wording(
        "The tissue moves: no rigid scene fits the views ({sigma_px:.2f} px error), so bundle adjustment was rejected.",
        STILL_PART,
    ),
    "shape-determined": Wording(
        "The motion determines the shape: another start finds it, too (correlation {correlation:.2f})."
    ),
    "shape-decided": Wording(
        "Two shapes fit the views; the result has the better one ({error_px:.2f} against {other_px:.2f} px error).",
    ),
    "shape-not-determined": Wording(
        "The motion does not determine the shape: no other start confirms it ({error_px:.2f} and {other_px:.2f} "
        "px error).",
        _MORE_MOTION,
    ),
    "mapping-not-determined": Wording(
        "The motion does not determine the shape, which rests on the depth network alone.",
        _MORE_MOTION,
    ),
    "mapping-worse": Wording(
        "Bundle adjustment was rejected: tracks left out of it fit worse ({error_px:.2f} px) than as tracked "
        "({tracked_px:.2f} px).",
    ),
    "mapping-depth-disagrees": Wording(
        "Bundle adjustment was rejected: keyframe depths would differ by {adjusted:.0%} ({tracked:.0%} before).",
    ),
    "depth-triangulated": Wording(
        "Several views measured depth in {triangulated} of {keyframes:keyframe}; the others keep the network's."
    ),
    "fusion-scaled": Wording(
        "Voxels measure {voxel_mm:g} mm, 1/{divisor} of the median depth; pixels beyond {max_depth_mm:g} mm are not "
        "fused.",
        "Set fusion.voxel_mm for another size.",
    ),
    "fusion-farther": Wording(
        "Pixels up to {max_depth_mm:g} mm are fused, beyond 200 voxels: the median depth is {median_mm:.0f} mm.",
    ),
    "fusion-coarsened": Wording(
        "Voxels measure {voxel_mm:g} mm instead of {finest_mm:g} mm: finer ones do not fit into memory, or are far "
        "finer than a pixel.",
        "Allow more memory with --memory.",
    ),
    "fusion-free-space": Wording(
        "{share:.1%} of the pixels in {frames:frame} were not fused: others look through there, or an instrument "
        "is near.",
    ),
    "fusion-too-far": Wording(
        "Most of the scene is not fused: its median depth is {median_mm:.0f} mm, and fusion ends at "
        "{max_depth_mm:g} mm.",
        "Leave fusion.max_depth_mm and fusion.voxel_mm out: they then follow the scene.",
    ),
    "memory-limited": Wording(
        "To limit memory, {observations} observations, {blocks} blocks of 8^3 voxels and {ahead:frame} ahead are "
        "kept at "
        "most.",
    ),
}
"""The words of every code of `engine/notices.py`."""


_MM = re.compile(r"(?<=\d) mm\b")


class _Format(Formatter):
    """Formats shares as "6 %", and counts by their noun: `{frames:frame}` is "1 frame" or "12 frames"."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if len(format_spec) > 1 and format_spec.isalpha():
            return f"{value} {format_spec}" + "s" * (value != 1)
        text = format(value, format_spec)
        return f"{text[:-1]} %" if format_spec.endswith("%") else text


def text_of(notice: Notice, *, scale_known: bool = True) -> str:
    """Return one sentence: what was found, and what it means for the result.

    scale_known : where it is not, lengths are in units of the result, and the sentence says so.
    """
    words = _Format().vformat(WORDINGS[notice.code].text, (), notice.values)
    if not scale_known:
        words = _MM.sub(" units", _MM.sub(" units (the scale is unknown)", words, count=1))
    return re.sub(r"^[a-z](?=[a-z-]*[\s:,])", lambda first: first[0].upper(), words.rstrip(".")) + "."


def in_words(said: str | Notice, *, scale_known: bool = True) -> str:
    """Return a notice with its next step in words, as `text_of`; the plain text of a reader as it is."""
    if isinstance(said, str):
        return said
    return f"{text_of(said, scale_known=scale_known)} {WORDINGS[said.code].next_step}".rstrip()


def facts_of_notices(notices: Iterable[Notice]) -> list[dict[str, Any]]:
    """Return code, level, values, text and next step of each notice, as `provenance.json` holds them."""
    return [
        {
            "code": notice.code,
            "level": notice.level,
            "values": dict(notice.values),
            "text": text_of(notice),
            "next_step": WORDINGS[notice.code].next_step,
        }
        for notice in notices
    ]


def scale_words(scale: Mapping[str, Any]) -> str:
    """Return what is known of a result's scale in words, from "scale" of its provenance; "" where that is empty."""
    if not scale:
        return ""
    if scale.get("stated"):
        return f"scale: sizes rest on the stated {scale['source']}"
    if scale["known"]:
        return f"scale: {scale['source']}"
    return f"scale unknown ({scale['source']}): compare shapes, not sizes"
