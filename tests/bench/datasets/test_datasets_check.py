"""Checking a data set: a sound one has no fault; what faults are called (all kinds: test_planted_faults.py)."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from scopemap.engine.errors import ScopemapError
from scopemap.engine.geometry.se3 import inverse, se3_exp
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence
from scopemap.input.source import SourceFrame, SourceTruth
from scopemap.input.trajectory.text import read_poses
from scopemap_bench.datasets.checking import Finding, check, check_path, refusal
from scopemap_bench.datasets.survey import FrameFigures, PoseDepthTest, Survey, survey
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom
from tests.support.drawn_inputs import picture, save
from tests.support.places import ROOT

COUNT, SIZE = 6, (64, 48)
SPEC = PhantomSpec(frames=COUNT, width=SIZE[0], height=SIZE[1], seed=2)
CAMERA = SPEC.camera


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phantom") / "sound"
    write_phantom(SPEC, folder)
    return folder


@pytest.fixture
def folder(sound: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "set"))


def findings(path: Path, **options: Any) -> list[Finding]:
    try:
        sequence = open_sequence(path, **options)
    except ScopemapError as error:
        return [refusal(error)]
    return check(survey(sequence))


def faults(found: list[Finding]) -> dict[str, str]:
    """Messages of errors and warnings by code."""
    return {finding.code: finding.message for finding in found if finding.severity != "info"}


# ---- what is sound


def test_a_sound_set_has_no_fault(folder: Path) -> None:
    found = survey(open_sequence(folder))
    assert faults(check(found)) == {}
    assert [f.code for f in check(found)] == ["assumed"]
    truth = read_poses(folder / "pose.txt")[:, :3, 3]
    figures = found.figures
    assert (figures["frames"], figures["first_number"], figures["last_number"]) == (COUNT, 0, COUNT - 1)
    assert (figures["width"], figures["height"], figures["fx"]) == (*SIZE, pytest.approx(CAMERA.fx))
    assert (figures["with_pose"], figures["with_depth"]) == (COUNT, COUNT)
    assert figures["path_mm"] == pytest.approx(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    assert figures["extent_mm"] == pytest.approx(np.linalg.norm(np.ptp(truth, axis=0)))
    assert figures["span_s"] == pytest.approx((COUNT - 1) / 30)
    assert 10 < figures["depth_nearest_mm"] < figures["depth_median_mm"] < figures["depth_farthest_mm"] < 100
    assert figures["pose_depth_error"] < 0.002


# ---- planted in files


def _rewrite_poses(alter: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        stored = alter(read_poses(folder / "pose.txt")).transpose(0, 2, 1)
        lines = [",".join(f"{value:.12g}" for value in T.ravel()) for T in stored]
        (folder / "pose.txt").write_text("\n".join(lines) + "\n")

    return plant


def _scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    def alter(poses: np.ndarray) -> np.ndarray:
        poses[:, :3, 3] *= factor
        return poses

    return alter


def _moved(number: int, twist: list[float]) -> Callable[[np.ndarray], np.ndarray]:
    def alter(poses: np.ndarray) -> np.ndarray:
        poses[number] = poses[number] @ se3_exp(np.array(twist))
        return poses

    return alter


def _astray(poses: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(1)
    poses[:, :3, 3] += rng.uniform(-12, 12, (len(poses), 3))
    return poses


def _looking_away(poses: np.ndarray) -> np.ndarray:
    poses[::2] = poses[::2] @ se3_exp(np.array([0, np.pi, 0, 0, 0, 0]))
    poses[1::3] = poses[1::3] @ se3_exp(np.array([2.0, 0, 0, 0, 0, 0]))
    return poses


def _not_a_number(poses: np.ndarray) -> np.ndarray:
    poses[2, 0, 0] = np.nan
    return poses


def _repaint(rgb: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: save(folder / "0003_color.png", rgb)


def _even(level: int) -> np.ndarray:
    return np.full((SIZE[1], SIZE[0], 3), level, np.uint8)


def _recalibrate(scale_mm: float = SPEC.depth_scale_mm, **changes: float) -> Callable[[Path], None]:
    return lambda folder: write_calibration(replace(CAMERA, **changes), folder / "camera.yaml", scale_mm)


def _cut_short(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:900]) and None


def _remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def _number_again(folder: Path) -> None:
    shutil.copy(folder / "0004_color.png", folder / "4_color.png")
    text = (folder / "pose.txt").read_text()
    (folder / "pose.txt").write_text(text + text.splitlines()[-1] + "\n")


def _numbers_back(folder: Path) -> None:
    for number in range(COUNT):  # numeric order looks at the letter first
        (folder / f"{number:04d}_color.png").rename(folder / f"{'ab'[number < 3]}{number:04d}_color.png")


@pytest.mark.parametrize(
    ("plant", "severity", "code", "message"),
    [
        (_remove("0003_color.png"), "warning", "number-gap", "after frame 2"),
        (_number_again, "error", "number-repeated", "names repeat the number of frame 4"),
        (_numbers_back, "error", "number-unsorted", "go back"),
        (_cut_short("0003_color.png"), "warning", "frame-unreadable", "frame 3"),
        (_cut_short("0003_color.png"), "warning", "source", r"0003_color\.png cannot be read"),
        (_rewrite_poses(_not_a_number), "error", "refused", "line 3.*NaN"),
        (_rewrite_poses(_scaled(1e-3)), "warning", "pose-unit", "looks like metres"),
        (_rewrite_poses(_scaled(1e-3)), "error", "pose-depth-unit", "the poses look like metres"),
        (_rewrite_poses(inverse), "error", "poses-inverted", "poses look like world-to-camera"),
        (_rewrite_poses(_astray), "error", "pose-depth-disagree", "do not belong together"),
        (_rewrite_poses(_looking_away), "warning", "pose-depth-apart", "no surface in common"),
        (_rewrite_poses(_moved(3, [0, 0, 0, 0, 30, 0])), "warning", "pose-jump", r"to 2 frames \(3, 4\)"),
        (_remove("0003_depth.tiff"), "warning", "depth-missing", "1 of 6 frames"),
        (_recalibrate(cx=9.0), "warning", "camera-centre", "middle half"),
    ],
)  # fmt: skip
def test_a_planted_fault_is_found(
    plant: Callable[[Path], None], severity: str, code: str, message: str, folder: Path
) -> None:
    plant(folder)
    found = findings(folder)
    named = [finding for finding in found if finding.code == code]
    assert len(named) == 1, found
    assert named[0].severity == severity
    assert re.search(message, named[0].message), named[0].message


def test_one_fault_is_not_reported_as_many(folder: Path) -> None:
    shutil.copytree(folder, folder.parent / "second")
    _repaint(_even(3))(folder)
    assert set(faults(findings(folder))) == {"frame-black"}
    _rewrite_poses(inverse)(folder.parent / "second")
    assert set(faults(findings(folder.parent / "second"))) == {"poses-inverted"}


def test_names_of_a_plain_folder(tmp_path: Path) -> None:
    for name in ("a_1.png", "b_1.png", "c_2.png"):
        save(tmp_path / name, picture(len(list(tmp_path.iterdir()))))
    assert set(faults(findings(tmp_path))) == {"number-repeated", "source"}  # a run says it, too
    for number, file in enumerate(sorted(tmp_path.iterdir())):
        file.rename(tmp_path / f"{1305031102.175304 + number / 7:.6f}.png")
    assert faults(findings(tmp_path)) == {}  # time stamps are no frame numbers
    for number, file in enumerate(sorted(tmp_path.iterdir())):
        file.rename(tmp_path / f"{5 * number:03d}.png")
    assert {f.code: f.message for f in findings(tmp_path)}["number-step"] == "frames are numbered in steps of 5"


# ---- planted in a reader, which let it pass


class _Altered:
    """A reader that gives other truth and other times than the one it wraps."""

    def __init__(self, sequence: Sequence, **changes: Callable[..., Any]) -> None:
        self._source, self._changes = sequence.source, changes

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        for frame in self._source.frames(selection):
            yield replace(frame, time_s=self._changed("time", frame.index, frame.time_s))

    def truth(self, index: int) -> SourceTruth:
        truth = self._source.truth(index)
        pose = self._changed("pose", index, truth.T_world_camera.copy())
        return replace(truth, T_world_camera=pose, depth_mm=self._changed("depth", index, truth.depth_mm.copy()))

    def _changed(self, what: str, index: int, value: Any) -> Any:
        return self._changes[what](index, value) if what in self._changes else value


@pytest.mark.parametrize(
    ("what", "alter", "code"),
    [
        ("pose", lambda T: T @ np.diag([-1.0, 1, 1, 1]), "pose-left-handed"),
        ("pose", lambda T: T * np.array([[np.nan], [1], [1], [1]]), "pose-not-finite"),
        ("pose", lambda T: T @ np.diag([2.0, 2, 2, 1]), "pose-not-rigid"),
        ("pose", lambda T: T.T, "pose-not-rigid"),
        ("pose", lambda T: None, "pose-missing"),
        ("depth", lambda depth: np.where(depth > 30, depth, 0), "depth-impossible"),
        ("depth", lambda depth: np.where(depth > 30, depth, np.inf), "depth-impossible"),
        ("time", lambda time_s: time_s - 1, "time-order"),
        ("time", lambda time_s: time_s + 0.025, "time-irregular"),
    ],
)
def test_a_fault_that_a_reader_lets_pass_is_found(
    what: str, alter: Callable[[Any], Any], code: str, sound: Path
) -> None:
    sequence = open_sequence(sound)
    source = _Altered(sequence, **{what: lambda index, value: alter(value) if index == 3 else value})
    assert set(faults(check(survey(replace(sequence, source=source))))) == {code}  # type: ignore[arg-type]


def test_frames_are_compared_over_three_lags() -> None:
    test = PoseDepthTest(CAMERA)
    slope = (20 + CAMERA.rays[..., 0]).astype(np.float32)
    for _ in range(95):
        test.add(slope, np.eye(4))
    assert [(a.lag, a.pairs) for a in test.agreements] == [(10, 94), (30, 13), (90, 1)]
    assert all(a.given == pytest.approx(0, abs=1e-6) for a in test.agreements)


def test_the_documents_name_every_code() -> None:
    room = ROOT / "bench" / "src" / "scopemap_bench" / "datasets"
    text = "".join((room / name).read_text() for name in ("checking.py", "survey.py"))
    heads = "camera|depth|frame|number|pose|poses|reading|time|truth"
    codes = set(re.findall(rf'"((?:{heads})-[a-z-]+)"', text)) | {"refused", "source", "assumed"}
    codes |= {"pose-missing", "depth-missing"}
    documented = (ROOT / "docs" / "formats.md").read_text().split("## Checking a data set")[1].split("\n## ")[0]
    assert set(re.findall(r"`([a-z]+(?:-[a-z]+)*)`", documented)) >= codes


def _moving(steps_mm: np.ndarray, noise_mm: float) -> Survey:
    """Poses of a path along x, each off by some noise."""
    positions_mm = np.cumsum(steps_mm)[:, None] * [1.0, 0, 0]
    positions_mm += np.random.default_rng(0).normal(0, noise_mm, positions_mm.shape)
    poses = np.tile(np.eye(4), (len(steps_mm), 1, 1))
    poses[:, :3, 3] = positions_mm
    frames = tuple(FrameFigures(i, i / 30, f"{i}", 200.0, 30.0, False, T, None) for i, T in enumerate(poses))
    return Survey(cast(Sequence, None), frames)


def test_a_camera_that_moves_off_does_not_jump() -> None:
    steps_mm = np.zeros(600)
    steps_mm[300:500] = 0.5
    assert check_path(_moving(steps_mm, 0.005)) == []
    steps_mm[100] = steps_mm[400] = 8.0
    (finding,) = check_path(_moving(steps_mm, 0.005))
    assert finding.code == "pose-jump"
    assert "to 2 frames (100, 400)" in finding.message
