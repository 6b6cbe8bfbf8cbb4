"""Distances and areas on a surface against closed forms, a plane and a cylinder; `scopemap measure` in a drawn tube."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from scopemap.apps.measure.measure import Measure
from scopemap.engine.geometry.surface_measures import SurfacePoint, area_inside, meet_surface, path_length
from tests.support.drawn_run import CAMERA, FRAMES, IN_RESULT, draw_run
from tests.support.front_door import call, refused

RADIUS = 10.0


def sheet(side: int, place: Callable[[np.ndarray, np.ndarray], list[np.ndarray]]) -> trimesh.Trimesh:
    """A grid of side x side vertices, bent by a function of u, v in 0..1."""
    u, v = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side)))
    here = np.arange(side * side).reshape(side, side)
    a, b, c, d = here[:-1, :-1], here[:-1, 1:], here[1:, 1:], here[1:, :-1]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    return trimesh.Trimesh(np.stack(place(u, v), axis=-1), faces, process=False)


PLANE = sheet(31, lambda u, v: [10 * u, 10 * v, np.full_like(u, 20)])
CYLINDER = sheet(61, lambda u, v: [RADIUS * np.cos(3 * u), RADIUS * np.sin(3 * u), 20 * v])


def met(mesh: trimesh.Trimesh, origin: list[float], direction: list[float]) -> SurfacePoint:
    found = meet_surface(mesh, np.array(origin, float), np.array(direction, float))
    assert found is not None
    return found


def test_a_ray_meets_the_nearest_triangle_in_front() -> None:
    both = trimesh.util.concatenate([PLANE, PLANE.copy().apply_translation([0, 0, 5])])
    found = met(both, [1.0, 2.0, 0.0], [0.1, 0.0, 2.0])
    np.testing.assert_allclose(found.position, [2, 2, 20], atol=1e-9)
    assert found.face < len(PLANE.faces)
    assert met(both, [1.0, 2.0, 22.0], [0, 0, 1]).position[2] == pytest.approx(25)
    assert meet_surface(both, np.zeros(3), np.array([0.0, 0, -1])) is None
    assert meet_surface(both, np.array([-1.0, 0, 0]), np.array([0.0, 0, 1])) is None


@pytest.mark.parametrize("end", [(8.3, 7.1), (8.0, 0.7), (0.5, 9.2), (1.15, 2.05), (1.01, 2.01)])
def test_a_path_on_a_plane_is_straight(end: tuple[float, float]) -> None:
    points = [met(PLANE, [x, y, 0], [0, 0, 1]) for x, y in ((1.0, 2.0), end)]
    exact = np.hypot(end[0] - 1, end[1] - 2)
    assert exact * (1 - 1e-9) <= path_length(PLANE, *points) <= 1.011 * exact


@pytest.mark.parametrize(("a", "b"), [((0.2, 1), (2.5, 17)), ((0.2, 3), (2.9, 4)), ((1, 1), (1.1, 19))])
def test_a_path_on_a_cylinder_is_straight_when_unrolled(a: tuple[float, float], b: tuple[float, float]) -> None:
    points = [met(CYLINDER, [0, 0, z], [np.cos(angle), np.sin(angle), 0]) for angle, z in (a, b)]
    exact = np.hypot(RADIUS * (b[0] - a[0]), b[1] - a[1])
    assert path_length(CYLINDER, *points) == pytest.approx(exact, rel=0.012)


def test_no_path_leads_over_a_gap() -> None:
    parts = trimesh.util.concatenate([PLANE, PLANE.copy().apply_translation([12, 0, 0])])
    assert path_length(parts, met(parts, [5, 5, 0], [0, 0, 1]), met(parts, [15, 5, 0], [0, 0, 1])) == np.inf


def test_the_area_of_a_polygon_is_that_of_what_is_seen_in_it() -> None:
    tilted = sheet(21, lambda u, v: [40 * u - 20, 40 * v - 20, 60 + 20 * u])
    corners = np.array([[-5.0, -6, 0], [7, -6, 0], [7, 3, 0], [1, -2, 0], [-5, 3, 0]])  # with a notch
    corners[:, 2] = 70 + corners[:, 0] / 2
    flat = 12 * 9 - 12 * 5 / 2
    found = area_inside(tilted, CAMERA.project(corners), CAMERA, np.eye(4))
    assert found == pytest.approx(flat * np.hypot(1, 0.5), rel=0.02)
    # What is hidden behind something does not count.
    hidden = trimesh.util.concatenate([tilted, sheet(9, lambda u, v: [4 * u - 2, 4 * v - 2, np.full_like(u, 10)])])
    assert area_inside(hidden, CAMERA.project(corners), CAMERA, np.eye(4)) < 0.9 * flat
    outside = np.array([[200.0, 200], [210, 200], [210, 210]])
    assert area_inside(tilted, outside, CAMERA, np.eye(4)) == 0


@pytest.mark.parametrize("side_mm", [0.5, 5.0, 20.0])
def test_the_area_does_not_depend_on_the_size_of_the_triangles(side_mm: float) -> None:
    wall = sheet(2, lambda u, v: [400 * u - 200, 400 * v - 200, np.full_like(u, 50)])
    corners = np.array([[0.0, 0, 50], [side_mm, 0, 50], [side_mm, side_mm, 50], [0, side_mm, 50]])
    found = area_inside(wall, CAMERA.project(corners), CAMERA, np.eye(4))
    assert found == pytest.approx(side_mm**2, rel=0.01)


# ---- the command, in a tube of radius 10 mm seen from its axis


def pixel(angle: float, z: float) -> str:
    """Where frame 0 sees a point of the tube's wall."""
    u, v = CAMERA.project(np.array([RADIUS * np.cos(angle), RADIUS * np.sin(angle), z]))
    return f"{u:.6f},{v:.6f}"


