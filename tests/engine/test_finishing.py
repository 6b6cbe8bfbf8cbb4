"""The engine without the runner: the same poses, depth and surface from a bare loop and the steps of `Pipeline`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from scopemap import Config, Result, open_sequence, reconstruct
from scopemap.engine.finishing import Execution, SegmentSurface
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.pipeline import Pipeline
from scopemap.result.frame_table import FrameTable
from scopemap.runner.estimators import create_estimators
from scopemap.runner.submap_frames import tracked_frames
from tests.support.pipeline_steps import stepped
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

SETTINGS = {"networks.flow": "dis", "networks.perceptual": "structure", "tracking.keyframe_every": 2}


class _Noting(Execution):
    """Notes the final frames."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def final(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        for frame in frames:
            self.frames.append(frame)
            yield frame


def _engine_alone(folder: Path, config: Config) -> tuple[SegmentSurface, list[Frame]]:
    """The surface and the final frames of a clip that stays in one map."""
    sequence, execution = open_sequence(folder), _Noting()
    with closing(FrameStore()) as store:
        pipeline = Pipeline(config, create_estimators(config, sequence), store)
        table = FrameTable.of(stepped(pipeline, frame).row for frame in sequence.frames())
        tracked = tracked_frames(table)
        (submap,) = pipeline.adjust(tracked, execution).submaps
        (segment,) = submap.segments
        return pipeline.surface(submap, segment, tracked, sequence.camera, execution), execution.frames


def _codes(result: Result) -> list[str]:
    return [notice["code"] for notice in result.provenance["notices"]]


@pytest.mark.parametrize("changes", [{}, {"mapping.method": "none"}], ids=["adjusted", "as tracked"])
def test_a_bare_loop_gives_what_the_runner_gives(changes: dict[str, str], tmp_path: Path) -> None:
    folder, config = write_tiny(tmp_path / "phantom", frames=8), Config.load(settings=SETTINGS | changes)
    result = reconstruct(open_sequence(folder), config)
    surface, frames = _engine_alone(folder, config)
    assert len(surface.mesh.faces) > 100
    assert surface.mesh.vertices.tobytes() == result.mesh.vertices.tobytes()
    assert surface.agreement == result.provenance["surface"]
    poses = np.stack([np.asarray(frame.T_world_camera) for frame in frames])
    assert poses.tobytes() == result.trajectory.T_world_camera.tobytes()
    assert [frame.index for frame in frames] == result.trajectory.indices.tolist()
    found = [notice.code for notice in surface.notices]
    assert "fusion-scaled" in found
    assert [code for code in _codes(result) if code in found] == found
    assert surface.is_checked == ("mapping-none" not in _codes(result))
