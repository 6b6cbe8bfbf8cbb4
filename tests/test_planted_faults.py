"""Faults that data sets have, planted into the made-up copy of every kind where they apply: `check` finds each of them.

A fault that does not apply to a kind says why. The same copy without it must not be told for it.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from drawn_datasets import WRITERS
from drawn_scene import Content, content
from stored_kinds import KINDS, Kind, put

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.errors import ScopemapError
from scopemap.geometry.se3 import inverse, se3_exp
from scopemap.io.opening import open_sequence
from scopemap_bench.datasets.checking import Finding, check, refusal
from scopemap_bench.datasets.survey import survey

AT = 3
LEAST_FAULTS = 12
REFUSED = ("refused", "camera-refused")
MIRROR, OPENGL = np.diag([1.0, -1, 1, 1]), np.diag([1.0, -1, -1, 1])
UNREAD = (*REFUSED, "frame-unreadable", "reading-stopped", "source")
NO_POSE = ("refused", "source", "pose-missing", "truth-unreadable")

Alter = Callable[[Content, int], None]
Applies = Callable[[Kind], str]


@dataclass(frozen=True)
class Fault:
    """One fault.

    alter : plants it, where it concerns one frame into the frame with this number. codes : by which it may be told.
    excused : why it does not apply to a kind, "" where it does. named : the frame that must be named, counted from the
    one that it is planted into; None where none can be.
    """

    alter: Alter
    codes: tuple[str, ...]
    excused: Applies = lambda kind: ""
    named: int | None = None


# ---- why a fault does not apply


def _stored_alone(kind: Kind) -> str:
    return "pictures lie in one stream: what spoils one spoils those after it" if kind.pictures == "video" else ""


def _streamed(kind: Kind) -> str:
    return "its pictures are files of their own" if kind.pictures == "files" else ""


def _sized(kind: Kind) -> str:
    return "a video's header states one size for all pictures" if kind.pictures == "video" else ""


def _numbered(kind: Kind) -> str:
    if kind.pictures in ("video", "messages"):
        return "its pictures are counted, they carry no number"
    if kind.pictures == "archive":
        return "of two members with one number the first is read, and the number of a frame stays one"
    return "frames are numbered by a list, not by their names" if kind.listed else ""


def _posed(kind: Kind) -> str:
    return "" if kind.poses else "the data set has no poses"


def _far_posed(kind: Kind) -> str:
    lever = "its poses are brought to a camera beside theirs, whose way about them is no longer in their unit"
    return lever if kind.lever else _posed(kind)


def _deep(kind: Kind) -> str:
    return "" if kind.depth else "the data set has no depth"


def _finely_deep(kind: Kind) -> str:
    if kind.depth == "coarse":
        return "its depth is coarse by its nature, and told so in the sound copy"
    return _deep(kind)


def _posed_and_deep(kind: Kind) -> str:
    return _posed(kind) or ("" if kind.depth else "without depth nothing tells how poses are meant")


def _stamped(kind: Kind) -> str:
    return "" if kind.stamps else "the data set stores no time stamps"


def _ordered(kind: Kind) -> str:
    in_stream = kind.pictures == "video" and not kind.depth
    return "a container puts its pictures in the order of time" if kind.stamps and in_stream else _stamped(kind)


# ---- what is planted


def _same_as_before(planted: Content, at: int) -> None:
    planted.rgb[at] = planted.rgb[at - 1]


def _even(level: int, planted: Content, at: int) -> None:
    planted.rgb[at] = np.full_like(planted.rgb[at], level)


def _half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def _spoil_picture(damage: Callable[[bytes], bytes], planted: Content, at: int) -> None:
    planted.rgb_damage[at] = damage


def _spoil_stream(damage: Callable[[bytes], bytes], planted: Content, at: int) -> None:
    planted.stream_damage = damage


def _spoil_most(planted: Content, at: int) -> None:
    planted.rgb_damage |= dict.fromkeys(planted.numbers[1:], _half)


def _only_one(planted: Content, at: int) -> None:
    for number in planted.numbers[1:]:
        del planted.rgb[number]


def _smaller(planted: Content, at: int) -> None:
    planted.rgb[at] = planted.rgb[at][:-8, :-8]


def _leave_out(planted: Content, at: int) -> None:
    del planted.rgb[at]


def _number_again(planted: Content, at: int) -> None:
    planted.names_again.append(at)


def _pose(alter: Callable[[np.ndarray], np.ndarray], planted: Content, at: int) -> None:
    planted.poses[at] = alter(planted.poses[at])


def _all_poses(alter: Callable[[np.ndarray], np.ndarray], planted: Content, at: int) -> None:
    planted.poses = {number: alter(T) for number, T in planted.poses.items()}


def _away(mm: float, planted: Content, at: int) -> None:
    scale = np.linalg.norm(planted.poses[at][:3, 3]) / AT
    planted.poses[at] = planted.poses[at] @ se3_exp(np.array([0, 0, 0, 0, mm * scale, 0]))


def _scaled(factor: float, T: np.ndarray) -> np.ndarray:
    return np.hstack([T[:, :3], T[:, 3:] * [[factor], [factor], [factor], [1.0]]])


def _no_pose(planted: Content, at: int) -> None:
    del planted.poses[at]


def _at_rest(planted: Content, at: int) -> None:
    planted.poses = dict.fromkeys(planted.poses, planted.poses[at])


def _spoil_poses(planted: Content, at: int) -> None:
    planted.poses_damage = lambda data: data[: int(0.6 * len(data))]


def _no_depth(planted: Content, at: int) -> None:
    del planted.depth_mm[at]


def _flat_depth(planted: Content, at: int) -> None:
    depth_mm = planted.depth_mm[at]
    planted.depth_mm[at] = np.where(depth_mm > 0, np.median(depth_mm), 0)


def _hollow_depth(planted: Content, at: int) -> None:
    planted.depth_mm[at] = planted.depth_mm[at].copy()
    planted.depth_mm[at][2:] = 0


def _spoil_depth(planted: Content, at: int) -> None:
    planted.depth_damage[at] = _half


def _shallow_depth(planted: Content, at: int) -> None:
    planted.shallow.add(at)


def _depth_scale(factor: float, planted: Content, at: int) -> None:
    planted.own = (planted.camera, factor * planted.depth_unit_mm)


def _exchanged(planted: Content, at: int) -> None:
    planted.poses[at], planted.poses[at + 3] = planted.poses[at + 3], planted.poses[at]


def _own(camera: Callable[[PinholeCamera], CameraModel], planted: Content, at: int) -> None:
    planted.own = (camera(planted.camera.central), None)


def _later(step_s: float, planted: Content, at: int) -> None:
    for number in planted.numbers[AT:]:
        planted.times_s[number] += step_s


def _other_unit(planted: Content, at: int) -> None:
    planted.depth_mm[at] = planted.depth_mm[at] / 100


FAULTS: dict[str, Fault] = {
    # pictures
    "a picture cut off": Fault(partial(_spoil_picture, _half), UNREAD, _stored_alone, named=0),
    "a picture of zero bytes": Fault(partial(_spoil_picture, lambda data: b""), UNREAD, _stored_alone, named=0),
    "a text named as a picture": Fault(partial(_spoil_picture, lambda data: b"text\n"), UNREAD, _stored_alone, named=0),
    "a stream cut off": Fault(partial(_spoil_stream, _half), UNREAD, _streamed),
    "a stream of zero bytes": Fault(partial(_spoil_stream, lambda data: b""), UNREAD, _streamed),
    "a text named as a stream": Fault(partial(_spoil_stream, lambda data: b"text\n"), UNREAD, _streamed),
    "all pictures but one cut off": Fault(_spoil_most, ("frame-few", *UNREAD), _stored_alone),
    "one picture alone": Fault(_only_one, ("frame-few", "refused")),
    "a picture of another size": Fault(_smaller, ("reading-stopped", "refused", "frame-unreadable"), _sized, named=0),
    "a picture missing": Fault(_leave_out, ("number-gap", "time-irregular", "refused", "source")),
    "a number twice": Fault(_number_again, ("number-repeated", "refused"), _numbered),
    "a picture repeated": Fault(_same_as_before, ("frame-repeated",), named=0),
    "a black picture": Fault(partial(_even, 2), ("frame-black",), named=0),
    "a picture of one colour": Fault(partial(_even, 120), ("frame-constant",), named=0),
    # time
    "a pause": Fault(partial(_later, 0.4), ("time-irregular",), _stamped, named=-1),
    "time going back": Fault(partial(_later, -0.1), ("time-order", "refused", "source"), _ordered),
    "a time stamp repeated": Fault(partial(_later, -0.04), ("time-order", "refused", "source"), _ordered),
    # camera
    "a calibration of another aspect": Fault(
        partial(_own, lambda c: replace(c, width=2 * c.width)), ("camera-refused",)
    ),
    "a principal point outside": Fault(partial(_own, lambda c: replace(c, cx=c.width + 9.0)), ("camera-refused",)),
    "a principal point near the edge": Fault(
        partial(_own, lambda c: replace(c, cx=0.1 * c.width)), ("camera-centre", "camera-refused")
    ),
    "a focal length of ten widths": Fault(
        partial(_own, lambda c: replace(c, fx=10.0 * c.width, fy=10.0 * c.width)), ("camera-refused", "camera-focal")
    ),
    "pixels that are not square": Fault(partial(_own, lambda c: replace(c, fy=1.3 * c.fx)), ("camera-aspect",)),
    # poses
    "a pose of NaN": Fault(partial(_pose, lambda T: np.full((4, 4), np.nan)), NO_POSE, _posed, named=0),
    "a pose that is no motion": Fault(partial(_pose, lambda T: T @ np.diag([-1.0, 1, 1, 1])), NO_POSE, _posed, named=0),
    "a pose missing": Fault(_no_pose, ("refused", "source", "pose-missing"), _posed),
    "the poses cut off": Fault(_spoil_poses, NO_POSE, _posed),
    "a pose far away": Fault(partial(_away, 40.0), ("pose-jump",), _posed, named=0),
    "a pose turned": Fault(
        partial(_pose, lambda T: T @ se3_exp(np.array([0, 0, 0.8, 0, 0, 0]))), ("pose-turn",), _posed, named=0
    ),
    "a camera that never moves": Fault(_at_rest, ("pose-still",), _posed),
    "poses world to camera": Fault(partial(_all_poses, inverse), ("poses-inverted",), _posed_and_deep),
    "poses of another hand": Fault(
        partial(_all_poses, lambda T: MIRROR @ T @ MIRROR), ("poses-mirrored",), _posed_and_deep
    ),
    "poses of a camera with y up": Fault(
        partial(_all_poses, lambda T: OPENGL @ T @ OPENGL), ("poses-opengl",), _posed_and_deep
    ),
    "poses in metres": Fault(partial(_all_poses, partial(_scaled, 1e-3)), ("pose-unit", "pose-depth-unit"), _far_posed),
    "poses in micrometres": Fault(partial(_all_poses, partial(_scaled, 1e3)), ("pose-unit", "pose-depth-unit"), _posed),
    "two poses exchanged": Fault(_exchanged, ("pose-depth-frame",), _posed_and_deep, named=0),
    # depth
    "depth missing": Fault(_no_depth, ("depth-missing",), _deep, named=0),
    "depth cut off": Fault(_spoil_depth, ("truth-unreadable",), _deep, named=0),
    "depth the same everywhere": Fault(_flat_depth, ("depth-constant",), _deep, named=0),
    "depth hardly anywhere": Fault(_hollow_depth, ("depth-unknown",), _deep, named=0),
    "depth of 8 bit": Fault(_shallow_depth, ("depth-coarse", "truth-unreadable"), _finely_deep, named=0),
    "depth a thousandth": Fault(partial(_depth_scale, 1e-3), ("depth-unit",), _deep),
    "depth a thousandfold": Fault(partial(_depth_scale, 1e3), ("depth-unit",), _deep),
    "depth of one frame in another unit": Fault(_other_unit, ("depth-jump", "depth-unknown"), _finely_deep, named=0),
}


# ---- planting


@pytest.fixture(scope="module")
def copies(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, Path, Content]]:
    """Returns by a kind's name: a copy as its writer made it, what is opened in it, the content of a sound one."""
    made: dict[str, tuple[Path, Path, Content]] = {}

    def copy(name: str) -> tuple[Path, Path, Content]:
        if name not in made:
            root = tmp_path_factory.mktemp("kind") / "input"
            entry = WRITERS[name](root)
            made[name] = root, entry.relative_to(root), _content(KINDS[name], entry)
        return made[name]

    return copy


