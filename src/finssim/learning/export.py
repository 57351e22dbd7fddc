"""Export of a trained network as a policy directory that runs without the training library."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from datetime import datetime, timezone
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from finssim.control.modes import MODES, action_mode
from finssim.control.policy import DESCRIPTION_FILE, NETWORK_FILE, Policy, PolicyDescription, VehicleIdentity
from finssim.core.files import atomic_directory
from finssim.core.provenance import provenance
from finssim.core.yaml_file import yaml_text
from finssim.learning.network import (
    INTEGRAL_LIMIT,
    INTEGRAL_RATE,
    INTEGRAL_REACH,
    Activation,
    Cell,
    Linear,
    Network,
    answer_of,
    first_memory,
)
from finssim.tasks.environment import Environment
from finssim.tasks.sensing import seen_with

if TYPE_CHECKING:
    from torch import nn


# Networks written as ONNX, operator by operator: layers, with or without memory in front of them.
#
# torch's own exporter traces and decomposes the network, which takes seconds for a handful of operators.

OPSET = 18
"""ONNX operator set of every exported network."""

IR_VERSION = 10
"""ONNX file version; the newest that onnxruntime of 2024 can read."""


def write_graph(network: Network, n: int, m: int) -> bytes:
    """Return an ONNX file that maps `observation` (N, n) to `action` (N, m) in [-1, 1].

    A network with memory has the additional input `memory` (N, k) and output `memory_after`.
    """
    network = network.as_type(np.float32)
    graph, x = _Graph(), "observation"
    inputs, outputs = [("observation", n)], [("action", m)]
    parts: dict[str, str] = {}
    if network.memory_size:
        inputs.append(("memory", network.memory_size))
        outputs.append(("memory_after", network.memory_size))
        sizes = {
            "integral": len(network.errors),
            "past": max(network.history - 1, 0) * n,
            "oldest": n if network.history else 0,
            "last": network.last_action,
            "cell": network.cell.units if network.cell else 0,
        }
        parts = graph.split("memory", {name: size for name, size in sizes.items() if size})
    after, state = [], []
    if network.errors:
        x, integral = graph.integrals(network.errors, parts["integral"], n)
        after = [integral]
    if network.mean is not None:
        x = graph.scaled(x, network.mean, network.scale)
    scaled = x
    window = [parts[name] for name in ("past", "oldest", "last") if name in parts]
    y = graph.node("Concat", [x, *window], axis=1) if window else x
    if network.cell is not None:
        y = graph.cell(network.cell, y, parts["cell"])
        state = [y]
    graph.stack(network.layers, y)
    if window:
        past = [scaled, *([parts["past"]] if "past" in parts else [])] if network.history else []
        after += [*past, *(["action"] if network.last_action else [])]
    if after + state:
        graph.node("Concat", after + state, "memory_after", axis=1)
    return graph.file(inputs, outputs)


class _Graph:
    """An ONNX graph under construction: its operators and weights."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._weights: list[Any] = []

    def node(self, kind: str, inputs: Sequence[str], output: str = "", **attributes: Any) -> str:
        """Append an operator, and return the name of its output."""
        output = output or f"{kind.lower()}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def weight(self, values: Any) -> str:
        """Append weights, and return their name."""
        name = f"weight_{len(self._weights)}"
        self._weights.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def split(self, x: str, sizes: dict[str, int]) -> dict[str, str]:
        """Split a row into named columns."""
        names = {name: f"{x}_{name}" for name in sizes}
        lengths = self.weight(np.array(list(sizes.values()), np.int64))
        self._nodes.append(helper.make_node("Split", [x, lengths], list(names.values()), axis=1))
        return names

    def linear(self, layer: Linear, x: str) -> str:
        """Append y = x W + b."""
        bias = [] if layer.bias is None else [self.weight(layer.bias)]
        return self.node("Gemm", [x, self.weight(layer.weight), *bias])

    def scaled(self, x: str, mean: Any, scale: Any) -> str:
        """Append (x - mean) scale."""
        return self.node("Mul", [self.node("Sub", [x, self.weight(mean)]), self.weight(scale)])

    def integrals(self, errors: Sequence[int], before: str, n: int) -> tuple[str, str]:
        """Append `with_integrals`: the augmented observation, and the integrals after the step."""
        rate, steepness, low, high = (
            self.weight(np.full((), value, np.float32))
            for value in (INTEGRAL_RATE, -1.0 / INTEGRAL_REACH**2, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)
        )
        e = self.node("Gather", ["observation", self.weight(np.array(errors, np.int64))], axis=1)
        near = self.node("Exp", [self.node("Mul", [steepness, self.node("Mul", [e, e])])])
        gain = self.node("Mul", [rate, self.node("Mul", [e, near])])
        z = self.node("Clip", [self.node("Add", [before, gain]), low, high])
        selection = np.eye(n, dtype=np.float32)[list(errors)]
        return self.node("Add", ["observation", self.node("MatMul", [z, self.weight(selection)])]), z

    def cell(self, cell: Cell, x: str, before: str) -> str:
        """Append one step of a GRU, as `Cell.step`."""
        from_x, from_h = (
            self.gates(self.linear(layer, row), "rzn")
            for layer, row in ((cell.from_x, x), (cell.from_h, before))
        )
        r, z = (self.node("Sigmoid", [self.node("Add", [from_x[g], from_h[g]])]) for g in "rz")
        n = self.node("Tanh", [self.node("Add", [from_x["n"], self.node("Mul", [r, from_h["n"]])])])
        change = self.node("Mul", [z, self.node("Sub", [before, n])])
        return self.node("Add", [n, change])

    def gates(self, x: str, names: str) -> dict[str, str]:
        """Split a row into equal parts, named by one letter each."""
        outputs = {name: f"{x}_{name}" for name in names}
        self._nodes.append(
            helper.make_node("Split", [x], list(outputs.values()), axis=1, num_outputs=len(names))
        )
        return outputs

    def modules(self, layers: Any, x: str) -> str:
        """Append torch layers in sequence: instance norm, convolutions, linear layers, ELU and flattening."""
        for layer in layers:
            weights = [self.weight(w.detach().cpu().numpy()) for w in layer.parameters()]
            if hasattr(layer, "kernel_size"):
                rows, columns = layer.padding
                strides, pads = list(layer.stride), [rows, columns, rows, columns]
                x = self.node("Conv", [x, *weights], strides=strides, pads=pads)
            elif hasattr(layer, "num_features"):
                ones = np.ones(layer.num_features, np.float32)
                inputs = [x, self.weight(ones), self.weight(0.0 * ones)]
                x = self.node("InstanceNormalization", inputs, epsilon=layer.eps)
            elif weights:
                x = self.node("Gemm", [x, *weights], transB=1)
            else:
                x = self.node("Elu" if hasattr(layer, "alpha") else "Flatten", [x])
        return x

    def stack(self, layers: Sequence[Linear | Activation], x: str) -> None:
        """Append layers in sequence, and the limits of the action."""
        for layer in layers:
            if isinstance(layer, Linear):
                x = self.linear(layer, x)
            elif layer.kind == "Elu":
                x = self.node("Elu", [x], alpha=layer.alpha)
            else:
                x = self.node(layer.kind, [x])
        low, high = (self.weight(np.full((), value, np.float32)) for value in (-1.0, 1.0))
        self.node("Clip", [x, low, high], "action")

    def file(
        self,
        inputs: Sequence[tuple[str, int]],
        outputs: Sequence[tuple[str, int]],
        pictures: Mapping[str, Sequence[int]] | None = None,
    ) -> bytes:
        """Return the graph as an ONNX file."""
        rows = [
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size]) for name, size in side]
            for side in (inputs, outputs)
        ]
        rows[0] += [
            helper.make_tensor_value_info(name, TensorProto.UINT8, ["N", *shape])
            for name, shape in (pictures or {}).items()
        ]
        graph = helper.make_graph(self._nodes, "policy", *rows, self._weights)
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="finssim")
        onnx.checker.check_model(model)
        return bytes(model.SerializeToString())


