"""What endangers a reconstruction in a video, besides its format: fast motion, jumps, blur, lack of texture.

The limits separate clips that runs tracked whole (likeness above 0.84, motion below 2 % of the width, detail above
0.015) from a colonoscopy and a bare tube of which they lost most frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from scopemap.inspection.checks import BLURRED_SHARE, repeated
from scopemap.inspection.clip import Clip, VideoFinding, segments_of

_FAST = 0.05  # motion per frame, share of the width
_UNLIKE, _CUT, _LIKE = 0.6, 0.2, 0.7  # correlation with the frame before
_SOFT_SHARE = 0.6  # of the video's usual detail
_NO_TEXTURE = 0.008
_SOME, _MANY = 0.05, 0.25  # shares of the frames


@dataclass(frozen=True)
class Dangers:
    """Flags of the frames that were read, (N,) bool each, and `textureless` of the whole video.

    fast : the picture moves by more than 5 % of its width.
    unlike : hardly like the frame before, moved by its flow, and no cut.
    soft : less than 0.6 of the usual detail, but more than what `checks` calls blurred.
    cut : unlike, between frames that are like their neighbours.
    lost : likely to be lost.
    """

    fast: np.ndarray
    unlike: np.ndarray
    soft: np.ndarray
    cut: np.ndarray
    lost: np.ndarray
    textureless: bool

    @classmethod
    def of(cls, clip: Clip) -> Dangers:
        """Return the dangers of a video; blank and repeated frames, which runs leave out, are in none of the flags."""
        shown = ~clip["blank"] & ~repeated(clip)
        motion, likeness, detail = clip["motion"], clip["likeness"], clip["detail"]
        usual = float(np.median(detail[shown])) if shown.any() else 0.0
        # A picture after a blank or an unreadable one resembles nothing.
        gap = np.diff(clip["position"]) > clip.step
        follows = shown & ~np.concatenate([[True], clip["blank"][:-1] | gap])
        unlike = follows & (likeness < _UNLIKE)
        around = np.minimum(np.concatenate([[1.0], likeness[:-1]]), np.concatenate([likeness[1:], [1.0]]))
        cut = follows & (likeness < _CUT) & (around > _LIKE)
        soft = shown & (detail < _SOFT_SHARE * usual) & (detail >= BLURRED_SHARE * usual)
        fast = follows & (motion > _FAST)
        return cls(fast, unlike & ~cut, soft, cut, fast | unlike, usual < _NO_TEXTURE)


def check_dangers(clip: Clip) -> Iterator[VideoFinding]:
    """Yield what may make a run lose frames: of what was read, so of every n-th frame where these were selected."""
    found = Dangers.of(clip)
    if found.textureless:
        message = "hardly any texture: little tells how the camera moves along or around such walls"
        yield VideoFinding("warning", "texture-low", message, "")
    if found.cut.any():
        cuts = segments_of(found.cut)
        message = f"the picture changes at once, as at a cut: {clip.counted(cuts)}"
        yield VideoFinding("warning", "cut", message, clip.selecting(cuts), clip.positions(cuts))
    if found.fast.mean() > _SOME:
        moving, fast = clip["motion"], segments_of(found.fast, gap=2)
        message = (
            f"fast motion: the picture moves by {np.median(moving):.1%} of its width from frame to frame, by "
            f"{np.percentile(moving, 95):.1%} in the fastest; by more than {_FAST:.0%} in {clip.counted(fast)}"
        )
        slower = "use every frame, not one of several" if clip.step > 1 else "a recording of a higher rate moves less"
        yield VideoFinding("warning", "motion-fast", message, slower, clip.positions(fast))
    if found.unlike.mean() > _SOME:
        unlike = segments_of(found.unlike, gap=2)
        message = (
            f"hardly like the frame before, its motion undone: {clip.counted(unlike)} (fast turns, motion blur, a wall "
            "close to the lens, water, smoke)"
        )
        yield VideoFinding("warning", "unlike", message, "", clip.positions(unlike))
    if found.soft.mean() > _SOME:
        soft = segments_of(found.soft, gap=2)
        message = f"soft, by motion blur or a wall close to the lens: {clip.counted(soft)}"
        yield VideoFinding("warning", "soft", message, "", clip.positions(soft))


def forecast(clip: Clip) -> str:
    """Return in words what a run can be expected to make of the video."""
    found = Dangers.of(clip)
    lost, cuts = int(found.lost.sum()), int(found.cut.sum())
    which = f"of one frame in {clip.step}: " if clip.step > 1 else ""
    if found.textureless:
        return f"{which}poor: walls without texture; expect most frames lost or in separate maps"
    if lost > _MANY * len(clip):
        return (
            f"{which}poor: about {lost} of {len(clip)} frames are hard to track; expect lost frames, and several "
            "separate maps instead of one surface"
        )
    if lost > _SOME * len(clip) or cuts:
        jumps = f", {cuts} cut{'s' * (cuts != 1)}" if cuts else ""
        return f"{which}fair: {lost} frames are hard to track{jumps}; the surface may break into separate maps there"
    return f"{which}good: nothing in its motion, sharpness and texture endangers a reconstruction"
