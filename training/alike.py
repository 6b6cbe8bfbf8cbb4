"""ALIKE-t: local features by a small network (Zhao et al., "ALIKE", IEEE Transactions on Multimedia 2022, arXiv
2112.02906), written from the paper; its authors' weights (BSD-3-Clause) become the file that the package ships:

    python -m training.alike --weights ../shared/data/weights/alike-t.pth --out src/scopemap/engine/tracking/alike.onnx
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from training.export import Graph, save_graph

_WIDTHS = (8, 16, 32, 64)
_SHARE = 16  # of the features of each scale: a quarter of the descriptor
_POOLS = (1, 2, 4, 4)
_MAPS = ("map1", "map2", "map3", "map4")
_FACTS = {"name": "ALIKE-t", "licence": "BSD-3-Clause, Copyright (c) 2022, Zhao Xiaoming", "paper": "arXiv 2112.02906"}


class Plain(nn.Module):
    """Two convolutions."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs)
        self.conv2, self.bn2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, outputs, H, W)."""
        return functional.relu(self.bn2(self.conv2(functional.relu(self.bn1(self.conv1(x))))))


class Residual(Plain):
    """The same with a short cut around them."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs)
        self.downsample = nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, outputs, H, W)."""
        inner = self.bn2(self.conv2(functional.relu(self.bn1(self.conv1(x)))))
        return functional.relu(inner + self.downsample(x))


class Alike(nn.Module):
    """The network; its parts have the names of the authors' weights."""

    def __init__(self) -> None:
        super().__init__()
        self.block1 = Plain(3, _WIDTHS[0])
        self.block2, self.block3, self.block4 = (Residual(a, b) for a, b in pairwise(_WIDTHS))
        self.conv1, self.conv2, self.conv3, self.conv4 = (nn.Conv2d(n, _SHARE, 1, bias=False) for n in _WIDTHS)
        self.convhead2 = nn.Conv2d(4 * _SHARE, 4 * _SHARE + 1, 1, bias=False)

    def forward(self, rgb: Tensor) -> tuple[Tensor, Tensor]:
        """Return scores (N, 1, H, W), 0..1, and descriptors (N, 64, H, W) of length 1.

        rgb : (N, 3, H, W), 0..1, H and W multiples of 32.
        """
        x, maps = rgb, []
        for pool, block, aggregate in self.scales():
            x = block(functional.max_pool2d(x, pool))
            own = functional.relu(aggregate(x))
            maps.append(functional.interpolate(own, rgb.shape[2:], mode="bilinear", align_corners=True))
        answer = self.convhead2(torch.cat(maps, 1))
        return torch.sigmoid(answer[:, -1:]), functional.normalize(answer[:, :-1])

    def scales(self) -> list[tuple[int, Plain, nn.Conv2d]]:
        """Return pooling, block and aggregation of each scale, from fine to coarse."""
        blocks = (self.block1, self.block2, self.block3, self.block4)
        return list(zip(_POOLS, blocks, (self.conv1, self.conv2, self.conv3, self.conv4), strict=True))


def export_alike(network: Alike, file: Path) -> None:
    """Write the network as an ONNX graph, weights in float16 under their own names.

    Outputs: scores (1, 1, H, W); the features of each scale (1, 16, h, w), not enlarged; and the descriptor's head
    (64, 64). A 1x1 convolution and an enlargement commute: so descriptors are computed at the keypoints alone.
    """
    graph = _AlikeGraph(network)
    graph.features(network, "rgb")
    sides = {"scores": (1, 1, "height", "width"), "head": (4 * _SHARE, 4 * _SHARE)}
    sides |= {name: (1, _SHARE, f"height{n}", f"width{n}") for n, name in enumerate(_MAPS)}
    made = helper.make_graph(
        graph.nodes,
        "alike",
        [helper.make_tensor_value_info("rgb", TensorProto.FLOAT, (1, 3, "height", "width"))],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, sides[name]) for name in ("scores", "head", *_MAPS)],
        graph.tensors,
    )
    save_graph(made, file, _FACTS)


def read_alike(file: Path) -> Alike:
    """Return an exported network, with its weights in float32, ready for use."""
    network = Alike()
    state = network.state_dict()
    for tensor in onnx.load(file).graph.initializer:
        if tensor.name in state:
            state[tensor.name] = torch.from_numpy(numpy_helper.to_array(tensor).astype(np.float32))
    network.load_state_dict(state)
    return network.eval()


class _AlikeGraph(Graph):
    """Nodes and tensors of ALIKE."""

    def features(self, network: Alike, rgb: str) -> None:
        """Add the whole network; its outputs have the names that `export_alike` gives."""
        x, scores = rgb, []
        head = self._weight(network.convhead2, "weight")
        of_descriptor = self._sliced(head, 0, (0, 4 * _SHARE))
        of_score = self._sliced(head, 0, (4 * _SHARE, 4 * _SHARE + 1))
        for n, (pool, block, aggregate) in enumerate(network.scales()):
            if pool > 1:
                x = self._add("MaxPool", x, kernel_shape=(pool, pool), strides=(pool, pool))
            x = self._block(block, x)
            own = self._named(_MAPS[n], "Relu", self._convolution(aggregate, x))
            scores.append(self._score(of_score, n, own, rgb))
        self._named("scores", "Sigmoid", self._add("Sum", *scores))
        self._named("head", "Squeeze", of_descriptor, self._constant("last axes", np.array([2, 3])))

    def _block(self, part: Plain, x: str) -> str:
        inner = self._add("Relu", self._part(part.bn1, self._convolution(part.conv1, x)))
        inner = self._part(part.bn2, self._convolution(part.conv2, inner))
        if isinstance(part, Residual):
            inner = self._add("Add", inner, self._convolution(part.downsample, x))
        return self._relu(inner)

    def _score(self, head: str, scale: int, own: str, rgb: str) -> str:
        """Add what a scale contributes to the scores, before the sigmoid, at the full size."""
        kernel = self._sliced(head, 1, (scale * _SHARE, (scale + 1) * _SHARE))
        score = self._add("Conv", own, kernel, kernel_shape=(1, 1))
        if scale == 0:
            return score
        first = self._add("Shape", score, start=0, end=2)
        sides = self._add("Concat", first, self._add("Shape", rgb, start=2, end=4), axis=0)
        return self._add("Resize", score, "", "", sides, mode="linear", coordinate_transformation_mode="align_corners")

    def _sliced(self, x: str, axis: int, part: tuple[int, int]) -> str:
        name = f"{x} {axis} {part[0]}"
        starts, ends, axes = (self._constant(f"{name} {n}", np.array([v])) for n, v in enumerate((*part, axis)))
        return self._add("Slice", x, starts, ends, axes)

    def _named(self, name: str, kind: str, *inputs: str) -> str:
        self.nodes.append(helper.make_node(kind, inputs, [name]))
        return name


def main() -> None:
    """Convert the authors' weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    network = Alike()
    network.load_state_dict(torch.load(options.weights, map_location="cpu", weights_only=True))
    export_alike(network.eval(), options.out)


if __name__ == "__main__":
    main()
