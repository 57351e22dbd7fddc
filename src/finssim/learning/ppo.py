"""PPO on the batched environment: its settings, and the run that turns them into a network."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from torch import nn

from finssim.learning.sb3 import Sb3VecEnv

__all__ = ["Checkpoint", "PpoSettings", "Run", "settings_for", "settings_record", "train_ppo"]

ROLLOUT_SAMPLES = 8192
"""Fewest samples between two updates: with few worlds, rollouts are longer."""

CHECKPOINT_STEPS = 500_000
"""Control steps of all worlds together between two checkpoints."""

RANDOMIZED_STEPS = {"t1": 3_000_000, "t2": 2_000_000}
"""Control steps when every episode has another vehicle: what must be learnt is more."""


@dataclass(frozen=True, kw_only=True)
class PpoSettings:
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
    log_std: float = -1.0
    """Logarithm of the action noise at the start: more hides the goal's last centimetres."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers, ELU, of the policy and of the value each."""


SETTINGS = {
    "t1": PpoSettings(),
    # A reference is close all the time: one second of foresight is enough, and learns faster than five.
    "t2": PpoSettings(discount=0.9),
}
"""By task; any other task learns as T1 does."""


def settings_for(
    task: str = "t1", *, randomized: bool = False, worlds: int | None = None, steps: int | None = None
) -> PpoSettings:
    """The settings of a training; what is None keeps its default."""
    settings = SETTINGS.get(task, SETTINGS["t1"])
    if randomized:
        settings = replace(settings, steps=RANDOMIZED_STEPS.get(task, RANDOMIZED_STEPS["t1"]))
    settings = replace(settings, steps=steps or settings.steps)
    worlds = worlds or settings.worlds
    rollout = max(settings.rollout, math.ceil(ROLLOUT_SAMPLES / worlds))
    return replace(settings, worlds=worlds, rollout=rollout)


Checkpoint = Callable[[nn.Module, int, list[dict[str, Any]]], None]
"""Called with the policy's network, the steps done and the training curve so far."""


@dataclass(frozen=True)
class Run:
    """What a training gave."""

    network: nn.Module
    """Observation to mean action."""
    curves: list[dict[str, Any]]
    """A row for every update: steps, wall time, mean return, ..."""
    interrupted: bool
    """Whether it was stopped before its time, by Ctrl-C."""
    learned: bool
    """Whether the network was updated at all."""


def train_ppo(
    venv: Sb3VecEnv,
    settings: PpoSettings,
    *,
    seed: int,
    device: str = "cpu",
    log: Path | None = None,
    show: Callable[[Mapping[str, Any]], None] = lambda row: None,
    checkpoint: Checkpoint | None = None,
) -> Run:
    """Train a policy network.

    Args:
        venv: The worlds.
        settings: Of the learner.
        seed: Of weights, actions, batches and worlds.
        device: Where torch computes, cpu or cuda.
        log: Folder for TensorBoard; no log if None.
        show: Called with every row of the training curve.
        checkpoint: Called every `CHECKPOINT_STEPS`.

    Returns:
        The run; after Ctrl-C too, with the network as it was.
    """
    model = PPO(
        "MlpPolicy",
        venv,
        learning_rate=lambda remaining: settings.learning_rate * max(remaining, 0.0),
        n_steps=settings.rollout,
        batch_size=settings.batch,
        n_epochs=settings.epochs,
        gamma=settings.discount,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip,
        seed=seed,
        device=device,
        stats_window_size=max(100, settings.worlds),
        policy_kwargs={
            "net_arch": list(settings.hidden),
            "activation_fn": nn.ELU,
            "log_std_init": settings.log_std,
        },
    )
    model.set_logger(configure(str(log) if log else None, ["tensorboard"] if log else []))
    watch = _Watch(show, checkpoint, venv.environment.task)
    interrupted = False
    try:
        model.learn(settings.steps, callback=watch)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        model.logger.close()
    return Run(_network(model), watch.curves, interrupted, learned=model._n_updates > 0)


def _network(model: PPO) -> nn.Module:
    """Observation to mean action, as a plain stack of layers."""
    policy: Any = model.policy
    return nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)


class _Watch(BaseCallback):
    """Writes a row of the curve after every rollout, and the checkpoints."""

    def __init__(
        self,
        show: Callable[[Mapping[str, Any]], None],
        checkpoint: Checkpoint | None,
        task: Any,
    ) -> None:
        super().__init__()
        self.curves: list[dict[str, Any]] = []
        self._show, self._checkpoint, self._next = show, checkpoint, CHECKPOINT_STEPS
        self._hold = float(getattr(task, "hold", 0.0))
        self._start = time.perf_counter()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        episodes = list(self.model.ep_info_buffer or ())
        elapsed = time.perf_counter() - self._start
        policy: Any = self.model.policy
        row = {
            "steps": self.num_timesteps,
            "seconds": round(elapsed, 3),
            "steps_per_s": round(self.num_timesteps / elapsed),
            "mean_return": _mean([e["r"] for e in episodes]),
            "mean_length": _mean([e["l"] for e in episodes]),
            "held": _mean([e["held"] >= self._hold for e in episodes]),
            "mean_reward": float(np.mean(self.model.rollout_buffer.rewards)),  # type: ignore[attr-defined]
            "action_std": float(torch.exp(policy.log_std).mean().item()),
        }
        self.curves.append(row)
        self.logger.record("rollout/held", row["held"])
        self.logger.record("rollout/reward_mean", row["mean_reward"])
        self._show(row)
        if self._checkpoint is not None and self.num_timesteps >= self._next:
            self._next += CHECKPOINT_STEPS
            self._checkpoint(_network(self.model), self.num_timesteps, self.curves)  # type: ignore[arg-type]


def _mean(values: list[Any]) -> float:
    return float(np.mean(values)) if values else 0.0


def settings_record(settings: PpoSettings) -> dict[str, Any]:
    """The settings as plain data, for the policy's description."""
    return {"algorithm": "PPO (Stable-Baselines3)", **asdict(settings)}
