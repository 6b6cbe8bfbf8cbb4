"""The surface in the window: its colours, what they mean, where clicks meet it, and which frames saw a place."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from scopemap.apps.browser.result_page import ResultPage
from scopemap.apps.browser.seen_by import frames_that_saw
from scopemap.apps.browser.shown_surface import ShownSurface, SurfacePick
from scopemap.apps.browser.surface_colours import colourings, depth_differences, in_relief
from scopemap.apps.browser.unlit_mesh import before_tone_mapping, unlit_glb, unlit_textured_glb
from scopemap.apps.coverage.coverage import coverage
from scopemap.engine.fusion.open_glb import OpenGlb
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.geometry.srgb import LINEAR, srgb_picture
from scopemap.report.pale_parts import PALE, faded
from scopemap.report.shown_mesh import in_texture
from scopemap.result.result import Result
from tests.support.drawn_run import CAMERA, IN_RESULT, draw_run, draw_textured_run, pose_of, tube
from tests.support.shown_window import shown_window

FRAME = 4


def tone_mapped(linear: np.ndarray) -> np.ndarray:
    """What three.js' filmic tone mapping (ACESFilmicToneMapping, r170) makes of linear colours (N, 3), written anew."""
    into = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
    back = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
    v = (linear / 0.6) @ into.T
    fit = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
    return np.asarray(np.clip(fit @ back.T, 0, 1))


def looked_at(surface: ShownSurface, pixel: tuple[float, float], frame: int = FRAME) -> SurfacePick:
    """The place on the surface at a pixel of a frame."""
    pose = pose_of(frame)
    found = surface.pick(pose[:3, 3], pose[:3, :3] @ CAMERA.unproject(np.array(pixel)))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_run(tmp_path_factory.mktemp("run"))


def test_tone_mapping_is_undone() -> None:
    colours = np.random.default_rng(0).integers(0, 256, (5000, 3)).astype(np.uint8)
    shown = srgb_picture(tone_mapped(before_tone_mapping(LINEAR[colours]))).astype(int)
    assert np.abs(shown - colours).max() <= 5
    assert np.abs(shown - colours).mean() < 0.05
    assert np.abs(srgb_picture(tone_mapped(LINEAR[colours])).astype(int) - colours).mean() > 5


def test_a_mesh_without_light_is_the_mesh() -> None:
    mesh = tube()
    content = unlit_glb(mesh.vertices, mesh.faces, np.full((len(mesh.vertices), 3), 100, np.uint8))
    scene = trimesh.load(io.BytesIO(content), file_type="glb", process=False)
    (read,) = scene.geometry.values()
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-5)
    assert (read.faces == mesh.faces).all()
    assert b"KHR_materials_unlit" in content
    assert len(content) < 30 * len(mesh.vertices) + 12 * len(mesh.faces) + 2000


