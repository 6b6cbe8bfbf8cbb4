"""Light, paint and camera of the training pictures: laws that hold whatever was drawn."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.drawn_buffers import WIDTH, sphere
from training.light import beam_shares, draw_light, shade
from training.samples import make_sample
from training.scene import COLON, LAPAROSCOPY


def _plain_light():
    light = draw_light(np.random.default_rng(0))
    return light._replace(
        gloss=np.zeros(8), mottling=np.zeros(5), vessels=np.zeros((2, 2)), fall=np.array([2.0, 1.0, 0.0, 0.0])
    )


def test_light_falls_with_the_square_of_the_distance():
    near = sphere(20.0)
    far = np.log(40.0)
    half = replace(near, log_distance=np.where(np.arange(WIDTH) < 32, near.log_distance, far).astype(np.float32))
    light = shade(half, _plain_light(), bounce=0.0)
    assert light[:, 10] == pytest.approx(4 * light[:, 50], rel=1e-4)


def test_light_falls_with_the_cosine_of_incidence():
    wall = sphere()
    tilted = wall.normal.copy()
    # Turn the right half's normals by 60 degrees about the vertical.
    c, s = np.cos(np.pi / 3), np.sin(np.pi / 3)
    rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    tilted[24, 40] = wall.normal[24, 40] @ rotation.T
    light = shade(replace(wall, normal=tilted.astype(np.float32)), _plain_light(), bounce=0.0)
    expected = max(-float(tilted[24, 40] @ wall.rays[24, 40]), 0)
    assert light[24, 40] == pytest.approx(expected * light[24, 41], rel=1e-3)


def test_shadow_and_nothing_are_dark():
    wall = sphere()
    lit, log_distance = wall.lit.copy(), wall.log_distance.copy()
    lit[5, 5], log_distance[6, 6] = 0, np.nan
    light = shade(replace(wall, lit=lit, log_distance=log_distance), _plain_light(), bounce=0.0)
    assert not light[5, 5].any()
    assert not light[6, 6].any()
    assert light[7, 7].all()


def test_bounced_light_only_adds():
    wall = sphere()
    direct, both = (shade(wall, _plain_light(), bounce) for bounce in (0.0, 0.5))
    assert (both >= direct).all()
    assert both.mean() > 1.05 * direct.mean()


def test_equal_generators_give_equal_samples_and_others_do_not():
    wall = sphere()
    a, b, c = (make_sample(wall, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert (a.rgb == b.rgb).all()
    assert np.array_equal(a.log_distance, b.log_distance, equal_nan=True)
    assert (a.rgb != c.rgb).any()


def test_outside_the_field_of_view_there_is_no_truth_and_no_light():
    for seed in range(30):
        sample = make_sample(sphere(), np.random.default_rng(seed))
        outside = ~np.isfinite(sample.log_distance)
        if outside.sum() > 50:
            assert np.median(sample.rgb[outside].max(-1)) < 60
            return
    pytest.fail("no field of view was drawn in 30 pictures")


def _angles(rays, axis):
    return np.arccos(np.clip(rays @ axis, -1, 1))


@pytest.mark.parametrize(("tilt", "steepness"), [((0.0, 0.0), 2.0), ((0.3, -0.2), 2.0), ((0.0, 0.0), 7.0)])
def test_a_beam_falls_with_the_angle_to_its_own_axis(tilt, steepness):
    wall = sphere()
    widest = _angles(wall.rays, np.array([0, 0, 1])).max()
    beams = np.array([[*tilt, 0.5, steepness, 0.05]] * 2)
    narrow, even = (shade(wall, _plain_light()._replace(beams=b), 0.0) for b in (beams, _plain_light().beams))
    turned, angle = widest * np.array(tilt), widest * np.hypot(*tilt)
    axis = np.array([*(turned * np.sinc(angle / np.pi)), np.cos(angle)])
    expected = 0.05 + 0.95 * 0.5 ** ((_angles(wall.rays, axis) / (0.5 * widest)) ** steepness)
    share = narrow[..., 0] / even[..., 0]
    # Brightness is told by the median of the picture.
    assert share == pytest.approx(expected * share.max() / expected.max(), rel=2e-3)
    assert beam_shares(wall.rays, beams) == pytest.approx(expected, rel=2e-3)


def test_near_tissue_is_darker_and_instruments_are_not():
    wall = sphere(40.0)
    log_distance = np.where(np.arange(WIDTH) < 20, np.log(20.0), wall.log_distance).astype(np.float32)
    part = np.where(np.arange(48)[:, None] < 10, 7, wall.part).astype(np.uint8)
    stepped = replace(wall, log_distance=log_distance, part=part)
    plain = _plain_light()._replace(near=np.zeros(3), tints=np.full((8, 3), 0.5))
    dark = plain._replace(near=np.array([0.8, -0.3, 0.02]))
    before, after = (shade(stepped, light, 0.0)[..., 0] for light in (plain, dark))
    assert before[30, 10] == pytest.approx(4 * before[30, 40], rel=1e-3)
    assert after[30, 10] == pytest.approx(4 * 0.2 * after[30, 40], rel=1e-3)
    assert after[5, 10] == pytest.approx(4 * after[30, 40], rel=1e-3)


def test_beams_and_dark_near_tissue_are_drawn_seldom_and_change_no_other_draw():
    open_ones, closed = (
        [draw_light(np.random.default_rng(n), kind) for n in range(400)] for kind in (LAPAROSCOPY, COLON)
    )
    for lights, beamed, darkened in ((open_ones, 0.3, 0.2), (closed, 0.1, 0.04)):
        assert np.mean([np.isfinite(light.beams[0, 2]) for light in lights]) == pytest.approx(beamed, abs=0.07)
        assert np.mean([light.near[0] > 0 for light in lights]) == pytest.approx(darkened, abs=0.06)
    for one, other in zip(open_ones, closed, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one[:-2], other[:-2], strict=True))
    first = [np.random.default_rng(3) for _ in range(2)]
    draw_light(first[0], LAPAROSCOPY)
    draw_light(first[1], COLON)
    assert first[0].random() == first[1].random()
