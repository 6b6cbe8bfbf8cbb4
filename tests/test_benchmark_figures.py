"""The benchmark's figures are looked at by their pixels: bars as long as their values, paths where they project."""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.geometry.se3 import se3, so3_exp
from scopemap.report.benchmark_figures import (
    BAR_COLOUR,
    BarGrid,
    draw_ate,
    draw_displacement_bars,
    draw_displacement_scatter,
    draw_frames_until_loss,
    draw_matched_points,
)
from scopemap.report.canvas import ESTIMATE_COLOUR, TRUTH_COLOUR
from scopemap.report.depth_panels import DepthScene, draw_depth_differences
from scopemap.report.mesh_view import draw_path, inside_view, outside_views, render_mesh
from scopemap.report.reconstruction_view import draw_reconstruction, view_from_behind

NAN = float("nan")


def read(file: Path) -> np.ndarray:
    return cv2.imread(str(file))[..., ::-1]


def is_colour(picture: np.ndarray, colour: str, within: int = 12) -> np.ndarray:
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return np.asarray(np.abs(picture.astype(int) - rgb).max(-1) < within)


def bar_lengths(picture: np.ndarray, colour: str = BAR_COLOUR) -> list[int]:
    """The lengths, px, of the bars of a colour from top to bottom, of one panel."""
    rows = is_colour(picture, colour).sum(axis=1)
    # A whisker cuts its bar in two.
    filled = cv2.morphologyEx((rows > 8).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 1), np.uint8)).ravel()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], filled.astype(int), [0]])))
    return [int(rows[top:bottom].max()) for top, bottom in zip(edges[::2], edges[1::2], strict=True)]


def ball(radius_mm: float = 10.0, centre_mm: tuple[float, float, float] = (0.0, 0.0, 60.0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius_mm)
    mesh.apply_translation(centre_mm)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=np.tile(np.uint8((120, 120, 220)), (642, 1)))


# ---- bars and points


def test_bars_are_as_long_as_their_values(tmp_path: Path) -> None:
    draw_ate(BarGrid(["colon"], ["a", "b", "c"], np.array([[1.0, 4.0, 2.0]])), tmp_path / "ate.png", alignment="sim3")
    lengths = np.array(bar_lengths(read(tmp_path / "ate.png")))
    np.testing.assert_allclose(lengths / lengths[1], [0.25, 1.0, 0.5], atol=0.02)
    assert lengths[1] > 150


def test_a_method_without_a_value_has_a_word_and_no_bar(tmp_path: Path) -> None:
    values = np.array([[1.0, NAN, 2.0]])
    for name, word in (("failed", "failed"), ("silent", "")):
        draw_ate(BarGrid(["colon"], ["a", "b", "c"], values, absent=word), tmp_path / f"{name}.png", alignment="sim3")
    assert len(bar_lengths(read(tmp_path / "failed.png"))) == 2
    changed = (read(tmp_path / "failed.png") != read(tmp_path / "silent.png")).any(-1)
    assert 20 < changed.sum() < 2000


def test_there_is_a_panel_per_sequence_and_a_bar_per_method(tmp_path: Path) -> None:
    values = np.ones((6, 9))
    draw_ate(BarGrid([f"s{i}" for i in range(6)], list("abcdefghi"), values), tmp_path / "many.png", alignment="se3")
    picture = read(tmp_path / "many.png")
    count, _, sizes, _ = cv2.connectedComponentsWithStats(is_colour(picture, BAR_COLOUR).astype(np.uint8))
    assert (sizes[1:, cv2.CC_STAT_AREA] > 500).sum() == 54
    assert count < 80


def test_methods_that_hold_to_the_end_are_green(tmp_path: Path) -> None:
    frames = BarGrid(["colon"], ["a", "b", "c"], np.array([[90.0, 45.0, 90.0]]))
    draw_frames_until_loss(frames, [90], tmp_path / "loss.png")
    picture = read(tmp_path / "loss.png")
    kept, lost = bar_lengths(picture, ESTIMATE_COLOUR), bar_lengths(picture)
    assert len(kept) == 2
    assert len(lost) == 1
    assert lost[0] / kept[0] == pytest.approx(0.5, abs=0.02)
    with pytest.raises(ValueError, match="lengths"):
        draw_frames_until_loss(frames, [90, 80], tmp_path / "bad.png")


