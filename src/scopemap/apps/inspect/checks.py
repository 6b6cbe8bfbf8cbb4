"""Findings about a video: its rate, repeated, blank, blurred frames, odd colours, cuts, motion, kind of endoscope.

Each check takes a `Clip`, or what else is known of the pictures, and yields findings, with the option that answers each
as its advice. What no option answers is no finding: the facts have the usual exposure and motion, and the forecast says
what they mean for a run. The limits of motion and texture separate clips that runs track whole (correlation above 0.84,
motion below 2 % of width, sharpness above 0.015) from a colonoscopy and a bare tube of which they lost most frames.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scopemap.apps.inspect.clip import Clip, Segment, VideoFinding, covered
from scopemap.apps.inspect.field_shape import Field
from scopemap.input.video_format.stereo_packing import Packing

_BLACK_LEVEL = 16.0
# Share of the video's usual sharpness that a blurred frame has. No texture: sharpness of the usual frame.
_BLURRED_SHARE = 0.35
_NO_TEXTURE = 0.008
# Mean red over the stronger of green and blue, of tissue in white light.
_LEAST_REDNESS = 1.1
_MOSTLY = 0.9
_FAST_HZ = 45.0
_SLOW_MOTION = 0.004
_FAST = 0.05  # motion per frame, share of the width
_UNLIKE = 0.6  # correlation with the frame before
_CUT = 0.2
_LIKE = 0.7
_SOME = 0.05  # shares of the frames
_MANY = 0.25
_WITH_EYEPIECE = ("laparoscope", "cystoscope", "sinus", "bronchoscope", "ureteroscope")
_WITH_CUT_CORNERS = ("colonoscope", "gastroscope")
_SQUARE = 0.05
_MOST_IN_BOX = 0.95  # share of the box around the field from which its corners may be those of a round field


def check_rate(clip: Clip) -> Iterator[VideoFinding]:
    """Yield that little moves from frame to frame of a video of a high rate."""
    if clip.stamped and clip.rate_hz >= _FAST_HZ and np.median(clip["motion"]) < _SLOW_MOTION * clip.step:
        message = f"little moves from frame to frame at {clip.rate_hz:.3g} pictures per second"
        yield VideoFinding("info", "rate-high", message, f"--fps {clip.rate_hz / 2:.3g} halves the work")


def check_packing(packed: Packing | None, *, interlaced: bool) -> Iterator[VideoFinding]:
    """Yield whether a picture holds two views (stereo), or two fields of different times (interlaced)."""
    if packed is not None:
        where = "beside" if packed.layout == "left-right" else "above"
        squeezed = ", each squeezed to half its size" if packed.squeezed else ""
        correlation = f"(correlation {packed.correlation:.2f})"
        message = f"two views {where} each other{squeezed} {correlation}; the rest is about the first"
        yield VideoFinding("warning", "stereo", message, f"--stereo {packed.layout}")
    if interlaced:
        message = "interlaced: odd and even rows show two moments, edges of what moves look like combs"
        yield VideoFinding("info", "interlaced", message, "runs use one field of it (--no-deinterlace: both)")


def check_repeats(clip: Clip) -> Iterator[VideoFinding]:
    """Yield duplicates, as conversions between rates make them, and frozen segments."""
    frozen = clip.segments(clip.repeats, seconds=0.3, least=4)
    single = clip.segments(clip.repeats & ~covered(frozen, len(clip)))
    advice = "runs leave them out (--set input.skip_duplicates=false keeps them)"
    if frozen:
        yield clip.finding("warning", "frozen", "the picture is frozen for {frames}", frozen, advice)
    if single:
        message = f"the same picture as before: {{frames}}{_rhythm(clip, single) if clip.step == 1 else ''}"
        yield clip.finding("info", "duplicates", message, single, advice)


def _rhythm(clip: Clip, single: tuple[Segment, ...]) -> str:
    """Return the interval in words where duplicates come at an even pace, as from 25 to 30 frames per second."""
    firsts = np.array([first for first, _ in single])
    steps = np.diff(firsts)[np.diff(clip["part"][firsts]) == 0]
    if steps.size < 3 or np.percentile(steps, 90) - np.percentile(steps, 10) > 1:
        return ""
    return f", about every {np.median(steps):.0f}th: the video was converted to a higher rate"


def check_frames(clip: Clip) -> Iterator[VideoFinding]:
    """Yield which frames are blank, blurred, or of another colour than tissue."""
    blank, black, sharpness = clip["blank"], clip["brightness"] <= _BLACK_LEVEL, clip["sharpness"]
    for flags, code, words in ((blank & black, "black", "black"), (blank & ~black, "one-colour", "of one colour")):
        if segments := clip.segments(flags):
            yield clip.finding("warning", code, f"{words}: {{frames}}", segments, "{selection}")
    usual = np.median(sharpness[~blank]) if not blank.all() else 0.0
    if segments := clip.segments(~blank & (sharpness < _BLURRED_SHARE * usual), seconds=0.15, least=3, gap=2):
        share = np.median(sharpness[covered(segments, len(clip))]) / usual
        message = (
            f"blurred, or without texture: {{frames}} show {share:.0%} of the usual sharpness (a smear on "
            "the lens, defocus, or tissue very near)"
        )
        yield clip.finding("warning", "blurred", message, segments, "{selection}")
    flags = ~blank & (clip["redness"] < _LEAST_REDNESS)
    if segments := clip.segments(flags, seconds=0.3, least=4, gap=3):
        advice = "look at them; narrow-band light is fine to run on"
        message = "not the colour of tissue in white light (outside the patient, or narrow-band light): {frames}"
        if np.mean(flags) > _MOSTLY:
            message = "most pictures do not have the colour of tissue in white light: narrow-band light, or no tissue"
        elif not covered(segments, len(clip)).all():
            advice += ", else {selection}"
        yield clip.finding("warning", "not-tissue", message, segments, advice)


def exposure_figures(clip: Clip) -> dict[str, float]:
    """Return median shares over the frames that are not blank: over-exposed, under-exposed, highlights, usable."""
    shown = ~clip["blank"]
    names = {"clipped": "over_exposed", "dark": "under_exposed", "highlights": "highlights", "usable": "usable"}
    return {f"{name}_share": float(np.median(clip[key][shown])) if shown.any() else 0.0 for key, name in names.items()}


def _dangers(clip: Clip) -> tuple[dict[str, np.ndarray], bool]:
    """Return flags of the frames that were read, (N,) bool each, and whether the video is without texture.

    fast : the picture moves by more than 5 % of its width. unlike : hardly like the frame before, moved by its flow.
    cut : so unlike, between frames that are like their neighbours; not in `unlike`. Blank and repeated frames, which
    runs leave out, are in none of them.
    """
    shown = ~clip["blank"] & ~clip.repeats
    correlation, sharpness = clip["correlation"], clip["sharpness"]
    usual = float(np.median(sharpness[shown])) if shown.any() else 0.0
    # A picture after a blank or an unreadable one resembles nothing.
    gap = np.diff(clip["position"]) > clip.step
    follows = shown & ~np.concatenate([[True], clip["blank"][:-1] | gap])
    around = np.minimum(np.concatenate([[1.0], correlation[:-1]]), np.concatenate([correlation[1:], [1.0]]))
    cut = follows & (correlation < _CUT) & (around > _LIKE)
    flags = {
        "cut": cut,
        "fast": follows & (clip["motion"] > _FAST),
        "unlike": follows & (correlation < _UNLIKE) & ~cut,
    }
    return flags, usual < _NO_TEXTURE


def check_dangers(clip: Clip) -> Iterator[VideoFinding]:
    """Yield what makes a run lose frames and an option avoids: cuts, and fast motion where frames are passed over."""
    flags, _ = _dangers(clip)
    if flags["cut"].any():
        message = "the picture changes at once, as at a cut: {frames}"
        yield clip.finding("warning", "cut", message, clip.segments(flags["cut"]), "{selection}")
    if clip.step > 1 and flags["fast"].mean() > _SOME:
        moving = clip["motion"]
        message = (
            f"fast motion: the picture moves by {np.median(moving):.1%} of its width from frame to frame, by "
            f"{np.percentile(moving, 95):.1%} in the fastest; by more than {_FAST:.0%} in {{frames}}"
        )
        advice = "use every frame: --frames without a step"
        yield clip.finding("warning", "motion-fast", message, clip.segments(flags["fast"], gap=2), advice)


def forecast(clip: Clip) -> str:
    """Return in words what a run can be expected to make of the video."""
    flags, textureless = _dangers(clip)
    lost, cuts = int((flags["fast"] | flags["unlike"] | flags["cut"]).sum()), int(flags["cut"].sum())
    which = f"of one frame in {clip.step}: " if clip.step > 1 else ""
    if len(clip) < clip.count:
        which = f"of {len(clip)} frames in {clip['part'].max() + 1} parts of the video: "
    if textureless:
        return f"{which}poor: walls without texture; expect most frames to be lost or in separate submaps"
    if lost > _MANY * len(clip):
        return (
            f"{which}poor: about {lost} of {len(clip)} frames are hard to track; expect lost frames and several "
            "submaps instead of one surface"
        )
    if lost > _SOME * len(clip) or cuts:
        jumps = f", {cuts} cut{'s' * (cuts != 1)}" if cuts else ""
        return f"{which}fair: {lost} frames are hard to track{jumps}; the surface may break into submaps there"
    return f"{which}good: motion, sharpness and texture suit a reconstruction"


def check_scope(field: Field, size: tuple[int, int], *, stereo: bool) -> Iterator[VideoFinding]:
    """Yield which kinds of endoscope the pictures are typical of, where they tell."""
    words, kinds = _guessed_scopes(field, size, stereo=stereo)
    if kinds:
        named = ", ".join(kinds[:-1]) + " or " * (len(kinds) > 1) + kinds[-1]
        advice = "" if len(kinds) == 1 else ": name the one that it is"
        yield VideoFinding("info", "scope", f"{words}: typical of {named}", f"--scope {'|'.join(kinds)}{advice}")


def _guessed_scopes(field: Field, size: tuple[int, int], *, stereo: bool) -> tuple[str, tuple[str, ...]]:
    """Return what of a picture tells the kind of endoscope, in words, and the kinds; "" and none where nothing does.

    A telescope or a bundle of fibres shows a camera behind it a round picture (Budd et al., arXiv 2210.14771); a
    capsule's is round, too (Prasath et al., "Mucosal Region Detection and 3D Reconstruction in Wireless Capsule
    Endoscopy Videos"), and square. C3VD's colonoscope has cut corners; that gastroscopes have them is a guess. Stereo
    endoscopes of all data sets that we read are laparoscopes.

    size : width and height of a picture, px. stereo : whether a picture holds two views.
    """
    left, top, right, bottom = field.box
    across, down = right - left, bottom - top
    if stereo:
        return "two views", ("laparoscope",)
    if field.shape == "circle":
        return "a round field of view", _WITH_EYEPIECE + ("capsule",) * _is_square(*size)
    is_square = _is_square(across * size[0], down * size[1])
    if field.shape == "cut corners" and field.share < _MOST_IN_BOX * across * down and not is_square:
        return "a field of view with cut corners", _WITH_CUT_CORNERS
    return "", ()


def _is_square(width: float, height: float) -> bool:
    return abs(width - height) <= _SQUARE * max(width, height)
