"""The preset `paper-strict`: each of its settings really turns off what `paper` does beyond the paper's text."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from plane_scene import CAMERA, EVERYWHERE, pose, see
from small_networks import saved, small_depth_anything, small_depth_pro
from tiny_phantom import FRAMES, only_images, write_tiny

from scopemap import Config, open_sequence, reconstruct
from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.rectification import Rectifier
from scopemap.config import PRESETS, FusionSettings
from scopemap.depth.anchor import AnchoredDepth
from scopemap.depth.correspondence import DenseMatcher
from scopemap.depth.create import create_depth
from scopemap.depth.estimate import DepthEstimate, PerceptualResult
from scopemap.depth.mapis import Mapis
from scopemap.depth.shading import ShadingDepth
from scopemap.flow.create import create_flow
from scopemap.flow.estimator import FlowPair
from scopemap.frame import Frame
from scopemap.fusion.volume import TsdfVolume
from scopemap.geometry.se3 import se3, so3_exp
from scopemap.masking.mask_files import create_masks
from scopemap.masking.masker import Masker
from scopemap.odometry import Step
from scopemap.tracking.pyramid import build_pyramid
from scopemap.tracking.rtdl import align
from scopemap.tracking.tracker import Tracker

PAPER, STRICT = Config.load("paper"), Config.load("paper-strict")
BEYOND = {key: value for key, value in PRESETS["paper-strict"].items() if PRESETS["paper"].get(key) != value}
WITHOUT_DOWNLOADS = {"networks.flow": "dis", "networks.perceptual": "structure"}
NARROW = PinholeCamera(800.0, 800.0, 39.5, 29.5, 80, 60)


def test_the_document_lists_every_setting_of_the_preset() -> None:
    text = (Path(__file__).parents[1] / "docs" / "method.md").read_text()
    section = text.split("## Beyond the paper, in the `paper` preset")[1].split("\n## ")[0]
    assert set(re.findall(r"`([a-z]+\.[a-z_.]+) = ", section)) >= set(BEYOND)


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


def test_the_working_size_is_the_inputs(tmp_path: Path) -> None:
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((600, 900, 3), 50 * number, np.uint8))
    widths = [open_sequence(tmp_path, settings=config.input).camera.width for config in (PAPER, STRICT)]
    assert widths == [300, 900]


def _frame(rgb: np.ndarray, depth_mm: np.ndarray | None = None, T: np.ndarray | None = None) -> Frame:
    height, width = rgb.shape[:2]
    camera = CAMERA if (height, width) == (CAMERA.height, CAMERA.width) else NARROW
    return Frame(0, 0.0, rgb, camera, np.ones((height, width), bool), depth_mm, T)


def test_no_pixel_is_masked(tmp_path: Path) -> None:
    rgb = see(np.eye(4)).rgb.copy()
    rgb[:, :40] = 0
    rgb[60:70, 100:110] = 255
    assert not Masker(PAPER.mask)(_frame(rgb)).valid.all()
    assert Masker(STRICT.mask)(_frame(rgb)).valid.all()
    cv2.imwrite(str(tmp_path / "0000.png"), np.full((60, 80), 255, np.uint8))
    rectifier = Rectifier(NARROW, NARROW)
    for config, used in ((PAPER, True), (STRICT, False)):
        assert (create_masks(config.mask, rectifier, tmp_path) is not None) == used


def test_the_first_depth_anything_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path))
    owner, name = STRICT.depth.model.split("/")
    saved(small_depth_anything(), tmp_path / f"{owner}--{name}")
    facts = create_depth(STRICT.depth, None, "cpu").provenance()  # type: ignore[arg-type]
    assert facts["model"] == "LiheYoung/depth-anything-small-hf"


def test_far_depth_is_kept() -> None:
    estimate = DepthEstimate(np.full((60, 80), 2000.0, np.float32), "depth")
    for config, known in ((PAPER, False), (STRICT, True)):
        settings = config.depth.model_copy(update={"anchor": "auto"})
        metric = AnchoredDepth(settings, ShadingDepth(settings)).metric(
            estimate, _frame(np.full((60, 80, 3), 90, np.uint8))
        )
        assert np.isfinite(metric.depth_mm).all() == known


@dataclass
class _Inconsistent:
    """A flow whose directions do not agree: both point 3 px to the right."""

    name: str = "stub"

    def estimate_checked(
        self, rgb_from: np.ndarray, rgb_to: np.ndarray, start: FlowPair | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        flow = np.zeros((*rgb_from.shape[:2], 2), np.float32)
        flow[..., 0] = 3.0
        return flow, flow


class _Alike:
    name = "stub"

    def compare(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> PerceptualResult:
        return PerceptualResult(np.zeros(rgb_a.shape[:2], np.float32), 0.0)


def test_flow_is_not_rejected_forward_and_backward() -> None:
    rgb = see(np.eye(4)).rgb
    shares = []
    for config in (PAPER, STRICT):
        matcher = DenseMatcher(config.mapis, _Inconsistent(), _Alike())  # type: ignore[arg-type]
        matcher.match(rgb, EVERYWHERE)
        link = matcher.match(rgb, EVERYWHERE)
        assert link is not None
        shares.append(link.consistent[:, :-6].mean())
    assert shares == [0.0, 1.0]


def test_an_outlier_counts_as_much_as_any_pixel() -> None:
    """A moving instrument pulls the pose of least squares away; Huber weights hold it."""
    reference, current = see(np.eye(4)), see(pose(at_mm=(1.0, 0.0, 0.0)))
    rgb = current.rgb.copy()
    rgb[40:140, 60:160] = see(pose(at_mm=(4.0, 2.0, 0.0))).rgb[40:140, 60:160]
    errors = []
    for config in (PAPER, STRICT):
        pyramid = build_pyramid(_frame(reference.rgb, reference.depth_mm, np.eye(4)), config.tracking)
        found = align(pyramid, build_pyramid(_frame(rgb), config.tracking), np.eye(4), config.tracking)
        errors.append(np.abs(found.motion.T_current_reference[:3, 3] - [-1.0, 0.0, 0.0]).max())
    assert errors[0] < 0.3
    assert errors[1] > 1.5 * errors[0]


def _second(config: Config, rgb: np.ndarray, valid_rows: int = CAMERA.height) -> Any:
    """Return the track of a picture after a keyframe of the plane."""
    view, tracker = see(np.eye(4)), Tracker(config.tracking)
    first = _frame(view.rgb, view.depth_mm)
    track = tracker.track(first)
    tracker.insert_keyframe(replace(first, T_world_camera=track.T_world_camera), measured=False)
    valid = EVERYWHERE.copy()
    valid[valid_rows:] = False
    return tracker.track(replace(_frame(rgb), index=1, valid=valid))


@pytest.mark.parametrize("fault", ["other picture", "small part"])
def test_no_frame_is_called_lost_for_fitting_badly(fault: str) -> None:
    noise = np.random.default_rng(0).integers(0, 256, see(np.eye(4)).rgb.shape, np.uint8)
    shown = (noise, CAMERA.height) if fault == "other picture" else (see(np.eye(4)).rgb, CAMERA.height // 20)
    assert [_second(config, *shown).status for config in (PAPER, STRICT)] == ["lost", "ok"]


def test_a_jump_is_accepted() -> None:
    """The picture has moved by 12 px."""
    settings = STRICT.tracking.model_copy(
        update={"advanced": STRICT.tracking.advanced.model_copy(update={"max_step": 0.005})}
    )
    rgb = see(pose(at_mm=(4.0, 0.0, 0.0))).rgb
    cautious = STRICT.model_copy(update={"tracking": settings})
    tracks = [_second(config, rgb) for config in (cautious, STRICT)]
    assert [track.status for track in tracks] == ["lost", "ok"]
    assert "jump" in tracks[0].reason


def _wall(distance_mm: float, error_mm: float = 0.0) -> Frame:
    """A camera that sees the world's plane z = 100 mm from a distance, with an error of its depth."""
    grey = np.full((60, 80, 3), 120, np.uint8)
    return _frame(grey, np.full((60, 80), distance_mm + error_mm, np.float32), pose(at_mm=(0, 0, 100 - distance_mm)))


