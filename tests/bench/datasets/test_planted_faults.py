"""Faults that data sets have, planted into made-up copies of three ways to store frames: `check` finds each of them.

What finds a fault is the same for all readers. The same copy without a fault must not be reported for it.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.errors import ScopemapError
from scopemap.engine.geometry.se3 import inverse, se3_exp
from scopemap.input.opening import open_sequence
from scopemap_bench.datasets.checking import Finding, check, refusal
from scopemap_bench.datasets.survey import survey
from tests.support.drawn_datasets import WRITERS
from tests.support.drawn_scene import Content, content
from tests.support.stored_kinds import KINDS, Kind, put

AT = 3
REFUSED = ("refused", "camera-refused")
MIRROR, OPENGL = np.diag([1.0, -1, 1, 1]), np.diag([1.0, -1, -1, 1])
UNREAD = (*REFUSED, "frame-unreadable", "reading-stopped", "source")
NO_POSE = ("refused", "source", "pose-missing", "truth-unreadable")

Alter = Callable[[Content, int], object]
Applies = Callable[[Kind], bool]


@dataclass(frozen=True)
class Fault:
    """One fault.

    alter : plants it, where it concerns one frame into the frame with this number. codes : by which it may be reported.
    excused : whether it does not apply to a kind. named : the frame that must be named, counted from the
    one that it is planted into; None where none can be.
    """

    alter: Alter
    codes: tuple[str, ...]
    excused: Applies = lambda kind: False
    named: int | None = None


# ---- where a fault does not apply


def _stored_alone(kind: Kind) -> bool:
    return kind.pictures == "video"  # what spoils one picture spoils those after it


def _streamed(kind: Kind) -> bool:
    return kind.pictures == "files"


def _numbered(kind: Kind) -> bool:
    return kind.pictures == "video" or kind.listed  # counted, or numbered by a list


def _deep(kind: Kind) -> bool:
    return kind.depth_unit_mm is None  # without depth nothing tells how poses are meant, either


def _stamped(kind: Kind) -> bool:
    return not kind.stamps


# ---- what is planted


def _half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def _picture(damage: Callable[[bytes], bytes]) -> Alter:
    return lambda planted, at: planted.rgb_damage.update({at: damage})


def _even(level: int) -> Alter:
    return lambda planted, at: planted.rgb.update({at: np.full_like(planted.rgb[at], level)})


def _stream(damage: Callable[[bytes], bytes]) -> Alter:
    return lambda planted, at: setattr(planted, "stream_damage", damage)


def _pose(alter: Callable[[np.ndarray], np.ndarray]) -> Alter:
    return lambda planted, at: planted.poses.update({at: alter(planted.poses[at])})


def _all_poses(alter: Callable[[np.ndarray], np.ndarray]) -> Alter:
    return lambda planted, at: planted.poses.update({number: alter(T) for number, T in planted.poses.items()})


def _away(planted: Content, at: int) -> None:
    scale = np.linalg.norm(planted.poses[at][:3, 3]) / AT
    planted.poses[at] = planted.poses[at] @ se3_exp(np.array([0, 0, 0, 0, 40 * scale, 0]))


def _exchanged(planted: Content, at: int) -> None:
    planted.poses[at], planted.poses[at + 3] = planted.poses[at + 3], planted.poses[at]


def _in_metres(T: np.ndarray) -> np.ndarray:
    return np.hstack([T[:, :3], T[:, 3:] * [[1e-3], [1e-3], [1e-3], [1.0]]])


def _depth(alter: Callable[[np.ndarray], np.ndarray]) -> Alter:
    return lambda planted, at: planted.depth_mm.update({at: alter(planted.depth_mm[at].copy())})


def _hollow(depth_mm: np.ndarray) -> np.ndarray:
    depth_mm[2:] = 0
    return depth_mm


def _camera(alter: Callable[[PinholeCamera], CameraModel]) -> Alter:
    return lambda planted, at: setattr(planted, "own", (alter(planted.camera.central), None))


def _later(step_s: float) -> Alter:
    return lambda planted, at: planted.times_s.update({n: planted.times_s[n] + step_s for n in planted.numbers[AT:]})


FAULTS: dict[str, Fault] = {
    # pictures
    "a picture cut off": Fault(_picture(_half), UNREAD, _stored_alone, named=0),
    "a stream cut off": Fault(_stream(_half), UNREAD, _streamed),
    "one picture alone": Fault(
        lambda planted, at: [planted.rgb.pop(number) for number in planted.numbers[1:]], ("frame-few", "refused")
    ),
    "a picture of another size": Fault(
        lambda planted, at: planted.rgb.update({at: planted.rgb[at][:-8, :-8]}),
        ("reading-stopped", "refused", "frame-unreadable", "source"),
        _stored_alone,
        named=0,
    ),
    "a picture missing": Fault(
        lambda planted, at: planted.rgb.pop(at), ("number-gap", "time-irregular", "refused", "source")
    ),
    "a number twice": Fault(
        lambda planted, at: planted.names_again.append(at), ("number-repeated", "refused"), _numbered
    ),
    "a picture repeated": Fault(
        lambda planted, at: planted.rgb.update({at: planted.rgb[at - 1]}), ("frame-repeated",), named=0
    ),
    "a black picture": Fault(_even(2), ("frame-black",), named=0),
    "a picture of one colour": Fault(_even(120), ("frame-constant",), named=0),
    # time
    "a pause": Fault(_later(0.4), ("time-irregular",), _stamped, named=-1),
    "time going back": Fault(_later(-0.1), ("time-order", "refused", "source"), _stamped),
    # camera
    "a calibration of another aspect": Fault(_camera(lambda c: replace(c, width=2 * c.width)), ("camera-refused",)),
    "a principal point near the edge": Fault(
        _camera(lambda c: replace(c, cx=0.1 * c.width)), ("camera-centre", "camera-refused")
    ),
    "a focal length of ten widths": Fault(
        _camera(lambda c: replace(c, fx=10.0 * c.width, fy=10.0 * c.width)), ("camera-refused", "camera-focal")
    ),
    "pixels that are not square": Fault(_camera(lambda c: replace(c, fy=1.3 * c.fx)), ("camera-aspect",)),
    # poses
    "a pose of NaN": Fault(_pose(lambda T: np.full((4, 4), np.nan)), NO_POSE, named=0),
    "a pose missing": Fault(lambda planted, at: planted.poses.pop(at), ("refused", "source", "pose-missing")),
    "a pose far away": Fault(_away, ("pose-jump",), named=0),
    "a pose turned": Fault(_pose(lambda T: T @ se3_exp(np.array([0, 0, 0.8, 0, 0, 0]))), ("pose-turn",), named=0),
    "a camera that never moves": Fault(
        lambda planted, at: planted.poses.update(dict.fromkeys(planted.poses, planted.poses[at])),
        ("pose-still",),
    ),
    "poses world to camera": Fault(_all_poses(inverse), ("poses-inverted",), _deep),
    "poses of another hand": Fault(_all_poses(lambda T: MIRROR @ T @ MIRROR), ("poses-mirrored",), _deep),
    "poses of a camera with y up": Fault(_all_poses(lambda T: OPENGL @ T @ OPENGL), ("poses-opengl",), _deep),
    "poses in metres": Fault(_all_poses(_in_metres), ("pose-unit", "pose-depth-unit")),
    "two poses exchanged": Fault(_exchanged, ("pose-depth-frame",), _deep, named=0),
    # depth
    "depth missing": Fault(lambda planted, at: planted.depth_mm.pop(at), ("depth-missing",), _deep, named=0),
    "depth cut off": Fault(
        lambda planted, at: planted.depth_damage.update({at: _half}), ("truth-unreadable",), _deep, named=0
    ),
    "depth the same everywhere": Fault(
        _depth(lambda mm: np.where(mm > 0, np.median(mm), 0)), ("depth-constant",), _deep, named=0
    ),
    "depth hardly anywhere": Fault(_depth(_hollow), ("depth-unknown",), _deep, named=0),
    "depth of 8 bit": Fault(
        lambda planted, at: planted.shallow.add(at), ("depth-coarse", "truth-unreadable"), _deep, named=0
    ),
    "depth a thousandfold": Fault(
        lambda planted, at: setattr(planted, "own", (planted.camera, 1e3 * planted.depth_unit_mm)),
        ("depth-unit",),
        _deep,
    ),
    "depth of one frame in another unit": Fault(
        _depth(lambda mm: mm / 100), ("depth-jump", "depth-unknown"), _deep, named=0
    ),
}


# ---- planting


Copies = Callable[[str], tuple[Path, Path, Content]]


@pytest.fixture(scope="module")
def copies(tmp_path_factory: pytest.TempPathFactory) -> Copies:
    """Returns by a kind's name: a copy as its writer made it, what is opened in it, the content of a sound one."""

    @cache
    def copy(name: str) -> tuple[Path, Path, Content]:
        root = tmp_path_factory.mktemp("kind") / "input"
        entry = WRITERS[name](root)
        camera = open_sequence(entry).rectifier.source
        return root, entry.relative_to(root), content(camera, KINDS[name].scale, KINDS[name].depth_unit_mm or 1.0)

    return copy


