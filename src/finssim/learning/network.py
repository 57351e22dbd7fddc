"""A trained network as plain arrays: what is evaluated and exported, whichever library it was learnt with."""

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
    """y = x W + b."""

    weight: Array
    """(inputs, outputs)."""
    bias: Array | None
    """(outputs,)."""


@dataclass(frozen=True)
class Activation:
    """An ONNX operator that acts on each number: Tanh, Relu, Elu or Identity."""

    kind: str
    alpha: float = 1.0
    """Factor of Elu below zero; the others have none."""


@dataclass(frozen=True)
class Cell:
    """A GRU of torch's equations (gates r, z, n), one step at a time; its memory is what it put out."""

    from_x: Linear
    """Weights from its inputs to all gates, side by side."""
    from_h: Linear
    """Weights from its previous output to all gates."""

    @property
    def units(self) -> int:
        """Numbers that it puts out."""
        return int(self.from_h.weight.shape[0])

    def step(self, x: Array, h: Array) -> Array:
        """Outputs (N, k) after those before."""
        xp, k = _library(x), self.units
        a, b = _linear(self.from_x, x), _linear(self.from_h, h)
        r, z = _sigmoid(xp, a[:, :k] + b[:, :k]), _sigmoid(xp, a[:, k : 2 * k] + b[:, k : 2 * k])
        n = xp.tanh(a[:, 2 * k :] + r * b[:, 2 * k :])
        return n + z * (h - n)


@dataclass(frozen=True)
class Network:
    """Observation to mean action: scaling, what is remembered, layers.

    What it remembers is one row of numbers, zeros at an episode's start: integrals of the errors that it observes; the
    scaled observations of the last control steps, newest first; the last action, limited to [-1, 1]; and the memory of
    its cell.
    """

    layers: tuple[Linear | Activation, ...]
    mean: Array | None = None
    """Taken off each observation, (n,)."""
    scale: Array | None = None
    """Factor after the mean is subtracted, (n,)."""
    history: int = 0
    """Earlier observations that it sees."""
    last_action: int = 0
    """Numbers of the last action that it sees: all or none."""
    observation_size: int = 0
    """n; needed where there is a history."""
    cell: Cell | None = None
    errors: tuple[int, ...] = ()
    """Elements of the observation to which their integrals are added, see `with_integrals`."""

    @property
    def window_size(self) -> int:
        """Numbers of the history and the last action together."""
        return self.history * self.observation_size + self.last_action

    @property
    def memory_size(self) -> int:
        """Numbers that it hands on from a control step to the next."""
        return len(self.errors) + self.window_size + (self.cell.units if self.cell else 0)

    def step(self, observation: Array, memory: Array | None) -> tuple[Array, Array | None]:
        """Mean action (N, m), not limited, and the memory after.

        Args:
            observation: (N, n).
            memory: (N, `memory_size`); None where it remembers nothing.
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
        """Return the network with all numbers as NumPy's of that type."""

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
    """The window of history and last action after a control step.

    Args:
        xp: NumPy or torch.
        window: Before it, (N, history * n + m).
        x: The scaled observation of the step, (N, n).
        action: What was done, in [-1, 1], (N, m); None where it is not remembered.
        history: Observations that are remembered.
    """
    n = x.shape[1]
    past = [x, window[:, : (history - 1) * n]] if history else []
    return xp.concatenate([*past, *([] if action is None else [action])], 1)


INTEGRAL_LIMIT = 0.1
"""An integral changes what is observed by this at most, as the task scales it."""
INTEGRAL_REACH = 0.04
"""Errors far beyond this are hardly collected: a way to go is no disturbance."""
INTEGRAL_RATE = 0.015
"""Share of the collected error in a control step: several seconds at ten a second, slow relative to the policy."""


def with_integrals(
    xp: Any, observation: Array, integral: Array, errors: Sequence[int]
) -> tuple[Array, Array]:
    """An observation in which errors that last grow until the policy has done away with them.

    For an error e and its integral z, in a control step:

        z ← clip(z + rate · e · exp(-(e / reach)²), ±limit),    e ← e + z

    Args:
        xp: NumPy or torch.
        observation: As the task defines it, (N, n).
        integral: z before the step, (N, k).
        errors: Which elements, k of them.

    Returns:
        The observation as the policy sees it, and z after the step.
    """
    index = list(errors)
    e = observation[:, index]
    z = integral + INTEGRAL_RATE * e * xp.exp(-((e / INTEGRAL_REACH) ** 2))
    z = xp.clip(z, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)
    augmented = observation + 0.0
    augmented[:, index] = e + z
    return augmented, z


def first_memory(network: Any, rows: int, device: str | None = None) -> Array | None:
    """Return the memory of a network at the start of so many episodes, (rows, k); None if it has none.

    Args:
        network: A `Network` or a torch module.
        rows: How many.
        device: Torch's, for a torch tensor; NumPy if None.
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
    """Action (N, m) and the memory after, of a `Network` or a torch module; one that sees takes pictures by name."""
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
