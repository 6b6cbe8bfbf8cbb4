"""Kinds of endoscopes: the lens that is typical of each, where a camera is unknown."""

from __future__ import annotations

from typing import NamedTuple

KINDS: dict[str, tuple[float, ...]] = {
    "pinhole": (),
    "equidistant fisheye": (0.0, 0.0, 0.0, 0.0),
    "orthographic fisheye": (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880),
}
"""Kinds of lenses, and the coefficients of fisheyes as of `FisheyeCamera`: f t, and f sin t as a series."""

FOV_RANGE_DEG = (30.0, 150.0)
"""Horizontal fields of view that endoscopes have."""


class LensPrior(NamedTuple):
    """What is expected of a lens.

    focal : fx over the width of the picture, at its centre. spread : standard deviation of its logarithm. kinds : of
    lenses that are possible, the likeliest first. source : what it rests on.
    """

    focal: float
    spread: float
    kinds: tuple[str, ...]
    source: str


ANY_LENS = LensPrior(0.55, float("inf"), tuple(KINDS), "")
"""Nothing is expected; the focal length is that with which a trial of lenses begins."""

_FISHEYES = ("orthographic fisheye", "equidistant fisheye")
_EVERY = tuple(KINDS)
_COLONOSCOPE = "C3VD's calibration, 126 deg"
_TELESCOPE = "rigid telescopes of 2.7 mm, 80 deg"
SCOPES: dict[str, LensPrior] = {
    "colonoscope": LensPrior(0.565, 0.15, _FISHEYES, _COLONOSCOPE),
    "gastroscope": LensPrior(0.565, 0.25, _FISHEYES, f"a guess from colonoscopes, {_COLONOSCOPE}"),
    "bronchoscope": LensPrior(0.6, 0.3, _EVERY, "the first flexible ones, 80 deg"),
    "laparoscope": LensPrior(0.85, 0.38, ("pinhole",), "calibrations of SCARED, 63 deg, EndoNeRF, 59 deg, and Hamlyn"),
    "cystoscope": LensPrior(0.5, 0.3, _EVERY, f"{_TELESCOPE}, and a flexible one of 140 deg"),
    "ureteroscope": LensPrior(0.9, 0.3, ("equidistant fisheye", "pinhole"), "two that were measured, 63 deg"),
    "sinus": LensPrior(0.6, 0.3, _EVERY, f"a guess from {_TELESCOPE}"),
    "capsule": LensPrior(0.49, 0.25, _EVERY, "EndoSLAM's calibration, 91 deg"),
}
"""By name; docs/calibrate.md says where each figure is published. Spreads are guesses, but for the laparoscope's."""