def _found(name: str, planted: Content, template: Path, entry: Path, folder: Path) -> list[Finding]:
    root = Path(shutil.copytree(template, folder / "input"))
    put(KINDS[name], root / entry, planted)
    try:
        sequence = open_sequence(root / entry)
    except ScopemapError as error:
        return [refusal(error)]
    return check(survey(sequence))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(WRITERS))
def test_what_any_reader_reads_whole_is_not_called_damaged(name: str, tmp_path: Path) -> None:
    found = check(survey(open_sequence(WRITERS[name](tmp_path / "input"))))
    damaged = {*REFUSED, "frame-unreadable", "reading-stopped", "truth-unreadable", "time-order"}
    assert {finding.code for finding in found} & damaged == set(), found


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_sound_copy_is_told_for_nothing(name: str, copies: Copies, tmp_path: Path) -> None:
    template, entry, sound = copies(name)
    assert [f for f in _found(name, sound, template, entry, tmp_path) if f.severity != "info"] == []


def test_every_fault_is_planted_somewhere() -> None:
    assert [what for what in FAULTS if all(FAULTS[what].excused(kind) for kind in KINDS.values())] == []


@pytest.mark.parametrize(
    ("name", "what"), [(name, what) for name in KINDS for what in FAULTS if not FAULTS[what].excused(KINDS[name])]
)
def test_a_planted_fault_is_found(name: str, what: str, copies: Copies, tmp_path: Path) -> None:
    template, entry, sound = copies(name)
    planted, fault = deepcopy(sound), FAULTS[what]
    at = planted.numbers[AT]
    fault.alter(planted, at)
    found = _found(name, planted, template, entry, tmp_path)
    told = [f for f in found if f.severity != "info" and f.code in fault.codes]
    assert told, found
    if fault.named is not None:
        number = at + fault.named
        stamps = "|".join(f"{sound.times_s[number] + late_s:.6f}" for late_s in (0, 0.005))
        place = sound.numbers.index(number) + 1
        # Of a list, readers name a line or row, which may come after a header.
        named = re.compile(rf"(?<![\d.])0*({number}|{stamps})(?!\d)|(line|row) ({place}|{place + 1})(?!\d)")
        assert any(named.search(finding.message.replace(str(tmp_path), "")) for finding in told), told