def test_displacement_bars_have_whiskers_and_medians(tmp_path: Path) -> None:
    mean, spread = np.array([[1.0, 2.0]]), np.array([[3.0, 0.5]])
    grid = BarGrid(["colon"], ["plain depth", "MAPIS"], mean, spread)
    draw_displacement_bars(grid, 0.5 * mean, tmp_path / "with.png", where="world")
    with_whiskers = read(tmp_path / "with.png")
    first, second = bar_lengths(with_whiskers)
    # The longest whisker ends at 4 mm, which leaves the bar of 1 mm a quarter of what a bar of 4 mm would have.
    assert second / first == pytest.approx(2.0, abs=0.1)
    draw_displacement_bars(BarGrid(["colon"], grid.methods, mean), 0.5 * mean, tmp_path / "bare.png", where="world")
    assert bar_lengths(read(tmp_path / "bare.png"))[1] > 1.5 * second
    with pytest.raises(ValueError, match="median_mm"):
        draw_displacement_bars(grid, np.ones((2, 2)), tmp_path / "bad.png", where="world")


def test_bar_grids_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"BarGrid\.values"):
        BarGrid(["a"], ["x", "y"], np.ones((2, 1)))
    with pytest.raises(ValueError, match=r"BarGrid\.spreads"):
        BarGrid(["a"], ["x"], np.ones((1, 1)), np.ones((1, 2)))
    with pytest.raises(ValueError, match="at least one"):
        BarGrid([], [], np.ones((0, 0)))


def test_scatters_share_their_scale(tmp_path: Path) -> None:
    low, high = np.full(40, 1.0), np.full(40, 3.0)
    draw_displacement_scatter({"low": low, "high": high}, tmp_path / "two.png", where="world")
    picture = read(tmp_path / "two.png")
    half = picture.shape[1] // 2
    sides = (picture[:, :half], picture[:, half:])
    heights = [np.median(np.nonzero(is_colour(side, "#d95f02", within=60))[0]) for side in sides]
    assert heights[0] > heights[1] + 60
    draw_displacement_scatter({"none": np.full(5, NAN), "low": low}, tmp_path / "none.png", where="camera")
    with pytest.raises(ValueError, match="at least one"):
        draw_displacement_scatter({}, tmp_path / "bad.png", where="world")


