"""Findings about a video's frames: time stamps, repeated, blank, blurred, badly exposed frames and odd colours.

Each check takes a `Clip` and yields findings, with the option that answers each as its advice.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scopemap.inspection.clip import Clip, Segment, VideoFinding, covered, segments_of, worded
from scopemap.io.frame_choice import LEAST_DIFFERENCE
from scopemap.io.video_format.interlacing import is_interlaced
from scopemap.io.video_format.stereo_packing import Packing

_BLACK_LEVEL = 16.0
BLURRED_SHARE = 0.35
"""A blurred frame has less than this share of the video's usual detail."""
# Mean red over the stronger of green and blue, of tissue in white light.
_LEAST_REDNESS, _MOSTLY = 1.1, 0.9
_UNEVEN, _UNEVEN_SHARE = 0.2, 0.05
_HOLE = 1.5
_LENGTH_SHARE, _LENGTH_S = 0.05, 1.0
_FAST_HZ, _SLOW_MOTION = 45.0, 0.004
_EXPOSURES = (
    ("clipped", 0.1, "over-exposed"),
    ("dark", 0.5, "under-exposed"),
    ("highlights", 0.1, "specular highlights"),
)


def check_frames(clip: Clip) -> Iterator[VideoFinding]:
    """Yield the findings of all checks of single frames."""
    for check in (_blank, _blurred, _colour, _exposure):
        yield from check(clip)


def check_timing(clip: Clip, claimed_s: float | None) -> Iterator[VideoFinding]:
    """Yield what is wrong with the time stamps; `claimed_s` is the length in the file's header, s, or None."""
    steps_s = clip.steps_s
    if steps_s.size < 2:
        return
    back = clip.positions(tuple((int(i) + 1, int(i) + 1) for i in np.flatnonzero(steps_s <= 0)))
    if back:
        message = f"{len(back)} time stamps are not later than the one before (frames {worded(back)})"
        advice = "poses keep their order; take no speeds from the time stamps"
        yield VideoFinding("warning", "time-order", message, advice, back)
        return
    usual_s = float(np.median(steps_s))
    yield from _dropped(clip, steps_s, usual_s)
    if claimed_s is not None and clip.is_whole and clip.stamped:
        times_s = clip["time_s"]
        read_s = float(times_s[-1] - times_s[0]) + usual_s
        if abs(read_s - claimed_s) > max(_LENGTH_S, _LENGTH_SHARE * claimed_s):
            message = f"the file's header claims {claimed_s:.1f} s, its pictures last {read_s:.1f} s"
            advice = "what can be read is used; copy the file again if it is cut off"
            yield VideoFinding("warning", "length-claimed", message, advice)
    # A hole is no variable rate.
    rest = np.abs(steps_s[steps_s < _HOLE * usual_s] / usual_s - 1)
    if clip.stamped and (rest > _UNEVEN).mean() > _UNEVEN_SHARE:
        low, high = 1 / np.percentile(steps_s, [95, 5])
        message = f"variable rate: {low:.3g} to {high:.3g} pictures per second, usually {1 / usual_s:.3g}"
        advice = "runs use the time stamps; --fps thins out by them, too"
        yield VideoFinding("info", "rate-variable", message, advice)
    if clip.stamped and clip.rate_hz >= _FAST_HZ and np.median(clip["motion"]) < _SLOW_MOTION * clip.step:
        message = f"{clip.rate_hz:.3g} pictures per second, between which hardly anything moves"
        yield VideoFinding("info", "rate-high", message, f"--fps {clip.rate_hz / 2:.3g} halves the work")


def _dropped(clip: Clip, steps_s: np.ndarray, usual_s: float) -> Iterator[VideoFinding]:
    before = np.flatnonzero(steps_s > _HOLE * usual_s)
    if before.size and before.size <= _UNEVEN_SHARE * len(clip):
        lost = int(np.round((steps_s[before] / usual_s - 1) * np.diff(clip["position"])[before]).sum())
        places = clip.positions(tuple((int(i), int(i) + 1) for i in before))
        what = "time stamps leave" if clip.stamped else "numbers in the names leave"
        message = (
            f"{what} {before.size} hole(s), about {lost} picture(s) were dropped (between frames {worded(places)})"
        )
        yield VideoFinding("warning", "frames-dropped", message, "", places)


def check_packing(packed: Packing | None, pictures: list[np.ndarray]) -> Iterator[VideoFinding]:
    """Yield whether a picture holds two views (stereo), or two fields of different times (interlaced).

    `pictures` are some of the video, (H, W, 3) uint8; interlacing shows only where something moves.
    """
    if packed is not None:
        where = "beside" if packed.layout == "left-right" else "above"
        squeezed = ", each squeezed to half its size" if packed.squeezed else ""
        correlation = f"(correlation {packed.correlation:.2f})"
        message = f"two views {where} each other{squeezed} {correlation}; the rest is about the first"
        yield VideoFinding("warning", "stereo", message, f"--stereo {packed.layout}")
    if pictures and is_interlaced(pictures):
        message = "interlaced: odd and even rows show two moments, edges of what moves look like combs"
        yield VideoFinding("warning", "interlaced", message, "--deinterlace")