def pixels(*places: tuple[float, float]) -> str:
    return " ".join(pixel(angle, z) for angle, z in places)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_run(tmp_path_factory.mktemp("measure") / "run")


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_run(
        tmp_path_factory.mktemp("measure") / "run", scale={"known": True, "measured": True, "source": "measured depth"}
    )


def measured(capfd: pytest.CaptureFixture[str], run: Path, points: str, *more: object) -> dict[str, Any]:
    capfd.readouterr()
    assert call("measure", run, "--frame", 0, "--points", points, "--json", *more) == 0
    return {one["what"]: one for one in json.loads(capfd.readouterr().out)}


A, B = (0.3, 30.0), (1.6, 22.0)
STRAIGHT = float(np.hypot(2 * RADIUS * np.sin((1.6 - 0.3) / 2), 8))
ALONG = float(np.hypot(RADIUS * (1.6 - 0.3), 8))


def test_distances_on_a_run_of_known_scale(known: Path, capfd: pytest.CaptureFixture[str]) -> None:
    found = measured(capfd, known, pixels(A, B))
    for what, exact in (("straight", STRAIGHT), ("along the surface", ALONG)):
        one = found[what]
        assert one["value"] == pytest.approx(exact, rel=0.015)
        assert one["unit"] == "mm"
        # The interval has the scale's 2 % in it, the pixels' and the depth's errors; all of them are small here.
        assert 0.04 * exact < one["high"] - one["low"] < 0.35 * exact
        assert one["low"] < exact < one["high"]


def test_the_area_of_a_patch_of_the_tube(known: Path, capfd: pytest.CaptureFixture[str]) -> None:
    angles = np.linspace(0.4, 1.9, 16)
    outline = [*((angle, 20.0) for angle in angles), *((angle, 32.0) for angle in angles[::-1])]
    (one,) = measured(capfd, known, pixels(*outline)).values()
    assert (one["what"], one["unit"]) == ("area", "mm2")
    assert str(Measure("area", 40.0, 30.0, 50.0, "mm2")) == "area: 40 mm² (30 to 50)"
    assert one["value"] == pytest.approx(RADIUS * 1.5 * 12, rel=0.03)
    assert one["low"] < RADIUS * 1.5 * 12 < one["high"]


def test_an_unknown_scale_gives_no_bare_number(run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    said = refused(capfd, "measure", run, "--frame", 0, "--points", pixels(A, B))
    assert "scale unknown" in said
    assert "reference" in said
    reference = pixels((2.5, 25.0), (3.5, 25.0))
    length = 2 * RADIUS * np.sin(0.5)
    ratio = measured(capfd, run, pixels(A, B), "--reference", reference)["straight"]
    assert ratio["unit"] == "times the reference"
    assert ratio["value"] == pytest.approx(STRAIGHT / length, rel=0.015)
    mm = measured(capfd, run, pixels(A, B), "--reference", reference, "--reference-mm", 5)
    assert mm["straight"]["unit"] == "mm"
    assert mm["straight"]["value"] == pytest.approx(5 * STRAIGHT / length, rel=0.015)
    assert mm["along the surface"]["value"] == pytest.approx(5 * ALONG / length, rel=0.015)
    assert call("measure", run, "--frame", 0, "--points", pixels(A, B, (1.0, 18.0)), "--reference", reference) == 0
    assert "times the reference's square (" in capfd.readouterr().out


def test_what_is_less_certain_has_a_wider_interval(
    tmp_path: Path, known: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def width(folder: Path, places: str = pixels(A, B)) -> float:
        one = measured(capfd, folder, places)["straight"]
        return (one["high"] - one["low"]) / one["value"]

    camera = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    scale = {"known": True, "source": "near-far 5:80 mm"}
    stated = draw_run(tmp_path / "stated", scale=scale)
    assumed = draw_run(
        tmp_path / "assumed", scale=scale, camera=camera | {"source": "assumed: 70 deg", "origin": "assumed"}
    )
    assert width(known) < width(stated) < width(assumed)
    near = ((0.3, 30.0), (0.5, 30.0))  # two pixels apart
    assert width(known, pixels(*near)) > 2 * width(known)
    for file in (stated / "depth").iterdir():
        file.unlink()  # nothing is known of the frames' depth: 5 % instead of what they differ by
    before = measured(capfd, known, pixels(A, B))["straight"]
    after = measured(capfd, stated, pixels(A, B))["straight"]
    assert after["high"] - after["low"] > before["high"] - before["low"]


def test_what_cannot_be_measured_is_refused(known: Path, capfd: pytest.CaptureFixture[str]) -> None:
    def said(frame: int, points: str) -> str:
        return refused(capfd, "measure", known, "--frame", frame, "--points", points)

    assert "it is in maps/1" in said(FRAMES - 1, "10,10 20,20")
    assert "it has no pose" in said(IN_RESULT, "10,10 20,20")
    assert (
        "no surface at pixel 200,10 of frame 0 (its rectified picture has 80x64 px); the nearest with a surface is"
        in said(0, "10,10 200,10")
    )
    assert call("measure", known, "--frame", 0, "--points", "10,10") == 2
    assert call("measure", known, "--frame", 0, "--points", "10;10 20,20") == 2
    assert call("measure", known, "--frame", 0, "--points", "10,10 20,20", "--reference", "1,1") == 2
    capfd.readouterr()
    assert "give both" in refused(capfd, "measure", known, "--frame", 0, "--points", "10,10 20,20", "--reference-mm", 5)