def test_matched_points_that_agree_hide_each_other(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(30, 50, (500, 3))
    for name, offset in (("same", 0.0), ("apart", 4.0)):
        draw_matched_points({name: (points, points + offset)}, tmp_path / f"{name}.png")
    blue = [is_colour(read(tmp_path / f"{name}.png"), BAR_COLOUR).sum() for name in ("same", "apart")]
    # The current points are drawn over the previous ones.
    assert blue[0] < 0.6 * blue[1]
    draw_matched_points({"none": (np.empty((0, 3)), np.empty((0, 3)))}, tmp_path / "none.png")
    with pytest.raises(ValueError, match="current points of x"):
        draw_matched_points({"x": (points, points[:3])}, tmp_path / "bad.png")
    with pytest.raises(ValueError, match="at least one"):
        draw_matched_points({}, tmp_path / "bad.png")


def test_figures_leave_the_backend_alone(tmp_path: Path) -> None:
    before = matplotlib.get_backend(auto_select=False)
    draw_ate(BarGrid(["a"], ["x"], np.ones((1, 1))), tmp_path / "x.png", alignment="none")
    assert matplotlib.get_backend(auto_select=False) == before


# ---- depth


def test_depth_differences_share_one_scale(tmp_path: Path) -> None:
    image = np.full((40, 60, 3), (250, 0, 250), np.uint8)
    flat = np.full((40, 60), 30.0)
    ramp = flat + np.linspace(0, 10, 60)
    steady, jumpy, unknown = (flat, flat), (flat, ramp), (flat, np.full_like(flat, NAN))
    scene = DepthScene("colon", (image, image), {"MAPIS": steady, "plain": jumpy, "lost": unknown})
    draw_depth_differences([scene, scene], tmp_path / "depth.png")
    picture = read(tmp_path / "depth.png")
    # Each scene shows its two frames.
    assert is_colour(picture, "#fa00fa").sum() > 4 * 150 * 100
    no_change, most = "#ffffcc", "#800026"
    assert is_colour(picture, no_change).sum() > 2 * 150 * 100
    assert is_colour(picture, most).sum() > 100
    # Black are the unknown depth and its difference in both scenes: as many panels as there are frames.
    assert is_colour(picture, "#000000").sum() > 0.9 * is_colour(picture, "#fa00fa").sum()
    draw_depth_differences([DepthScene("colon", (image, image), {"MAPIS": steady})], tmp_path / "steady.png")
    assert is_colour(read(tmp_path / "steady.png"), no_change).sum() > 150 * 100


def test_depth_scenes_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    with pytest.raises(ValueError, match="depth of plain"):
        DepthScene("colon", (image, image), {"plain": (np.ones((4, 6)), np.ones((6, 4)))})
    with pytest.raises(ValueError, match="at least one method"):
        DepthScene("colon", (image, image), {})
    with pytest.raises(ValueError, match="at least one scene"):
        draw_depth_differences([], tmp_path / "bad.png")


# ---- paths over meshes


def test_a_path_is_drawn_where_it_projects() -> None:
    view = inside_view(np.eye(4))
    picture = render_mesh(ball(), view)
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


def test_the_mesh_does_not_hide_the_path() -> None:
    view = inside_view(np.eye(4))
    picture = render_mesh(ball(), view)
    draw_path(picture, view, np.array([[-5.0, 0.0, 90.0], [5.0, 0.0, 90.0]]), TRUTH_COLOUR)
    middle = picture[view.camera.height // 2, view.camera.width // 2]
    assert is_colour(middle[None], TRUTH_COLOUR).all()


def test_what_lies_behind_the_view_is_cut_off() -> None:
    view = inside_view(np.eye(4))
    white = np.full((view.camera.height, view.camera.width, 3), 255, np.uint8)
    behind, through = white.copy(), white.copy()
    draw_path(behind, view, np.array([[0.0, 0.0, -5.0], [3.0, 0.0, -1.0]]), ESTIMATE_COLOUR)
    assert (behind == 255).all()
    draw_path(through, view, np.array([[1.0, 0.0, -5.0], [1.0, 0.0, 50.0]]), ESTIMATE_COLOUR)
    rows, columns = np.nonzero(is_colour(through, ESTIMATE_COLOUR))
    # From the edge of the picture, where it enters, to where 1 mm at 50 mm projects; and no line back across.
    end_px = view.camera.cx + view.camera.fx / 50
    assert columns.max() == view.camera.width - 1
    assert columns.min() == pytest.approx(end_px, abs=3)
    assert np.ptp(rows) <= 3


def test_outside_views_hold_the_path_too() -> None:
    path = np.array([[0.0, 0.0, -200.0], [NAN] * 3, [50.0, 0.0, 0.0]])
    for view in outside_views(ball(), np.eye(4), path):
        local = (path[[0, 2]] - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, :3]
        pixels = view.camera.project(local)
        assert (local[:, 2] > 0).all()
        assert pixels.min() >= 0
        assert pixels.max() <= view.camera.width - 1
    assert len(outside_views(trimesh.Trimesh(), None, np.full((3, 3), NAN))) == 2


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


def test_a_reconstruction_shows_estimate_green_and_truth_red(tmp_path: Path) -> None:
    t = np.linspace(0, 1, 30)[:, None]
    truth = t * [20.0, 5.0, 40.0]
    draw_reconstruction(ball(), truth + np.array([0.0, 6.0, 0.0]), truth, tmp_path / "both.png", np.eye(4))
    draw_reconstruction(ball(), truth, truth, tmp_path / "same.png", np.eye(4))
    draw_reconstruction(ball(), truth, None, tmp_path / "alone.png")
    both, same, alone = (read(tmp_path / f"{name}.png") for name in ("both", "same", "alone"))
    assert both.shape[1] > alone.shape[1] > 800
    for picture in (both, same):
        assert is_colour(picture, ESTIMATE_COLOUR).sum() > 500
        # The truth is the broader line below: it shows beside an estimate that lies on it.
        assert is_colour(picture, TRUTH_COLOUR).sum() > 500
    assert is_colour(both, TRUTH_COLOUR).sum() > is_colour(same, TRUTH_COLOUR).sum()
    assert is_colour(alone, ESTIMATE_COLOUR).sum() > 500
    assert is_colour(alone, TRUTH_COLOUR).sum() == 0
    assert (is_colour(both, "#7878dc") | ((both[..., 2] > 60) & (both[..., 0] < 0.7 * both[..., 2]))).sum() > 3000


def test_a_reconstruction_of_nothing_is_white(tmp_path: Path) -> None:
    lost = np.full((4, 3), NAN)
    draw_reconstruction(trimesh.Trimesh(), lost, lost, tmp_path / "nothing.png", np.eye(4))
    assert (read(tmp_path / "nothing.png") > 250).mean() > 0.95