def _content(kind: Kind, entry: Path) -> Content:
    sequence = open_sequence(entry)
    whole = sequence.rectifier.source
    camera = whole.resized(whole.width // kind.smaller, whole.height // kind.smaller)
    sensor = sequence.source.depth_sensor
    eye = camera if sensor is None else sensor.camera.resized(camera.width, camera.height)
    return content(camera, eye, kind.scale, kind.first, kind.depth_unit_mm)


def _found(name: str, planted: Content, template: Path, entry: Path, folder: Path) -> list[Finding]:
    root = Path(shutil.copytree(template, folder / "input"))
    options = put(KINDS[name], root / entry, planted)
    try:
        sequence = open_sequence(root / entry, **options)
    except ScopemapError as error:
        return [refusal(error)]
    return check(survey(sequence))


Copies = Callable[[str], tuple[Path, Path, Content]]


def test_every_kind_can_be_planted() -> None:
    unknown = sorted(set(WRITERS) - set(KINDS))
    assert not unknown, f"tests/stored_kinds.py does not say how these store frames and truth: {', '.join(unknown)}"
    assert set(KINDS) == set(WRITERS)


@pytest.mark.parametrize("name", sorted(KINDS))
def test_a_sound_copy_is_told_for_its_nature_alone(name: str, copies: Copies, tmp_path: Path) -> None:
    template, entry, sound = copies(name)
    found = _found(name, sound, template, entry, tmp_path)
    assert {finding.code for finding in found if finding.severity != "info"} == KINDS[name].told, found


# One reader of each way to store frames and truth.
REPRESENTATIVE = ("c3vd", "dicom:frames", "endomapper-sim", "scared", "stereomis", "tum", "video")


@pytest.mark.parametrize(
    ("name", "what"),
    [(name, what) for name in REPRESENTATIVE for what in FAULTS if not FAULTS[what].excused(KINDS[name])],
)
def test_a_planted_fault_is_found(name: str, what: str, copies: Copies, tmp_path: Path) -> None:
    template, entry, sound = copies(name)
    planted, fault = deepcopy(sound), FAULTS[what]
    at = planted.numbers[AT]
    fault.alter(planted, at)
    found = _found(name, planted, template, entry, tmp_path)
    told = [f for f in found if f.severity != "info" and f.code in fault.codes and f.code not in KINDS[name].told]
    assert told, found
    if fault.named is not None:
        number = at + fault.named
        stamps = "|".join(f"{sound.times_s[number] + late_s:.6f}" for late_s in (0, 0.005))
        place = _place_in_words(name, sound.numbers.index(number))
        named = re.compile(rf"(?<![\d.])0*({number}|{stamps})(?!\d)|{place}(?!\d)")
        assert any(named.search(finding.message.replace(str(tmp_path), "")) for finding in told), told


def _place_in_words(name: str, place: int) -> str:
    """Return how a reader names the entry of a frame, `place` from 0: they count from 1, and a header is a line."""
    if name == "colmap:txt":
        return f"line {2 * place + 3}"  # two lines of an image, after two of a header
    return f"image {place + 1}" if name == "endomapper" else f"(line|row) ({place + 1}|{place + 2})"


@pytest.mark.parametrize("name", sorted(KINDS))
def test_twelve_faults_apply_to_every_kind(name: str) -> None:
    excuses = {what: reason for what, fault in FAULTS.items() if (reason := fault.excused(KINDS[name]))}
    assert len(FAULTS) - len(excuses) >= LEAST_FAULTS, excuses
