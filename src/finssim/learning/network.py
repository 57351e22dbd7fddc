"""A trained network as plain arrays, for evaluation and export, independent of the training library."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

Array = Any
"""A NumPy array or a torch tensor."""


@dataclass(frozen=True)
class Linear:
    """A linear layer, y = x W + b."""

    weight: Array
    """(inputs, outputs)."""
    bias: Array | None
    """(outputs,)."""


@dataclass(frozen=True)
class Activation:
    """An elementwise ONNX operator: Tanh, Relu, Elu or Identity."""

    kind: str
    alpha: float = 1.0
    """Factor of Elu below zero; unused by the others."""


@dataclass(frozen=True)
class Cell:
    """A GRU with torch's equations (gates r, z, n), one step at a time; its memory is its previous output."""

    from_x: Linear
    """Weights from the inputs to all gates, concatenated."""
    from_h: Linear
    """Weights from the previous output to all gates."""

    @property
    def units(self) -> int:
        """Number of outputs."""
        return int(self.from_h.weight.shape[0])

    def step(self, x: Array, h: Array) -> Array:
        """Return the outputs (N, k) after the previous ones."""
        xp, k = _library(x), self.units
        a, b = _linear(self.from_x, x), _linear(self.from_h, h)
        r, z = _sigmoid(xp, a[:, :k] + b[:, :k]), _sigmoid(xp, a[:, k : 2 * k] + b[:, k : 2 * k])
        n = xp.tanh(a[:, 2 * k :] + r * b[:, 2 * k :])
        return n + z * (h - n)


@dataclass(frozen=True)
class Network:
    """Map from observation to mean action: scaling, memory, layers.

    Its memory is one row of numbers, zeros at an episode's start: integrals of the observed errors; the scaled
    observations of the last control steps, newest first; the last action, limited to [-1, 1]; and the memory of its
    cell.
    """

    layers: tuple[Linear | Activation, ...]
    mean: Array | None = None
    """Mean that is subtracted from each observation, (n,)."""
    scale: Array | None = None
    """Factor after the mean is subtracted, (n,)."""
    history: int = 0
    """Number of previous observations in the input."""
    last_action: int = 0
    """Numbers of the last action in the input: all or none."""
    observation_size: int = 0
    """n; required with a history."""
    cell: Cell | None = None
    errors: tuple[int, ...] = ()
    """Elements of the observation to which their integrals are added, see `with_integrals`."""

    @property
    def window_size(self) -> int:
        """Numbers in the history and the last action together."""
        return self.history * self.observation_size + self.last_action

    @property
    def memory_size(self) -> int:
        """Numbers that are passed from one control step to the next."""
        return len(self.errors) + self.window_size + (self.cell.units if self.cell else 0)

    def step(self, observation: Array, memory: Array | None) -> tuple[Array, Array | None]:
        """Return the mean action (N, m), not limited, and the memory after the step.

        Args:
            observation: (N, n).
            memory: (N, `memory_size`); None without memory.
        """
        xp, i, k = _library(observation), len(self.errors), self.window_size
        x, after = observation, []
        if i:
            x, integral = with_integrals(xp, observation, memory[:, :i], self.errors)
            after, memory = [integral], memory[:, i:]
        if self.mean is not None:
            x = (x - self.mean) * self.scale
        y = x if not k else xp.concatenate([x, memory[:, :k]], 1)
        state = []
        if self.cell is not None:
            y = self.cell.step(y, memory[:, k:])
            state = [y]
        for layer in self.layers:
            y = _linear(layer, y) if isinstance(layer, Linear) else _activate(xp, layer, y)
        if k:
            action = xp.clip(y, -1.0, 1.0) if self.last_action else None
            after.append(advance_history(xp, memory[:, :k], x, action, self.history))
        after += state
        return y, (xp.concatenate(after, 1) if len(after) > 1 else after[0]) if after else None

    def as_type(self, kind: Any) -> Network:
        """Return the network with all numbers as NumPy arrays of that type."""

        def cast(value: Any) -> Any:
            if isinstance(value, tuple):
                return tuple(cast(item) for item in value)
            if isinstance(value, Linear | Cell):
                return replace(value, **{f.name: cast(getattr(value, f.name)) for f in fields(value)})
            if value is None or isinstance(value, int | float | str | Activation):
                return value
            return np.asarray(value if isinstance(value, np.ndarray) else value.detach().cpu().numpy(), kind)

        return replace(self, **{f.name: cast(getattr(self, f.name)) for f in fields(self)})


