"""From a trained network to the file that the package ships, and back: an ONNX graph with float16 weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from scopemap.engine.depth.scopenet.planes import INSTRUMENTS, PLANES
from training.network import (
    SPREAD_RANGE,
    TYPICAL_LOG_MM,
    TYPICAL_LOG_SPREAD,
    Block,
    Context,
    InstrumentHead,
    InstrumentMerge,
    Merge,
    ScopeNet,
)

_OPSET, _IR_VERSION = 17, 8  # of 2022: every runtime in use reads these


def export(network: ScopeNet, file: Path, facts: dict[str, str]) -> None:
    """Write the network as an ONNX graph: weights in float16 under the network's own names, `facts` as metadata.

    Sides of the picture are multiples of `STRIDE`. Where the network has a head for instruments, the graph has a second
    output, `INSTRUMENTS` (1, 1, H/2, W/2): the probability that a pixel shows one. Runtimes compute in float32, and
    fold the batch normalisations into the convolutions when they load the graph.
    """
    graph = Graph(network)
    answer = graph.scopenet(network, "planes")
    outputs = [helper.make_tensor_value_info(answer, TensorProto.FLOAT, (1, 2, "height", "width"))]
    if network.instruments is not None:
        half = (1, 1, "half height", "half width")
        outputs.append(helper.make_tensor_value_info(INSTRUMENTS, TensorProto.FLOAT, half))
    planes = helper.make_tensor_value_info("planes", TensorProto.FLOAT, (1, PLANES, "height", "width"))
    save_graph(helper.make_graph(graph.nodes, "scopenet", [planes], outputs, graph.tensors), file, facts)


def save_graph(graph: onnx.GraphProto, file: Path, facts: dict[str, str]) -> None:
    """Check a graph and write it as a model with these facts as metadata."""
    versions = {"opset_imports": [helper.make_opsetid("", _OPSET)], "ir_version": _IR_VERSION}
    model = helper.make_model(graph, producer_name="scopemap", **versions)
    helper.set_model_props(model, facts)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, file)


def read_network(file: Path) -> ScopeNet:
    """Return an exported network of the default widths, with its weights in float32, ready for use."""
    state = {}
    for tensor in onnx.load(file).graph.initializer:
        if "." in tensor.name:  # of a part; the others are constants of the graph
            state[tensor.name] = torch.from_numpy(numpy_helper.to_array(tensor).astype(np.float32))
    network = ScopeNet(instruments=any(name.startswith("instruments.") for name in state))
    # The counters of training are not in the file.
    counters = {name: value for name, value in network.state_dict().items() if name.endswith("num_batches_tracked")}
    network.load_state_dict(counters | state)
    return network.eval()


class Graph:
    """Nodes and tensors of a network; every method adds a part and returns the name of its output."""

    def __init__(self, network: nn.Module) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.tensors: list[onnx.TensorProto] = []
        self._names = {part: name for name, part in network.named_modules()}

    def scopenet(self, net: ScopeNet, planes: str) -> str:
        """Add a whole ScopeNet, as in `ScopeNet.forward` but for the padding."""
        self._constant("twice", np.array([1, 1, 2, 2], np.float32))
        x, scales = planes, []
        for stage in net.stages:
            x = self._sequence(stage, x)
            scales.append(x)
        x = self._context(net.context, x)
        if net.instruments is not None:
            self._instruments(net.instruments, planes, [*scales[:-1], x])
        for merge, fine in zip(net.merges, reversed(scales[:-1]), strict=True):
            x = self._merge(merge, x, fine)
        x = self._enlarged(self._convolution(net.from_coarse, x))
        x = self._relu(self._add("Add", x, self._sequence(net.from_planes, planes)))
        x = self._convolution(net.head, self._relu(self._sequence(net.detail, x)))
        typical = np.float32([TYPICAL_LOG_MM, TYPICAL_LOG_SPREAD])[:, None, None]
        x = self._add("Add", x, self._constant("typical", typical))
        # The distance has no bounds.
        low, high = np.float32([[-np.inf, np.inf], SPREAD_RANGE]).T[..., None, None]
        return self._add("Min", self._add("Max", x, self._constant("low", low)), self._constant("high", high))

    def _instruments(self, head: InstrumentHead, planes: str, scales: list[str]) -> None:
        quarter = self._sequence(head.quarter, planes)
        eighth = self._sequence(head.eighth, quarter)
        half, second, third, fourth, coarsest = scales
        x = self._part(head.middle, self._relu(self._convolution(head.start, coarsest)))
        third, second = self._add("Concat", third, eighth, axis=1), self._add("Concat", second, quarter, axis=1)
        for merge, fine in zip(head.merges, (fourth, third, second, half), strict=True):
            x = self._merge(merge, x, fine)
        self.nodes.append(helper.make_node("Sigmoid", [self._convolution(head.last, x)], [INSTRUMENTS]))

    def _sequence(self, parts: nn.Sequential, x: str) -> str:
        for part in parts:
            x = self._part(part, x)
        return x

    def _part(self, part: nn.Module, x: str) -> str:
        match part:
            case nn.Sequential():
                return self._sequence(part, x)
            case nn.Conv2d():
                return self._convolution(part, x)
            case nn.BatchNorm2d():
                names = ("weight", "bias", "running_mean", "running_var")
                return self._add(
                    "BatchNormalization", x, *(self._weight(part, name) for name in names), epsilon=part.eps
                )
            case nn.ReLU():
                return self._relu(x)
            case Block():
                inner = self._sequence(part.second, self._relu(self._sequence(part.first, x)))
                return self._relu(self._add("Add", x, inner))
        raise TypeError(f"no ONNX for {type(part).__name__}")

    def _context(self, part: Context, x: str) -> str:
        mean = self._add("Flatten", self._add("GlobalAveragePool", x))
        whole = self._linear(part.second, self._relu(self._linear(part.first, mean)))
        axes = self._constant("sides", np.array([2, 3]))
        return self._relu(self._add("Add", x, self._add("Unsqueeze", whole, axes)))

    def _merge(self, part: Merge | InstrumentMerge, coarse: str, fine: str) -> str:
        enlarged = self._enlarged(self._convolution(part.from_coarse, coarse))
        return self._part(part.block, self._relu(self._add("Add", enlarged, self._convolution(part.from_fine, fine))))

    def _linear(self, part: nn.Linear, x: str) -> str:
        return self._add("Gemm", x, self._weight(part, "weight"), self._weight(part, "bias"), transB=1)

    def _convolution(self, part: nn.Conv2d, x: str) -> str:
        weights = [self._weight(part, "weight")] + ([] if part.bias is None else [self._weight(part, "bias")])
        sides = {"kernel_shape": part.kernel_size, "strides": part.stride, "pads": part.padding * 2}
        return self._add("Conv", x, *weights, **sides)

    def _enlarged(self, x: str) -> str:
        return self._add("Resize", x, "", "twice", mode="linear", coordinate_transformation_mode="half_pixel")

    def _relu(self, x: str) -> str:
        return self._add("Relu", x)

    def _weight(self, part: nn.Module, name: str) -> str:
        full = f"{self._names[part]}.{name}"
        half = getattr(part, name).detach().cpu().numpy().astype(np.float16)
        return self._add("Cast", self._constant(full, half), to=TensorProto.FLOAT)

    def _constant(self, name: str, array: np.ndarray) -> str:
        self.tensors.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def _add(self, kind: str, *inputs: str, **attributes: object) -> str:
        output = f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output
