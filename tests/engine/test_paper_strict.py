"""The preset `paper-strict`: each of its settings really turns off what `paper` does beyond the paper's text."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.support.extras import NETWORKS
from tests.support.places import ROOT

pytest.importorskip("torch", reason=NETWORKS)

import numpy as np

from scopemap import Config, open_sequence, reconstruct
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import PRESETS
from scopemap.engine.depth.estimate import PerceptualResult
from scopemap.engine.depth.mapis import DenseMatcher, Mapis
from scopemap.engine.flow.flows import create_flow
from scopemap.engine.frame import Frame
from scopemap.engine.odometry import Step
from scopemap.engine.tracking.tracker import Tracker
from tests.support.plane_scene import CAMERA, EVERYWHERE, pose, see
from tests.support.small_networks import saved, small_depth_anything, small_depth_pro
from tests.support.tiny_phantom import FRAMES, only_images, write_tiny

pytestmark = pytest.mark.networks

PAPER, STRICT = Config.load("paper"), Config.load("paper-strict")
BEYOND = {key: value for key, value in PRESETS["paper-strict"].items() if PRESETS["paper"].get(key) != value}
WITHOUT_DOWNLOADS = {"networks.flow": "dis", "networks.perceptual": "structure"}
NARROW = PinholeCamera(800.0, 800.0, 39.5, 29.5, 80, 60)


def test_the_document_lists_every_setting_of_the_preset() -> None:
    text = (ROOT / "docs" / "method.md").read_text()
    section = text.split("## Beyond the paper, in the `paper` preset")[1].split("\n## ")[0]
    assert set(re.findall(r"`([a-z]+\.[a-z_.]+) = ", section)) >= set(BEYOND)
    methods = {part for key, value in BEYOND.items() if key.endswith(".method") for part in value.split("+")}
    assert all(method in section for method in methods - {"no-overlays"})


def _run(preset: str, folder: Path, model: Path, **more: Any) -> tuple[Any, list[Step]]:
    steps: list[Step] = []
    settings = WITHOUT_DOWNLOADS | {"depth.model": str(model)} | more
    config = Config.load(preset, settings=settings)  # type: ignore[arg-type]
    sequence = open_sequence(folder, settings=config.input)
    return reconstruct(sequence, config, observers=(steps.append,)), steps


def test_a_user_with_folders_of_weights_gets_the_papers_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Small networks of the real classes; no calibration: Depth Pro's focal length is the camera's, D1 is its depth."""
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path / "none"))
    model = saved(small_depth_anything(), tmp_path / "anything")
    folders = {"depth.anchor_model": str(saved(small_depth_pro(inverse_depth=300.0), tmp_path / "pro"))}
    images = only_images(write_tiny(tmp_path / "phantom", "black:4-4"), tmp_path / "images")
    for preset in ("paper", "paper-strict"):
        result, steps = _run(preset, images, model, **folders)
        found_px = result.camera.fx
        anchor = result.provenance["estimators"]["anchor"]
        assert result.provenance["camera"]["source"] == "estimated: Depth Pro on frame 0"
        assert re.fullmatch(rf"Depth Pro on frame 0, by the focal length that it finds, {found_px:.0f} px", anchor)
        assert "revision" not in " ".join(result.provenance["estimators"])
        assert len(result.provenance["estimators"]["anchor sha256 model.safetensors"]) == 64
        # Without the text's additions every pixel is used, and every frame that shows anything is tracked.
        unmasked = [bool(step.frame.valid.all()) for step in steps]
        assert unmasked.count(True) == (0 if preset == "paper" else FRAMES - 1)
        if preset == "paper-strict":
            assert result.lost["index"].tolist() == [4]


def test_a_range_takes_the_place_of_depth_pro(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path / "none"))
    model = saved(small_depth_anything(), tmp_path / "anything")
    folder = write_tiny(tmp_path / "phantom", frames=2)
    result, _ = _run("paper", folder, model, **{"depth.near_far_mm": (20.0, 70.0)})
    assert result.provenance["estimators"]["anchor"] == "near-far 20:70 mm"


def _frame(rgb: np.ndarray, depth_mm: np.ndarray | None = None, T: np.ndarray | None = None) -> Frame:
    height, width = rgb.shape[:2]
    camera = CAMERA if (height, width) == (CAMERA.height, CAMERA.width) else NARROW
    return Frame(0, 0.0, rgb, camera, np.ones((height, width), bool), depth_mm, T)


class _Alike:
    name = "stub"

    def compare(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> PerceptualResult:
        return PerceptualResult(np.zeros(rgb_a.shape[:2], np.float32), 0.0)


def _second(config: Config, rgb: np.ndarray, valid_rows: int = CAMERA.height) -> Any:
    """Return the track of a picture after a keyframe of the plane."""
    view, tracker = see(np.eye(4)), Tracker(config.tracking)
    first = _frame(view.rgb, view.depth_mm)
    track = tracker.track(first)
    tracker.update(replace(first, T_world_camera=track.T_world_camera), track.decision, measured=False)
    valid = EVERYWHERE.copy()
    valid[valid_rows:] = False
    return tracker.track(replace(_frame(rgb), index=1, valid=valid))


@pytest.mark.parametrize("fault", ["other picture", "small part"])
def test_no_frame_is_called_lost_for_fitting_badly(fault: str) -> None:
    noise = np.random.default_rng(0).integers(0, 256, see(np.eye(4)).rgb.shape, np.uint8)
    shown = (noise, CAMERA.height) if fault == "other picture" else (see(np.eye(4)).rgb, CAMERA.height // 20)
    assert [_second(config, *shown).status for config in (PAPER, STRICT)] == ["lost", "ok"]


@pytest.mark.parametrize(("blend", "expected_mm"), [("linear", 50.0), ("none", 100.0)])
def test_without_flow_the_previous_depth_is_blended_where_it_was(blend: str, expected_mm: float) -> None:
    """The ablation "- Optical Flow": the previous depth is blended unwarped, unless `mapis.blend = none`."""
    settings = Config.load("paper", settings={"mapis.blend": blend}).mapis
    matcher, mapis, rgb = DenseMatcher(settings, create_flow("none", "cpu"), _Alike()), Mapis(settings), see(pose()).rgb
    for raw_mm in (50.0, 100.0):
        link = matcher.match(rgb, EVERYWHERE)
        refined = mapis.refine(np.full(EVERYWHERE.shape, raw_mm, np.float32), "disparity", CAMERA, link, None)
    assert np.median(refined.depth_mm) == pytest.approx(expected_mm)
