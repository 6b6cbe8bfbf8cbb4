"""The benchmark's figures are looked at by their pixels: bars as long as their values, points where they agree."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import trimesh

from scopemap.report.mesh_figures import ESTIMATE_COLOUR, TRUTH_COLOUR
from scopemap_bench.pictures import (
    BAR_COLOUR,
    draw_ate,
    draw_displacements,
    draw_frames_until_contradicted,
    draw_frames_until_loss,
)
from scopemap_bench.scene_pictures import draw_depth_change, draw_reconstruction
from tests.support.picture_colours import is_colour, read

NAN = float("nan")


def bar_lengths(picture: np.ndarray, colour: str = BAR_COLOUR) -> list[int]:
    """The lengths, px, of the bars of a colour from top to bottom, of one panel."""
    rows = is_colour(picture, colour).sum(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (rows > 8).astype(int), [0]])))
    return [int(rows[top:bottom].max()) for top, bottom in zip(edges[::2], edges[1::2], strict=True)]


def grid(values: list[list[float]]) -> pd.DataFrame:
    """Sequences s0, s1, ... by methods a, b, ..."""
    return pd.DataFrame(values, [f"s{i}" for i in range(len(values))], list("abcdefghi")[: len(values[0])])


def test_bars_are_as_long_as_their_values(tmp_path: Path) -> None:
    draw_ate(grid([[1.0, 4.0, 2.0]]), tmp_path / "ate.png", alignment="sim3")
    lengths = np.array(bar_lengths(read(tmp_path / "ate.png")))
    np.testing.assert_allclose(lengths / lengths[1], [0.25, 1.0, 0.5], atol=0.02)
    assert lengths[1] > 150


def test_every_displacement_is_a_bar(tmp_path: Path) -> None:
    values_mm = {"ours": np.array([1.0, 4.0, NAN, 2.0]), "none": np.full(4, NAN), "empty": np.empty(0)}
    draw_displacements(values_mm, tmp_path / "bars.png", bar="match", where="world")
    lengths = np.array(bar_lengths(read(tmp_path / "bars.png").transpose(1, 0, 2)))
    np.testing.assert_allclose(lengths / lengths[1], [0.25, 1.0, 0.5], atol=0.03)


def test_methods_that_hold_to_the_end_are_green(tmp_path: Path) -> None:
    frames = grid([[90.0, 45.0, 90.0]])
    draw_frames_until_loss(frames, [90], tmp_path / "loss.png")
    picture = read(tmp_path / "loss.png")
    kept, lost = bar_lengths(picture, ESTIMATE_COLOUR), bar_lengths(picture)
    assert len(kept) == 2
    assert len(lost) == 1
    assert lost[0] / kept[0] == pytest.approx(0.5, abs=0.02)
    with pytest.raises(ValueError, match="lengths"):
        draw_frames_until_loss(frames, [90, 80], tmp_path / "bad.png")


def test_frames_until_contradicted_are_bars_and_lines_over_the_limits(tmp_path: Path) -> None:
    frames = grid([[80.0, 40.0, 20.0], [NAN, NAN, NAN]])
    low, high = frames / 2, frames.clip(upper=60.0) + 20.0
    draw_frames_until_contradicted(frames, low, high, tmp_path / "until.png", limits="1 to 8 px")
    picture = read(tmp_path / "until.png")
    shown, left_out = np.array_split(picture, 2, axis=1)
    lengths = np.array(bar_lengths(shown))
    np.testing.assert_allclose(lengths / lengths[0], [1.0, 0.5, 0.25], atol=0.03)
    assert bar_lengths(left_out) == []


def test_depth_changes_share_one_scale(tmp_path: Path) -> None:
    image = np.full((40, 60, 3), (250, 0, 250), np.uint8)
    flat = np.full((40, 60), 30.0)
    jumpy, unknown = (flat, flat + np.linspace(0, 10, 60)), (flat, np.full_like(flat, NAN))
    depths = {"MAPIS": (flat, flat), "plain": jumpy, "lost": unknown}
    tissue = (np.ones(flat.shape, bool),) * 2
    draw_depth_change({"frame 1": image, "frame 2": image}, tissue, depths, tmp_path / "depth.png")
    picture = read(tmp_path / "depth.png")
    frame_px = is_colour(picture, "#fa00fa").sum() / 2
    turbo = cv2.applyColorMap(np.array([[0, 255]], np.uint8), cv2.COLORMAP_TURBO)[0, :, ::-1]
    none, most = ("#" + bytes(colour.tolist()).hex() for colour in turbo)
    # Near depths are red, as the largest differences are; a difference of 0 is blue; black is unknown.
    assert is_colour(picture, most).sum() > 3.9 * frame_px
    assert is_colour(picture, none).sum() > 0.9 * frame_px
    assert is_colour(picture, "#000000").sum() > 1.9 * frame_px


def test_a_reconstruction_shows_estimate_green_and_truth_red(tmp_path: Path) -> None:
    truth = np.linspace(0, 1, 30)[:, None] * [20.0, 5.0, 40.0]
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0).apply_translation([0.0, 0.0, 60.0])
    for name, true_mm in (("same", truth), ("alone", None)):
        draw_reconstruction(ball, truth, true_mm, tmp_path / f"{name}.png", np.eye(4))
    same, alone = read(tmp_path / "same.png"), read(tmp_path / "alone.png")
    # The truth is the broader line below: it shows beside an estimate that lies on it.
    assert is_colour(same, ESTIMATE_COLOUR).sum() > 500
    assert is_colour(same, TRUTH_COLOUR).sum() > 500
    assert is_colour(alone, ESTIMATE_COLOUR).sum() > 500
    assert is_colour(alone, TRUTH_COLOUR).sum() == 0


def test_a_box_of_the_surface_is_enlarged(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0).apply_translation([0.0, 0.0, 60.0])
    shown = {}
    for zoom in ((0.5, 0.5, 0.2), (0.1, 0.1, 0.2)):
        draw_reconstruction(ball, np.zeros((2, 3)), None, tmp_path / "mesh.png", np.eye(4), zoom)
        picture = read(tmp_path / "mesh.png")
        assert is_colour(picture, BAR_COLOUR).sum() > 300
        shown[zoom[0]] = float((picture[-460:, -460:] < 250).mean())
    assert shown[0.5] > 0.9 > 0.1 > shown[0.1]