def repeated(clip: Clip) -> np.ndarray:
    """Return which frames repeat the last one that was no repeat, (N,) bool; blank frames repeat nothing."""
    return (clip["change"] < LEAST_DIFFERENCE) & ~clip["blank"]


def check_repeats(clip: Clip) -> Iterator[VideoFinding]:
    """Yield duplicates, as conversions between rates make them, and frozen segments."""
    flags = repeated(clip)
    frozen = clip.segments(flags, seconds=0.3, least=4)
    single = segments_of(flags & ~covered(frozen, len(clip)))
    advice = "runs leave them out (--set input.skip_duplicates=false keeps them)"
    if frozen:
        message = f"the picture is frozen for {clip.counted(frozen)}"
        yield VideoFinding("warning", "frozen", message, advice, clip.positions(frozen))
    if single:
        message = f"the same picture as before: {clip.counted(single)}{_rhythm(single) if clip.step == 1 else ''}"
        yield VideoFinding("info", "duplicates", message, advice, clip.positions(single))


def _rhythm(single: tuple[Segment, ...]) -> str:
    """Return the interval in words where duplicates come at an even pace, as from 25 to 30 frames per second."""
    steps = np.diff([first for first, _ in single])
    if steps.size < 3 or np.percentile(steps, 90) - np.percentile(steps, 10) > 1:
        return ""
    return f", about every {np.median(steps):.0f}th: the video was converted to a higher rate"


def _blank(clip: Clip) -> Iterator[VideoFinding]:
    blank, black = clip["blank"], clip["brightness"] <= _BLACK_LEVEL
    for flags, code, words in ((blank & black, "black", "black"), (blank & ~black, "one-colour", "of one colour")):
        segments = segments_of(flags)
        if segments:
            message = f"{words}: {clip.counted(segments)}"
            yield VideoFinding("warning", code, message, clip.selecting(segments), clip.positions(segments))


def _blurred(clip: Clip) -> Iterator[VideoFinding]:
    shown, detail = ~clip["blank"], clip["detail"]
    usual = np.median(detail[shown]) if shown.any() else 0.0
    segments = clip.segments(shown & (detail < BLURRED_SHARE * usual), seconds=0.15, least=3, gap=2)
    if segments:
        share = np.median(detail[covered(segments, len(clip))]) / usual
        message = (
            f"blurred, or without texture: {clip.counted(segments)} show {share:.0%} of the usual detail (a smear on "
            "the lens, defocus, or tissue very near)"
        )
        yield VideoFinding("warning", "blurred", message, clip.selecting(segments), clip.positions(segments))


def _colour(clip: Clip) -> Iterator[VideoFinding]:
    flags = (clip["redness"] < _LEAST_REDNESS) & ~clip["blank"]
    segments = clip.segments(flags, seconds=0.3, least=4, gap=3)
    if not segments:
        return
    advice = "look at them; narrow-band light is fine to run on"
    if np.mean(flags) > _MOSTLY:
        message = "hardly any picture has the colour of tissue in white light: is it narrow-band light, or no tissue?"
    else:
        frames = clip.counted(segments)
        message = f"not the colour of tissue in white light (outside the patient, or narrow-band light): {frames}"
        advice += f", else {clip.selecting(segments)}" if clip.selecting(segments) else ""
    yield VideoFinding("warning", "not-tissue", message, advice, clip.positions(segments))


def _exposure(clip: Clip) -> Iterator[VideoFinding]:
    shown = ~clip["blank"]
    for name, most, words in _EXPOSURES:
        segments = clip.segments(shown & (clip[name] > most), seconds=0.15, least=3, gap=2)
        if segments:
            worst, frames = float(np.max(clip[name][shown])), clip.counted(segments)
            message = f"more than {most:.0%} of the field is {words} in {frames}, {worst:.0%} at worst"
            yield VideoFinding("info", name, message, "", clip.positions(segments))


def exposure_figures(clip: Clip) -> dict[str, float]:
    """Return median shares over the frames that are not blank: over-exposed, under-exposed, highlights, usable."""
    shown = ~clip["blank"]
    names = {"clipped": "over_exposed", "dark": "under_exposed", "highlights": "highlights", "usable": "usable"}
    return {f"{name}_share": float(np.median(clip[key][shown])) if shown.any() else 0.0 for key, name in names.items()}
