"""Optical flow: known motion is found, both directions are checked, RAFT's two sets of names lead to one network."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from tests.support.extras import NETWORKS

pytest.importorskip("torch", reason=NETWORKS)

import cv2
import numpy as np
import torch
from torchvision.models.optical_flow import raft_large, raft_small

from scopemap.engine.errors import WeightsError
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.flow.estimator import agree, pair_flow
from scopemap.engine.flow.flows import create_flow
from scopemap.engine.flow.raft import RaftFlow, torchvision_names
from scopemap.engine.geometry.warp import pull

pytestmark = pytest.mark.networks

SHAPE = (140, 171)


def _texture(shift_x: float = 0.0, shift_y: float = 0.0) -> np.ndarray:
    """A smooth random picture whose content is moved by the shift, px."""
    noise = np.random.default_rng(11).normal(size=(SHAPE[0] + 40, SHAPE[1] + 40)).astype(np.float32)
    smooth = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), None, 20, 235, cv2.NORM_MINMAX)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    grey = cv2.remap(smooth, u + 20 - shift_x, v + 20 - shift_y, cv2.INTER_CUBIC)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, -1)


def _random_raft(size: str) -> Any:
    torch.manual_seed(2)
    network = raft_small() if size == "small" else raft_large()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_()
            module.running_var.uniform_(0.5, 2.0)
    return network.eval()


def _authors_names(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Torchvision's names back to the authors', written down independently of the adapter."""
    authors: dict[str, torch.Tensor] = {}
    for name, tensor in state.items():
        new = name.replace("feature_encoder", "fnet").replace("context_encoder", "cnet")
        new = re.sub(r"(.net)\.convnormrelu\.0", r"\1.conv1", new)
        new = re.sub(r"(.net)\.convnormrelu\.1", r"\1.norm1", new)
        new = re.sub(r"(.net)\.conv\.", r"\1.conv2.", new)
        new = re.sub(r"convnormrelu(\d)\.0", r"conv\1", new)
        new = re.sub(r"convnormrelu(\d)\.1", r"norm\1", new)
        new = new.replace("motion_encoder.convcorr", "encoder.convc").replace(
            "motion_encoder.convflow", "encoder.convf"
        )
        new = new.replace("motion_encoder.conv.0.", "encoder.conv.")
        new = re.sub(r"encoder\.conv([cf]\d)\.0", r"encoder.conv\1", new)
        two = any("convgru2" in other for other in state)
        new = re.sub(r"recurrent_block\.convgru(\d)\.conv(.)", r"gru.conv\2\1" if two else r"gru.conv\2", new)
        new = new.replace("mask_predictor.convrelu.0", "update_block.mask.0")
        new = new.replace("mask_predictor.conv.", "update_block.mask.2.")
        authors["module." + new] = tensor
        if "cnet" in new and "downsample.1" in new:
            authors["module." + new.replace("downsample.1", "norm3")] = tensor
    return authors


def test_pull_keeps_unknown_depth_from_its_neighbours() -> None:
    depth = np.full(SHAPE, 40.0, np.float32)
    depth[60:70, 60:70] = np.nan
    quarter = pull(depth, np.full((*SHAPE, 2), (0.25, 0.0), np.float32))
    known = np.isfinite(quarter)
    np.testing.assert_allclose(quarter[known], 40.0, rtol=1e-6)
    assert not known[61:69, 61:68].any()
    assert known[:60, :-1].all()


def test_agree_sees_contradictions_and_the_border() -> None:
    forth = np.full((*SHAPE, 2), (5.0, 0.0), np.float32)
    back = -forth
    back[:, 100:] = (-2.0, 0.0)
    consistent = agree(forth, back, 1.0)
    assert consistent[:, :94].all()
    assert not consistent[:, 96:].any()
    assert not agree(forth, -forth, 1.0)[:, -5:].any()


