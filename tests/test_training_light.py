"""Light, paint and camera of the training pictures: laws that hold whatever was drawn."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_buffers import WIDTH, sphere

from training.light import draw_light, shade
from training.samples import make_sample


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
