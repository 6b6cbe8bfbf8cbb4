"""Distortion coefficients in a file: in a list, by kind or by name, counted from 0 or from 1; all of them are used."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scopemap.input.camera_files.lens_models import LENS_MODELS, OPENCV, LensModel
from scopemap.input.camera_files.parsing import Fields, is_number, numbers_in, plain_name

LISTS = (
    "distortion_coefficients", "D", "D1", "K_dist", "distCoeffs", "dist", "DL", "dist_coeff", "dist_coefs",
    "dist_coef", "distortion", "distortion_coeffs", "distortion_coeff", "distortion_coefficient", "distortion_coefs",
    "distortion_parameters", "distortion_params", "dist_params", "distortion_vector", "lens_distortion", "coeffs",
    "coefficients", "kc", "distCoeffs1", "distCoeff1", "dist1",
)  # fmt: skip
_RADIAL_LISTS = ("RadialDistortion", "radial", "radial_distortion_coefficients", "radial_coefficients")
_TANGENTIAL_LISTS = (
    "TangentialDistortion", "tangential", "tangential_distortion_coefficients", "tangential_coefficients",
)  # fmt: skip
# A list of coefficients, or a camera matrix.
_LIST_OR_MATRIX = ("k",)
_MATRIX_COUNTS = (9, 12, 16)
# Letters before the number of a coefficient: radial, tangential, and one of a list in the order of the lens.
_RADIAL = "k"
_TANGENTIAL = ("p", "t", "r")
_LISTED = ("d", "kc", "dist")
_FROM_TWO = {2, 3, 4, 5}
_OWN_NAMES = {name for lens in LENS_MODELS for names in lens.own_names for name in names if len(name) > 1}
_STRAY = re.compile("|".join([r"(k|p|s|kc)\d{1,2}", "tau[xy12]", *sorted(_OWN_NAMES)]))
_UNREAD = re.compile(r"(?<!un)dist(?!anc|rib)|coef|radial|tangential|^param(eter)?s$", re.IGNORECASE)
# Counts, settings and precisions of a lens, and the second camera's, are not its coefficients.
_BESIDE = re.compile(
    r"num|count|intrinsic|estim|flag|model$|type$|fix|zero|max|min|std|sigma|err|uncert|cov|rms|right|inverse|depth|2$|_r$|distr$|coeffs?r$",
    re.IGNORECASE,
)
_LONGEST_QUOTE = 40
_MOST_TRIED = 100
_DEEPEST = 3


@dataclass(frozen=True)
class _Set:
    """Coefficients in the order of the lens, the names that they have in the file, and where they are in it."""

    place: Fields
    names: tuple[str, ...]
    values: list[float]

    @property
    def trimmed(self) -> list[float]:
        """The values without zeros at the end."""
        return self.values[: max((i + 1 for i, value in enumerate(self.values) if value), default=0)]


def coefficients_in(places: Sequence[Fields], lens: LensModel | None) -> list[float]:
    """Return the coefficients in mappings, in the order of the lens (None: the file does not say which).

    Raises `ValueError`, with the name, where a coefficient that is not zero is not used, and where two sets differ.
    """
    sets = [found for place in places for found in _sets_at(place, lens)]
    chosen = next((found for found in sets if any(found.values)), sets[0] if sets else None)
    if chosen is None:
        chosen = _Set(Fields([]), (), [])
    for other in sets:
        if any(other.values) and not _agree(other, chosen):
            names = " and ".join(", ".join(found.names)[:_LONGEST_QUOTE] for found in (chosen, other))
            raise ValueError(f"its distortion coefficients are there twice and differ ({names}): leave one out")
    _check_nothing_unread(places, sets)
    return chosen.values


def has_numbers(node: Any, depth: int = 0) -> bool:
    """Return whether a number other than 0 is in a node; YAML's aliases may make it larger than the file."""
    if isinstance(node, Fields):
        node = [inner for name, inner in node.pairs if name not in ("rows", "cols")]
    if isinstance(node, list):
        return depth < _DEEPEST and any(has_numbers(inner, depth + 1) for inner in node[:_MOST_TRIED])
    return any(is_number(word) and float(word) for word in str(node).split())


def _agree(one: _Set, other: _Set) -> bool:
    return len(one.trimmed) == len(other.trimmed) and np.allclose(one.trimmed, other.trimmed, rtol=1e-6, atol=0)


def _sets_at(place: Fields, lens: LensModel | None) -> Iterator[_Set]:
    for name, node in place.nodes(LISTS):
        if (values := numbers_in(node, name)) is not None:
            yield _Set(place, (name,), values)
    for name, node in place.nodes(_LIST_OR_MATRIX):
        values = numbers_in(node, name) if isinstance(node, Fields | list | str) else None
        if values and len(values) not in _MATRIX_COUNTS:
            yield _Set(place, (name,), values)
    lists = [(names, place.numbers(names)) for names in (_RADIAL_LISTS, _TANGENTIAL_LISTS)]
    if any(values for _, values in lists):
        radial, tangential = (dict(enumerate(values or [], start=1)) for _, values in lists)
        names = tuple(name for spellings, values in lists if values for name, _ in place.nodes(spellings))
        yield _Set(place, names, _in_order(radial, tangential, {}, lens))
    for names in () if lens is None else lens.own_names:
        own = [place.number((name,)) for name in names]
        is_size = "w" in names and any(place.nodes(("h",)))
        if not is_size and any(value is not None for value in own):
            yield _Set(place, names, [value or 0.0 for value in own])
    yield from _named_sets(place, lens)


