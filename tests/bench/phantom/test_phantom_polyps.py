"""Polyps on a phantom's wall: as large as asked for, nearer than the wall, in the masks that are written beside it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.errors import InputError, SettingsError
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec, Polyp, parse_polyps
from scopemap_bench.phantom.writer import write_phantom

pytestmark = pytest.mark.slow

PLAIN = PhantomSpec(frames=3, width=128, height=96, seed=203)
SPEC = PhantomSpec(
    frames=3, width=128, height=96, seed=203, polyps=parse_polyps("sessile:8@1,flat:6@2,pedunculated:6@0")
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("polyps") / "out"
    write_phantom(SPEC, folder)
    return folder


def test_true_sizes_are_about_those_asked_for(folder: Path) -> None:
    truth = json.loads((folder / "lesions" / "truth.json").read_text())
    for one, polyp in zip(truth, SPEC.polyps, strict=True):
        assert one["kind"] == polyp.kind
        assert 0.75 * polyp.diameter_mm < one["diameter_mm"] < 1.35 * polyp.diameter_mm
        assert 0.65 < one["cross_diameter_mm"] / one["diameter_mm"] < 1
        assert one["area_mm2"] > 0.7 * one["diameter_mm"] * one["cross_diameter_mm"] * np.pi / 4
    heights = [one["height_mm"] for one in truth]
    assert heights == pytest.approx([3.6, 1.5, 6.6], rel=0.25)


def test_polyps_stand_before_the_wall_and_are_redder(folder: Path) -> None:
    (rgb, surface), (plain_rgb, plain) = (render_frame(prepare(spec), 1) for spec in (SPEC, PLAIN))
    masks = [np.asarray(cv2.imread(str(folder / "lesions" / str(n) / "0001.png"), 0)) for n in (1, 2, 3)]
    inside = np.any([mask > 0 for mask in masks], axis=0)
    assert all((mask > 0).sum() > 20 for mask in masks)
    nearer = plain.distance_mm - surface.distance_mm
    assert np.nanmin(nearer[inside]) > 0
    far = cv2.dilate(inside.astype(np.uint8), np.ones((9, 9))) == 0
    np.testing.assert_allclose(nearer[far], 0, atol=0.05)
    red = [picture[inside].astype(float).mean(axis=0) for picture in (rgb, plain_rgb)]
    assert red[0][1] / red[0][0] < 0.9 * red[1][1] / red[1][0]


def test_a_phantom_without_them_writes_no_masks(folder: Path) -> None:
    write_phantom(PhantomSpec(frames=1, width=32, height=32), folder)
    assert not list(folder.glob("lesions/**/*.*"))


def test_polyps_are_read_from_text() -> None:
    assert parse_polyps(" sessile:8@30, flat:12.5@60") == (Polyp("sessile", 8.0, 30), Polyp("flat", 12.5, 60))
    assert parse_polyps("") == ()
    with pytest.raises(SettingsError, match="expected KIND:MM@FRAME"):
        parse_polyps("round:8@30")
    with pytest.raises(SettingsError, match="14 at most"):
        PhantomSpec(polyps=(Polyp("pedunculated", 20.0, 1),))
    with pytest.raises(InputError, match="no room for the polyp 1"):
        prepare(PhantomSpec(frames=2, width=32, height=32, polyps=(Polyp("flat", 25.0, 1),)))
