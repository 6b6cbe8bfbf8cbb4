"""A trial of lenses: it finds kind and focal length where they can be known, and says so where they cannot."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera
from scopemap.engine.config import Config
from scopemap.engine.geometry.se3 import so3_exp
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.focal_length.from_motion import FocalEstimate, with_focal_from_motion
from scopemap.input.focal_length.trial import LensTrial, try_lenses
from scopemap.input.focal_length.windows import Window
from scopemap.input.opening import open_sequence
from scopemap.input.scopes import KINDS, SCOPES
from scopemap.result.verdict import verdict
from scopemap.runner.reconstruct import reconstruct
from tests.support.front_door import refused, warned
from tests.support.turning_clip import write_clip

pytestmark = pytest.mark.slow

HALF_PX, POINTS = 160.0, 150
FORWARD = {"rotation_deg": (0.0, 0.0, 0.0), "translation": (0.05, -0.03, 0.3)}
TURNING = {"rotation_deg": (6.0, 4.0, 2.0), "translation": (0.25, -0.15, 0.1)}


def _lens(kind: str, focal_px: float) -> PinholeCamera | FisheyeCamera:
    plane = PinholeCamera(focal_px, focal_px, 0.0, 0.0, 320, 256)
    return FisheyeCamera(plane, KINDS[kind]) if KINDS[kind] else plane


def _window(
    kind: str,
    focal_px: float,
    seed: int,
    *,
    rotation_deg: tuple[float, float, float],
    translation: tuple[float, float, float],
    noise_px: float = 0.1,
    depth_noise: float = 0.2,
) -> Window:
    """Points before a camera that turns and moves on, seen in 4 partners; their distances are about known."""
    rng, lens = np.random.default_rng(seed), _lens(kind, focal_px)
    pixel = rng.uniform(-1, 1, (POINTS, 2)) * [0.95 * HALF_PX, 0.7 * HALF_PX]
    rays = lens.unproject(pixel)
    point = rays / np.linalg.norm(rays, axis=1, keepdims=True) * rng.uniform(0.6, 2.5, (POINTS, 1))
    seen = []
    for share in np.arange(1, 5) / 4:
        moved = point @ so3_exp(np.radians(rotation_deg) * share).T - share * np.array(translation)
        seen.append(lens.project(moved) + rng.normal(0, noise_px, (POINTS, 2)))
    distance = np.linalg.norm(point, axis=1) * np.exp(rng.normal(0, depth_noise, POINTS))
    return Window(pixel, np.stack(seen, 1), HALF_PX, log_distance=np.log(distance))


def _tried(kind: str, focal_px: float, **motion: object) -> LensTrial | None:
    return try_lenses([_window(kind, focal_px, seed, **motion) for seed in range(2)])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "focal_px", "motion"),
    [
        ("pinhole", 180.0, TURNING),
        ("pinhole", 383.0, TURNING),  # laparoscopes of the Hamlyn videos: 45 degrees
        ("equidistant fisheye", 170.0, FORWARD),
        ("orthographic fisheye", 190.0, FORWARD),
    ],
)
def test_kind_and_focal_length_are_found(kind: str, focal_px: float, motion: dict) -> None:
    found = _tried(kind, focal_px, **motion)
    assert found is not None
    assert (found.kind, found.reason, found.windows) == (kind, "", 2)
    assert abs(math.log(found.focal_px / focal_px)) < max(2 * found.share, 0.02) < 0.15
    edge = _lens(kind, found.focal_px).unproject(np.array([[HALF_PX, 0.0]]))[0, 0]
    assert found.fov_deg == pytest.approx(2 * math.degrees(math.atan(edge)))


@pytest.mark.parametrize(
    "motion",
    [
        {"rotation_deg": (0.0, 0.0, 0.0), "translation": (0.1, 0.05, 0.0)},
        {"rotation_deg": (0.0, 0.0, 0.0), "translation": (0.0, 0.0, 0.0)},
    ],
    ids=["sideways", "rest"],
)
def test_a_straight_lens_that_does_not_turn_is_not_known(motion: dict) -> None:
    found = _tried("pinhole", 180.0, **motion)
    assert found is not None
    assert found.reason


def test_tissue_that_deforms_tells_nothing() -> None:
    assert _tried("pinhole", 180.0, noise_px=3.0, **TURNING) is None
    assert try_lenses([]) is None


def test_a_kind_of_endoscope_leaves_out_other_lenses() -> None:
    windows = [_window("orthographic fisheye", 190.0, seed, **FORWARD) for seed in range(2)]  # type: ignore[arg-type]
    assert try_lenses(windows, SCOPES["laparoscope"]) is None
    found = try_lenses(windows, SCOPES["colonoscope"])
    assert found is not None
    assert (found.kind, found.reason) == ("orthographic fisheye", "")
    assert abs(math.log(found.focal_px / 190.0)) < max(2 * found.share, 0.02)


# ---- in a run

UNDETERMINED = FocalEstimate(math.nan, math.inf, math.nan, 0, reason="0 windows")
FISHEYE = LensTrial("orthographic fisheye", 100.0, 0.03, 110.0, 0.99, 4)
LIGHT = {"depth.backend": "shading", "networks.flow": "none", "fusion.enabled": False}


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return write_clip(tmp_path / "clip", 100.0, 12, turn_deg=0.0)


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[LensTrial | None]:
    """What the trial says, to be filled in; the motion tells nothing."""
    said: list[LensTrial | None] = []
    place = "scopemap.input.focal_length.from_motion"
    window = Window(np.zeros((1, 2)), np.zeros((1, 1, 2)), 100.0)

    def motion(*arguments: object) -> FocalEstimate:
        arguments[2].append(window)  # type: ignore[attr-defined]
        return UNDETERMINED

    monkeypatch.setattr(f"{place}.focal_from_motion", motion)
    monkeypatch.setattr(f"{place}.try_lenses", lambda *_: said[0])
    return said


def test_a_run_sees_through_the_lens_that_was_found(clip: Path, tried: list, tmp_path: Path) -> None:
    tried.append(FISHEYE)
    result = reconstruct(open_sequence(clip), Config.load(settings=LIGHT), out=tmp_path / "out")
    assert result.camera.fx == pytest.approx(100.0)
    facts = result.provenance["camera"]
    assert facts["source"].startswith(
        "estimated: by trial of lenses in 4 windows, orthographic fisheye, fx 100 +- 3 px"
    )
    assert facts["focal_sigma_px"] == pytest.approx(3.0)
    assert not any("camera is unknown" in warning for warning in warned(result.provenance))
    lens = read_calibration(tmp_path / "out" / "source_camera.yaml", (200, 160)).camera
    assert isinstance(lens, FisheyeCamera)
    assert lens.distortion == pytest.approx(KINDS["orthographic fisheye"])


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (None, "too few of the first frames show a rigid scene"),
        (dataclasses.replace(FISHEYE, reason="several lenses fit about as well"), "several lenses fit about as well"),
    ],
)
def test_the_default_is_named_where_nothing_is_known(
    clip: Path, tried: list, said: LensTrial | None, words: str
) -> None:
    tried.append(said)
    result = reconstruct(open_sequence(clip), Config.load(settings=LIGHT))
    assert [text for text in warned(result.provenance) if text.startswith("The focal length is assumed: ")]
    assert result.provenance["camera"]["source"].startswith("assumed: horizontal field of view 70 deg")
    assert words in result.provenance["camera"]["source"]
    reasons = [reason.text for reason in verdict(result).reasons]
    assert sum("lens is assumed" in text for text in reasons) == 1
    assert not any("focal length is assumed" in text for text in reasons)  # said once


@pytest.mark.parametrize("scope", SCOPES)
def test_the_lens_of_a_kind_of_endoscope_is_assumed_where_nothing_is_known(clip: Path, tried: list, scope: str) -> None:
    tried.append(None)
    config = Config.load(settings=LIGHT | {"input.scope": scope})
    sequence = open_sequence(clip, settings=config.input)
    assert sequence.camera.fx == pytest.approx(SCOPES[scope].focal * 200)
    sequence, _ = with_focal_from_motion(sequence, config)
    lens = sequence.rectifier.source
    assert getattr(lens, "distortion", ()) == pytest.approx(KINDS[SCOPES[scope].kinds[0]])
    assert sequence.focal_sigma_px == pytest.approx(SCOPES[scope].spread * SCOPES[scope].focal * 200)
    assert sequence.camera_source.startswith(f"assumed: as of a {scope}, fx {SCOPES[scope].focal:g} of the width")
    assert sequence.camera_origin == "assumed"
    assert [notice.code for notice in sequence.source.warnings if not isinstance(notice, str)] == ["camera-unknown"]


UNCLEAR = dataclasses.replace(FISHEYE, share=0.1, reason="several lenses fit about as well")
VAGUE = FocalEstimate(200.0, 0.15, 53.0, 4)


@pytest.mark.parametrize(
    ("motion", "said", "scope", "focal_px", "sigma_px", "fisheye"),
    [
        # The trial has weighed what is expected already.
        (UNDETERMINED, UNCLEAR, "bronchoscope", 100.0, 10.0, True),
        (VAGUE, UNCLEAR, "bronchoscope", 100.0, 10.0, True),
        # Windows in which no lens leaves a rigid scene say nothing of the motion's either.
        (VAGUE, None, "bronchoscope", 120.0, 36.0, False),
    ],
)
def test_what_is_seen_is_weighed_with_what_is_expected_of_a_kind_of_endoscope(
    clip: Path,
    tried: list,
    monkeypatch: pytest.MonkeyPatch,
    motion: FocalEstimate,
    said: LensTrial | None,
    scope: str,
    focal_px: float,
    sigma_px: float,
    fisheye: bool,
) -> None:
    tried.append(said)
    window = Window(np.zeros((1, 2)), np.zeros((1, 1, 2)), 100.0)
    place = "scopemap.input.focal_length.from_motion.focal_from_motion"
    monkeypatch.setattr(place, lambda *arguments: arguments[2].append(window) or motion)
    config = Config.load(settings=LIGHT | {"input.scope": scope})
    sequence, _ = with_focal_from_motion(open_sequence(clip, settings=config.input), config)
    assert sequence.camera.fx == pytest.approx(focal_px)
    assert sequence.focal_sigma_px == pytest.approx(sigma_px, rel=1e-3)
    assert isinstance(sequence.rectifier.source, FisheyeCamera) == fisheye
    assert sequence.camera_source.startswith(f"assumed: as of a {scope}")
    assert sequence.camera_origin == "assumed"
    assert [notice.code for notice in sequence.source.warnings if not isinstance(notice, str)] == ["camera-unknown"]


def test_what_is_stated_overrules_the_kind_of_endoscope(clip: Path) -> None:
    settings = Config.load(settings={"input.scope": "colonoscope"}).input
    assert open_sequence(clip, fov_deg=90.0, settings=settings).camera.fx == pytest.approx(100.0)
    known = open_sequence(clip, camera="120 120 100 80", settings=settings)
    assert known.calibrated
    assert known.camera.fx == pytest.approx(120.0)


@pytest.mark.parametrize("command", [("run", "--out"), ("batch", "--out"), ("live",)])
def test_a_kind_that_is_not_known_is_answered_with_those_that_are(
    command: tuple[str, ...], clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    name, *out = command
    answer = refused(capfd, name, clip, *out, *[tmp_path / "out"][: len(out)], "--scope", "telescope")
    assert "unknown scope 'telescope'" in answer
    assert all(scope in answer for scope in SCOPES)