def write_seeing(network: Any, n: int, m: int) -> bytes:
    """Return the ONNX file of a `SeeingNetwork`: besides `observation` each picture, uint8 (N, *shape), by name."""
    graph = _Graph()
    scale = graph.weight(np.full((), 1.0 / 255.0, np.float32))
    mean, factor = (x.cpu().numpy() for x in (network.mean, network.scale))
    features = [graph.scaled("observation", mean, factor)]
    for name in network.shapes:
        x = graph.node("Mul", [graph.node("Cast", [name], to=TensorProto.FLOAT), scale])
        x = graph.node("Transpose", [x], perm=[0, 3, 1, 2])
        features.append(graph.modules(network.encoders[name], x))
    x = graph.modules(network.layers, graph.node("Concat", features, axis=1))
    graph.stack((), x)
    return graph.file([("observation", n)], [("action", m)], network.shapes)


CURVES_FILE = "curves.csv"
EVALUATION_FILE = "evaluation.json"


class ExportError(ValueError):
    """A network cannot be written as a policy, or the written one computes something else."""


def export_policy(
    network: nn.Module | Network | bytes,
    directory: str | Path,
    description: PolicyDescription,
    *,
    curves: Sequence[Mapping[str, Any]] = (),
    evaluation: Mapping[str, Any] | None = None,
    also: Callable[[Path], None] | None = None,
    tolerance: float = 1e-6,
) -> Path:
    """Write a policy directory completely or not at all, after comparing onnxruntime with the network.

    Args:
        network: A `Network`, or a torch module that maps observations (N, n) float32 to the mean action (N, m); the
            written one clips the action to [-1, 1]. Or the result of `onnx_bytes`, which is not compared again.
        directory: Folder to write. An existing policy directory is replaced; any other folder with files is refused.
        description: Description of the training; `memory`, `files`, `provenance` and `created` are filled in.
        curves: Rows of `curves.csv`, with equal keys.
        evaluation: Content of `evaluation.json`.
        also: Function that writes more files into the folder before it replaces the old one.
        tolerance: Largest allowed difference between the actions of network and onnxruntime, beyond rounding [1].

    Returns:
        The folder.

    Raises:
        ExportError: The network's sizes do not fit the description, or the two results differ.
        OutputError: The folder cannot be written.
    """
    content = network if isinstance(network, bytes) else onnx_bytes(network, description)
    inputs = {
        tensor.name: tensor.type.tensor_type.shape for tensor in onnx.load_from_string(content).graph.input
    }
    complete = description.model_copy(
        update={
            "memory": inputs["memory"].dim[-1].dim_value if "memory" in inputs else 0,
            "files": {NETWORK_FILE: hashlib.sha256(content).hexdigest()},
            "provenance": provenance(),
            "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        }
    )
    with atomic_directory(directory, replaces=DESCRIPTION_FILE) as folder:
        (folder / NETWORK_FILE).write_bytes(content)
        record = complete.model_dump(mode="json", exclude=None if complete.pictures else {"pictures"})
        text = yaml_text(record, default_flow_style=None, width=120)
        (folder / DESCRIPTION_FILE).write_text(text, encoding="utf-8")
        _write_curves(folder / CURVES_FILE, curves)
        if evaluation is not None:
            text = json.dumps(evaluation, indent=2, allow_nan=False) + "\n"
            (folder / EVALUATION_FILE).write_text(text, encoding="utf-8")
        if also is not None:
            also(folder)
        policy = Policy.load(folder)
        if not isinstance(network, bytes):
            _check_agreement(network, policy, tolerance)
    return Path(directory)


def description_of(environment: Environment, **training: Any) -> PolicyDescription:
    """Return the description of a policy directory for the environment of its training.

    Args:
        environment: Environment with task, vehicle, action mode and scale, model and ranges.
        training: Further facts on the training, as plain data.
    """
    task, vehicle, ranges = environment.task, environment.nominal[0], environment.randomization
    wrench = MODES[environment.action_mode].wrench
    scale = environment.wrench_scale.tolist() if wrench else 1.0
    return PolicyDescription(
        task=task.name,
        observation=task.schema,
        pictures={} if environment.sight is None else environment.sight.describe(),
        action=action_mode(environment.action_mode, vehicle, scale).describe(),
        control_period=task.control_step,
        vehicle=VehicleIdentity(name=vehicle.name, sha256=vehicle.sha256),
        hydrodynamics=environment.simulator.hydrodynamics,
        seed=environment.seed,
        training={
            **training,
            "randomization": ranges.ranges.model_dump(mode="json") if ranges else None,
            "observe": {**training.get("observe", {}), **seen_with(environment.noise, vehicle)},
            "task": task.record(),
            "agents": list(task.agents),
        },
    )


def save_policy(model: Any, environment: Environment, directory: str | Path, **training: Any) -> Path:
    """Write a network trained with another library, or any other network, as a policy directory.

    Args:
        model: Maps observations (N, n) to the mean action (N, m): a torch module, a `Network`, an algorithm of
            Stable-Baselines3 (PPO, A2C, SAC) or a runner of RSL-RL.
        environment: Environment of the training; for an adapter its `environment`.
        directory: Folder to write; an existing policy directory is replaced.
        training: Further facts on the training, as plain data: learner, steps, ...

    Returns:
        The folder.

    Raises:
        ExportError: The model is of another kind, scales its observations itself, or does not fit the environment.
        OutputError: The folder cannot be written.

    Example:
        save_policy(model, worlds.environment, "runs/mine", learner="sb3 by hand")
    """
    kind = f"{type(model).__module__}.{type(model).__qualname__}"
    described = description_of(environment, **{"learner": kind, "complete": True, **training})
    return export_policy(_mean_of(model, kind), directory, described)


def _mean_of(model: Any, kind: str) -> nn.Module | Network:
    """Return the map from observation to mean action of a library's model."""
    if isinstance(model, Network):
        return model
    from torch import nn

    if isinstance(model, nn.Module):
        return model
    if hasattr(model, "get_vec_normalize_env"):  # Stable-Baselines3
        if model.get_vec_normalize_env() is not None:
            raise ExportError(
                f"{kind}: VecNormalize scales the observations: train without it; the observations are of order one"
            )
        policy = model.policy
        if hasattr(policy, "lstm_actor"):
            raise ExportError(
                f"{kind}: has an LSTM, which a policy directory does not support: ppo has a GRU (--set memory=32)"
            )
        if hasattr(policy, "mlp_extractor"):
            return nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)
        if hasattr(policy, "actor") and hasattr(policy.actor, "latent_pi"):
            return nn.Sequential(policy.actor.latent_pi, policy.actor.mu, nn.Tanh())
    actor = getattr(getattr(model, "alg", None), "actor", None)  # RSL-RL
    if isinstance(getattr(actor, "mlp", None), nn.Module):
        if getattr(actor, "obs_normalization", False):
            raise ExportError(f"{kind}: obs_normalization scales the observations: train without it")
        return nn.Sequential(*actor.mlp)
    raise ExportError(
        f"{kind}: expected a torch module, a Network, an algorithm of Stable-Baselines3 or a runner of RSL-RL: give "
        "the module that maps observations to the mean action"
    )


