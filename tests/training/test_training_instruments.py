"""The head that finds instruments: layers, pictures with them, and its training, which leaves the trunk as it is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.extras import DEV

pytest.importorskip("onnx", reason=DEV)

import numpy as np
import onnx
from onnx import numpy_helper

from scopemap.engine.depth.scopenet import estimator as module
from tests.support.drawn_buffers import HEIGHT, WIDTH, sphere
from training.instrument_layers import Layer, LayerStore, render_layer, render_layers
from training.instrument_samples import make_instrument_sample
from training.instruments import main

pytestmark = pytest.mark.dev

SHIPPED = Path(module.__file__).parent / module.WEIGHTS_NAME


@pytest.fixture(scope="module")
def layers(tmp_path_factory: pytest.TempPathFactory) -> LayerStore:
    return render_layers(tmp_path_factory.mktemp("layers") / "layers.npz", 5, (HEIGHT, WIDTH), 1)


def test_layers_are_the_same_whoever_renders_them_and_survive_the_file(layers: LayerStore) -> None:
    assert len(layers) == 5
    for index in (0, 3):
        again, kept = render_layer(1, index, WIDTH, HEIGHT), layers[index]
        np.testing.assert_array_equal(again.pixel, kept.pixel)
        np.testing.assert_array_equal(again.row, kept.row)
        np.testing.assert_array_equal(again.materials, kept.materials)
        np.testing.assert_allclose(again.distance, kept.distance, rtol=1e-3)
        np.testing.assert_allclose(np.linalg.norm(kept.normal, axis=1), 1, atol=0.02)
        assert kept.row.min() >= 1
        assert kept.row.max() < len(kept.materials)


def test_a_picture_shows_the_layer_and_is_true_of_it(layers: LayerStore) -> None:
    """The label is where the picture differs from the one without the layer, but for its shadow and its blur."""
    buffers, near = sphere(), layers[0]
    for seed in range(2):
        sample = make_instrument_sample(buffers, near, np.random.default_rng(seed))
        twin = make_instrument_sample(buffers, near, np.random.default_rng(seed))
        np.testing.assert_array_equal(sample.rgb, twin.rgb)
        bare = make_instrument_sample(buffers, None, np.random.default_rng(seed))
        assert sample.planes.shape == (8, HEIGHT, WIDTH)
        assert sample.instruments.max() <= 1
        assert not bare.instruments.any()
        assert not sample.instruments[~sample.field].any()
    # Tissue in front of all of it hides it: most samples look at the distances.
    far = Layer(**{**near.__dict__, "distance": near.distance + 50})
    hidden = [not make_instrument_sample(buffers, far, np.random.default_rng(n)).instruments.any() for n in range(12)]
    assert 3 <= sum(hidden) <= 11


def test_one_command_trains_a_head_and_leaves_the_depth_as_it_was(tmp_path: Path) -> None:
    recipe = tmp_path / "small.toml"
    recipe.write_text("scenes = 2\nlayers = 3\nheld_out = 2\nsteps = 3\nwarm_up = 1\npictures = 2\n")
    out = tmp_path / "run"
    main(["--out", str(out), "--start", str(SHIPPED), "--recipe", str(recipe), "--threads", "1"])
    before, after = (_tensors(file) for file in (SHIPPED, out / "scopenet.onnx"))
    trunk = {name for name in before if not name.startswith("instruments.")}
    assert trunk == {name for name in after if not name.startswith("instruments.")}
    for name in trunk:
        np.testing.assert_array_equal(before[name], after[name], err_msg=name)
    assert any(name.startswith("instruments.") for name in after)
    figures = json.loads((out / "figures.json").read_text())
    assert {"IoU 320x256", "false 320x256", "threshold, logit"} <= set(figures)


def _tensors(file: Path) -> dict[str, np.ndarray]:
    return {tensor.name: numpy_helper.to_array(tensor) for tensor in onnx.load(file).graph.initializer}