def test_dis_finds_a_known_shift() -> None:
    shift = np.array([2.0, -1.5], np.float32)
    flow = pair_flow(DisFlow(), _texture(), _texture(*shift), 1.0)
    inner = (slice(20, -20), slice(20, -20))
    assert np.abs(flow.to_previous[inner] + shift).mean() < 0.15
    assert flow.consistent[inner].mean() > 0.98
    assert flow.to_previous.dtype == np.float32
    warped = pull(_texture(), flow.to_previous)
    error = np.abs(warped.astype(float) - _texture(*shift))[inner].mean()
    assert error < 0.2 * np.abs(_texture().astype(float) - _texture(*shift))[inner].mean()


def test_flow_that_is_not_checked_is_computed_one_way() -> None:
    class OneWay(DisFlow):
        def estimate_checked(self, *images: Any) -> Any:
            raise AssertionError("the way back serves nothing")

    flow = pair_flow(OneWay(), _texture(), _texture(5), 0.0)
    inside = np.arange(SHAPE[1]) + flow.to_previous[..., 0]
    rows = slice(10, -10)
    np.testing.assert_array_equal(flow.consistent[rows], ((inside >= 0) & (inside <= SHAPE[1] - 1))[rows])
    assert not flow.consistent[rows].all()


def test_checked_dis_flow_begins_at_its_start() -> None:
    # Further than the texture's own size: without a start other parts of it fit.
    shift = np.full((*SHAPE, 2), (20.0, 0.0), np.float32)
    inner = (slice(20, -20), slice(20, -40))
    lost = DisFlow().estimate_checked(_texture(), _texture(20))
    found = DisFlow().estimate_checked(_texture(), _texture(20), (shift, -shift))
    for flow, start, errs in ((lost[0], shift, True), (found[0], shift, False), (found[1], -shift, False)):
        assert (np.abs(flow[inner] - start[inner]).mean() > 0.5) == errs
    assert (shift == (20.0, 0.0)).all()


@pytest.mark.parametrize("size", ["small", "large"])
def test_the_authors_names_lead_to_the_same_network(size: Any, tmp_path: Path) -> None:
    network = _random_raft(size)
    state = network.state_dict()
    authors = _authors_names(state)
    assert not set(authors) & set(state)
    renamed = torchvision_names(authors)
    assert renamed.keys() == state.keys()
    assert all(torch.equal(renamed[name], state[name]) for name in state)
    torch.save(state, tmp_path / "theirs.pth")
    torch.save(authors, tmp_path / "authors.pth")
    pair = (_texture(), _texture(2, 1))
    theirs, ours = (
        RaftFlow(size, iterations=2, device="cpu", checkpoint=tmp_path / f"{file}.pth").estimate(*pair)
        for file in ("theirs", "authors")
    )
    np.testing.assert_array_equal(theirs, ours)


def test_raft_agrees_with_torchvision_by_hand(tmp_path: Path) -> None:
    network = _random_raft("small")
    torch.save(network.state_dict(), tmp_path / "raft.pth")
    estimator = RaftFlow("small", iterations=3, device="cpu", checkpoint=tmp_path / "raft.pth")
    images = [np.ascontiguousarray(_texture(s, 0)[:136, :168]) for s in (0, 3)]
    tensors = [torch.from_numpy(image).permute(2, 0, 1)[None] / 255.0 * 2 - 1 for image in images]
    with torch.no_grad():
        expected = network(*tensors, num_flow_updates=3)[-1][0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(estimator.estimate(*images), expected, atol=1e-3)
    forth, back = estimator.estimate_both(*images)
    np.testing.assert_allclose(forth, expected, atol=1e-3)
    np.testing.assert_allclose(back, estimator.estimate(*images[::-1]), atol=1e-3)
    assert estimator._network.corr_block.corr_pyramid == []  # gigabytes for large images


def test_unfit_checkpoints_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    authors = _authors_names(_random_raft("large").state_dict())
    torch.save(authors, tmp_path / "large.pth")
    with pytest.raises(WeightsError, match="does not hold the weights of raft-small"):
        RaftFlow("small", device="cpu", checkpoint=tmp_path / "large.pth")
    authors["module.cnet.layer2.0.norm3.weight"] = authors["module.cnet.layer2.0.norm3.weight"] + 1
    with pytest.raises(WeightsError, match="different values"):
        torchvision_names(authors)
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path / "none"))
    with pytest.raises(WeightsError, match="scopemap models pull raft-small"):
        create_flow("raft-small")
