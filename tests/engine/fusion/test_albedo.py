"""Colours of the tissue: a wall of known albedo under a lamp at the camera, in pictures with sRGB's tone curve."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import FusionSettings
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import compare_rendering, lit_like
from scopemap.engine.fusion.surface_fusion import TsdfVolume
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import se3

CAMERA = PinholeCamera(100.0, 100.0, 79.5, 59.5, 160, 120)
TILT = np.array([-0.5, 0.0, np.sqrt(0.75)])  # normal of the wall normal . X = 40: one side near, one far
PINK = np.array([0.8, 0.4, 0.4])


def _shot(x_mm: float = 0.0, exposure: float = 1.0, albedo: np.ndarray = PINK, spot_px: int = 0) -> Frame:
    """See the wall from (x, 0, 0); light falls with cosine / distance^2; a saturated spot is at the centre."""
    T = se3(np.eye(3), np.array([x_mm, 0.0, 0.0]))
    plane_mm = 40.0 - x_mm * TILT[0]
    depth_mm = plane_mm / (CAMERA.rays @ TILT)
    distance_mm = depth_mm * np.linalg.norm(CAMERA.rays, axis=-1)
    light = exposure * plane_mm / distance_mm * (40.0 / distance_mm) ** 2
    level = 255 * np.clip(0.5 * light[..., None] * albedo, 0, 1) ** (1 / 2.2)
    rgb = np.round(level).astype(np.uint8)
    if spot_px:
        rgb[60 - spot_px : 60 + spot_px, 80 - spot_px : 80 + spot_px] = 255
    return Frame(0, 0.0, rgb, CAMERA, np.ones(rgb.shape[:2], bool), depth_mm.astype(np.float32), T)


def _fused(frames: list[Frame], colours: str = "albedo") -> trimesh.Trimesh:
    settings = FusionSettings(voxel_mm=1.0, truncation_mm=4.0, max_depth_mm=200.0, colours=colours)
    volume = TsdfVolume(settings)
    for frame in frames:
        volume.integrate(frame)
    return volume.extract_mesh()


def _spread(mesh: trimesh.Trimesh) -> float:
    """Ratio of the bright to the dark end of the mesh's grey levels."""
    low, high = np.percentile(np.asarray(mesh.visual.vertex_colors)[:, :3].mean(axis=1), [3, 97])
    return float(high / low)


def test_the_far_side_is_as_bright_as_the_near_one_and_the_hue_stays() -> None:
    frames = [_shot()]
    mesh = _fused(frames)
    raw = _spread(_fused(frames, "raw"))
    assert raw > 2.0
    # The model is damped: cosines count little, and the light is bounded.
    assert _spread(mesh) < raw**0.5
    colours = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(float)
    assert colours[:, 0] / colours[:, 1] == pytest.approx(2 ** (1 / 2.2), rel=0.05)
    # As bright as the video.
    assert np.median(colours.mean(axis=1)) == pytest.approx(np.median(frames[0].rgb.mean(axis=-1)), rel=0.05)


def test_exposures_are_equalised_where_frames_overlap() -> None:
    frames = [_shot(x_mm, exposure) for x_mm, exposure in ((0, 1.0), (12, 0.4), (24, 1.0), (36, 0.4))]
    unlike, alike = [(_spread(_fused(frames, colours))) for colours in ("raw", "albedo")]
    assert alike < unlike**0.5
    # The same wall in one exposure.
    assert alike < 1.1 * _spread(_fused([_shot(x_mm) for x_mm in (0, 12, 24, 36)]))


def test_a_saturated_view_does_not_paint_what_another_saw() -> None:
    mesh = _fused([_shot(spot_px=8), _shot(), _shot(spot_px=8)])
    clean = _fused([_shot()] * 3)
    assert len(mesh.vertices) == len(clean.vertices)
    difference = np.abs(np.asarray(mesh.visual.vertex_colors, float) - np.asarray(clean.visual.vertex_colors))
    assert difference.max() <= 8
    # Alone it is better than nothing.
    assert (np.asarray(_fused([_shot(spot_px=8)]).visual.vertex_colors)[:, :3] > 120).any()


def test_a_rendering_is_lit_again_before_it_is_compared() -> None:
    frames = [_shot(0.0, 1.0), _shot(10.0, 0.5)]
    mesh = _fused(frames)
    for frame in frames:
        unlit = render_mesh(mesh, frame.camera, frame.T_world_camera)
        view = lit_like(unlit, frame.camera, frame.rgb, frame.depth_mm)
        shown = np.isfinite(view.depth_mm)
        # The tone curve and the bounds are not the model's exactly.
        assert np.abs(view.rgb.astype(float) - frame.rgb)[shown].mean() < 8
        lit_ssim, unlit_ssim = (compare_rendering(seen, frame.rgb, frame.depth_mm).ssim for seen in (view, unlit))
        assert lit_ssim > unlit_ssim + 0.005
