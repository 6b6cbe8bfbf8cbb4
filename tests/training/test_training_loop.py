"""The training loop on a handful of drawn scenes: it learns, goes on where it was stopped, exports what it learnt."""

import csv
import json
import os
import subprocess
import sys
from dataclasses import replace

import pytest

from tests.support.extras import NETWORKS
from tests.support.places import ROOT

pytest.importorskip("torch", reason=NETWORKS)

import numpy as np
import torch

from scopemap.engine.depth.scopenet.estimator import ScopeNetDepth, load_network
from tests.support.drawn_buffers import HEIGHT, WIDTH, sphere
from training.buffers import create_store, open_store
from training.calibrate import calibrated, fit_calibration
from training.export import export, read_network
from training.network import TYPICAL_LOG_MM, ScopeNet
from training.recipe import Part, Recipe, Use
from training.report import LOOKS, write_report
from training.train import Training

pytestmark = pytest.mark.networks

SMALL = Part("small", WIDTH, HEIGHT, 4)
HELD_OUT = Part("held-out", WIDTH, HEIGHT, 3)
USES = (Use("small", 2, 3, 1.0, 0.0, 0.5), Use("small", 1, 2, 1.0, 0.5, 1.0))
RECIPE = Recipe(steps=4, check_every=2, warm_up=1, ema=0.5, parts=(SMALL,), uses=USES, held_out=HELD_OUT)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    for part in (SMALL, HELD_OUT):
        store = create_store(folder / part.name, part.count, (HEIGHT, WIDTH))
        for n in range(part.count):
            slope = np.linspace(-0.5, 0.5, WIDTH, dtype=np.float32) * (n + 1)
            wall = sphere(20.0 + 10 * n)
            store.put(n, replace(wall, log_distance=wall.log_distance + slope))
    return folder


@pytest.fixture(scope="module")
def whole(scenes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return Training(RECIPE, scenes, folder, "cpu", lambda text: None).run(), folder


def test_a_stopped_training_goes_on_to_the_same_weights(scenes, whole, tmp_path):
    def stop(text: str) -> None:
        raise KeyboardInterrupt(text)

    with pytest.raises(KeyboardInterrupt, match="step 2 of 4"):
        Training(RECIPE, scenes, tmp_path, "cpu", stop).run()
    said = []
    network = Training(RECIPE, scenes, tmp_path, "cpu", said.append).run()
    assert said[0] == "going on from step 2"
    for (name, value), other in zip(network.state_dict().items(), whole[0].state_dict().values(), strict=True):
        assert torch.equal(value, other), name
    steps = [row["step"] for row in csv.DictReader((tmp_path / "log.csv").open())]
    assert steps == ["2", "4"]


def test_the_exported_file_holds_the_network_in_half_precision(whole, tmp_path):
    network, _ = whole
    export(network, tmp_path / "net.onnx", {"seed": "0"})
    assert (tmp_path / "net.onnx").stat().st_size < 2.1 * sum(value.numel() for value in network.parameters())
    assert load_network(tmp_path / "net.onnx").get_modelmeta().custom_metadata_map == {"seed": "0"}
    again = read_network(tmp_path / "net.onnx").state_dict()
    for name, value in network.state_dict().items():
        counter = name.endswith("num_batches_tracked")
        assert counter or torch.equal(again[name], value.half().float()), name


def test_weights_of_another_network_are_not_read(whole, tmp_path):
    export(ScopeNet(widths=(8, 8, 16, 16, 16)), tmp_path / "small.onnx", {})
    with pytest.raises(RuntimeError, match="size mismatch"):
        read_network(tmp_path / "small.onnx")


def test_calibration_stretches_a_compressed_range_and_rights_the_spread(tmp_path):
    # Alike from left and right: samples are mirrored at random.
    bowl = np.abs(np.linspace(-0.5, 0.5, WIDTH, dtype=np.float32))
    store = create_store(tmp_path, 1, (HEIGHT, WIDTH))
    wall = sphere(20.0)
    store.put(0, replace(wall, log_distance=np.log(20.0) + np.tile(bowl, (HEIGHT, 1))))

    class Compressed(ScopeNet):
        """Knows the truth but says it with half the range, and a spread far too large."""

        def forward(self, planes):
            said = 3.0 + 0.5 * torch.from_numpy(bowl).expand(planes.shape[0], HEIGHT, WIDTH)
            raw = torch.stack([said - TYPICAL_LOG_MM, torch.zeros_like(said) + 2.0], 1)
            raw = raw * self.head.weight[:, 0, 1, 1, None, None] + self.head.bias[:, None, None]
            return raw + torch.tensor([TYPICAL_LOG_MM, 0.0])[:, None, None]

    network = Compressed()
    with torch.no_grad():
        network.head.weight.fill_(1.0)
    fitted = fit_calibration(network, [store])
    before = network(torch.zeros(1, 8, HEIGHT, WIDTH))
    after = calibrated(network, fitted)(torch.zeros(1, 8, HEIGHT, WIDTH))
    assert fitted.exponent == pytest.approx(2.0, abs=0.02)
    assert fitted.spread < 0.05
    expected = fitted.pivot + fitted.exponent * (before[0, 0] - fitted.pivot)
    assert torch.allclose(after[0, 0], expected, atol=1e-5)


def test_the_report_says_every_kind_that_was_there(whole, scenes):
    network, folder = whole
    said = []
    write_report(network, open_store(scenes / "held-out"), folder, said.append)
    assert [line.split()[0] for line in said] == ["held-out", "all", "colon"] * len(LOOKS)
    table = json.loads((folder / "held_out.json").read_text())
    assert list(table) == list(LOOKS)
    assert table["whole size"]["all"]["pictures"] == HELD_OUT.count
    assert table["whole size"]["all"] != table["whole size, nothing strange"]["all"]
    assert (folder / "curves.png").stat().st_size > 1000


def test_one_command_renders_trains_evaluates_and_exports(tmp_path):
    small, large = Part("small", 40, 32, 3), Part("held-out", 40, 32, 2)
    recipe = replace(RECIPE, parts=(small,), uses=(Use("small", 1, 2, 1.0),), held_out=large)
    (tmp_path / "tiny.toml").write_text(recipe.toml())
    command = [sys.executable, "-m", "training", "--out", "run", "--recipe", "tiny.toml", "--threads", "1"]
    root = ROOT
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(root), str(root / "src")])}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "small scenes: 3 of 3 rendered" in done.stdout
    assert "calibrated on training scenes" in done.stdout
    made = {path.name for path in (tmp_path / "run").iterdir()}
    assert made >= {"recipe.toml", "log.csv", "curves.png", "checkpoint.pt", "held_out.json", "scopenet.onnx"}
    estimator = ScopeNetDepth(str(tmp_path / "run" / "scopenet.onnx"))
    assert estimator.provenance()["depth"] == "scopenet"
