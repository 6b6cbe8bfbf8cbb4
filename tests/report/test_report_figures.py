"""Figures of a run are looked at by their pixels: the right colours in the right places, paths where they project."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap.report.depth_figures import colour_depth
from scopemap.report.mesh_figures import (
    ESTIMATE_COLOUR,
    TRUTH_COLOUR,
    draw_path,
    draw_trajectories,
    inside_view,
    mesh_picture,
    outside_views,
    view_from_behind,
)
from scopemap.report.sheet import Plot, Sheet
from tests.support.picture_colours import is_colour, read

NAN = float("nan")


def count_colour(picture: np.ndarray, colour: str) -> int:
    return int(is_colour(picture, colour).sum())


def coloured_ball(centre_mm: tuple[float, float, float], radius_mm: float, rgb: tuple) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius_mm)
    mesh.apply_translation(centre_mm)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=np.tile(np.uint8(rgb), (len(mesh.vertices), 1)))


BALL = coloured_ball((0.0, 0.0, 60.0), 10.0, (120, 120, 220))


def test_trajectories_show_estimate_green_and_truth_red(tmp_path: Path) -> None:
    t = np.linspace(0, 6, 50)
    estimate = np.stack([np.sin(t), np.cos(t), t], -1) * 10
    estimate[20:25] = np.nan
    draw_trajectories(estimate, estimate + 4.0, tmp_path / "both.png")
    both = read(tmp_path / "both.png")
    assert both.shape[1] > 900
    assert count_colour(both, ESTIMATE_COLOUR) > 500
    assert count_colour(both, TRUTH_COLOUR) > 500
    draw_trajectories(estimate, estimate + 4.0, tmp_path / "runs.png", names=("first", "second"), unit="units")
    assert (read(tmp_path / "runs.png") != both).any()


def test_a_plot_puts_values_where_its_axes_say_and_leaves_gaps() -> None:
    sheet = Sheet(100, 80)
    plot = Plot(sheet, (10.0, 10.0, 80.0, 60.0), (0.0, 8.0), (0.0, 6.0))
    np.testing.assert_allclose(plot.place(np.array([[0.0, 0.0], [8.0, 6.0]])), [[10, 70], [90, 10]])
    sheet.line(plot.place(np.array([[0.0, 3.0], [3.0, 3.0], [np.nan, 3.0], [5.0, 3.0], [8.0, 3.0]])), "#ff0000", 3)
    drawn = count_colour(sheet.rgb[:, 12:38], "#ff0000")
    assert drawn >= 3 * 26
    assert (sheet.rgb[:, 45:55] == 255).all()


@settings(max_examples=20, deadline=None)
@given(st.floats(1, 50), st.floats(1, 100))
def test_depth_colours_are_a_scale(near_mm: float, span_mm: float) -> None:
    depth = np.linspace(near_mm, near_mm + span_mm, 256)[None].astype(np.float32)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_TURBO)[..., ::-1][0].tolist()
    levels = [table.index(colour) for colour in colour_depth(depth, near_mm, near_mm + span_mm)[0].tolist()]
    assert levels[0] == 255  # near is red, here as in the previews and on the page
    assert levels[-1] == 0
    assert (np.diff(levels) <= 0).all()
    # Over the logarithm: the geometric mean has the middle colour.
    middle = np.full((1, 1), np.sqrt(near_mm * (near_mm + span_mm)))
    assert table.index(colour_depth(middle, near_mm, near_mm + span_mm)[0, 0].tolist()) in (127, 128)


def test_unknown_depth_is_black_and_the_range_must_make_sense() -> None:
    depth = np.array([[np.nan, 10.0], [20.0, 500.0]])
    rgb = colour_depth(depth, 10, 100)
    assert rgb.dtype == np.uint8
    assert (rgb[0, 0] == 0).all()
    assert rgb.any(axis=-1).sum() == 3
    with pytest.raises(ValueError, match="beyond"):
        colour_depth(depth, 10, 10)
    with pytest.raises(ValueError, match="beyond 0"):
        colour_depth(depth, 0, 10)


def test_a_ball_is_painted_where_it_projects() -> None:
    view = inside_view(np.eye(4))
    picture = mesh_picture(coloured_ball((10.0, -5.0, 50.0), 8.0, (200, 40, 30)), view)
    painted = (picture != 255).any(-1)
    u, v = np.meshgrid(np.arange(view.camera.width), np.arange(view.camera.height))
    rays = view.camera.unproject(np.stack([u, v], -1))
    centre = np.array([10.0, -5.0, 50.0])
    # A ray hits the ball where its distance from the centre is below the radius.
    miss_mm = np.linalg.norm(np.cross(rays / np.linalg.norm(rays, axis=-1, keepdims=True), centre), axis=-1)
    assert painted[miss_mm < 7.8].all()
    assert not painted[miss_mm > 8.2].any()
    brightest = picture[miss_mm < 7.8].max(axis=0)
    assert brightest[0] > 190
    assert brightest[2] < 35


def test_outside_views_hold_the_whole_mesh() -> None:
    mesh = coloured_ball((300.0, -40.0, 900.0), 55.0, (90, 90, 200))
    for view in outside_views(mesh, se3(np.eye(3), np.array([300.0, -40.0, 900.0]))).values():
        pixels = view.camera.project((mesh.vertices - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, :3])
        assert pixels.min() >= 0
        assert pixels.max() <= view.camera.width - 1
        assert (mesh_picture(mesh, view) != 255).any(-1).mean() > 0.15


def test_a_path_is_drawn_where_it_projects() -> None:
    view = inside_view(np.eye(4))
    picture = mesh_picture(BALL, view)
    path = np.array([[-8.0, 5.0, 40.0], [8.0, 5.0, 40.0], [NAN] * 3, [0.0, -8.0, 40.0], [0.0, -4.0, 40.0]])
    draw_path(picture, view, path, ESTIMATE_COLOUR)
    green = is_colour(picture, ESTIMATE_COLOUR)
    pixels = view.camera.project(path)
    for share in np.linspace(0.02, 0.98, 20):
        for start, end in ((0, 1), (3, 4)):
            u, v = np.round(pixels[start] + share * (pixels[end] - pixels[start])).astype(int)
            assert green[v - 1 : v + 2, u - 1 : u + 2].any()
    rows, columns = np.nonzero(green)
    # The start is a dot.
    assert columns.min() >= pixels[0, 0] - 6
    assert columns.max() <= pixels[1, 0] + 2
    # The gap: nothing between the two stretches but the ball.
    assert not green[int(pixels[4, 1]) + 5 : int(pixels[0, 1]) - 5].any()
    assert (rows.min(), rows.max()) == pytest.approx((pixels[3, 1], pixels[0, 1] + 4), abs=3)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-80, 80)] * 3), min_size=1, max_size=5), st.floats(-3, 3))
def test_a_view_from_behind_holds_every_position(points: list[tuple[float, float, float]], turn_rad: float) -> None:
    T_world_camera = se3(so3_exp(np.array([0.3, turn_rad, -0.2])), np.array([5.0, -3.0, 20.0]))
    positions = np.array([*points, (NAN, NAN, NAN)])
    view = view_from_behind(T_world_camera, positions)
    local = (positions[:-1] - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, :3]
    pixels = view.camera.project(local)
    assert (local[:, 2] > 0).all()
    assert pixels.min() >= 0
    assert pixels.max() <= view.camera.width - 1
