"""What the names in a folder of images tell: their order, times, and which of them are no frames of one camera."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median, mode

from scopemap.engine.errors import InputError
from scopemap.input.decoding import by_number, frame_number

_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_OTHER_CONTENT = {
    **dict.fromkeys(("depth", "depths", "disp", "disparity"), "depth"),
    **dict.fromkeys(("mask", "masks", "label", "labels", "segmentation", "annotation", "annotations"), "label"),
    **dict.fromkeys(("seg", "gt"), "label"),
    **dict.fromkeys(("normals", "flow", "occlusion", "occlusions"), "auxiliary"),
}
_UNSURE = ("seg", "gt")  # may name a part of a video: others must be there
_COLOUR = ("color", "colour", "rgb")
_CAMERA = ("cam", "camera", "view", "ch", "channel", "eye")
# Two letters count where they stand alone, or as capitals behind a small letter or a digit: imgL.
_EYE = re.compile(r"(?<![A-Za-z])(?i:left|right|l|r)(?![A-Za-z])|(?<=[a-z0-9])(?:Left|Right|L|R)(?![a-z])")
_LAST_NUMBER = re.compile(r"(\d+)(?:\.(\d+))?(?=\D*$)")
_FEW_CAMERAS = 4
# A counter that misses a few numbers is one still.
_LEAST_COUNTED = 0.8
_RATES_HZ = (0.1, 1000.0)  # of videos and time lapses
_LARGEST_STEP = 2000  # of frames that are numbered
_MOST_UNEVEN = 100.0  # longest over usual step of a clock that only pauses
_MOST_UNEVEN_DECIMAL = 10.0  # of decimal numbers, which may be two counters: scan_0.14, scan_1.01
_MOST_PICTURES = 8  # kinds of pictures beside one frame
_NS = 1e-9
_US = 1e-6
_MS = 1e-3
_UNIX_S = (6e8, 5e9)  # 1989 to 2128


@dataclass(frozen=True)
class Chosen:
    """The images that are frames, in their order, what was left out (phrases), and what is doubtful about names."""

    files: list[Path]
    notes: list[str]
    warnings: list[str]


def numeric_order(path: Path) -> list[tuple[int, int, str]]:
    """Sorting key: digits in the name count as numbers, so that 10 comes after 9."""
    parts = re.split(r"(\d+)", path.stem)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in parts]


def in_order(files: list[Path]) -> list[Path]:
    """Return files by the numbers in their names; 0.2 comes after 0.067 where these are decimal numbers."""
    decimal = decimal_numbers(files)
    return sorted(files, key=numeric_order if decimal is None else lambda file: (decimal[file], file.name))


def chosen_frames(folder: Path, files: list[Path]) -> Chosen:
    """Return which images of a folder are the frames of one camera.

    Depth, label and similar pictures are left out by their names, and of two eyes the right one. Raises `InputError`
    where only such pictures are there, and where several series have the same numbers and none is known to be colour.
    """
    notes = list[str]()
    files = _numbered(_one_eye(_frames(folder, files, notes), notes), notes)
    files = in_order(_one_series(folder, files, notes))
    return Chosen(files, notes, [] if decimal_numbers(files) is not None else _doubts(files))


def _frames(folder: Path, files: list[Path], notes: list[str]) -> list[Path]:
    contents = {file: content for file in files if (content := _content(file))}
    others = [file for file in files if file not in contents]
    if len(others) * _MOST_PICTURES >= len(contents):
        for kind in sorted({kind for kind, _ in contents.values()}):
            left = [file for file, (found, _) in contents.items() if found == kind]
            notes.append(f"left out: {len(left)} {kind} picture(s) by their names, such as {min(left).name}")
        return others
    if all(word in _UNSURE for _, word in contents.values()):
        return files
    kinds = " and ".join(sorted({kind for kind, _ in contents.values()}))
    found = f"all {len(files)} images are {kinds} pictures by their names, such as {min(files).name}"
    raise InputError(f"reading {folder}: {found}; give the folder of the colour pictures")


def _content(file: Path) -> tuple[str, str] | None:
    """Return the kind of a picture that is no frame, and the word that tells: the first or last one of its name."""
    words = [word.lower() for word in _WORD.findall(file.stem)]
    return next(((_OTHER_CONTENT[word], word) for word in words[:1] + words[-1:] if word in _OTHER_CONTENT), None)


def _numbered(files: list[Path], notes: list[str]) -> list[Path]:
    """Return the files without the few that have no number where the others have one, such as a cover or thumbnail."""
    numbered = [file for file in files if frame_number(file) is not None]
    # The first of copies, or of files that were renamed together, may have none: image.png, image (1).png.
    strays = [file for file in files if file not in numbered and not _begins_one_of(file, numbered)]
    if not strays or len(strays) * _MOST_PICTURES > len(numbered):
        return files
    notes.append(f"left out: {len(strays)} picture(s) without a number in their names, such as {min(strays).name}")
    return [file for file in files if file not in strays]


def _begins_one_of(file: Path, others: list[Path]) -> bool:
    return any(other.stem.startswith(file.stem) for other in others)


def _one_eye(files: list[Path], notes: list[str]) -> list[Path]:
    """Return the files without those of the right eye, where most have a left one of the same name."""
    eyes: dict[str, dict[str, Path]] = defaultdict(dict)
    for file in files:
        for eye in _EYE.finditer(file.stem):
            eyes[file.stem[: eye.start()] + "*" + file.stem[eye.end() :]][eye.group()[0].lower()] = file
    pairs = [pair for pair in eyes.values() if len(pair) == 2]
    if 4 * len(pairs) < len(files) or not pairs:
        return files
    right = {pair["r"] for pair in eyes.values() if "r" in pair}
    both = f"the names show two eyes: the left one is used, {len(right)} pictures of the right one are left out"
    notes.append(f"stereo: {both}, such as {min(right).name}; for both, move these and give --stereo use:FOLDER")
    return [file for file in files if file not in right]


def _one_series(folder: Path, files: list[Path], notes: list[str]) -> list[Path]:
    """Return the files of the colour pictures where names of other words have the same numbers."""
    by_form: dict[str, dict[int, Path]] = defaultdict(dict)
    for file in files:
        if (number := frame_number(file)) is not None:
            head = _LAST_NUMBER.sub("#", file.stem)
            is_camera = any(word.lower() in _CAMERA for word in _WORD.findall(head))
            form = head if is_camera else re.sub(r"\d+", "#", file.stem)
            by_form[form + file.suffix.lower()][number] = file  # 0000.jpg beside its mask 0000.png
    first, *others = sorted(by_form.values(), key=len, reverse=True) or [{}]
    mixed = [first, *(other for other in others if 2 * len(first.keys() & other.keys()) > len(other) > 1)]
    if not 1 < len(mixed) <= _FEW_CAMERAS or decimal_numbers(files) is not None:
        return files
    colour = [one for one in mixed if set(_COLOUR) & {word.lower() for word in _WORD.findall(_any(one).stem)}]
    named = ", ".join(f"{len(one)} like {_any(one).name}" for one in mixed)
    if len(colour) != 1:
        found = f"its names show {len(mixed)} series with the same numbers ({named})"
        raise InputError(f"reading {folder}: {found}; move those to be used into a folder of their own")
    left = {file for one in mixed if one is not colour[0] for file in one.values()}
    notes.append(f"left out: {len(left)} pictures of another series than {_any(colour[0]).name} ({named})")
    return [file for file in files if file not in left]


def _any(series: dict[int, Path]) -> Path:
    return series[min(series)]


def _doubts(files: list[Path]) -> list[str]:
    """Return a warning where numbers in the names repeat or go back, so that frames are counted instead."""
    numbers = [(number, file) for file in files if (number := frame_number(file)) is not None]
    seen = dict[int, Path]()
    for number, file in numbers:
        if number in seen:
            same = f"{seen[number].name} and {file.name} have the same number"
            return [f"{same}: all pictures are used in the order of their names, which mixes cameras or clips, if any"]
        seen[number] = file
    return []


def decimal_numbers(files: list[Path]) -> dict[Path, float] | None:
    """Return the decimal number at the end of each name, such as a time in s; None where names have counters."""
    found = [(file, _LAST_NUMBER.search(file.stem)) for file in files]
    matches = [(file, match) for file, match in found if match is not None]
    if len(matches) < max(2, len(files)) or len({file.stem[: match.start()] for file, match in matches}) > 1:
        return None
    whole, shares = [match[1] for _, match in matches], [match[2] for _, match in matches]
    written = [share for share in shares if share is not None]
    if 2 * len(written) < len(files) or not _are_decimals(whole, shares, written):
        return None
    return {file: float(match[0]) for file, match in matches}


def by_frame(files: list[Path], pictures: Mapping[int, Path]) -> dict[int, Path]:
    """Return files that belong to frames, such as masks, by the number of their frame.

    pictures : of the frames by their numbers, none of a video. A file whose name ends in a decimal number belongs to
    the picture with the same one, as `frame_0.2` and `mask_0.2`; else it belongs to the frame of the last whole number.
    Raises `InputError` for decimal numbers that no picture has, and as `by_number`.
    """
    decimal = decimal_numbers(files)
    if decimal is None:
        return by_number(files)
    ordered = sorted(decimal, key=lambda file: decimal[file])
    own = decimal_numbers(list(pictures.values()))
    if own is None:
        # Digits behind the point count as a number where they increase as the decimal numbers do.
        if all((frame_number(a) or 0) < (frame_number(b) or 0) for a, b in pairwise(ordered)):
            return by_number(ordered)
        found = f"names such as {ordered[0].name} hold decimal numbers, and those of the frames do not"
        raise InputError(f"reading {ordered[0].parent}: {found}; name each file by the number of its frame")
    number_of = {own[picture]: number for number, picture in pictures.items()}
    stray = [file for file in ordered if decimal[file] not in number_of]
    if stray:
        found = f"{len(stray)} of {len(ordered)} files, such as {stray[0].name}, have no frame of this number"
        name_as = f"name each as its frame, such as {next(iter(pictures.values())).name}"
        raise InputError(f"reading {stray[0].parent}: {found}; {name_as}")
    return {number_of[decimal[file]]: file for file in ordered}


def _are_decimals(whole: list[str], shares: list[str | None], written: list[str]) -> bool:
    if len({len(share) for share in written}) == 1:
        return len(set(whole)) > 1 or set(whole) == {"0"}
    if any(len(share) > 1 and share.startswith("0") for share in written):
        return True
    if any(len(share) > 1 and share.endswith("0") for share in written):
        return False
    counters = sorted((int(a), int(b or 0)) for a, b in zip(whole, shares, strict=True))
    steps = [b[1] - a[1] for a, b in pairwise(counters) if a[0] == b[0]]
    # A counter goes by ones, or by as many as frames were thinned by.
    return not steps or steps.count(mode(steps)) < _LEAST_COUNTED * len(steps)


def times_in_names(files: list[Path], numbers: list[int]) -> tuple[list[float], str]:
    """Return the times of frames, s, that their names give, and which they are, a phrase; [] and "" without any.

    numbers : of the frames, in their names where these increase. Times are decimal numbers of seconds, or whole numbers
    of ns, us, ms or s since 1970, or of ns or us since any moment, that make 0.1 to 1000 frames/s.
    """
    decimal = decimal_numbers(files)
    values = numbers if decimal is None else [decimal[file] for file in files]
    steps = [b - a for a, b in pairwise(values)]
    if not steps or min(steps) <= 0:
        return [], ""
    usual, uneven = median(steps), _MOST_UNEVEN if decimal is None else _MOST_UNEVEN_DECIMAL
    for unit_s, name in ((1.0, "s"),) if decimal is not None else ((_NS, "ns"), (_US, "us"), (_MS, "ms"), (1.0, "s")):
        is_unix = _UNIX_S[0] < values[0] * unit_s < _UNIX_S[1]
        is_clock = is_unix or decimal is not None or (unit_s < _MS and usual > _LARGEST_STEP)
        if is_clock and 1 / _RATES_HZ[1] <= usual * unit_s <= 1 / _RATES_HZ[0] and max(steps) < uneven * usual:
            return [value * unit_s for value in values], f"the numbers in the names, {name}"
    return [], ""