def _named_sets(place: Fields, lens: LensModel | None) -> Iterator[_Set]:
    """Yield the coefficients that have a name each."""
    radial = _numbered(place, _RADIAL)
    letters = (letter for letter in _TANGENTIAL if letter == "p" or not _is_of_pose(place, letter))
    letter, tangential = next(((at, found) for at in letters if (found := _numbered(place, at))), ("p", {}))
    if radial or tangential:
        first = 2 if lens is not None and lens.from_two and set(radial) == _FROM_TWO else int(0 not in radial)
        radial_by_order = {number - first + 1: value for number, value in radial.items()}
        tangential_by_order = {number + int(0 in tangential): value for number, value in tangential.items()}
        spelled = {f"k{number - first + 1}": f"k{number}" for number in radial}
        spelled |= {f"p{number + int(0 in tangential)}": f"{letter}{number}" for number in tangential}
        yield _Set(place, tuple(spelled.values()), _in_order(radial_by_order, tangential_by_order, spelled, lens))
    for letters_of_list in _LISTED:
        found = _numbered(place, letters_of_list)
        first = int(0 not in found)
        if missing := [f"{letters_of_list}{i}" for i in range(first, max(found, default=0)) if i not in found]:
            raise ValueError(f"its distortion coefficients have no {missing[0]}")
        if found:
            yield _Set(place, tuple(f"{letters_of_list}{i}" for i in sorted(found)), [found[i] for i in sorted(found)])


def _is_of_pose(place: Fields, letter: str) -> bool:
    """Return whether numbers of a letter are a translation, t1 t2 t3, or a pose, t_00 to t_23 (Polycam)."""
    return bool(_numbered(place, letter).keys() & {3}) or any(place.nodes((f"{letter}_03",)))


def _numbered(place: Fields, letters: str) -> dict[int, float]:
    """Return the numbers that are called by these letters and a digit or two, by what the digits say."""
    named = {number: place.number((f"{letters}{number}",)) for number in range(21)}
    return {number: value for number, value in named.items() if value is not None}


def _in_order(
    radial: dict[int, float], tangential: dict[int, float], spelled: dict[str, str], stated: LensModel | None
) -> list[float]:
    """Return radial and tangential coefficients, counted from 1, in the order of the lens.

    spelled : names in the file, by ours. stated : the lens that the file names. Raises `ValueError` where one has no
    place in the lens, and where the names do not tell which lens it is.
    """
    lens = stated or OPENCV
    named = {f"k{number}": value for number, value in sorted(radial.items())}
    named |= {f"p{number}": value for number, value in sorted(tangential.items())}
    if beyond := [spelled.get(name, name) for name, value in named.items() if value and name not in lens.terms]:
        alone = f"the {lens.title} lens has {' '.join(lens.terms)} alone"
        raise ValueError(f"{alone}, found others, too: {', '.join(beyond)}; calibrate without them")
    if stated is None and named.get("k4") and not tangential:
        fourth = f"it has {spelled.get('k4', 'k4')} but no p1, and names no model"
        raise ValueError(f"{fourth}: OpenCV's or a fisheye's? add `model: fisheye`")
    for name, others in lens.needs.items():
        if named.get(name) and not any(other in named for other in others):
            alone = f"{spelled.get(name, name)} in it, without {' and '.join(others)},"
            raise ValueError(f"{alone} is another term than that of the {lens.title} lens: calibrate without it")
    return lens.in_order(named)


def _is_lens(node: Any) -> bool:
    """Return whether a node is a mapping of a lens alone, not of another camera."""
    return (
        isinstance(node, Fields) and node.number(("k1",)) is not None and not any(node.nodes(("fx", "K", "intrinsics")))
    )


def _check_nothing_unread(places: Sequence[Fields], sets: Sequence[_Set]) -> None:
    used = {(id(found.place), plain_name(name)) for found in sets for name in found.names}
    read = {id(found.place) for found in sets}
    for place in places:
        for name, node in place.pairs:
            if (id(place), plain_name(name)) in used or id(node) in read or not has_numbers(node):
                continue
            if not isinstance(node, Fields | list) and _STRAY.fullmatch(plain_name(name)):
                raise ValueError(f"{name[:_LONGEST_QUOTE]!r} in it is a distortion coefficient that is not used")
            if (_UNREAD.search(name) or _is_lens(node)) and not _BESIDE.search(name):
                advice = "call it distortion_coefficients, a list in OpenCV's order, k1 k2 p1 p2 k3"
                raise ValueError(f"{name[:_LONGEST_QUOTE]!r} in it looks like distortion but is not read: {advice}")
