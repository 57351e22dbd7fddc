"""Networks written out as ONNX, operator by operator: stacks of layers, with an LSTM in front of them or none.

torch's own exporter traces and decomposes the network, which takes seconds for a handful of operators.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from finssim.learning.recurrent import RecurrentNetwork

__all__ = ["ACTIVATIONS", "IR_VERSION", "OPSET", "can_write", "write_graph"]

OPSET = 18
"""ONNX operator set of every exported network."""

IR_VERSION = 10
"""ONNX file version; the newest that the onnxruntime of 2024 reads."""

ACTIVATIONS = {nn.Tanh: "Tanh", nn.ReLU: "Relu", nn.ELU: "Elu", nn.Identity: "Identity"}
"""Activations with one ONNX operator of the same meaning."""


def can_write(network: nn.Module) -> bool:
    """Whether it is a stack of linear layers and these activations, behind an LSTM of one layer or not."""
    if isinstance(network, RecurrentNetwork):
        lstm, network = network.lstm, network.layers
        if lstm.num_layers > 1 or lstm.bidirectional or lstm.proj_size:
            return False
    layers = _layers(network)
    return all(isinstance(layer, nn.Linear) or type(layer) in ACTIVATIONS for layer in layers)


def write_graph(network: nn.Module, n: int, m: int) -> bytes:
    """An ONNX file: `observation` (N, n) to `action` (N, m) in [-1, 1].

    Of a network that remembers, `memory` (N, k) goes in too, and `memory_after` comes out.
    """
    graph, x = _Graph(), "observation"
    values = [[("observation", n)], [("action", m)]]
    if isinstance(network, RecurrentNetwork):
        x = graph.lstm(network.lstm)
        values = [
            [*values[0], ("memory", network.memory_size)],
            [*values[1], ("memory_after", network.memory_size)],
        ]
        network = network.layers
    graph.stack(list(_layers(network)), x)
    return graph.file(*values)


class _Graph:
    """Operators and weights, as they are added."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._weights: list[Any] = []

    def node(self, kind: str, inputs: Sequence[str], outputs: Sequence[str], **attributes: Any) -> None:
        self._nodes.append(helper.make_node(kind, inputs, outputs, **attributes))

    def gemm(self, x: str, weights: dict[str, torch.Tensor], y: str) -> None:
        """y = x Wᵀ + b; a layer without b has one entry."""
        self._weights += [numpy_helper.from_array(_float32(tensor), name) for name, tensor in weights.items()]
        self.node("Gemm", [x, *weights], [y], transB=1)

    def lstm(self, lstm: nn.LSTM) -> str:
        """One step of torch's LSTM, gates i, f, g, o: c' = f c + i g and h' = o tanh(c'), with h, c in `memory`."""
        weights = dict(lstm.named_parameters())
        for x, name in (("observation", "ih"), ("h", "hh")):
            parts = {
                f"{part}_{name}": weights[f"{part}_{name}_l0"] for part in ("weight", "bias")[: 1 + lstm.bias]
            }
            self.gemm(x, parts, f"from_{name}")
        gates = {"i": "Sigmoid", "f": "Sigmoid", "g": "Tanh", "o": "Sigmoid"}
        first = helper.make_node("Split", ["memory"], ["h", "c"], axis=1, num_outputs=2)
        self._nodes.insert(0, first)
        self.node("Add", ["from_ih", "from_hh"], ["gates"])
        self.node("Split", ["gates"], [f"{gate}_in" for gate in gates], axis=1, num_outputs=4)
        for gate, kind in gates.items():
            self.node(kind, [f"{gate}_in"], [gate])
        self.node("Mul", ["f", "c"], ["kept"])
        self.node("Mul", ["i", "g"], ["taken"])
        self.node("Add", ["kept", "taken"], ["c_after"])
        self.node("Tanh", ["c_after"], ["c_said"])
        self.node("Mul", ["o", "c_said"], ["h_after"])
        self.node("Concat", ["h_after", "c_after"], ["memory_after"], axis=1)
        return "h_after"

    def stack(self, layers: Sequence[nn.Module], x: str) -> None:
        """Layers one after the other, and the limits of the action."""
        for i, layer in enumerate(layers):
            if isinstance(layer, nn.Linear):  # weight, then bias
                self.gemm(x, {f"{name}_{i}": p for name, p in layer.named_parameters()}, f"x_{i}")
            elif isinstance(layer, nn.ELU):
                self.node("Elu", [x], [f"x_{i}"], alpha=float(layer.alpha))
            else:
                self.node(ACTIVATIONS[type(layer)], [x], [f"x_{i}"])
            x = f"x_{i}"
        for name, value in (("low", -1.0), ("high", 1.0)):
            self._weights.append(numpy_helper.from_array(np.full((), value, np.float32), name))
        self.node("Clip", [x, "low", "high"], ["action"])

    def file(self, inputs: Sequence[tuple[str, int]], outputs: Sequence[tuple[str, int]]) -> bytes:
        told = [
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size]) for name, size in values]
            for values in (inputs, outputs)
        ]
        graph = helper.make_graph(self._nodes, "policy", *told, self._weights)
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="finssim")
        onnx.checker.check_model(model)
        return bytes(model.SerializeToString())


def _layers(module: nn.Module) -> Iterable[nn.Module]:
    """The layers of nested `nn.Sequential`s, in order."""
    if isinstance(module, nn.Sequential):
        for child in module:
            yield from _layers(child)
    else:
        yield module


def _float32(tensor: torch.Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = tensor.detach().to("cpu", torch.float32).numpy()
    return array
