"""Depth Pro in a run: the focal length of an unknown camera, and depth beyond the limit."""

from __future__ import annotations

from pathlib import Path

import pytest

from scopemap import Config, open_sequence, reconstruct
from scopemap.engine.errors import InputError
from tests.support.spied_depth import spied
from tests.support.tiny_phantom import SIZE, only_images, write_tiny

pytestmark = pytest.mark.slow

WITHOUT_NETWORKS = {"networks.flow": "dis", "networks.perceptual": "structure"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "sound", frames=3)


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("anchor_too", [False, True])
def test_an_unknown_camera_takes_depth_pros_focal_length(
    preset: str, anchor_too: bool, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spies = spied(monkeypatch, anchor_too, name="depth-pro", focal_px=83.25)
    sequence = open_sequence(only_images(folder, tmp_path / "bare"))
    depth = {"depth.backend": "shading", "depth.anchor": "auto"}
    result = reconstruct(sequence, Config.load(preset, settings=WITHOUT_NETWORKS | depth))  # type: ignore[arg-type]
    assert result.camera.fx == pytest.approx(83.25)
    assert result.camera.fy == pytest.approx(83.25)
    assert (result.camera.width, result.camera.height) == SIZE
    assert result.provenance["camera"]["source"] == "estimated: Depth Pro on frame 0"
    assert spies[0].seen[-1].camera.fx == pytest.approx(83.25)
    assert sequence.camera.fx != pytest.approx(83.25)


@pytest.mark.parametrize(("name", "focal_px"), [("depth-anything", 83.0), ("depth-pro", None)])
def test_an_unknown_camera_stays_assumed_without_a_focal_length(
    name: str, focal_px: float | None, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spied(monkeypatch, name=name, focal_px=focal_px)
    sequence = open_sequence(only_images(folder, tmp_path / "bare"))
    result = reconstruct(sequence, Config.load())
    assert result.camera == sequence.camera
    assert "assumed" in result.provenance["camera"]["source"]
    if name != "depth-pro":  # which would have been asked instead of the motion
        assert "; the motion does not constrain it: " in result.provenance["camera"]["source"]


@pytest.mark.parametrize("anchor_too", [False, True])
def test_depth_beyond_the_limit_is_not_dropped_in_silence(
    anchor_too: bool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says what happened, of the anchor or of depth itself, and which setting decides."""
    spied(monkeypatch, anchor_too, name="depth-pro", focal_px=100.0)
    far = {"depth.backend": "shading", "depth.shading_median_mm": 900.0, "depth.anchor": "auto"}
    if anchor_too:
        far["depth.backend"] = f"files:{folder}"
        far["depth.files_kind"] = "depth"
    with pytest.raises(InputError, match=r"100% of its depth is beyond depth\.max_depth_mm = 300 \(median \d+ mm\)$"):
        reconstruct(open_sequence(folder, frames=slice(0, 2)), Config.load(settings=far))
