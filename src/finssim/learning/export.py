"""A torch network as a policy directory that runs without torch."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from datetime import datetime, timezone
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
import yaml
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from finssim.control.policy import Policy
from finssim.control.policy_description import DESCRIPTION_FILE, NETWORK_FILE, PolicyDescription
from finssim.files import atomic_directory
from finssim.provenance import provenance

__all__ = ["CURVES_FILE", "EVALUATION_FILE", "ExportError", "export_policy"]

CURVES_FILE = "curves.csv"
EVALUATION_FILE = "evaluation.json"

OPSET = 18
"""ONNX operator set of every exported network."""

IR_VERSION = 10
"""ONNX file version; the newest that the onnxruntime of 2024 reads."""

ACTIVATIONS = {nn.Tanh: "Tanh", nn.ReLU: "Relu", nn.ELU: "Elu", nn.Identity: "Identity"}
"""Activations with one ONNX operator of the same meaning, for networks written out layer by layer."""


class ExportError(ValueError):
    """A network cannot be written as a policy, or what was written does not compute the same."""


def export_policy(
    network: nn.Module,
    directory: str | Path,
    description: PolicyDescription,
    *,
    curves: Sequence[Mapping[str, Any]] = (),
    evaluation: Mapping[str, Any] | None = None,
    also: Callable[[Path], None] | None = None,
    tolerance: float = 1e-6,
) -> Path:
    """Writes a policy directory whole or not at all, after checking that onnxruntime computes what torch does.

    Args:
        network: Maps observations (N, n) float32 to the mean action (N, m); the written one clips it to [-1, 1].
        directory: Folder to write. An earlier policy directory is replaced; any other folder with files is refused.
        description: What it was trained with; `files`, `provenance` and `created` are filled in here.
        curves: Rows of `curves.csv`, with equal keys.
        evaluation: Content of `evaluation.json`.
        also: Writes more files into the folder before it takes its place.
        tolerance: Largest difference allowed between the actions of torch and onnxruntime, beyond float32 rounding [1].

    Returns:
        The folder.

    Raises:
        ExportError: The network's sizes do not fit the description, or the two disagree.
        OutputError: The folder cannot be written.
    """
    content = _onnx_bytes(network, description)
    complete = description.model_copy(
        update={
            "files": {NETWORK_FILE: hashlib.sha256(content).hexdigest()},
            "provenance": provenance(),
            "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        }
    )
    with atomic_directory(directory, replaces=DESCRIPTION_FILE) as folder:
        (folder / NETWORK_FILE).write_bytes(content)
        text = yaml.safe_dump(
            complete.model_dump(mode="json"),
            sort_keys=False,
            default_flow_style=None,
            allow_unicode=True,
            width=120,
        )
        (folder / DESCRIPTION_FILE).write_text(text, encoding="utf-8")
        _write_curves(folder / CURVES_FILE, curves)
        if evaluation is not None:
            text = json.dumps(evaluation, indent=2, allow_nan=False) + "\n"
            (folder / EVALUATION_FILE).write_text(text, encoding="utf-8")
        if also is not None:
            also(folder)
        _check_agreement(network, Policy.load(folder), tolerance)
    return Path(directory)


def _onnx_bytes(network: nn.Module, description: PolicyDescription) -> bytes:
    n, m = description.observation.size, description.action_size
    try:
        with torch.no_grad():
            shape = tuple(deepcopy(network).cpu().eval()(torch.zeros(2, n)).shape)
    except RuntimeError as error:  # torch's way of saying that matrix sizes do not fit
        raise ExportError(f"the network does not take observations of {n} elements ({error})") from error
    if shape != (2, m):
        raise ExportError(f"the network maps (2, {n}) to {shape}, but the description says (2, {m})")
    layers = list(_layers(network))
    if all(isinstance(layer, nn.Linear) or type(layer) in ACTIVATIONS for layer in layers):
        return _write_layers(layers, n, m)
    return _trace(network, n)


def _layers(module: nn.Module) -> Iterable[nn.Module]:
    """The layers of nested `nn.Sequential`s, in order."""
    if isinstance(module, nn.Sequential):
        for child in module:
            yield from _layers(child)
    else:
        yield module


def _write_layers(layers: Sequence[nn.Module], n: int, m: int) -> bytes:
    """The graph of a multi-layer perceptron, written operator by operator.

    torch's own exporter traces and decomposes the network, which takes seconds for a handful of operators.
    """
    limits = [("low", np.full((), -1.0, np.float32)), ("high", np.full((), 1.0, np.float32))]
    weights = [numpy_helper.from_array(value, name) for name, value in limits]
    nodes, x = [], "observation"
    for i, layer in enumerate(layers):
        if isinstance(layer, nn.Linear):
            tensors = {
                f"{name}_{i}": parameter for name, parameter in layer.named_parameters()
            }  # weight, then bias
            weights += [numpy_helper.from_array(_float32(tensor), name) for name, tensor in tensors.items()]
            nodes.append(helper.make_node("Gemm", [x, *tensors], [f"x_{i}"], transB=1))
        elif isinstance(layer, nn.ELU):
            nodes.append(helper.make_node("Elu", [x], [f"x_{i}"], alpha=float(layer.alpha)))
        else:
            nodes.append(helper.make_node(ACTIVATIONS[type(layer)], [x], [f"x_{i}"]))
        x = f"x_{i}"
    nodes.append(helper.make_node("Clip", [x, "low", "high"], ["action"]))
    inputs = [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["N", n])]
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", m])]
    graph = helper.make_graph(nodes, "policy", inputs, outputs, weights)
    opsets = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="finssim")
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


class _Clipped(nn.Module):
    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        action: torch.Tensor = self.network(observation).clamp(-1.0, 1.0)
        return action


def _trace(network: nn.Module, n: int) -> bytes:
    """The graph of any other network, from torch's exporter (seconds)."""
    if find_spec("onnxscript") is None:
        raise ExportError(
            "exporting a network that is no plain stack of linear layers and tanh, ReLU or ELU needs onnxscript: "
            "pip install onnxscript"
        )
    program = torch.onnx.export(
        _Clipped(deepcopy(network)).cpu().eval(),
        (torch.zeros(2, n),),
        dynamo=True,
        opset_version=OPSET,
        input_names=["observation"],
        output_names=["action"],
        dynamic_shapes=({0: torch.export.Dim("N")},),
        verbose=False,
    )
    assert program is not None  # it is None only where a file is given to write to
    model = program.model_proto
    model.ir_version = IR_VERSION
    return bytes(model.SerializeToString())


def _check_agreement(network: nn.Module, policy: Policy, tolerance: float) -> None:
    """Compares onnxruntime with torch to `tolerance` beyond what float32 rounds off in this network.

    That rounding, seen between torch in float32 and in float64, is 1e-7 for a fresh network and above 1e-6 for a
    trained one with large gains; a wrong graph is off by far more.
    """
    copy = deepcopy(network).cpu().eval()
    shape = (512, policy.description.observation.size)
    observation = torch.as_tensor(np.random.default_rng(0).normal(size=shape))
    with torch.no_grad():
        single = copy(observation.float()).clamp(-1.0, 1.0).numpy()
        double = copy.double()(observation).clamp(-1.0, 1.0).numpy()
    allowed = tolerance + 4.0 * float(np.max(np.abs(single - double)))
    error = float(np.max(np.abs(policy.act(observation.numpy()) - double)))
    if not error <= allowed:
        sentence = f"onnxruntime and torch differ by {error:.2g} in an action, expected at most {allowed:.2g}"
        raise ExportError(f"{sentence}: look for weights that are not finite or huge")


def _float32(tensor: torch.Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = tensor.detach().to("cpu", torch.float32).numpy()
    return array


def _write_curves(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        if rows:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
