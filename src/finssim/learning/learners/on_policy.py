"""Settings that all PPO learners share, whichever library they are of."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from finssim.learning.learners.task_settings import applied
from finssim.tasks import Task

__all__ = ["OnPolicySettings", "fitted"]

ROLLOUT_SAMPLES = 8192
"""Fewest samples between two updates: with few worlds, rollouts are longer."""


@dataclass(frozen=True, kw_only=True)
class OnPolicySettings:
    """Settings of PPO; the defaults, T1's, hold setpoints to a centimetre after some twenty seconds."""

    worlds: int = 256
    steps: int = 1_300_000
    """Control steps of all worlds together."""
    rollout: int = 32
    """Control steps of each world between two updates."""
    batch: int = 2048
    """Samples in a gradient step. At equal arithmetic, many small steps learn faster here than few large ones."""
    epochs: int = 5
    """Passes over a rollout."""
    learning_rate: float = 1.5e-3
    """At the start; falls linearly to zero, which is what brings the last centimetres."""
    discount: float = 0.98
    """Per control step: 5 s of foresight at 10 Hz, a few time constants of the vehicle."""
    gae_lambda: float = 0.95
    clip: float = 0.2
    value_weight: float = 0.5
    """Of the value's squared error beside the policy's objective, where both share a gradient norm."""
    largest_gradient: float = 0.5
    """Longer gradients are shortened to this norm: an odd batch must not undo the work of many."""
    entropy_weight: float = 0.0
    """No reward for noise: it would keep the vehicle from settling."""
    log_std: float = -1.0
    """Logarithm of the action noise at the start: more hides the goal's last centimetres."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers, ELU, of the policy and of the value each."""


S = TypeVar("S", bound=OnPolicySettings)


def fitted(settings: S, task: Task, **given: Any) -> S:
    """The settings for a task, with rollouts long enough; `given` as `task_settings.applied` takes it."""
    settings = applied(settings, **given)
    rows = settings.worlds * len(task.agents)
    return replace(settings, rollout=max(settings.rollout, math.ceil(ROLLOUT_SAMPLES / rows)))