def onnx_bytes(network: nn.Module | Network, description: PolicyDescription) -> bytes:
    """Return the ONNX file of a network that fits a description.

    Raises:
        ExportError: Its sizes do not fit, or its kind is not supported.
    """
    n, m = description.observation.size, description.action_size
    try:
        pictures = {
            name: np.zeros((2, *picture["shape"]), np.uint8) for name, picture in description.pictures.items()
        }
        memory = _memory(network, 2)
        shape = _answer(network, np.zeros((2, n)), memory, np.float32, pictures, limited=False).shape
    except (
        RuntimeError,
        ValueError,
    ) as error:  # errors of torch and NumPy for matrix sizes that do not fit
        raise ExportError(f"the network does not take observations of {n} elements ({error})") from error
    k = int(getattr(network, "memory_size", 0))
    if shape != (2, m + k):
        raise ExportError(
            f"the network maps (2, {n}) to (2, {shape[1] - k}), but the description has (2, {m})"
        )
    if isinstance(network, Network):
        return write_graph(network, n, m)
    from finssim.learning.torch_networks import SeeingNetwork, plain_network

    if isinstance(network, SeeingNetwork):
        return write_seeing(network, n, m)
    plain = plain_network(network)
    if plain is not None:
        return write_graph(plain, n, m)
    return _trace(network, n)


