"""Light, paint and camera of the training pictures: laws that hold whatever was drawn."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_buffers import WIDTH, sphere

from training import sensor
from training.light import INSTRUMENT, draw_light, shade
from training.samples import make_sample
from training.sensor import field_of_view, take_picture


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


def test_a_wet_wall_mirrors_the_lamp_where_it_faces_it():
    wall, light = sphere(), _plain_light()
    wet = light._replace(gloss=np.ones(8), coat=np.array([200.0, 2.0, 5.0, 0.0, 0.0]))
    assert (shade(wall, wet, 0.0)[24, 32] / shade(wall, wet, 0.0).min() >= 1).all()
    dull = replace(wall, normal=np.roll(wall.normal, 20, axis=1))
    # Averted facets mirror nothing: only the diffuse part is left.
    ratio = shade(dull, wet, 0.0)[24, 32] / shade(dull, light, 0.0)[24, 32]
    assert ratio == pytest.approx(ratio[0] * np.ones(3), rel=1e-3)


def test_instruments_are_grey_or_bluish_whatever_the_tissue():
    tints = np.stack([draw_light(np.random.default_rng(n)).tints[INSTRUMENT] for n in range(40)])
    assert (tints[:, 0] < 1.3 * tints[:, 2]).all()
    assert (np.ptp(tints, axis=1) < 0.8 * tints.mean(1)).all()


def test_equal_generators_give_equal_samples_and_others_do_not():
    wall = sphere()
    a, b, c = (make_sample(wall, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert (a.rgb == b.rgb).all()
    assert np.array_equal(a.log_distance, b.log_distance, equal_nan=True)
    assert (a.rgb != c.rgb).any()


def test_flipped_rays_still_belong_to_their_pixels():
    wall = sphere()
    for seed in range(12):
        sample = make_sample(wall, np.random.default_rng(seed))
        # The principal point is near the middle: rays left of it lean left, above it up.
        assert (sample.rays[:, :20, 0] < 0).all()
        assert (sample.rays[:, 50:, 0] > 0).all()
        assert (sample.rays[:15, :, 1] < 0).all()
        assert np.linalg.norm(sample.rays, axis=-1) == pytest.approx(1, abs=1e-5)


def test_colours_mixed_anew_leave_grey_grey_and_some_colours_none():
    spreads = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        grey = np.full((2, 3, 3), 0.4, np.float32)
        assert sensor._recoloured(grey, rng) == pytest.approx(grey, abs=1e-5)
        red = np.full((2, 3, 3), [0.6, 0.2, 0.1], np.float32)
        mixed = sensor._recoloured(red, np.random.default_rng(seed))
        assert (mixed >= 0).all()
        spreads.append(float(np.ptp(mixed[0, 0])))
    assert min(spreads) < 0.2 < np.median(spreads)


def test_strange_patches_are_smooth_and_darken_as_often_as_they_brighten():
    factors = np.stack([sensor._stranger(64, 80, np.random.default_rng(seed)) for seed in range(40)])
    assert factors.min() > 0.2
    assert factors.max() < 5
    assert np.log(factors).mean() == pytest.approx(0, abs=0.05)
    assert 0.05 < np.log(factors).std() < 0.4
    steps = np.abs(np.diff(np.log(factors), axis=2))
    assert np.percentile(steps, 99) < 0.15
    colour = np.ptp(np.log(factors), axis=-1)
    assert colour.mean() < 0.3 * np.abs(np.log(factors)).mean()


def test_pictures_are_bright_enough_and_some_saturate():
    pictures = [
        take_picture(shade(sphere(), draw_light(np.random.default_rng(n)), 0.2), np.random.default_rng(n))[0]
        for n in range(60)
    ]
    medians = np.array([np.median(rgb.max(-1)) for rgb in pictures])
    assert (medians > 12).mean() > 0.9
    assert 0.03 < np.mean([(rgb.max(-1) >= 250).mean() > 0.05 for rgb in pictures]) < 0.8


def test_outside_the_field_of_view_there_is_no_truth_and_no_light():
    for seed in range(30):
        sample = make_sample(sphere(), np.random.default_rng(seed))
        outside = ~np.isfinite(sample.log_distance)
        if outside.sum() > 50:
            assert np.median(sample.rgb[outside].max(-1)) < 60
            return
    pytest.fail("no field of view was drawn in 30 pictures")


def test_fields_of_view_leave_most_of_the_picture():
    shares = [field_of_view(96, 128, np.random.default_rng(n)).mean() for n in range(100)]
    assert min(shares) > 0.3
    assert max(shares) == 1.0


def test_nothing_strange_is_drawn_where_nothing_strange_is_wanted(monkeypatch):
    drawn = []

    def counted(light, *others):
        drawn.append(len(others))
        return 1.0 if len(others) == 2 else light

    for name in ("_stranger", "_recoloured"):
        monkeypatch.setattr(sensor, name, counted)
    light = np.full((48, 64, 3), 1.0, np.float32)
    for strange, least, most in ((False, 0, 0), (True, 10, 50)):
        drawn.clear()
        for n in range(40):
            take_picture(light, np.random.default_rng(n), strange=strange)
        for effect in (1, 2):
            assert least <= drawn.count(effect) <= most
