"""Runs that must not pretend: no depth to start from, an input in the way, parts whose facts must not mix."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.config import PRESETS, Config
from scopemap.engine.depth.anchor import max_depth_mm
from scopemap.engine.depth.mapis import Mapis
from scopemap.engine.errors import InputError, WeightsError
from scopemap.engine.pipeline import Pipeline
from scopemap.input.opening import open_sequence
from scopemap.runner.estimators import create_estimators, missing_weights
from scopemap.runner.provenance import estimators_provenance
from scopemap.runner.reconstruct import reconstruct
from tests.support.front_door import refused
from tests.support.tiny_phantom import FRAMES, with_true_depth, write_tiny


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("refusals") / "phantom")


def _depth_files(folder: Path, values_mm: list[float]) -> Path:
    folder.mkdir()
    for index, value in enumerate(values_mm):
        np.save(folder / f"{index:04d}_depth.npy", np.full((128, 160), value, np.float32))
    return folder


@pytest.mark.slow
def test_without_any_depth_no_frame_counts_as_tracked(folder: Path, tmp_path: Path) -> None:
    empty = _depth_files(tmp_path / "empty", [0.0] * FRAMES)
    with pytest.raises(InputError, match="too little of its depth is known"):
        reconstruct(open_sequence(folder), with_true_depth(empty, depth__files_kind="measured"))


@pytest.mark.slow
def test_the_world_starts_at_the_first_frame_with_depth(folder: Path, tmp_path: Path) -> None:
    late = _depth_files(tmp_path / "late", [0.0, 0.0] + [30.0] * (FRAMES - 2))
    result = reconstruct(open_sequence(folder), with_true_depth(late, depth__files_kind="measured"))
    status = result.frames["status"].tolist()
    assert status == ["lost", "lost", "initial"] + ["ok"] * (FRAMES - 3)


@pytest.mark.slow
def test_masked_pixels_are_not_linked(folder: Path) -> None:
    config = Config.load(settings={"networks.flow": "none", "networks.perceptual": "structure"})
    sequence = open_sequence(folder)
    pipeline = Pipeline(config, create_estimators(config, sequence))
    preprocessed_frames = [pipeline.match(pipeline.estimate(frame)) for frame in sequence.frames()]
    assert not preprocessed_frames[0].frame.valid.all()
    for past, preprocessed in itertools.pairwise(preprocessed_frames):
        assert preprocessed.correspondence is not None
        np.testing.assert_array_equal(
            preprocessed.correspondence.consistent, past.frame.valid & preprocessed.frame.valid
        )


def test_measured_depth_needs_no_link(folder: Path) -> None:
    config = with_true_depth(folder)
    assert not Mapis(config.mapis).needs_previous("measured")
    assert Mapis(config.mapis).needs_previous("depth")
    sequence = open_sequence(folder)
    pipeline = Pipeline(config, create_estimators(config, sequence))
    assert all(pipeline.match(pipeline.estimate(frame)).correspondence is None for frame in sequence.frames())


def test_facts_of_the_parts_do_not_overwrite_each_other(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = Config.load(settings={"networks.perceptual": "structure"})
    estimators = create_estimators(config, open_sequence(folder))
    monkeypatch.setattr(estimators.flow, "provenance", lambda: {"flow": "raft", "sha256": "f"})
    monkeypatch.setattr(estimators.perceptual, "provenance", lambda: {"perceptual": "lpips", "sha256": "p"})
    facts = estimators_provenance(estimators)
    assert (facts["flow"], facts["flow sha256"], facts["perceptual sha256"]) == ("raft", "f", "p")


def test_frames_are_read_without_their_truth(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    sequence = open_sequence(folder)
    monkeypatch.setattr(sequence.source, "truth", asked.append)
    assert [frame.index for frame in sequence.frames()] == list(range(FRAMES))
    assert asked == []
    assert len(list(sequence)) == FRAMES
    assert asked == list(range(FRAMES))


def test_a_stated_farthest_tissue_is_believed() -> None:
    assert max_depth_mm(Config.load().depth) == 300.0
    assert max_depth_mm(Config.load(settings={"depth.near_far_mm": (50, 400)}).depth) == 400.0


PAPER = [name for name, values in PRESETS.items() if "depth.anchor" in values]
ONLY_DEPTH_PRO = {"networks.flow": "dis", "networks.perceptual": "structure"}


@pytest.mark.parametrize("preset", PAPER)
@pytest.mark.parametrize(
    ("depth", "others"),
    [
        *((depth, others) for depth in ("scopenet", "shading", "files") for others in ({}, ONLY_DEPTH_PRO)),
        *((depth, {}) for depth in ("depth-anything", "depth-pro")),
    ],
)
def test_another_depth_than_the_presets_names_the_anchor_that_is_left(
    preset: str, others: dict[str, str], depth: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path / "none"))
    chosen = others | {"depth.backend": f"files:{folder}" if depth == "files" else depth}
    config = Config.load(preset, settings=chosen)  # type: ignore[arg-type]
    with pytest.raises(WeightsError) as caught:
        create_estimators(config, open_sequence(folder))
    error, advised = str(caught.value), depth not in ("depth-pro", PRESETS[preset]["depth.backend"])
    assert ("--set depth.anchor=auto" in error) == advised
    assert "scopemap models pull depth-pro" in error
    assert others or "scopemap models pull raft-large && scopemap models pull alexnet" in error
    if advised:
        followed = Config.load(preset, settings=chosen | {"depth.anchor": "auto"})  # type: ignore[arg-type]
        assert missing_weights(followed) == ([] if others else ["raft-large", "alexnet"])


@pytest.mark.parametrize("preset", PAPER)
def test_the_command_says_so_in_one_sentence(
    preset: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path / "none"))
    words = ("run", folder, "--out", tmp_path / "out", "--quiet", "--preset", preset, "--depth", "scopenet")
    error = refused(capfd, *words)
    assert f"--set depth.anchor=auto does without depth-pro, the metric anchor of the preset {preset}\n" in error