def advance_history(xp: Any, window: Array, x: Array, action: Array | None, history: int) -> Array:
    """Return the window of history and last action after a control step.

    Args:
        xp: NumPy or torch.
        window: Previous window, (N, history * n + m).
        x: Scaled observation of the step, (N, n).
        action: Action of the step, in [-1, 1], (N, m); None if it is not in the window.
        history: Number of stored observations.
    """
    n = x.shape[1]
    past = [x, window[:, : (history - 1) * n]] if history else []
    return xp.concatenate([*past, *([] if action is None else [action])], 1)


INTEGRAL_LIMIT = 0.1
"""Greatest change of an observed error by its integral, in the task's scaling."""
INTEGRAL_REACH = 0.04
"""Scale of the errors that are integrated; much larger ones are not, because they are distances, not disturbances."""
INTEGRAL_RATE = 0.015
"""Fraction of the error that is added in a control step: several seconds at 10 Hz, slow relative to the policy."""


def with_integrals(
    xp: Any, observation: Array, integral: Array, errors: Sequence[int]
) -> tuple[Array, Array]:
    """Return an observation in which persistent errors grow until the policy has removed them.

    For an error e and its integral z, in a control step:

        z ← clip(z + rate · e · exp(-(e / reach)²), ±limit),    e ← e + z

    Args:
        xp: NumPy or torch.
        observation: Observation as defined by the task, (N, n).
        integral: z before the step, (N, k).
        errors: Indices of the k elements.

    Returns:
        The augmented observation, and z after the step.
    """
    index = list(errors)
    e = observation[:, index]
    z = integral + INTEGRAL_RATE * e * xp.exp(-((e / INTEGRAL_REACH) ** 2))
    z = xp.clip(z, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)
    augmented = observation + 0.0
    augmented[:, index] = e + z
    return augmented, z


def first_memory(network: Any, rows: int, device: str | None = None) -> Array | None:
    """Return the initial memory of a network for a number of episodes, (rows, k); None if it has none.

    Args:
        network: A `Network` or a torch module.
        rows: Number of episodes.
        device: Device of a torch tensor; NumPy if None.
    """
    size = getattr(network, "memory_size", 0)
    if not size:
        return None
    if device is None:
        return np.zeros((rows, size), np.float32)
    import torch

    return torch.zeros(rows, size, device=device)


def answer_of(
    network: Any, observation: Array, memory: Array | None, pictures: Mapping[str, Array] | None = None
) -> tuple[Array, Array | None]:
    """Return action (N, m) and memory after the step of a `Network` or a torch module, which may take pictures by
    name."""
    if isinstance(network, Network):
        return network.step(observation, memory)
    if memory is None:
        return network(observation, **(pictures or {})), None
    action, memory = network(observation, memory)
    return action, memory


def _library(array: Array) -> Any:
    return np if isinstance(array, np.ndarray) else sys.modules["torch"]


def _linear(layer: Linear, x: Array) -> Array:
    y = x @ layer.weight
    return y if layer.bias is None else y + layer.bias


def _sigmoid(xp: Any, x: Array) -> Array:
    return 1.0 / (1.0 + xp.exp(-x))


def _activate(xp: Any, layer: Activation, x: Array) -> Array:
    if layer.kind == "Tanh":
        return xp.tanh(x)
    if layer.kind == "Identity":
        return x
    if layer.kind == "Relu":
        return xp.where(x > 0.0, x, 0.0 * x)
    return xp.where(x > 0.0, x, layer.alpha * xp.expm1(xp.where(x > 0.0, 0.0 * x, x)))
