"""A lens that nobody has given is replaced by the one that the motion of all keyframes fits."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.lenses import FisheyeCamera
from scopemap.engine.config import Config
from scopemap.engine.mapping.judge import LensTest
from scopemap.engine.notices import Notice
from scopemap.engine.odometry import Step
from scopemap.input.opening import open_sequence
from scopemap.input.scopes import KINDS
from scopemap.result.result import Result
from scopemap.result.verdict import verdict
from scopemap.runner.lens_of_motion import OtherLens, lens_of_motion, lenses_of
from scopemap.runner.observers import RunStopped
from scopemap.runner.reconstruct import reconstruct
from scopemap.runner.run import Run
from tests.support.alike_runs import check_alike
from tests.support.turning_clip import write_clip

pytestmark = pytest.mark.slow

LIGHT = {"depth.backend": "shading", "networks.flow": "none", "fusion.enabled": False}
WIDER = LensTest(held_px=0.3, free_px=0.2, log_focal=-0.4, sigma=0.01)


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return write_clip(tmp_path / "clip", 100.0, 12, turn_deg=0.0, way_mm=0.0)


def test_an_assumed_lens_is_replaced_and_no_doubt_of_it_stays(clip: Path) -> None:
    sequence = open_sequence(clip)
    sequence.source.warnings.append(Notice("camera-unknown", {"reason": "the camera hardly turns"}))
    found = lens_of_motion(sequence, Config(), WIDER, again=False)
    assert isinstance(found, OtherLens)
    found = found.seen_by(sequence)
    assert found.camera.fx == pytest.approx(sequence.camera.fx * math.exp(-0.4))
    assert found.camera_origin == "estimated"
    assert found.camera_source == "estimated: pinhole, field of view 92 deg, from the motion, 87 to 98"
    assert 0 < found.focal_sigma_px < 0.1 * found.camera.fx
    assert not found.warnings


@pytest.mark.parametrize(
    ("given", "lens"),
    [
        ({"camera": "120 120 99.5 79.5"}, WIDER),
        ({"fov_deg": 90.0}, WIDER),
        ({}, LensTest()),
        ({}, WIDER._replace(free_px=0.295)),  # hardly better
        ({}, WIDER._replace(held_px=0.9, free_px=0.6)),  # tissue moves
        ({}, WIDER._replace(sigma=0.2)),
        ({}, WIDER._replace(sigma=0.05)),  # told badly: with what depth adds 25 %
        ({}, WIDER._replace(log_focal=math.log(0.1))),  # no endoscope
    ],
)
def test_a_lens_that_is_given_or_not_contradicted_stays(clip: Path, given: dict, lens: LensTest) -> None:
    assert lens_of_motion(open_sequence(clip, **given), Config(), lens, again=False) is None


def test_a_fisheye_straightens_the_pictures_and_states_its_own_field_of_view(clip: Path) -> None:
    sequence = open_sequence(clip)
    kind = "equidistant fisheye"
    assert set(lenses_of(sequence, Config(), again=False).kinds) == set(KINDS)
    found = lens_of_motion(sequence, Config(), WIDER._replace(kind=kind, log_focal=-0.2), again=False)
    assert isinstance(found, OtherLens)
    found = found.seen_by(sequence)
    assert isinstance(found.rectifier.source, FisheyeCamera)
    assert found.rectifier.source.distortion == KINDS[kind]
    fov_deg = math.degrees(sequence.camera.width / (sequence.camera.fx * math.exp(-0.2)))
    assert found.camera_source.startswith(f"estimated: {kind}, field of view {fov_deg:.0f} deg")
    assert lenses_of(found, Config(), again=True).bend == KINDS[kind]
    assert not lenses_of(open_sequence(clip, fov_deg=90.0), Config(), again=False).kinds


def test_a_lens_of_the_motion_is_refined_while_it_changes_much(clip: Path) -> None:
    sequence, slightly = open_sequence(clip), WIDER._replace(free_px=0.295)
    assert lens_of_motion(sequence, Config(), slightly, again=True) is not None
    assert lens_of_motion(sequence, Config(), slightly._replace(log_focal=0.04), again=True) is None


def test_the_assumed_field_of_view_typed_in_is_still_assumed(clip: Path) -> None:
    assert open_sequence(clip, fov_deg=70.0).camera_origin == "assumed"
    assert open_sequence(clip, fov_deg=71.0).camera_origin == "stated"


def test_focal_lengths_that_differ_across_and_down_are_a_caution(clip: Path) -> None:
    codes = [
        [warning.code for warning in open_sequence(clip, camera=f"120 {fy} 99.5 79.5").warnings]
        for fy in (120.0, 125.0, 130.0)
    ]
    assert codes == [[], [], ["camera-aspect"]]


class _Seen:
    """Counts the steps since it began anew."""

    def __init__(self) -> None:
        self.count = self.begun = 0

    def __call__(self, step: Step) -> None:
        self.count += 1

    def forget(self) -> None:
        self.count, self.begun = 0, self.begun + 1


def test_a_run_begins_again_with_the_lens_of_the_motion(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tests = iter([WIDER, LensTest(0.2, 0.2, 0.0, 0.01)])
    monkeypatch.setattr(Run, "lens", property(lambda run: next(tests)))
    seen, said = _Seen(), list[str]()
    result = reconstruct(
        open_sequence(clip),
        Config.load(settings=LIGHT),
        out=tmp_path / "out",
        observers=(seen,),
        progress=lambda doing, done, total: said.append(doing),
    )
    assert (seen.count, seen.begun) == (result.provenance["frames"], 1)
    assert [words for words in said if words.startswith("tracking again")]
    assert result.provenance["camera"]["origin"] == "estimated"
    assert result.camera.fx == pytest.approx(open_sequence(clip).camera.fx * math.exp(-0.4))
    assert not {"camera-assumed", "camera-unknown"} & {reason.code for reason in verdict(result).reasons}


def test_a_pass_with_the_lens_of_the_motion_is_stopped_and_goes_on_to_the_same_result(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settled, depths_mm = LensTest(0.2, 0.2, 0.0, 0.01), list[float]()

    def run(out: Path, tests: list[LensTest], *observers: Callable[[Step], None]) -> list[int]:
        told, indices = iter(tests), list[int]()
        monkeypatch.setattr(Run, "lens", property(lambda run: next(told)))

        def note(step: Step) -> None:
            indices.append(step.frame.index)
            depths_mm.append(float(np.nanmedian(step.frame.depth_mm)))

        sequence = open_sequence(clip)
        reconstruct(sequence, Config.load(settings=LIGHT), out=out, observers=(note, *observers))
        return indices

    seen = _Seen()

    def stop(step: Step) -> None:
        seen(step)
        if seen.begun and step.frame.index == 4:
            raise RunStopped

    stop.forget = seen.forget  # type: ignore[attr-defined]
    whole = run(tmp_path / "whole", [WIDER, settled])
    with pytest.raises(RunStopped):
        run(tmp_path / "stopped", [WIDER], stop)
    rest = run(tmp_path / "stopped", [settled])
    assert rest == whole[len(whole) - len(rest) :]
    assert rest[0] > 4, "no frame is tracked twice"
    assert rest[0] < 12
    check_alike(*(Result(tmp_path / name) for name in ("stopped", "whole")), depth_mm=float(np.median(depths_mm)))
    for name in ("camera.yaml", "config.toml"):
        assert (tmp_path / "stopped" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    said = [Result(tmp_path / name).provenance for name in ("whole", "stopped")]
    assert said[0]["notices"] == said[1]["notices"]
    assert said[0]["camera"] == said[1]["camera"]