def _fusion(config: Config, **changes: Any) -> FusionSettings:
    return config.fusion.model_copy(update={"voxel_mm": 0.5, "truncation_mm": 3.0} | changes)


def test_every_observation_weighs_the_same_in_the_volume() -> None:
    """Of two views that differ by 2 mm the surface is the mean; by weight it is nearer to that of the near view."""
    levels = []
    for config in (PAPER, STRICT):
        volume = TsdfVolume(_fusion(config))
        for frame in (_wall(40.0), _wall(40.0), _wall(90.0, 1.0), _wall(90.0, 1.0)):
            volume.integrate(frame)
        vertices = volume.extract_mesh().vertices
        middle = np.abs(vertices[:, :2]).max(axis=1) < 1.0
        levels.append(float(np.median(vertices[middle, 2])))
    assert levels[0] < 100.4
    assert levels[1] == pytest.approx(100.5, abs=0.05)


def _slanted_wall(tangent: float, distance_mm: float) -> Frame:
    """A wall whose normal is so far from the optical axis, as the tangent of the angle."""
    normal = se3(so3_exp(np.array([0.0, np.arctan(tangent), 0.0])), np.zeros(3))[:3, 2]
    u, v = np.meshgrid(np.arange(80), np.arange(60))
    rays = NARROW.unproject(np.stack([u, v], -1))
    depth_mm = (distance_mm / (rays @ normal)).astype(np.float32)
    depth_mm[depth_mm <= 0] = np.nan
    return _frame(np.full((60, 80, 3), 120, np.uint8), depth_mm, np.eye(4))


