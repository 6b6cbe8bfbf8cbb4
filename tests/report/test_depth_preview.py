"""Pictures of a run's depth, and what the result says of its scale."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from scopemap import open_sequence, reconstruct
from scopemap.engine.config import Config
from scopemap.engine.frame import Frame
from scopemap.input.sequence import Sequence
from scopemap.report.depth_figures import MASKED_GREY, DepthPreviews
from scopemap.result.depth_maps import DepthReader, DepthWriter
from scopemap.result.result import Result
from scopemap.result.summary import summary_lines
from scopemap.result.wording import scale_words
from tests.support.tiny_phantom import FRAMES, only_images, write_tiny

pytestmark = pytest.mark.slow

UNKNOWN = "scale unknown (scopenet's own scale): compare shapes, not sizes"


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    folder = tmp_path_factory.mktemp("scale")
    return open_sequence(only_images(write_tiny(folder / "phantom"), folder / "images"))


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run") / "out"


@pytest.fixture(scope="module")
def result(images: Sequence, out: Path) -> Result:
    return reconstruct(images, Config.load(settings={"input.focal": "assume"}), out=out)


def _frame(images: Sequence, index: int, depth_mm: float) -> Frame:
    frame = next(iter(images.frames()))
    ramp_mm = np.linspace(depth_mm, 2 * depth_mm, frame.rgb[..., 0].size, dtype=np.float32)
    ramp_mm = ramp_mm.reshape(frame.rgb.shape[:2])
    ramp_mm[:10] = np.nan
    return replace(frame, index=index, depth_mm=ramp_mm, depth_sigma_mm=None)


def test_previews_have_one_range_and_legend_for_all_frames_and_unknown_is_black(
    images: Sequence, tmp_path: Path
) -> None:
    write, previews = DepthWriter(tmp_path), DepthPreviews(tmp_path)
    for index, depth_mm in enumerate((10.0, 40.0)):
        frame = _frame(images, index, depth_mm)
        frame.valid[20:30] = False
        write(frame)
        previews(frame)
    range_mm = write.finish(scale_known=False)
    assert range_mm is not None
    previews.finish(range_mm, scale_known=False)
    facts = json.loads((tmp_path / "depth" / "depth.json").read_text())
    near_mm, far_mm = facts["preview_mm"]
    assert (near_mm, far_mm) == range_mm
    assert 10 <= near_mm < 12
    assert 75 < far_mm <= 80
    assert facts["scale_known"] is False
    near, far = (cv2.imread(str(tmp_path / "depth_preview" / f"00000{n}.jpg")) for n in (0, 1))
    assert near.dtype == np.uint8
    assert max(near[:6].max(), far[:6].max()) < 20
    assert near[11, 5, 2] > 100 > near[11, 5, 0]  # red, as OpenCV orders colours
    assert np.abs(near[22:28].astype(int) - MASKED_GREY).max() < 20
    assert not list((tmp_path / "depth_preview").glob("*.png"))
    height = images.camera.height
    legend = far[height:]
    assert far[height - 2, -5, 0] > far[height - 2, -5, 2]
    assert np.median(near[12:height].max(axis=-1)) > 100
    np.testing.assert_array_equal(near[height + 8 :], legend[8:])  # but for what JPEG smears
    # What the legend calls nearest, farthest and unknown has the colours of these.
    nearest, farthest, unknown = (legend[23:29, x : x + 6].mean((0, 1)) for x in (8, 62, 116))
    assert nearest[2] > 100 > nearest[0]
    assert np.abs(nearest - near[10:14, :4].mean((0, 1))).max() < 40
    assert np.abs(farthest - far[height - 3 : height, -4:].mean((0, 1))).max() < 40
    assert unknown.max() < 30
    for index in (0, 1):
        previews(_frame(images, index, 10.0))
    previews.finish(range_mm, scale_known=True)
    known = cv2.imread(str(tmp_path / "depth_preview" / "000001.jpg"))[height:]
    assert (known != legend).any()  # millimetres, not multiples
    assert DepthWriter(tmp_path / "none").finish(scale_known=True) is None
    depth_mm = DepthReader(tmp_path).read(1)
    assert depth_mm is not None
    np.testing.assert_allclose(depth_mm[10:].min(), np.nanmin(_frame(images, 1, 40.0).depth_mm), atol=0.01)


def test_a_scale_that_is_a_guess_is_said_everywhere(result: Result, out: Path) -> None:
    assert result.provenance["scale"] == {
        "known": False,
        "measured": False,
        "stated": False,
        "source": "scopenet's own scale",
    }
    assert scale_words(result.provenance["scale"]) == UNKNOWN
    lines = summary_lines(result)
    assert lines[1].endswith("(scale unknown)")
    assert f"# {UNKNOWN}" in (out / "trajectory.tum").read_text().splitlines()
    assert f"comment {UNKNOWN}\n".encode() in (out / "mesh.ply").read_bytes()[:600]
    assert json.loads((out / "depth" / "depth.json").read_text())["scale_known"] is False
    assert json.loads((out / "provenance.json").read_text())["scale"]["known"] is False
    assert UNKNOWN.encode() in (out / "mesh.glb").read_bytes()
    assert len(trimesh.load_mesh(out / "mesh.ply").faces) == len(result.mesh.faces)
    assert len(list((out / "depth_preview").iterdir())) == FRAMES


@pytest.mark.parametrize(
    ("settings", "known"),
    [
        ({"depth.near_far_mm": [5, 80]}, True),
        ({"depth.backend": "shading"}, False),
        ({"depth.anchor": "factor", "depth.backend": "scopenet"}, False),
    ],
)
def test_what_is_anchored_is_known(images: Sequence, settings: dict[str, object], known: bool) -> None:
    config = Config.load(settings={"input.focal": "assume", "fusion.enabled": False, **settings})
    facts = reconstruct(images, config).provenance["scale"]
    assert facts["known"] is known
    assert scale_words(facts).startswith(
        "scale: sizes rest on the stated near-far 5:80 mm" if known else "scale unknown ("
    )


def test_depth_of_a_run_of_unknown_scale_is_not_measured(images: Sequence, result: Result, out: Path) -> None:
    settings = {"input.focal": "assume", "fusion.enabled": False, "depth.backend": f"files:{out / 'depth'}"}
    facts = reconstruct(images, Config.load(settings=settings)).provenance["scale"]
    assert facts == {"known": False, "measured": False, "stated": False, "source": "measured depth of unknown unit"}
