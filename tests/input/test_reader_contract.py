"""One body for all readers: what `Source` promises holds for each, on a made-up copy of its layout."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from scopemap.engine.frame import Frame, TruthQuality
from scopemap.input.mask_files import MaskFiles
from scopemap.input.opening import open_sequence, readers
from scopemap.input.sequence import Sequence
from scopemap.result.reference import reference_trajectory
from tests.support.drawn_datasets import WRITERS

NAMES = sorted(WRITERS)


@pytest.fixture(scope="module", params=NAMES)
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    return request.param, WRITERS[request.param](tmp_path_factory.mktemp("reader") / "input")


@pytest.fixture(scope="module")
def sequence(written: tuple[str, Path]) -> Sequence:
    return open_sequence(written[1])


@pytest.fixture(scope="module")
def frames(sequence: Sequence) -> list[Frame]:
    return list(sequence.frames())


def test_every_reader_has_a_copy() -> None:
    assert {name.split(":")[0] for name in NAMES} >= set(readers())


def test_it_is_recognised_and_can_be_named(written: tuple[str, Path], frames: list[Frame]) -> None:
    name, path = written
    kind = name.split(":")[0]
    found = open_sequence(path)
    assert found.source.name == kind
    named = open_sequence(found.path, dataset=kind)
    assert [frame.index for frame in named.frames()] == [frame.index for frame in frames]


def test_frames_are_whole_and_in_order(sequence: Sequence, frames: list[Frame]) -> None:
    assert len(frames) >= 2
    assert sequence.count in (None, len(frames))
    assert all(a.index < b.index and a.time_s < b.time_s for a, b in pairwise(frames))
    for frame in frames:
        assert frame.rgb.dtype == np.uint8
        assert frame.rgb.shape == (sequence.camera.height, sequence.camera.width, 3)
        assert frame.valid.any()
        assert frame.camera == sequence.camera
        # Truth is asked for, never carried along.
        assert frame.depth_mm is None
        assert frame.T_world_camera is None


def test_it_can_be_read_again_and_in_part(written: tuple[str, Path], sequence: Sequence, frames: list[Frame]) -> None:
    again = list(sequence.frames())
    some = list(open_sequence(written[1], frames=slice(1, None, 1)).frames()) if len(frames) > 2 else frames[1:]
    assert [f.index for f in some] == [f.index for f in frames[1:]]
    for one, other in zip(frames, again, strict=True):
        assert (one.index, one.time_s) == (other.index, other.time_s)
        np.testing.assert_array_equal(one.rgb, other.rgb)
    for one, other in zip(frames[1:], some, strict=True):
        np.testing.assert_array_equal(one.rgb, other.rgb)


def test_stamps_are_those_of_the_frames(sequence: Sequence, frames: list[Frame]) -> None:
    stamps = sequence.source.stamps(slice(None))
    if stamps is not None:
        assert [index for index, _ in stamps] == [frame.index for frame in frames]
        np.testing.assert_allclose([time for _, time in stamps], [frame.time_s for frame in frames])


def test_truth_is_in_the_common_form(sequence: Sequence) -> None:
    for frame, truth in sequence:
        pose = sequence.source.pose(frame.index)
        if truth is None:
            assert pose is None
            continue
        assert truth.quality in get_args(TruthQuality)
        if pose is None:
            assert truth.T_world_camera is None
        else:
            np.testing.assert_array_equal(truth.T_world_camera, pose)
            assert pose.shape == (4, 4)
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
            assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
            np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
        if truth.depth_mm is not None:
            assert truth.depth_mm.dtype == np.float32
            assert truth.depth_mm.shape == frame.rgb.shape[:2]
            known = np.isfinite(truth.depth_mm)
            assert known.any()
            assert (truth.depth_mm[known] > 0).all()


def test_the_reference_is_the_poses(sequence: Sequence, frames: list[Frame]) -> None:
    poses = {frame.index: sequence.source.pose(frame.index) for frame in frames}
    known = {index: pose for index, pose in poses.items() if pose is not None}
    reference = reference_trajectory(sequence)
    if not known:
        assert reference is None
        return
    assert list(reference.indices) == list(known)
    np.testing.assert_allclose(reference.T_world_camera, list(known.values()))


def test_what_is_known_of_the_camera_is_said(sequence: Sequence) -> None:
    source = sequence.source
    assert (source.camera is None) == (not sequence.calibrated)
    assert sequence.camera_source
    assert all(str(said) for said in [*sequence.notes, *sequence.warnings])
    if source.masks is not None:
        masks = MaskFiles(source.masks, sequence.rectifier)
        assert any(masks.covered(frame.index) is not None for frame in sequence.frames())
