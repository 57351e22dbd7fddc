"""Networks written out as ONNX, operator by operator: layers, with what they remember in front of them or none.

torch's own exporter traces and decomposes the network, which takes seconds for a handful of operators.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from finssim.learning.network import Activation, Cell, Linear, Network

__all__ = ["IR_VERSION", "OPSET", "write_graph"]

OPSET = 18
"""ONNX operator set of every exported network."""

IR_VERSION = 10
"""ONNX file version; the newest that the onnxruntime of 2024 reads."""


def write_graph(network: Network, n: int, m: int) -> bytes:
    """An ONNX file: `observation` (N, n) to `action` (N, m) in [-1, 1].

    Of a network that remembers, `memory` (N, k) goes in too, and `memory_after` comes out.
    """
    network = network.as_type(np.float32)
    graph, x = _Graph(), "observation"
    inputs, outputs = [("observation", n)], [("action", m)]
    if network.mean is not None:
        x = graph.node(
            "Mul", [graph.node("Sub", [x, graph.weight(network.mean)]), graph.weight(network.scale)]
        )
    scaled, after, parts = x, [], {}
    if network.memory_size:
        inputs.append(("memory", network.memory_size))
        outputs.append(("memory_after", network.memory_size))
        sizes = {
            "past": max(network.history - 1, 0) * n,
            "oldest": n if network.history else 0,
            "last": network.last_action,
            "cell": network.cell.memory_size if network.cell else 0,
        }
        parts = graph.split("memory", {name: size for name, size in sizes.items() if size})
    window = [parts[name] for name in ("past", "oldest", "last") if name in parts]
    y = graph.node("Concat", [x, *window], axis=1) if window else x
    if network.cell is not None:
        y, state = graph.cell(network.cell, y, parts["cell"])
        after = [state]
    graph.stack(network.layers, y)
    if window:
        past = [scaled, *([parts["past"]] if "past" in parts else [])] if network.history else []
        after = [*past, *(["action"] if network.last_action else []), *after]
    if after:
        graph.node("Concat", after, "memory_after", axis=1)
    return graph.file(inputs, outputs)


class _Graph:
    """Operators and weights, as they are added."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._weights: list[Any] = []

    def node(self, kind: str, inputs: Sequence[str], output: str = "", **attributes: Any) -> str:
        """Append an operator; the name of its output."""
        output = output or f"{kind.lower()}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def weight(self, values: Any) -> str:
        """Append numbers; their name."""
        name = f"weight_{len(self._weights)}"
        self._weights.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def split(self, x: str, sizes: dict[str, int]) -> dict[str, str]:
        """Columns of a row by name."""
        names = {name: f"{x}_{name}" for name in sizes}
        lengths = self.weight(np.array(list(sizes.values()), np.int64))
        self._nodes.append(helper.make_node("Split", [x, lengths], list(names.values()), axis=1))
        return names

    def linear(self, layer: Linear, x: str) -> str:
        """y = x W + b."""
        bias = [] if layer.bias is None else [self.weight(layer.bias)]
        return self.node("Gemm", [x, self.weight(layer.weight), *bias])

    def cell(self, cell: Cell, x: str, memory: str) -> tuple[str, str]:
        """One step of an LSTM or a GRU, as `Cell.step` has it: its outputs and its memory after."""
        if cell.kind == "gru":
            from_x, from_h = (
                self.gates(self.linear(layer, row), "rzn")
                for layer, row in ((cell.from_x, x), (cell.from_h, memory))
            )
            r, z = (self.node("Sigmoid", [self.node("Add", [from_x[g], from_h[g]])]) for g in "rz")
            n = self.node("Tanh", [self.node("Add", [from_x["n"], self.node("Mul", [r, from_h["n"]])])])
            change = self.node("Mul", [z, self.node("Sub", [memory, n])])
            h = self.node("Add", [n, change])
            return h, h
        state = self.split(memory, {"h": cell.units, "c": cell.units})
        total = self.node("Add", [self.linear(cell.from_x, x), self.linear(cell.from_h, state["h"])])
        gates = self.gates(total, "ifgo")
        i, f, o = (self.node("Sigmoid", [gates[name]]) for name in "ifo")
        g = self.node("Tanh", [gates["g"]])
        c = self.node("Add", [self.node("Mul", [f, state["c"]]), self.node("Mul", [i, g])])
        h = self.node("Mul", [o, self.node("Tanh", [c])])
        return h, self.node("Concat", [h, c], axis=1)

    def gates(self, x: str, names: str) -> dict[str, str]:
        """Equal parts of a row, a letter each."""
        outputs = {name: f"{x}_{name}" for name in names}
        self._nodes.append(
            helper.make_node("Split", [x], list(outputs.values()), axis=1, num_outputs=len(names))
        )
        return outputs

    def stack(self, layers: Sequence[Linear | Activation], x: str) -> None:
        """Layers one after the other, and the limits of the action."""
        for layer in layers:
            if isinstance(layer, Linear):
                x = self.linear(layer, x)
            elif layer.kind == "Elu":
                x = self.node("Elu", [x], alpha=layer.alpha)
            else:
                x = self.node(layer.kind, [x])
        low, high = (self.weight(np.full((), value, np.float32)) for value in (-1.0, 1.0))
        self.node("Clip", [x, low, high], "action")

    def file(self, inputs: Sequence[tuple[str, int]], outputs: Sequence[tuple[str, int]]) -> bytes:
        """The graph as an ONNX file."""
        rows = [
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size]) for name, size in side]
            for side in (inputs, outputs)
        ]
        graph = helper.make_graph(self._nodes, "policy", *rows, self._weights)
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="finssim")
        onnx.checker.check_model(model)
        return bytes(model.SerializeToString())
