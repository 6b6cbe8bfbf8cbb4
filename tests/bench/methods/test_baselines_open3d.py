"""Open3D's odometries behind our signature: units, direction, refusals; skips where Open3D cannot be imported."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import SettingsError
from scopemap.engine.frame import Frame
from scopemap.engine.tracking.track import FrameTracker, Track
from scopemap.input.opening import open_sequence
from scopemap.runner.reconstruct import reconstruct
from scopemap_bench.methods import baselines
from scopemap_bench.methods.baselines import ICP_METHODS, RGBD_METHODS, Open3dTracker, load_open3d
from tests.support.tiny_phantom import true_poses, with_true_depth, write_tiny

COLOUR, CLOUDS = list(RGBD_METHODS), list(ICP_METHODS)
PLAIN = {
    **{"mapis__frame_scale": "none", "mapis__blend": "none", "networks__flow": "none"},
    **{"mapping__method": "none", "fusion__enabled": False},
}
CAMERA = PinholeCamera(140.0, 140.0, 79.5, 63.5, 160, 128)


@pytest.fixture(scope="module")
def _open3d() -> ModuleType:
    try:
        return load_open3d()
    except SettingsError as error:
        pytest.skip(str(error))


needs_open3d = pytest.mark.usefixtures("_open3d")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom"))


@cache
def _picture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 255, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0).astype(np.float32)
    return np.clip(128 + 3 * (blurred - 128), 13, 239).astype(np.uint8)


def _bowl(index: int = 0, further_mm: float = 0.0) -> Frame:
    """A textured bowl 30 mm away: no plane, so that ICP is not free to slide."""
    v, u = np.indices((CAMERA.height, CAMERA.width), dtype=np.float32)
    depth_mm = 30 + further_mm + 4 * np.sin(u / 17) * np.cos(v / 13)
    valid = np.ones((CAMERA.height, CAMERA.width), bool)
    return Frame(index, index / 30, _picture(), CAMERA, valid, depth_mm.astype(np.float32))


def _follow(tracker: FrameTracker, frames: list[Frame]) -> Iterator[Track]:
    """What the pipeline does with a tracker and frames whose depth stays as it is."""
    for frame in frames:
        track = tracker.track(frame)
        if track.decision.kind != "none":
            tracked = replace(frame, T_world_camera=track.T_world_camera)
            assert tracker.update(tracked, track.decision, measured=True)
        yield track


@needs_open3d
@pytest.mark.parametrize(
    ("method", "share"),
    # Share of standing still's error that is left. ICP between points slides along the tube: with true depth, too,
    # it does worse than standing still.
    [(COLOUR[0], 0.4), (COLOUR[1], 0.5), (CLOUDS[1], 0.1), (CLOUDS[0], None)],
)
def test_with_true_depth_three_of_four_beat_standing_still(folder: Path, method: str, share: float | None) -> None:
    config = with_true_depth(folder, **PLAIN)
    result = reconstruct(open_sequence(folder), config, tracker=Open3dTracker(method))
    assert result.frames["status"].tolist() == ["initial"] + ["ok"] * (len(result.frames) - 1)
    assert result.frames["keyframe"].tolist() == [0, *range(len(result.frames) - 1)]
    estimated_mm, true_mm = result.trajectory.T_world_camera[:, :3, 3], true_poses(folder)[:, :3, 3]
    error_mm = np.linalg.norm(estimated_mm - true_mm, axis=1)
    still_mm = np.linalg.norm(true_mm, axis=1)
    assert still_mm[-1] > 3
    left = np.sqrt(np.mean(error_mm**2) / np.mean(still_mm**2))
    assert estimated_mm[-1] @ true_mm[-1] > 0
    if share is None:
        assert 1.0 < left < 2.0
    else:
        assert left < share
        assert estimated_mm[-1] @ true_mm[-1] > 0.9 * np.linalg.norm(estimated_mm[-1]) * np.linalg.norm(true_mm[-1])


@needs_open3d
def test_a_surface_that_moves_away_moves_the_camera_back_by_as_many_mm() -> None:
    """All depths grow by 1 mm, so geometry must find 1 mm along the axis, whatever Open3D's own unit is."""
    _, track = _follow(Open3dTracker(CLOUDS[1]), [_bowl(0), _bowl(1, further_mm=1.0)])
    assert track.status == "ok"
    assert track.T_world_camera[2, 3] == pytest.approx(-1.0, abs=0.1)


@needs_open3d
@pytest.mark.parametrize("method", COLOUR + CLOUDS)
def test_nothing_within_reach_is_lost_and_not_identity(method: str, capfd: pytest.CaptureFixture[str]) -> None:
    """20 mm farther all at once: beyond the 3 mm within which Open3D looks, where it calls identity a success."""
    tracks = list(_follow(Open3dTracker(method), [_bowl(0), _bowl(1, 20.0), _bowl(2)]))
    assert [track.status for track in tracks] == ["initial", "lost", "ok"]
    assert "no p" in tracks[1].reason  # pixels, points
    assert tracks[2].keyframe == 0  # a lost frame is no reference
    assert capfd.readouterr() == ("", "")


@needs_open3d
@pytest.mark.parametrize("method", COLOUR + CLOUDS)
def test_frames_that_show_nothing_are_lost_and_the_next_one_is_not(method: str) -> None:
    nothing = np.zeros((CAMERA.height, CAMERA.width), bool)
    unknown = np.full((CAMERA.height, CAMERA.width), np.nan, np.float32)
    black, blind = replace(_bowl(0), valid=nothing), replace(_bowl(2), depth_mm=unknown)
    tracks = list(_follow(Open3dTracker(method), [black, _bowl(1), blind, _bowl(3)]))
    assert [track.status for track in tracks] == ["lost", "initial", "lost", "ok"]
    assert tracks[0].reason == tracks[2].reason == "only 0% of the image is usable"
    assert tracks[3].keyframe == 1


@needs_open3d
def test_the_reference_has_the_depth_that_was_adopted_last() -> None:
    """Refined depth, where there is any, replaces the raw depth that the frame was tracked with."""
    tracker = Open3dTracker(CLOUDS[1])
    first = tracker.track(_bowl(0))
    assert first.status == "initial"
    refined = replace(_bowl(0, further_mm=1.0), T_world_camera=np.eye(4))
    assert tracker.update(refined, first.decision, measured=False)
    np.testing.assert_allclose(tracker.track(_bowl(1, further_mm=1.0)).T_world_camera, np.eye(4), atol=1e-9)
    assert not tracker.update(
        replace(refined, depth_mm=np.full_like(refined.depth_mm, np.nan)), first.decision, measured=False
    )
    with pytest.raises(ValueError, match="needs a pose"):
        tracker.update(_bowl(2), first.decision, measured=False)
    with pytest.raises(ValueError, match="frames with depth"):
        tracker.track(replace(_bowl(2), depth_mm=None))


def test_without_open3d_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> ModuleType:
        raise OSError(f"libusb-1.0.so.0: cannot open shared object file ({name})")

    monkeypatch.setattr(baselines.importlib, "import_module", missing)
    with pytest.raises(
        SettingsError, match=r"libusb-1\.0\.so\.0.*pip install -c constraints\.txt -e '\./bench\[baselines\]'.*libgl1"
    ):
        Open3dTracker("park")
