"""What happens on a phantom's way: turns, contact with the wall, instruments, pushed tissue, fluid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.geometry.se3 import inverse, rotation_angle_rad
from scopemap_bench.phantom.camera_path import turned
from scopemap_bench.phantom.instrument import Capsules, insert
from scopemap_bench.phantom.render import Phantom, light, prepare
from scopemap_bench.phantom.spec import PhantomSpec, parse_events

SMALL = {"width": 64, "height": 48}


def phantom(events: str, frames: int = 30, scene: str = "colon") -> Phantom:
    return prepare(PhantomSpec(scene=scene, frames=frames, seed=5, events=parse_events(events), **SMALL))  # type: ignore[arg - type]


def turns_deg(poses: np.ndarray) -> np.ndarray:
    return np.degrees(rotation_angle_rad((inverse(poses[:-1]) @ poses[1:])[:, :3, :3]))


def test_a_turn_is_30_degrees_and_stays() -> None:
    poses = np.broadcast_to(np.eye(4), (20, 4, 4))
    cut = turned(poses, 8, 8)
    np.testing.assert_allclose(turns_deg(cut), np.where(np.arange(19) == 7, 30.0, 0.0), atol=1e-5)
    slow = turned(poses, 4, 9)
    assert turns_deg(slow).max() < 9
    assert turns_deg(slow)[[0, 1, 2, 9, 10]].max() < 1e-4
    np.testing.assert_allclose(turned(cut, 12, 15, back=True)[15:], poses[15:], atol=1e-12)
    np.testing.assert_array_equal(slow[:, :3, 3], 0)


def test_contact_comes_to_4_mm_of_the_wall_and_goes_back() -> None:
    touching, plain = phantom("contact:6-20"), phantom("")
    space_mm = touching.volume.values_at(touching.poses[:, :3, 3])[0]
    assert 4.0 <= space_mm.min() < 4.6
    assert 12 <= space_mm.argmin() <= 14
    np.testing.assert_allclose(touching.poses[[5, 21]], plain.poses[[5, 21]], atol=1e-9)
    assert turns_deg(touching.poses).max() < 20


@pytest.mark.parametrize("scene", ["colon", "laparoscopy"])
def test_an_instrument_comes_and_goes_and_hides_the_depth_behind_it(scene: str) -> None:
    with_tool = phantom("instrument:4-24", scene=scene)
    without = replace(with_tool, spec=replace(with_tool.spec, events=()))
    hidden = []
    for index in (3, 8, 14, 24, 25):
        (radiance, surface), (bare, tissue) = light(with_tool, index), light(without, index)
        tool = np.isnan(surface.depth_mm) & np.isfinite(tissue.depth_mm)
        np.testing.assert_array_equal(radiance[~tool], bare[~tool])
        np.testing.assert_array_equal(surface.depth_mm[~tool], tissue.depth_mm[~tool])
        hidden.append(tool.mean())
    assert hidden[0] == hidden[4] == 0
    assert 0.02 < hidden[2] < 0.4
    assert hidden[3] < hidden[2]


def test_a_ray_meets_a_capsule_at_its_radius() -> None:
    seen = phantom("")
    _, surface = light(seen, 0)
    camera, ends = seen.spec.camera, np.array([[3.0, -2.0, 9.0], [-2.0, 1.0, 14.0]])
    far = replace(surface, distance_mm=np.full_like(surface.distance_mm, 1e3))
    inserted = []
    for radius in (1.5, 1.6):
        tool = Capsules(ends[None], np.array([radius]), np.ones((1, 3)))
        inserted.append(np.isnan(insert(tool, np.zeros((48, 64, 3), np.float32), far, camera)[1].depth_mm))
    # A ray meets it where it passes the segment at no more than the radius.
    rays = camera.rays / np.linalg.norm(camera.rays, axis=-1, keepdims=True)
    share = np.linspace(0, 1, 2001)[:, None]
    points = ends[0] + share * (ends[1] - ends[0])
    passes = np.min([np.linalg.norm(np.cross(rays, point), axis=-1) for point in points[::10]], axis=0)
    assert inserted[0].sum() > 50
    assert not (inserted[0] & (passes > 1.501)).any()
    assert not ((passes < 1.499) & ~inserted[0]).any()
    assert inserted[1].sum() > inserted[0].sum()


def test_pushed_tissue_moves_two_ways_and_stays_so() -> None:
    pushed = phantom("push:5-15", scene="laparoscopy")
    right, down, ahead = pushed.poses[5, :3, :3].T
    middle = pushed.poses[5, :3, 3] + 60 * ahead
    points = np.stack([middle - 25 * right, middle, middle + 25 * right])
    moved = [pushed.motion.at(time).at(points) @ down for time in (0, 5, 10, 15, 29)]
    np.testing.assert_allclose(moved[:2], 0, atol=1e-9)
    np.testing.assert_allclose(moved[4], moved[3])
    np.testing.assert_allclose(moved[2], 0.5 * moved[3])
    assert moved[3][0] < -4
    assert moved[3][2] > 4
    assert abs(moved[3][1]) < 1e-9