def _trace(network: nn.Module, n: int) -> bytes:
    """Return the graph of any other network from torch's exporter (takes seconds)."""
    import torch
    from torch import nn

    if find_spec("onnxscript") is None:
        raise ExportError(
            "exporting a network that is no plain stack of linear layers and tanh, ReLU or ELU needs onnxscript: "
            "pip install onnxscript"
        )
    program = torch.onnx.export(
        nn.Sequential(deepcopy(network), nn.Hardtanh()).cpu().eval(),
        (torch.zeros(2, n),),
        dynamo=True,
        opset_version=OPSET,
        input_names=["observation"],
        output_names=["action"],
        dynamic_shapes=({0: torch.export.Dim("N")},),
        verbose=False,
    )
    assert program is not None  # None only if a file name is given
    model = program.model_proto
    model.ir_version = IR_VERSION
    return bytes(model.SerializeToString())


def _check_agreement(network: nn.Module | Network, policy: Policy, tolerance: float) -> None:
    """Compare onnxruntime with the network, to `tolerance` beyond its float32 rounding.

    That rounding, the difference between float32 and float64, is 1e-7 for a fresh network and above 1e-6 for a trained
    one with large gains; a wrong graph differs by far more.
    """
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(512, policy.description.observation.size))
    k = policy.description.memory
    memory = rng.uniform(-1.0, 1.0, size=(512, k)) if k else None
    pictures = {
        name: rng.integers(0, 256, (512, *picture["shape"]), dtype=np.uint8)
        for name, picture in policy.description.pictures.items()
    }
    single = _answer(network, observation, memory, np.float32, pictures)
    double = _answer(network, observation, memory, np.float64, pictures)
    parts = policy.step(memory, observation, pictures)
    answer = np.concatenate([part for part in parts if part is not None], axis=1)
    allowed = tolerance + 4.0 * float(np.max(np.abs(single - double)))
    error = float(np.max(np.abs(answer - double)))
    if not error <= allowed:
        sentence = (
            f"onnxruntime and the network differ by {error:.2g} in an action, expected at most {allowed:.2g}"
        )
        raise ExportError(f"{sentence}: check for weights that are not finite or very large")


