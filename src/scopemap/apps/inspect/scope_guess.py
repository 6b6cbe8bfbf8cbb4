"""Which kinds of endoscope give such pictures, as far as the shape of the field of view and two views tell.

A telescope or a bundle of fibres shows a camera behind it a round picture (Budd et al., arXiv 2210.14771); a capsule's
is round, too (Prasath et al., "Mucosal Region Detection and 3D Reconstruction in Wireless Capsule Endoscopy Videos"),
and square. C3VD's colonoscope has cut corners; that gastroscopes have them is a guess. Stereo endoscopes of all data
sets that we read are laparoscopes.
"""

from __future__ import annotations

from collections.abc import Iterator

from scopemap.apps.inspect.clip import VideoFinding
from scopemap.apps.inspect.field_shape import Field

_WITH_EYEPIECE = ("laparoscope", "cystoscope", "sinus", "bronchoscope", "ureteroscope")
_WITH_CUT_CORNERS = ("colonoscope", "gastroscope")
_SQUARE = 0.05
_MOST_IN_BOX = 0.95  # share of the box around the field from which its corners may be those of a round field


def guess_scopes(field: Field, size: tuple[int, int], *, stereo: bool) -> tuple[str, tuple[str, ...]]:
    """Return what of a picture tells the kind of endoscope, in words, and the kinds; "" and none where nothing does.

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


def check_scope(field: Field, size: tuple[int, int], *, stereo: bool) -> Iterator[VideoFinding]:
    """Yield which kinds of endoscope the pictures are typical of, where they tell."""
    words, kinds = guess_scopes(field, size, stereo=stereo)
    if kinds:
        named = ", ".join(kinds[:-1]) + " or " * (len(kinds) > 1) + kinds[-1]
        advice = "" if len(kinds) == 1 else ": name the one that it is"
        yield VideoFinding("info", "scope", f"{words}: typical of {named}", f"--scope {'|'.join(kinds)}{advice}")


def _is_square(width: float, height: float) -> bool:
    return abs(width - height) <= _SQUARE * max(width, height)
