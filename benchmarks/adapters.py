"""Overhead of each learning library's interface over the batched step: `python benchmarks/adapters.py [--json FILE]`.

Worlds, task and actions are the same, episodes end at different times, and rounds of the raw step and of the adapter
alternate, so that the median of the rounds' ratios depends little on other load. PettingZoo and Gymnasium's `Env` step
one world, and are compared with one world.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

import finssim
from finssim.learning.adapter import age_episodes
from finssim.tasks import Environment

ROUNDS, STEPS = 20, 20


def raw(environment: Environment, action: np.ndarray) -> Callable[[], Any]:
    """Return the step of the batched environment itself."""
    return lambda: environment.step(action)


def gymnasium_vector(environment: Environment, action: np.ndarray) -> Callable[[], Any]:
    """Return the step of Gymnasium's `VectorEnv`."""
    from finssim.learning.gymnasium_env import VectorEnv

    env = VectorEnv(task=environment)
    return lambda: env.step(action)


def sb3(environment: Environment, action: np.ndarray) -> Callable[[], Any]:
    """Return the step of Stable-Baselines3's `VecEnv`."""
    from finssim.learning.sb3 import Sb3VecEnv

    env = Sb3VecEnv(environment)
    rows = action.reshape(-1, action.shape[-1])
    return lambda: env.step(rows)


def torchrl(environment: Environment, action: np.ndarray) -> Callable[[], Any]:
    """Return the step of TorchRL's `EnvBase`, including the reset of finished episodes."""
    import torch

    from finssim.learning.torchrl_env import TorchRlEnv

    env, tensor = TorchRlEnv(environment), torch.as_tensor(action)
    key = ("agents", "action") if environment.agents > 1 else "action"
    now = env.reset()
    age_episodes(environment)

    def step() -> None:
        nonlocal now
        _, now = env.step_and_maybe_reset(now.set(key, tensor))

    return step


def rsl_rl(environment: Environment, action: np.ndarray) -> Callable[[], Any]:
    """Return the step of RSL-RL's `VecEnv`."""
    import torch

    from finssim.learning.rsl_rl_env import RslRlVecEnv

    env, rows = RslRlVecEnv(environment), torch.as_tensor(action.reshape(-1, action.shape[-1]))
    return lambda: env.step(rows)


def gymnasium_single(environment: Environment, action: np.ndarray) -> Callable[[], Any]:
    """Return the step of Gymnasium's `Env`: one world, reset when its episode ends."""
    from finssim.learning.gymnasium_env import Env

    env = Env(environment)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action[0])
        if terminated or truncated:
            env.reset()

    return step


def pettingzoo(environment: Environment, action: np.ndarray) -> Callable[[], Any]:
    """Return the step of PettingZoo's `ParallelEnv`: one world, reset when its episode ends."""
    from finssim.learning.pettingzoo_env import PettingZooEnv

    env = PettingZooEnv(environment)
    env.reset()
    rows = action[0].reshape(environment.agents, -1)
    actions = dict(zip(env.possible_agents, rows, strict=True))

    def step() -> None:
        env.step(actions)
        if not env.agents:
            env.reset()

    return step


BATCHED = (gymnasium_vector, sb3, torchrl, rsl_rl)
SINGLE = (gymnasium_single, pettingzoo)


def seconds(step: Callable[[], Any]) -> float:
    """Measure the time of one step [s]."""
    start = time.perf_counter()
    for _ in range(STEPS):
        step()
    return (time.perf_counter() - start) / STEPS


def compare(
    adapter: Callable[..., Callable[[], Any]], task: str, worlds: int, single: bool
) -> dict[str, float]:
    """Measure steps per second of the raw step and of the adapter, and the ratio of their times."""
    both = []
    for kind in (raw, adapter):
        environment = finssim.make(task, worlds=worlds, seed=1, auto_reset=not single)
        agents = () if environment.agents == 1 else (environment.agents,)
        shape = (worlds, *agents, environment.action_size)
        action = np.random.default_rng(2).uniform(-1.0, 1.0, shape).astype(np.float32)
        both.append(kind(environment, action))
        age_episodes(environment)
    for step in both:
        seconds(step)
    times = []
    for turn in range(ROUNDS):
        # The order alternates too, since the processor's clock falls within a pair.
        order = (0, 1) if turn % 2 else (1, 0)
        took = {k: seconds(both[k]) for k in order}
        times.append((took[0], took[1]))
    return {
        "raw_steps_per_s": round(worlds / min(t[0] for t in times)),
        "steps_per_s": round(worlds / min(t[1] for t in times)),
        "ratio": round(median(b / a for a, b in times), 3),
    }


def main() -> None:
    """Print the figures; write them with --json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="t1")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    several = finssim.make(arguments.task).agents > 1
    figures: dict[str, Any] = {"task": arguments.task, "worlds": arguments.worlds, "adapters": {}}
    for adapter in (*BATCHED, *SINGLE):
        single = adapter in SINGLE
        if several and adapter in (gymnasium_vector, gymnasium_single):
            continue  # its interface has one agent
        found = compare(adapter, arguments.task, 1 if single else arguments.worlds, single)
        figures["adapters"][adapter.__name__] = found
        print(
            f"{adapter.__name__:17} {found['steps_per_s']:>9,} of {found['raw_steps_per_s']:>9,} steps/s, "
            f"{100.0 * (found['ratio'] - 1.0):+.1f} % time of a step" + (" (one world)" if single else ""),
            flush=True,
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