def _memory(network: nn.Module | Network, rows: int) -> NDArray[Any] | None:
    memory: NDArray[Any] | None = first_memory(network, rows)
    return memory


def _answer(
    network: nn.Module | Network,
    observation: NDArray[Any],
    memory: NDArray[Any] | None,
    kind: type[np.floating[Any]],
    pictures: Mapping[str, NDArray[np.uint8]],
    limited: bool = True,
) -> NDArray[Any]:
    """Return the action, in [-1, 1] if `limited`, and the memory after the step, (N, m + k), in the given
    precision."""
    inputs = [None if x is None else np.asarray(x, dtype=kind) for x in (observation, memory)]
    if isinstance(network, Network):
        action, after = network.as_type(kind).step(*inputs)
    else:
        import torch

        copy = deepcopy(network).cpu().eval().to(torch.float64 if kind is np.float64 else torch.float32)
        with torch.no_grad():
            tensors = {name: torch.from_numpy(x) for name, x in pictures.items()}
            parts = answer_of(copy, *(None if x is None else torch.from_numpy(x) for x in inputs), tensors)
        if memory is not None or isinstance(parts[0], tuple):
            raise ExportError(
                "a torch module with memory cannot be written: ppo has a GRU (--set memory=32), and a "
                "finssim.learning.network.Network may have one"
            )
        action, after = (None if x is None else x.numpy() for x in parts)
    action = np.clip(action, -1.0, 1.0) if limited else action
    return action if after is None else np.concatenate([action, after], axis=1)


def _write_curves(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        if rows:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
