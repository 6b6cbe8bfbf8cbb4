"""A run's surface against its own video: figures of a made-up frame, and `scopemap evaluate --against-video`."""

from __future__ import annotations

import json
import math
import shutil
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import trimesh
from typer.testing import CliRunner

from scopemap import open_sequence, reconstruct
from scopemap.apps.evaluate.against_video import RunFrames
from scopemap.cli.app import app
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.depth.perceptual import StructureDistance
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import (
    FrameAgreement,
    agreement_figures,
    compare_rendering,
    rendered_frames,
    vertex_sigmas,
)
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.result.summary import summary_lines
from scopemap.terminal.figures import show
from scopemap_bench.evaluation.surface import distances_mm
from tests.support.tiny_phantom import with_true_depth, write_tiny

pytestmark = pytest.mark.slow

CAMERA = PinholeCamera(60.0, 60.0, 39.5, 31.5, 80, 64)
BLACK = np.zeros((64, 80, 3), np.uint8)


def _wall() -> trimesh.Trimesh:
    """A coloured wall at 50 mm that fills the view: one vertex per pixel and a margin."""
    u, v = np.meshgrid(np.arange(-2, 82), np.arange(-2, 66))
    vertices = np.stack([(u - CAMERA.cx) / 60, (v - CAMERA.cy) / 60, np.ones(u.shape)], -1).reshape(-1, 3) * 50
    corner = (np.arange(67)[:, None] * 84 + np.arange(83)).ravel()
    below, right = corner + 84, corner + 1
    faces = np.concatenate([np.stack([corner, right, below], 1), np.stack([right, below + 1, below], 1)])
    rng = np.random.default_rng(1)
    colours = cv2.resize(rng.integers(0, 255, (17, 21, 3)).astype(np.uint8), (84, 68)).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)


def _depth(depth_mm: float = 50.0) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), depth_mm, np.float32)


def _compared(mesh: trimesh.Trimesh, rgb: np.ndarray, depth_mm: np.ndarray) -> FrameAgreement:
    return compare_rendering(render_mesh(mesh, CAMERA, np.eye(4)), rgb, depth_mm)


def test_figures_of_a_wall_are_those_in_closed_form() -> None:
    wall = _wall()
    rgb = render_mesh(wall, CAMERA, np.eye(4)).rgb
    same = _compared(wall, rgb, _depth())
    assert same.coverage == 1.0
    assert same.ssim == pytest.approx(1.0)
    assert same.depth_error == pytest.approx(0.0, abs=1e-6)
    assert _compared(wall, rgb, _depth(55.0)).depth_error == pytest.approx(math.log(1.1), abs=1e-6)
    torn = wall.copy()
    torn.update_faces(torn.triangles_center[:, 0] < 0)
    half = _compared(torn, rgb, _depth())
    assert half.coverage == pytest.approx(0.5, abs=0.02)
    assert half.ssim < 0.7
    figures = agreement_figures([same, half])
    assert (figures["frames"], figures["coverage_least"]) == (2, half.coverage)
    assert figures["coverage_mean"] == pytest.approx((1 + half.coverage) / 2)
    # Half the wall is missing, and so is its agreement; the median does not tell it.
    assert (same.within_10_percent, half.within_10_percent) == (1.0, half.coverage)
    assert _compared(wall, rgb, _depth(56.0)).within_10_percent == 0.0
    assert figures["within_10_percent_least"] == half.coverage


def test_without_usable_pixels_there_is_no_figure() -> None:
    blind = _compared(_wall(), BLACK, _depth(np.nan))
    assert blind.coverage == 0
    assert math.isnan(blind.depth_error)
    assert agreement_figures([]) == {"frames": 0}
    nothing = dict.fromkeys(("coverage", "within_10_percent"), 0)
    assert agreement_figures([blind]) == {"frames": 1} | {
        f"{name}_{of}": value for name, value in nothing.items() for of in ("mean", "least")
    }


def test_figures_are_printed_by_what_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    kinds = dict.fromkeys(
        ("held_out", "fused", "nearest_frame"), agreement_figures([_compared(_wall(), BLACK, _depth())])
    )
    show({"against_video": kinds | {"worst_frames": "1, 2"}}, "table")
    said = capsys.readouterr().out
    assert "frames kept out of fusion" in said
    assert "_" not in said


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("held_out")
    source = write_tiny(folder / "phantom", frames=12)
    config = with_true_depth(source, fusion__voxel_mm=1.0)
    result = reconstruct(open_sequence(source), config, out=folder / "run")
    # Every run says how its surface agrees with some of its frames.
    assert result.provenance["surface"]["frames"] == 12
    assert result.provenance["surface"]["coverage_mean"] > 0.75
    assert "covers" in next(line for line in summary_lines(result) if line.startswith("  surface "))
    return folder / "run"


