"""Kinds of lenses: exact tracks through a fisheye tell it, and those of a pinhole ask for none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera
from scopemap.engine.mapping.bundle_adjustment import adjust
from scopemap.engine.mapping.bundle_problem import BundleProblem, Priors
from scopemap.engine.mapping.judge import LensTest
from scopemap.engine.mapping.lens import LensKinds, angle_of_radius, lens_test
from scopemap.input.scopes import KINDS
from tests.support.drawn_bundle import FOCAL_PX, LINE, tracked, world

LOOSE = Priors(rotation_rad=10, translation_share=10)


def _tested(kind: str, now: str = "pinhole", factor: float = 1.0) -> LensTest:
    """Return the test of tracks seen through a kind of lens and straightened by another, of `factor` times its f."""

    def lens(kind: str, focal_px: float) -> FisheyeCamera | PinholeCamera:
        plane = PinholeCamera(focal_px, focal_px, 0.0, 0.0, 320, 256)
        return FisheyeCamera(plane, KINDS[kind]) if KINDS[kind] else plane

    def seen(pixel: np.ndarray) -> np.ndarray:
        rays = np.column_stack([pixel / FOCAL_PX, np.ones(len(pixel))])
        picture = lens(kind, FOCAL_PX).project(rays) + rng.normal(0, 0.05, (len(rays), 2))
        return factor * FOCAL_PX * lens(now, factor * FOCAL_PX).unproject(picture)[:, :2]

    rng = np.random.default_rng(11)
    T, points, observations = world(rng)
    points, observations = (replace(one, pixel=seen(one.pixel)) for one in (points, observations))
    problem = BundleProblem(tracked(T, rng), points, observations, LOOSE, LINE, factor * FOCAL_PX)
    solution = adjust(problem).state
    return LensKinds(KINDS, KINDS[now]).better_than(lens_test(problem, solution), problem, solution)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "factor"), [("equidistant fisheye", 1.0), ("orthographic fisheye", 1.3)])
def test_a_fisheye_that_is_taken_for_a_pinhole_is_told(kind: str, factor: float) -> None:
    found = _tested(kind, factor=factor)
    assert found.kind == kind
    assert found.log_focal == pytest.approx(-np.log(factor), abs=0.03)
    assert found.contradicts


@pytest.mark.slow
def test_a_pinhole_stays_one() -> None:
    found = _tested("pinhole")
    assert found.kind == ""
    assert not found.contradicts


def test_another_focal_length_of_the_present_fisheye_is_told() -> None:
    found = _tested("orthographic fisheye", now="orthographic fisheye", factor=1.2)
    assert found.kind == ""
    assert found.log_focal == pytest.approx(-np.log(1.2), abs=0.02)
    assert found.contradicts


@pytest.mark.parametrize("kind", list(KINDS))
def test_angles_are_those_of_the_lens(kind: str) -> None:
    plane = PinholeCamera(1.0, 1.0, 0.0, 0.0, 2, 2)
    lens = FisheyeCamera(plane, KINDS[kind]) if KINDS[kind] else plane
    ray = lens.unproject(np.array([0.7, 0.0]))
    assert angle_of_radius(KINDS[kind], 0.7) == pytest.approx(np.arctan(ray[0]), abs=1e-5)
