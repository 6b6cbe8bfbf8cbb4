"""Instruments: found by scopenet's second output, which leaves depth as it is, and left out of tracking and fusion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.extras import NETWORKS

pytest.importorskip("torch", reason=NETWORKS)

import numpy as np
import torch

from scopemap import open_sequence
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.config import Config, MaskSettings
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.depth.scopenet import estimator as module
from scopemap.engine.depth.scopenet.estimator import WEIGHTS_NAME
from scopemap.engine.errors import SettingsError
from scopemap.engine.frame import Frame
from scopemap.engine.masking.masker import Masker, without_instruments
from scopemap.engine.pipeline import Pipeline
from scopemap.input.mask_files import create_masks
from scopemap.runner.estimators import create_estimators
from tests.support.pipeline_steps import stepped
from tests.support.tiny_phantom import write_tiny
from training.export import read_network

pytestmark = pytest.mark.networks

HEIGHT, WIDTH = 70, 94
CAMERA = PinholeCamera(60.0, 60.0, 47.0, 35.0, WIDTH, HEIGHT)
SHIPPED = Path(module.__file__).parent / WEIGHTS_NAME


def _frame(seed: int = 3) -> Frame:
    rgb = np.random.default_rng(seed).integers(60, 160, (HEIGHT, WIDTH, 3), np.uint8)
    return Frame(0, 0.0, rgb, CAMERA, np.ones((HEIGHT, WIDTH), bool))


def _bar(level: float, rest: float = 0.0) -> np.ndarray:
    """Probability of an instrument: columns 30 to 49 at `level`."""
    found = np.full((HEIGHT, WIDTH), rest, np.float32)
    found[:, 30:50] = level
    return found


# ---- the network


def test_the_runtime_finds_instruments_as_torch_does() -> None:
    network, planes = read_network(SHIPPED), np.random.default_rng(1).normal(0, 0.3, (8, 96, 64)).astype(np.float32)
    assert network.instruments is not None
    with torch.no_grad():
        given = torch.from_numpy(planes)[None]
        expected = torch.sigmoid(network.instruments(given, network.features(given)))[0, 0].numpy()
    _, instruments = module.load_network(SHIPPED).run(None, {"planes": planes[None]})
    assert instruments.shape == (1, 1, 48, 32)
    assert np.ptp(expected) > 1e-3
    np.testing.assert_allclose(instruments[0, 0], expected, atol=1e-4)


# ---- from probabilities to a mask


LOOKED_FOR = MaskSettings(instruments="auto")


def _masked(masker: Masker, probability: np.ndarray | None) -> np.ndarray | None:
    masker(_frame())
    return masker.instruments(probability)


def test_a_likely_region_is_masked_with_a_rim_and_a_speck_is_not() -> None:
    found = _masked(Masker(LOOKED_FOR), _bar(0.9))
    assert found is not None
    assert found[:, 30:50].all()
    assert found[:, [29, 50]].all()
    assert not found[:, :25].any()
    assert not found[:, 55:].any()
    speck = np.zeros((HEIGHT, WIDTH), np.float32)
    speck[4, 4] = 1.0
    unsure = _masked(Masker(LOOKED_FOR), np.maximum(speck, _bar(0.4)))
    assert unsure is not None
    assert not unsure.any()


def test_what_was_an_instrument_a_frame_ago_is_held_longer() -> None:
    weak = _bar(0.03)
    weak[:5, 30:50] = 0.9
    for before, held in ((None, False), (_bar(0.9), True)):
        masker = Masker(LOOKED_FOR)
        if before is not None:
            _masked(masker, before)
        found = _masked(masker, weak)
        assert found is not None
        assert found[:5, 30:50].all()
        assert found[20:, 30:50].all() == found[20:, 30:50].any() == held


def test_nobody_looks_where_the_settings_or_the_network_do_not(tmp_path: Path) -> None:
    assert _masked(Masker(LOOKED_FOR), None) is None
    assert _masked(Masker(MaskSettings()), _bar(0.9)) is None
    for way in ("off", "files"):
        assert _masked(Masker(MaskSettings(instruments=way)), _bar(0.9)) is None

    class Files:
        warnings: list[str] = []  # noqa: RUF012

        def covered(self, index: int) -> np.ndarray | None:
            return np.zeros((HEIGHT, WIDTH), bool) if index == 0 else None

        def provenance(self) -> dict[str, str]:
            return {}

    masker = Masker(LOOKED_FOR, Files())
    assert _masked(masker, _bar(0.9)) is None, "frame 0 has a mask from a file"
    masker(replace(_frame(), index=1))
    found = masker.instruments(_bar(0.9))
    assert found is not None
    assert found.any()


def test_settings_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    same = Rectifier(CAMERA, CAMERA)
    with pytest.raises(SettingsError, match=r"mask\.instruments=off contradicts mask\.files"):
        create_masks(MaskSettings(instruments="off", files=str(tmp_path / "masks")), same)
    assert create_masks(MaskSettings(instruments="files"), same) is None
    assert create_masks(MaskSettings(instruments="off"), same, tmp_path / "masks") is None


def test_a_mask_of_another_size_takes_usable_pixels_and_highlights() -> None:
    frame = replace(_frame(), highlights=np.ones((HEIGHT, WIDTH), bool))
    half = np.zeros((HEIGHT // 2, WIDTH // 2), bool)
    half[:, :10] = True
    seen = without_instruments(frame, half)
    assert seen.highlights is not None
    for image in (seen.valid, seen.highlights):
        assert not image[:, :20].any()
        assert image[:, 20:].all()


# ---- in the pipeline


class _WithInstruments:
    """A depth estimator that finds instruments where it is told."""

    name = "scopenet"

    def __init__(self) -> None:
        self.columns = slice(0, 0)

    def estimate(self, frame: Frame) -> DepthEstimate:
        found = np.zeros(frame.valid.shape, np.float32)
        found[:, self.columns] = 0.9
        depth = np.full(frame.valid.shape, 40.0, np.float32)
        return DepthEstimate(depth, "depth", sigma=0.1 * depth, instruments=found)

    def provenance(self) -> dict[str, str]:
        return {"depth": self.name}


def test_instruments_have_no_depth_and_are_not_usable_and_a_covered_frame_says_so(tmp_path: Path) -> None:
    sequence = open_sequence(write_tiny(tmp_path / "phantom"))
    network = _WithInstruments()
    for way in ("auto", "off"):
        config = Config.load(settings={"mask.instruments": way})
        pipeline = Pipeline(config, replace(create_estimators(config, sequence), depth=network))
        first, second, third, *_ = sequence.frames()
        network.columns = slice(0, 20)
        step = stepped(pipeline, first)
        bare = Masker(config.mask)(first)
        if way == "off":
            np.testing.assert_array_equal(step.frame.valid, bare.valid)
            continue
        assert not step.frame.valid[:, :20].any()
        assert np.isnan(step.frame.depth_mm[:, :20]).all()
        assert np.isnan(step.frame.depth_sigma_mm[:, :20]).all()
        np.testing.assert_array_equal(step.frame.valid[:, 30:], bare.valid[:, 30:])
        assert np.isfinite(step.frame.depth_mm[:, 30:]).all()
        network.columns = slice(0, first.valid.shape[1])
        covered = stepped(pipeline, second).track
        assert covered.status == "lost"
        assert covered.reason == "only 0% of the image is usable: instruments cover 100%"
        network.columns = slice(0, 0)
        assert stepped(pipeline, third).track.status != "lost"
