"""A phantom's lamp of a narrow beam, and an omentum that is near and dark in front of a lit wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.engine.errors import SettingsError
from scopemap_bench.phantom.march import rays_of
from scopemap_bench.phantom.render import Phantom, light, prepare
from scopemap_bench.phantom.shading import beam, shade
from scopemap_bench.phantom.spec import PhantomSpec, parse_events

SPEC = PhantomSpec("tube", 5, 64, 48, fov_deg=60, seed=21, noise=0.0)
OPEN = PhantomSpec("abdominal_wall", 5, 64, 48, fov_deg=45, route="sideways", seed=21, omentum_mm=40)


@pytest.fixture(scope="module")
def tube() -> Phantom:
    return prepare(SPEC)


def test_a_beam_falls_as_a_gaussian_of_the_angle_on_tissue_and_on_instruments(tube: Phantom) -> None:
    spec = replace(SPEC, events=parse_events("instrument:0-4"))
    plain = light(replace(tube, spec=spec), 2)[0]
    narrow = light(replace(tube, spec=replace(spec, beam_deg=24.0)), 2)[0]
    rays = rays_of(SPEC.camera)
    angle_deg = np.degrees(np.arccos(rays[..., 2] / np.linalg.norm(rays, axis=-1)))
    np.testing.assert_allclose(narrow, plain * 0.5 ** ((angle_deg / 12.0) ** 2)[..., None], rtol=1e-4)
    assert (plain > 0).mean() > 0.8


def test_half_of_the_beam_is_half_as_wide_as_told() -> None:
    camera = PhantomSpec(width=91, height=91, fov_deg=90).camera
    sent = beam(camera, 60.0)
    column = 45 + round(camera.central.fx * np.tan(np.radians(30)))
    assert isinstance(sent, np.ndarray)
    assert sent[45, 45] == 1.0
    assert sent[45, column] == pytest.approx(0.5, abs=0.01)


def test_without_a_beam_nothing_is_changed(tube: Phantom) -> None:
    assert (SPEC.beam_deg, SPEC.omentum_mm) == (None, 0)
    assert beam(SPEC.camera, None) == 1.0
    surface = light(tube, 2)[1]
    albedo, film = np.full((48, 64, 3), 0.3, np.float32), np.ones((48, 64), np.float32)
    looks = surface, albedo, 0 * albedo, film, SPEC.camera
    np.testing.assert_array_equal(shade(*looks, 0.1, beam(SPEC.camera, None)), shade(*looks, 0.1))


def test_what_light_is_scattered_reaches_beside_the_beam(tube: Phantom) -> None:
    narrow = replace(SPEC, beam_deg=10.0)
    dark, scattered = (light(replace(tube, spec=replace(narrow, indirect=share)), 2)[0] for share in (0.0, 0.15))
    assert scattered[0, 0].max() > 10 * dark[0, 0].max()
    assert scattered.max() < 1.2 * dark.max()


@pytest.mark.slow
def test_an_omentum_is_near_and_dark_at_the_lower_edge_and_leaves_the_wall() -> None:
    phantom = prepare(OPEN)
    narrow, surface = light(replace(phantom, spec=replace(OPEN, beam_deg=24.0)), 2)
    wide, _ = light(phantom, 2)
    # Away from it the wall is as plane as without it.
    assert np.ptp(surface.depth_mm[:20]) < 0.1 * np.median(surface.depth_mm[:20])
    assert np.median(surface.depth_mm[40:]) < 0.75 * np.median(surface.depth_mm[:20])
    edge, middle = (np.median(narrow[rows, 26:38].max(-1)) for rows in (slice(40, 48), slice(20, 28)))
    assert edge < 0.4 * middle
    # Its albedo alone makes it no brighter than the wall, though it is nearer.
    assert np.median(wide[40:].max(-1)) < np.median(wide[20:28].max(-1))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"beam_deg": 3}, "beam_deg must be between 5 and 170"),
        ({"beam_deg": 180}, "beam_deg"),
        ({"beam_deg": "wide"}, "cannot use 'wide'"),
        ({"omentum_mm": -1}, "omentum_mm must be between 0 and 45"),
        ({"omentum_mm": 46}, "omentum_mm"),
        ({"omentum_mm": 20, "scene": "colon"}, "open cavity"),
    ],
)
def test_lamps_and_organs_that_cannot_be_are_refused(settings: dict[str, object], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        OPEN.with_settings(settings)
