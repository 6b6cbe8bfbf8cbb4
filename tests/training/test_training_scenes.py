"""Training scenes: rays, normals and shadows agree with closed forms; stores are the same whoever renders them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from scopemap.engine.errors import InputError
from training.buffers import Buffers, camera_rays, create_store, decode, encode, open_store
from training.marching import INSTRUMENT, march_rays, shade_shadows, surface
from training.render import render_buffers, render_store
from training.scene import COLON, KINDS, LAPAROSCOPY, SINUS, Scene
from training.shapes import ELLIPSOID, shape_row
from training.viewpoint import random_camera

pytestmark = pytest.mark.slow

SIZE = (32, 40)
CAMERA = np.array([0, 24.0, 24.3, 19.0, 16.2, 40, 32], np.float32)


@pytest.fixture(scope="module")
def frames() -> list[Buffers]:
    return [render_buffers(5, n, SIZE[1], SIZE[0], kind=kind) for kind in KINDS for n in range(6)]


def _ball(radius: float) -> Scene:
    row = shape_row(ELLIPSOID, np.zeros(3), np.eye(3), (radius, radius, radius), solid=False)
    return Scene(kind=SINUS, base=np.array([2.0]), shapes=row[None], seed=1)


def _same(a: Buffers, b: Buffers) -> bool:
    rows = zip(encode(a).values(), encode(b).values(), strict=True)
    return all(x.tobytes() == y.tobytes() for x, y in rows) and a.log_distance.tobytes() == b.log_distance.tobytes()


def test_distances_in_a_ball_agree_with_the_closed_form() -> None:
    eye, rays = np.array([3.0, -4.0, 5.0]), camera_rays(CAMERA)
    found = march_rays(_ball(20.0).arrays(), eye, rays, 0.9, 500.0)
    along = rays @ eye
    np.testing.assert_allclose(found, -along + np.sqrt(along**2 - eye @ eye + 400.0), rtol=3e-4)


def test_a_ball_hides_a_lamp_from_what_lies_behind_it() -> None:
    small = shape_row(ELLIPSOID, np.array([0, 0, 8.0]), np.eye(3), (2.0, 2.0, 2.0), blend=1e-3)
    arrays = Scene(kind=SINUS, base=np.array([2.0]), shapes=np.vstack([_ball(20.0).shapes, small]), seed=1).arrays()
    eye, rays, lamp = np.zeros(3), camera_rays(CAMERA), np.array([3.0, 0.5, 0.0])
    found = march_rays(arrays, eye, rays, 0.9, 500.0)
    normal, part, lit = np.zeros_like(rays), np.zeros(SIZE, np.uint8), np.zeros(SIZE)
    surface(arrays, eye, rays, found, 1 / 24.0, normal, part)
    shade_shadows(arrays, (eye, np.eye(3), CAMERA.astype(float)), (rays, found, normal), lamp, 0.9, 200.0, lit)
    way = found[..., None] * rays - lamp
    length = np.linalg.norm(way, axis=-1)
    near = np.clip(np.einsum("hwc,c->hw", way, np.array([0, 0, 8.0]) - lamp) / length**2, 0, 1)
    miss = np.linalg.norm(lamp + near[..., None] * way - [0, 0, 8.0], axis=-1)
    wall = found > 15.0
    assert np.all(lit[wall & (miss < 1.9)] == 0.0)
    assert np.all(lit[wall & (miss > 2.6)] == 1.0)
    assert (wall & (miss < 1.9)).sum() > 20


@pytest.mark.parametrize("kind", [COLON, LAPAROSCOPY])
def test_the_same_seed_and_index_give_the_same_bytes(kind: int) -> None:
    first, second = (render_buffers(3, 7, 40, 32, kind=kind) for _ in range(2))
    assert _same(first, second)
    assert not _same(first, render_buffers(3, 8, 40, 32, kind=kind))


def test_ranges_hold_for_every_kind(frames: list[Buffers]) -> None:
    for frame in frames:
        known = np.isfinite(frame.log_distance)
        assert known.mean() >= 0.98
        distance = np.exp(frame.log_distance[known])
        assert distance.min() >= 1.999
        assert distance.max() <= 400.1
        low, high = np.percentile(distance, (5, 95))
        assert 1.3 <= high / low <= 20.0
        assert np.abs(frame.noise).max() <= 1.0
        assert frame.part.max() <= INSTRUMENT
        assert (frame.part == INSTRUMENT).mean() <= 0.6
        assert frame.lit.min() >= 0.0
        assert frame.lit.max() <= 1.0
        assert frame.lit[..., 0].mean() > 0.2
        assert np.linalg.norm(np.nan_to_num(frame.lamps_mm), axis=1).max() < 10.0


def test_normals_agree_with_differences_of_the_distances(frames: list[Buffers]) -> None:
    errors = []
    for frame in frames:
        points = np.exp(frame.log_distance)[..., None] * frame.rays
        across = points[1:-1, 2:] - points[1:-1, :-2]
        down = points[2:, 1:-1] - points[:-2, 1:-1]
        normal = -np.cross(across, down)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        given = frame.normal[1:-1, 1:-1]
        assert ((frame.normal * frame.rays).sum(-1)[np.isfinite(frame.log_distance)] < 0.0).all()
        inner = (given * frame.normal[1:-1, 2:]).sum(-1), (given * frame.normal[2:, 1:-1]).sum(-1)
        smooth = minimum_filter(np.minimum(*inner), 3) > 0.995
        errors.append(np.rad2deg(np.arccos(np.clip((normal * given).sum(-1)[smooth], -1, 1))))
    every = np.concatenate(errors)
    assert len(every) > 2500
    assert np.median(every) < 1.5
    assert np.percentile(every, 95) < 8.0


def test_a_row_of_a_store_keeps_a_frame(frames: list[Buffers]) -> None:
    frame = frames[0]
    back = decode(encode(frame))
    np.testing.assert_allclose(back.log_distance, frame.log_distance, atol=6e-5)
    np.testing.assert_allclose(back.normal, frame.normal, atol=0.01)
    np.testing.assert_allclose(back.noise, frame.noise, atol=0.005)
    np.testing.assert_allclose(back.lit, frame.lit, atol=0.003)
    np.testing.assert_array_equal(back.part, frame.part)
    np.testing.assert_allclose(back.rays, frame.rays, atol=1e-6)
    assert (back.kind, back.size) == (frame.kind, frame.size)


def test_an_interrupted_rendering_goes_on_to_the_same_bytes_whatever_the_workers(tmp_path: Path) -> None:
    render_store(tmp_path / "whole", 5, (16, 20), 4, workers=2)
    cut = create_store(tmp_path / "cut", 5, (16, 20))
    cut.put(3, render_buffers(4, 3, 20, 16))
    with pytest.raises(InputError, match="not rendered yet"):
        _ = cut[0]
    seen: list[tuple[int, int]] = []
    render_store(tmp_path / "cut", 5, (16, 20), 4, workers=0, progress=lambda done, count: seen.append((done, count)))
    assert seen == [(5, 5)]
    for name in ("log_distance", "normal", "noise", "part", "lit", "meta", "done"):
        assert (tmp_path / "whole" / f"{name}.npy").read_bytes() == (tmp_path / "cut" / f"{name}.npy").read_bytes()
    assert len(open_store(tmp_path / "whole")) == 5


def test_a_store_of_another_size_is_refused(tmp_path: Path) -> None:
    create_store(tmp_path / "a", 2, (16, 20))
    with pytest.raises(InputError, match="use another folder"):
        render_store(tmp_path / "a", 3, (16, 20), 4)
    with pytest.raises(InputError, match=r"no done\.npy"):
        open_store(tmp_path / "b")


def test_narrow_lenses_are_drawn_in_the_share_asked_for_and_leave_the_others() -> None:
    some, none = (
        [random_camera(np.random.default_rng(n), 160, 128, share) for n in range(300)] for share in (0.2, 0.0)
    )
    narrow = [camera[0] == 0 and 2 * np.degrees(np.arctan(80 / camera[1])) < 50.0 for camera in some]
    assert np.mean(narrow) == pytest.approx(0.2, abs=0.07)
    for number in np.flatnonzero(~np.array(narrow)):
        np.testing.assert_array_equal(some[number], none[number])
