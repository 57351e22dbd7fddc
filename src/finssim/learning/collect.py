"""`finssim collect`: episodes of an expert as a data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.modes import action_mode
from finssim.control.policy import plain_data
from finssim.files import atomic_directory, refuse_unwritable
from finssim.learning.demonstrations import DATASET_FILE, DatasetError, Episode, save
from finssim.provenance import provenance
from finssim.tasks import Environment, make
from finssim.tasks.agents import NOWHERE, Agent, Known, expert_for, restarted

__all__ = ["collect", "record_episodes"]

WORLDS = 64
"""At once, at most."""


def collect(
    expert: str | Path,
    task: str,
    *,
    episodes: int,
    out: Path,
    vehicle: str = "finsrov",
    hydrodynamics: str = "calibrated",
    action: str | None = None,
    randomize: str | Path | None = None,
    observe: str = "training",
    disturb: float = 0.0,
    seed: int = 42,
    show: Callable[[float], None] = lambda part: None,
) -> dict[str, Any]:
    """Run an expert and write what it did.

    Args:
        expert: A policy directory, or a baseline of the task by name.
        task: Key of `TASKS`.
        episodes: How many; of a task with several agents each one's is an episode of its own.
        out: Folder of the data set; an earlier one there is replaced.
        vehicle: Name or file.
        hydrodynamics: calibrated, mesh or simplified.
        action: Mode; the task's own if None.
        randomize: Name or file of ranges; none if None.
        observe: What the expert sees: truth, estimator, sensors or training.
        disturb: Standard deviation of a noise that is added to what is done, and not to what is written: the expert
            is then seen to recover from where it would not have gone by itself. In parts of full action.
        seed: Of everything random.
        show: Called with the part done.

    Returns:
        What the data set says of itself, with `episodes`, `steps`, and in `metrics` the means of the task's measures.

    Raises:
        DatasetError: A number does not fit.
        EnvironmentSetupError, AgentError, PolicyError, VehicleError, OutputError: As they say.
    """
    if episodes < 1 or not 0.0 <= disturb < 1.0:
        raise DatasetError(f"episodes {episodes} and disturb {disturb}: expected 1 or more, and 0 to below 1")
    refuse_unwritable(atomic_directory(out, replaces=DATASET_FILE))
    environment = make(
        task, worlds=min(episodes, WORLDS), vehicle=vehicle, hydrodynamics=hydrodynamics, action=action,
        randomize=randomize, observe=observe, seed=seed,
    )  # fmt: skip
    body = environment.simulator.vehicles[0]
    who = expert_for(expert, body, environment.task, environment.action_mode)
    found = record_episodes(environment, who, episodes, disturb=disturb, seed=seed, show=show)
    described = {
        "task": environment.task.name,
        "expert": who.name,
        "observation": environment.task.schema.model_dump(mode="json"),
        "action": action_mode(environment.action_mode, body).describe(),
        "vehicle": {"name": body.name, "sha256": body.sha256},
        "hydrodynamics": hydrodynamics,
        "randomize": None if randomize is None else str(randomize),
        "observe": observe,
        "disturb": disturb,
        "seed": seed,
        "provenance": provenance(),
    }
    save(out, found, plain_data(described))
    means = {
        name: float(np.nanmean(values))
        if np.isfinite(values := np.array([e.metrics[name] for e in found])).any()
        else None
        for name in found[0].metrics
    }
    steps = sum(len(e.action) for e in found)
    return {**described, "episodes": len(found), "steps": steps, "metrics": means}


def record_episodes(
    environment: Environment,
    expert: Agent,
    count: int,
    *,
    disturb: float = 0.0,
    seed: int = 0,
    show: Callable[[float], None] = lambda part: None,
) -> list[Episode]:
    """Episodes of every agent; every world gives as many, one more or less, so that short ones are not favoured.

    Those of a world in which a number stopped being finite are left out.

    Args:
        environment: Its episodes start over here.
        expert: Who acts.
        count: How many episodes.
        disturb: Noise on what is done [part of full action].
        seed: Of that noise.
        show: Called with the part done.
    """
    rng = np.random.default_rng(seed)
    worlds, agents = environment.worlds, environment.agents
    rows = worlds * agents
    quota = np.full(worlds, count // rows)
    quota[: -(-(count - int(quota.sum()) * agents) // agents)] += 1
    fresh = expert.reset(rows)
    memory, seen = fresh, environment.reset(seed=environment.seed).reshape(rows, -1).copy()
    running: list[list[Any]] = [[] for _ in range(rows)]
    found: list[Episode] = []
    while len(found) < count and quota.any():
        wanted, memory = expert.act(memory, Known(seen), NOWHERE)
        wanted = np.clip(wanted, -1.0, 1.0)
        done = np.clip(wanted + disturb * rng.standard_normal(wanted.shape), -1.0, 1.0).astype(np.float32)
        shape = (worlds, -1) if agents == 1 else (worlds, agents, -1)
        step = environment.step(done.reshape(shape))
        reward = step.reward.reshape(rows)
        for i in range(rows):
            if quota[i // agents]:
                running[i].append((seen[i], wanted[i], float(reward[i])))
        ended = step.terminated | step.truncated
        if ended.any():
            last = step.final_observation.reshape(rows, -1)
            measured = environment.task.metrics(environment.arrays)
            broke = ended & (
                environment.arrays.done.numpy() == 0
            )  # began anew after a number that was not finite
            for w in np.flatnonzero(ended & (quota > 0)):
                quota[w] -= not broke[w]
                whole = {name: float(values[w]) for name, values in measured.items()}
                for i in range(w * agents, (w + 1) * agents):
                    if not broke[w]:
                        found.append(_episode(running[i], last[i], bool(step.terminated[w]), whole))
                    running[i] = []
            memory = restarted(memory, fresh, np.repeat(ended, agents))
        seen = step.observation.reshape(rows, -1).copy()
        show(min(len(found) / count, 1.0))
    return found[:count]


def _episode(
    steps: list[Any], last: NDArray[np.float32], terminated: bool, metrics: dict[str, float]
) -> Episode:
    observation, action, reward = zip(*steps, strict=True)
    return Episode(
        observation=np.array([*observation, last], dtype=np.float32),
        action=np.array(action, dtype=np.float32),
        reward=np.array(reward, dtype=np.float32),
        terminated=terminated,
        metrics=metrics,
    )