def test_every_tenth_frame_is_compared_with_the_surface_of_the_others(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path))
    result = CliRunner().invoke(app, ["evaluate", str(run_folder), "--against-video", "--json"])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)["against_video"]
    assert (figures["held_out"]["frames"], figures["fused"]["frames"]) == (1, 11)
    # True depth and true enough poses: the surface is where the frame sees it.
    assert figures["held_out"]["coverage_mean"] > 0.75
    assert figures["held_out"]["depth_error"] < 0.02
    assert figures["held_out"]["ssim"] > 0.4
    # Neighbouring frames see the same: their coloured points look alike, and no surface adds to that.
    assert figures["nearest_frame"]["ssim"] > max(0.7, figures["held_out"]["ssim"])
    assert figures["nearest_frame"]["coverage_mean"] > 0.8
    lacking = f"needs the weights alexnet or alexnet-features in {tmp_path}"
    if find_spec("torch") is None:
        lacking = "LPIPS needs torch and torchvision and lpips: pip install -c constraints.txt -e '.[networks]'"
    assert figures["lpips"] == f"left out: {lacking}"
    rows = pd.read_csv(run_folder / "against_video" / "frames.csv")
    assert rows.loc[rows["fused"] == 0, "index"].tolist() == [5]
    assert cv2.imread(str(run_folder / "against_video" / "worst.png")) is not None


def test_the_frames_of_a_run_give_its_surface_again(run_folder: Path) -> None:
    own = trimesh.load_mesh(run_folder / "mesh.ply", process=False)
    with closing(RunFrames(run_folder)) as frames:
        assert frames.indices == list(range(12))
        (again,), (fewer,) = frames.fuse().values(), frames.fuse(without=range(6)).values()
    assert len(again.faces) == pytest.approx(len(own.faces), rel=0.01)
    assert distances_mm(np.asarray(own.vertices), again).mean() < 0.02
    assert fewer.area < again.area


def test_lpips_counts_pixels_with_known_depth_alone() -> None:
    wall = _wall()
    view = render_mesh(wall, CAMERA, np.eye(4))
    depth_mm, other = _depth(), view.rgb.copy()
    depth_mm[:, 40:] = np.nan
    other[:, 40:] = 255
    measure = StructureDistance()
    assert compare_rendering(view, other, depth_mm, measure).lpips == pytest.approx(0, abs=1e-6)
    assert compare_rendering(view, other, _depth(), measure).lpips > 0.1
    assert math.isnan(compare_rendering(view, other, depth_mm * np.nan, measure).lpips)


def test_a_run_whose_video_is_gone_and_no_truth_are_refused(run_folder: Path, tmp_path: Path) -> None:
    moved = tmp_path / "run"
    shutil.copytree(run_folder, moved)
    provenance = json.loads((moved / "provenance.json").read_text())
    (moved / "provenance.json").write_text(
        json.dumps({key: provenance[key] for key in provenance if not key.startswith("input")})
    )
    gone = CliRunner().invoke(app, ["evaluate", str(moved), "--against-video"])
    assert gone.exit_code != 0
    assert "was not found; name it with --input PATH" in gone.output + str(gone.exception)
    neither = CliRunner().invoke(app, ["evaluate", str(run_folder)])
    assert neither.exit_code == 2
    assert "--against-video" in neither.output
    more = CliRunner().invoke(app, ["evaluate", str(run_folder), "--against-video", "--depth", "median"])
    assert more.exit_code == 2


def test_a_vertex_is_as_uncertain_as_the_frames_that_see_it() -> None:
    def frame(number: int, depth_mm: float) -> Frame:
        seen = Frame(number, 0.0, BLACK, CAMERA, np.ones((64, 80), bool), depth_mm=_depth(depth_mm))
        return replace(seen, depth_sigma_mm=np.full((64, 80), 0.3, np.float32), T_world_camera=np.eye(4))

    wall = _wall()
    rendered = rendered_frames(wall, [frame(0, 50.0), frame(1, 50.4)])
    sigmas = vertex_sigmas(len(wall.vertices), rendered).reshape(68, 84)
    seen = np.isfinite(sigmas)
    assert seen[2:-2, 2:-2].all()
    assert not seen[:1].any()  # outside of the picture
    np.testing.assert_allclose(sigmas[seen], np.sqrt((0.3**2 + 0.4**2) / 2), rtol=0.01)
