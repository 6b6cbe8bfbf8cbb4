"""How a phantom's tissue moves: by the closed form, on the surface, in the depth, with a tip; cuts, and smoke."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap.engine.errors import SettingsError
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.decoding import read_decoded
from scopemap_bench.phantom.instrument import instrument
from scopemap_bench.phantom.motion import Grasp, Push, TissueMotion, contractions, insufflated
from scopemap_bench.phantom.render import Phantom, prepare, render_frame
from scopemap_bench.phantom.shading import veil
from scopemap_bench.phantom.slit import in_wound
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import DISPLACEMENT, write_phantom

pytestmark = pytest.mark.slow

FRAMES = 13
MOVED = {
    "several": PhantomSpec(deform=True, breath_frames=8.0, events=parse_events("peristalsis:0-12")),
    "rebound": PhantomSpec(scene="laparoscopy", events=parse_events("rebound:1-9")),
    "grasp": PhantomSpec(scene="laparoscopy", deform=True, breath_frames=9.0, events=parse_events("grasp:0-12")),
}


def _small(name: str) -> PhantomSpec:
    return MOVED[name].with_settings({"width": 96, "height": 80, "frames": FRAMES, "seed": 4})


@pytest.fixture(scope="module", params=MOVED)
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Phantom, Path]:
    folder = tmp_path_factory.mktemp("moved") / request.param
    write_phantom(_small(request.param), folder)
    return prepare(_small(request.param)), folder


def test_the_true_displacement_is_the_closed_form_on_the_surface_and_in_the_depth(
    written: tuple[Phantom, Path],
) -> None:
    phantom, folder = written
    positions = np.load(folder / DISPLACEMENT)["positions_mm"].astype(float)
    assert positions.shape == (FRAMES, 1000, 3)
    assert np.linalg.norm(positions - positions[0], axis=-1).max() > 2.0
    camera = phantom.spec.camera
    for index in (0, 5, 9):
        rest = positions[index] - phantom.motion.at(index).at(positions[index])
        np.testing.assert_allclose(rest, positions[0] - phantom.motion.at(0).at(positions[0]), atol=2e-4)
        assert np.abs(phantom.volume.values_at(rest)[0]).max() < 1e-3
        depth_mm = read_decoded(folder / f"{index:04d}_depth.tiff") * phantom.spec.depth_scale_mm
        local = transform(inverse(phantom.poses[index]), positions[index])
        column, row = np.rint(camera.project(local)).T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        ahead = local[inside, 2] / depth_mm[row[inside].astype(int), column[inside].astype(int)]
        # Some points are behind others; a pixel is wide where they meet.
        known = ahead[np.isfinite(ahead)]
        assert np.mean(np.abs(known - 1) < 0.01) > 0.5
        assert np.mean(known < 0.97) < 0.04


def test_tissue_that_is_held_stays_at_the_tip_and_swings_back() -> None:
    phantom = prepare(_small("grasp"))
    grasp = next(part for part in phantom.motion.parts if isinstance(part, Grasp))
    for time in (3.0, 4.6, 6.0, 8.5):
        held = phantom.motion.at(time).move(grasp.point_mm[None])[0]
        tool = instrument(time, 0, 12, True, 4, (held, grasp.holds(time)))
        assert grasp.holds(time)
        assert tool is not None
        assert np.linalg.norm(tool.ends[2, 1] - tool.ends[3, 1]) < 2.0
        assert np.linalg.norm(tool.ends[2:, 1].mean(0) - held) < 0.1
        alone = grasp.at(time).move(grasp.point_mm[None])[0] - grasp.point_mm
        np.testing.assert_allclose(alone, grasp.at(time).bumps[0, 3:6], atol=1e-6)
    assert np.linalg.norm(grasp.at(6.0).bumps[0, 3:6]) == pytest.approx(8.0)
    assert (grasp.holds(1.0), grasp.holds(9.5)) == (False, False)
    assert np.linalg.norm(grasp.at(12.0).bumps[0, 3:6]) < 0.05


def test_a_push_that_is_let_go_passes_its_place_and_comes_to_rest() -> None:
    part = prepare(_small("rebound")).motion.parts[0]
    assert isinstance(part, Push)
    strength = [float(part.at(t).waves[0, 3:6] @ part.full.waves[0, 3:6]) / 36.0 for t in np.linspace(0, 30, 301)]
    assert (max(strength), strength[0]) == (pytest.approx(1.0, abs=0.01), 0)
    assert -0.3 < min(strength) < -0.1
    assert abs(strength[-1]) < 1e-3
    assert np.abs(np.diff(strength)).max() < 0.2


def test_contractions_narrow_the_lumen_and_travel_along_it() -> None:
    part = contractions(0, 200, np.eye(4))
    wall = np.array([[16.0, 0, 20.0], [0, -16.0, 20.0], [-16.0, 0, 20.0]])
    inwards = [part.at(t).at(wall)[:, :2] @ [1, 0] for t in (100.0, 130.0)]
    assert inwards[0][0] == pytest.approx(-inwards[0][2])
    assert inwards[0][0] * inwards[1][0] < 0
    later = part.at(106.0).at(wall + np.array([0, 0, 7.0]))
    np.testing.assert_allclose(later, part.at(100.0).at(wall), atol=1e-9)
    assert np.abs(later[:, 2]).max() < 1e-12
    assert all(np.abs(part.at(t).at(wall)).max() < 1e-12 for t in (-1.0, 0.0, 200.0, 250.0))


def test_a_cut_parts_the_tissue_and_stretches_nothing_across(tmp_path: Path) -> None:
    settings = {"scene": "laparoscopy", "width": 160, "height": 128, "frames": 3, "seed": 3}
    spec = PhantomSpec(events=parse_events("cut:0-2")).with_settings(settings)
    phantom = prepare(spec)
    motion, slits = phantom.motion.at(2), phantom.motion.at(2).slits
    centre, across = slits[0, :3], slits[0, 3:6]
    beside = centre + np.array([[-0.01], [0.01], [-30.0], [30.0]]) * across
    gaps = [np.diff(phantom.motion.at(time).move(beside)[:2], axis=0) @ across for time in (0, 2)]
    assert gaps[0] == pytest.approx(0.02)
    assert gaps[1] == pytest.approx(4.4, abs=0.1)
    assert np.abs(motion.move(beside) - beside)[2:].max() < 0.1
    _, surface = render_frame(phantom, 2)
    seen = transform(phantom.poses[2], spec.camera.rays.astype(float) * surface.depth_mm[..., None])
    wound = in_wound(slits, surface.rest_mm)
    assert 30 < wound.sum() < 400
    known = np.isfinite(surface.depth_mm)
    rest = surface.rest_mm.astype(float)
    assert np.abs(phantom.volume.values_at(rest[known & ~wound])[0]).max() < 1e-3
    np.testing.assert_allclose(motion.move(rest[known & ~wound]), seen[known & ~wound], atol=5e-3)
    below = -phantom.volume.values_at(rest[wound])[0]
    assert (below.min() > -0.01, 2.0 < below.max() < 3.6) == (True, True)
    write_phantom(spec, tmp_path / "cut")
    first, last = (trimesh.load(tmp_path / f"cut/mesh_truth/000{n}.ply", process=False) for n in (0, 2))
    np.testing.assert_array_equal(first.faces, last.faces)
    sides = [mesh.edges_unique_length for mesh in (first, last)]
    assert (sides[1] / sides[0]).max() < 1.6
    assert np.isfinite(np.load(tmp_path / "cut" / DISPLACEMENT)["positions_mm"]).all()


def test_a_veil_hides_what_is_far_more_than_what_is_near_and_clears() -> None:
    light = np.full((40, 50, 3), 0.05, np.float32)
    distance = np.where(np.arange(50) < 25, 30.0, 90.0) * np.ones((40, 1))
    near, far = (veil(light, distance, 0.5, 20.0)[:, columns].mean() for columns in (slice(25), slice(25, 50)))
    assert 0.05 < near < far < 0.45
    np.testing.assert_allclose(veil(light, distance, 0.0, 3.0), light, atol=1e-6)
    drifted = veil(light, distance, 0.5, 20.0) - veil(light, distance, 0.5, 30.0)
    assert np.abs(drifted).max() > 0.02


def test_only_one_cut_is_possible() -> None:
    with pytest.raises(SettingsError, match="one cut at most"):
        PhantomSpec(events=parse_events("cut:1-2,cut:5-6"))


def test_insufflated_tissue_is_wider_across_the_view_alone() -> None:
    turn = np.linspace(0, 2 * np.pi, 9)
    ring_mm = np.column_stack([15 * np.cos(turn), 15 * np.sin(turn), np.full(9, 40.0)])
    moved = TissueMotion((), insufflated(0.05, np.eye(4))).at(3.0).move(ring_mm)
    assert np.linalg.norm(moved[:, :2], axis=1) / 15 == pytest.approx(1.05, abs=0.004)
    assert moved[:, 2] == pytest.approx(40)