def test_a_texture_is_shown_as_it_is_and_darker_in_relief(tmp_path: Path) -> None:
    surface = ShownSurface(Result(draw_textured_run(tmp_path)))
    assert surface.textured is not None
    content = unlit_textured_glb(surface.textured, surface.texture(pale=False, relief=False))
    scene = trimesh.load(io.BytesIO(content), file_type="glb", process=False)
    (read,) = scene.geometry.values()
    np.testing.assert_allclose(read.vertices, surface.mesh.vertices[surface.faces].reshape(-1, 3), atol=1e-5)
    # What the page makes of it: the linear texture times the colours of the vertices, tone mapped.
    picture = np.asarray(read.visual.material.baseColorTexture)[..., :3]
    factor = OpenGlb(content)
    accessor = factor.tree["accessors"][factor.tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert accessor["max"] == pytest.approx([2.0] * 3, rel=1e-3)
    shown = srgb_picture(tone_mapped(2.0 * LINEAR[picture[32, [5, 60]]])).astype(int)
    assert np.abs(shown - [[20, 160, 40], [20, 60, 200]]).max() <= 8
    vars(surface)["facing"] = np.full(len(surface.vertices), 1 / 9)  # a light of 0.6
    relief = cv2.imdecode(np.frombuffer(surface.texture(pale=False, relief=True), np.uint8), 1)[..., ::-1]
    inside = round(0.3 * 64 - 0.5), round(0.2 * 64 - 0.5)  # where a triangle has a corner
    before, after = (
        srgb_picture(tone_mapped(2.0 * LINEAR[one[inside][None]])).astype(int) for one in (picture, relief)
    )
    assert np.abs(after - 0.6 * before).max() <= 15  # a JPEG of 64 px


def test_what_few_frames_saw_is_pale_in_colours_and_in_the_texture(tmp_path: Path) -> None:
    surface = ShownSurface(Result(draw_textured_run(tmp_path)))
    assert surface.textured is not None
    # The tube's confidence grows from 0 to 1.
    assert surface.sure[0] == 0
    assert (surface.sure[len(surface.sure) * 2 // 3 :] == 1).all()
    found = colourings(surface)["picture, pale where unsure"]()
    assert "Pale" in found.words
    pale = faded(found.colours, surface.sure)
    assert np.abs(pale[0].astype(int) - PALE).max() < np.abs(found.colours[0].astype(int) - PALE).max() / 3
    assert (pale[-1] == found.colours[-1]).all()
    shares = in_texture(np.full(len(surface.textured.vertices), 0.4), surface.textured)
    height, width = 64, 64
    assert shares.shape == (height, width)
    # The triangles on the left have their corners at 0.2 of the texture's width and 0.7 of its height.
    assert shares[round(0.3 * height - 0.5), round(0.2 * width - 0.5)] == pytest.approx(0.4, abs=0.02)
    assert shares[-1, width // 2] == 1
    whole, less = (
        cv2.imdecode(np.frombuffer(surface.texture(pale=pale, relief=False), np.uint8), 1) for pale in (False, True)
    )
    assert whole.shape == less.shape == (height, width, 3)


def test_a_surface_of_fewer_triangles_has_no_texture(tmp_path: Path) -> None:
    run = Result(draw_textured_run(tmp_path))
    assert ShownSurface(run, most_faces=500).textured is None
    assert ShownSurface(run.others[0]).textured is None


def test_colours_mean_what_they_say(folder: Path) -> None:
    surface = ShownSurface(Result(folder))
    found = colourings(surface)
    assert list(found) == ["picture, pale where unsure", "picture", "confidence", "times seen", "depth deviation"]
    assert (found["picture"]().colours == np.asarray(tube().visual.vertex_colors)[:, :3]).all()
    viridis = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    assert (found["confidence"]().colours[[0, -1]] == viridis[[0, 255]]).all()
    # Of the ends of the tube the near one is behind most cameras, the middle is before all of them.
    seen = found["times seen"]()
    assert f"of {IN_RESULT} frames" in seen.words
    z = np.asarray(surface.mesh.vertices)[:, 2]
    brightness = seen.colours.astype(int).sum(axis=1)
    assert brightness[(z > 50) & (z < 60)].mean() > brightness[z < 10].mean() + 100
    # The frames' depth is that of the surface, but for the size of their pixels.
    apart = depth_differences(surface)
    assert np.nanmedian(apart) < 0.03
    assert np.isnan(apart[z < 5.5]).all()
    assert (found["depth deviation"]().colours[np.isnan(apart)] == 150).all()


def test_what_is_not_known_is_not_offered(tmp_path: Path) -> None:
    run = Result(draw_run(tmp_path))
    for file in (tmp_path / "depth").glob("*.png"):
        file.unlink()
    mesh = tube()
    run.mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.visual.vertex_colors, process=False)
    assert list(colourings(ShownSurface(run))) == ["picture, pale where unsure", "picture"]
    run.mesh = trimesh.Trimesh()
    assert list(colourings(ShownSurface(run))) == ["picture"]


def test_relief_darkens_what_does_not_face_the_camera(folder: Path) -> None:
    surface = ShownSurface(Result(folder))
    shaded = in_relief(surface.facing, surface.colours).astype(int)
    assert (shaded <= surface.colours).all()
    z = np.asarray(surface.mesh.vertices)[:, 2]
    assert surface.facing[np.abs(z - 8) < 1].mean() > 0.9
    assert surface.facing[np.abs(z - 60) < 10].mean() < 0.4


def test_few_triangles_are_shown(folder: Path) -> None:
    assert len(ShownSurface(Result(folder), 1000).faces) <= 1000


def test_a_click_meets_the_surface_where_the_frame_shows_it(folder: Path) -> None:
    surface = ShownSurface(Result(folder))
    place = surface.position(looked_at(surface, (60.0, 40.0)))
    pixel = CAMERA.project(transform(inverse(pose_of(FRAME)), place))
    np.testing.assert_allclose(pixel, (60.0, 40.0), atol=1e-6)
    assert surface.pick(np.array([0.0, 0.0, -50.0]), np.array([0.0, 0.0, -1.0])) is None


def test_frames_that_saw_a_place_are_found_with_its_pixel(folder: Path) -> None:
    surface = ShownSurface(Result(folder))
    pick = looked_at(surface, (60.0, 40.0))
    seen = frames_that_saw(surface, [pick])
    own = next(sight for sight in seen if sight.frame == FRAME)
    np.testing.assert_allclose(own.pixels, [(60.0, 40.0)], atol=1e-6)
    assert [sight.px_per_mm for sight in seen] == sorted((sight.px_per_mm for sight in seen), reverse=True)
    assert all(sight.frame < IN_RESULT for sight in seen)
    # Behind the last cameras is what the first ones saw at the border.
    near = looked_at(surface, (5.0, 32.0), 0)
    assert IN_RESULT - 1 not in [sight.frame for sight in frames_that_saw(surface, [near])]
    beside = surface.pick(np.array([0.0, 0.0, 8.0]), np.array([1.0, 0.0, 0.0]))
    assert beside is not None
    assert not frames_that_saw(surface, [near, beside])


def test_a_frame_with_something_in_front_did_not_see_it(tmp_path: Path) -> None:
    surface = ShownSurface(Result(draw_run(tmp_path)))
    pick = looked_at(surface, (60.0, 40.0))
    file = tmp_path / "depth" / f"{FRAME:06d}.png"
    depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(file), depth // 2)
    assert FRAME not in [sight.frame for sight in frames_that_saw(surface, [pick])]
    # Without depth the surface itself decides.
    file.unlink()
    assert FRAME in [sight.frame for sight in frames_that_saw(surface, [pick])]


@pytest.mark.slow
def test_coverage_has_form_and_borders_around_what_was_not_seen(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'scopemap[app]'")
    folder = draw_run(tmp_path)
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        shown.choose("Dropdown", "Colour by", "coverage")
        shown.until(lambda: "Gaps of the surface are closed, but not the open ends of a lumen." in shown.words)
        found = coverage(folder)
        # All that was not seen has a border, a little on the cameras' side of it.
        borders = shown.nodes["/page/model/borders"].points
        flags = found.unseen_faces[np.asarray(found.surface.face_adjacency)]
        edges = np.asarray(found.surface.face_adjacency_edges)[flags[:, 0] != flags[:, 1]]
        assert len(borders) == len(edges) > 0
        ends = np.asarray(found.surface.vertices)[edges]
        assert 0 < np.linalg.norm(borders - ends, axis=-1).max() < 1.0
        # Form is seen: the same colours, darker where the surface does not face a camera.
        shaded = shown.nodes["/page/model/surface"].glb_data
        shown.choose("Checkbox", "Shading", False)
        assert shown.nodes["/page/model/surface"].glb_data != shaded
        shown.choose("Dropdown", "Colour by", "picture")
        assert "/page/model/borders" not in shown.nodes