def test_a_far_oblique_wall_seen_once_gives_a_surface() -> None:
    faces = []
    for config in (PAPER, STRICT):
        volume = TsdfVolume(_fusion(config, max_depth_mm=100.0))
        volume.integrate(_slanted_wall(5.0, 18.0))
        faces.append(len(volume.extract_mesh().faces))
    assert faces[0] < 0.5 * faces[1]


def test_a_wall_seen_from_its_edge_is_fused() -> None:
    faces = []
    for config in (PAPER, STRICT):
        volume = TsdfVolume(_fusion(config, max_depth_mm=300.0))
        for _ in range(5):
            volume.integrate(_slanted_wall(14.0, 6.0))
        faces.append(len(volume.extract_mesh().faces))
    assert faces[0] < 0.5 * faces[1]


def test_a_small_piece_stays() -> None:
    frame = _wall(40.0)
    assert frame.depth_mm is not None
    depth_mm = np.where(np.arange(80) < 60, frame.depth_mm, np.nan).astype(np.float32)
    depth_mm[:8, 70:] = 40.0
    pieces = []
    for config in (PAPER, STRICT):
        volume = TsdfVolume(_fusion(config, voxel_mm=0.2, truncation_mm=1.0))
        for _ in range(4):
            volume.integrate(replace(frame, depth_mm=depth_mm))
        pieces.append(len(volume.extract_mesh().split(only_watertight=False)))
    assert pieces == [1, 2]


def test_the_far_wall_is_fused() -> None:
    faces = []
    for config in (PAPER, STRICT):
        volume = TsdfVolume(_fusion(config, voxel_mm=2.0, truncation_mm=10.0))
        for _ in range(3):
            volume.integrate(_wall(200.0))
        faces.append(len(volume.extract_mesh().faces))
    assert faces[0] == 0 < faces[1]


@pytest.mark.parametrize(("blend", "expected_mm"), [("linear", 50.0), ("none", 100.0)])
def test_without_flow_the_previous_depth_is_blended_where_it_was(blend: str, expected_mm: float) -> None:
    """The ablation "- Optical Flow": the previous depth is blended unwarped, unless `mapis.paper.blend = none`."""
    settings = Config.load("paper", settings={"mapis.paper.blend": blend}).mapis
    matcher, mapis, rgb = DenseMatcher(settings, create_flow("none", "cpu"), _Alike()), Mapis(settings), see(pose()).rgb
    for raw_mm in (50.0, 100.0):
        link = matcher.match(rgb, EVERYWHERE)
        refined = mapis.refine(np.full(EVERYWHERE.shape, raw_mm, np.float32), "disparity", CAMERA, link, None)
    assert np.median(refined.depth_mm) == pytest.approx(expected_mm)
