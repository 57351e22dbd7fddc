"""`check_task`: search a user-defined task for common mistakes by running a few short episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.tasks.environment import Environment
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle

LARGEST = 20.0
"""Magnitude above which an observation counts as unbounded: networks need numbers of order one."""

WORLDS = 8
"""Number of worlds in the check."""

EPISODE = 10
"""Control steps of an episode in the check; there are `EPISODES` episodes."""

EPISODES = 3


class TaskError(ValueError):
    """A task has mistakes; the message has one sentence for each."""


class Played(NamedTuple):
    """Recorded results, by step and world."""

    observation: NDArray[np.float32]
    """(steps, worlds, numbers of all agents)"""
    reward: NDArray[np.float32]
    """Rewards, (steps, worlds, agents)."""
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    metrics: dict[str, NDArray[np.float64]]
    """Metrics at the end, in their units."""

    @property
    def ended(self) -> NDArray[np.bool_]:
        """Return which episodes ended, (steps, worlds)."""
        return self.terminated | self.truncated


def check_task(
    task: Task, vehicle: Vehicle | str | Sequence[Vehicle | str] = "finsrov", **options: Any
) -> None:
    """Run a task with random actions and check for mistakes.

    Mistakes are: observations that are not finite, unbounded or outside their clip; results that differ for equal seeds
    or with the number of worlds; episodes that do not end, or end twice; rewards and observations that depend on the
    previous episode; identical starts; metrics that contradict the steps.

    Args:
        task: The task.
        vehicle: One vehicle for all roles of the task, or one for each.
        options: Further arguments of `Environment`.

    Raises:
        TaskError: There are mistakes.
        EnvironmentSetupError: The task does not run with these vehicles.
    """
    short = replace(task, time_limit=EPISODE * task.control_step)

    def environment(worlds: int) -> Environment:
        return Environment(short, vehicle, worlds=worlds, **{"seed": 1, **options})

    env = environment(WORLDS)
    agents = () if env.agents == 1 else (env.agents,)
    shape = (EPISODES * EPISODE, 9 * WORLDS, *agents, env.action_size)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)
    first = _play(env, actions[:, :WORLDS])
    again = _play(environment(WORLDS), actions[:, :WORLDS])
    many = _play(environment(9 * WORLDS), actions)
    otherwise = actions[:, :WORLDS].copy()
    otherwise[:EPISODE] *= -1.0
    past = _play(environment(WORLDS), otherwise)

    mistakes = [
        *_observation(first, short, env.agents),
        *_ends(first),
        *_repeats(first, again, many),
        *_leaks(first, past),
        *_starts(first),
        *_metrics(first),
    ]
    if mistakes:
        raise TaskError(f"task '{task.name}': " + "; ".join(mistakes))


def _play(environment: Environment, actions: NDArray[np.float32]) -> Played:
    rows: list[tuple[Any, ...]] = []
    worlds = environment.worlds
    for action in actions:
        step = environment.step(action)
        numbers = (x.reshape(worlds, -1).copy() for x in (step.observation, step.reward))
        rows.append((*numbers, step.terminated.copy(), step.truncated.copy()))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Played(*columns, environment.task.metrics(environment.arrays))


def _observation(played: Played, task: Task, agents: int) -> Iterator[str]:
    """Yield findings on observations, which must be finite and of order one, part by part, and on rewards."""
    if not np.isfinite(played.reward).all():
        yield "a reward is not finite"
    first, table = 0, played.observation.reshape(*played.observation.shape[:2], agents, -1)
    for part in task.observation:
        numbers = table[..., first : first + part.size]
        first += part.size
        if not np.isfinite(numbers).all():
            yield f"observation '{part.name}' is not finite"
            continue
        largest = float(np.abs(numbers).max())
        if part.clip is not None and largest > part.clip * (1.0 + 1e-6):
            yield f"observation '{part.name}' reaches {largest:.3g}, expected at most its clip of {part.clip:g}"
        elif largest > LARGEST:
            yield f"observation '{part.name}' reaches {largest:.3g}: give it a scale or a clip"


def _ends(played: Played) -> Iterator[str]:
    """Yield findings on ends: every episode must end by its time limit, either terminated or truncated."""
    if (played.terminated & played.truncated).any():
        yield "an episode is terminated and truncated at once: a failure at the time limit is a failure"
    for world in range(played.ended.shape[1]):
        ends = np.flatnonzero(played.ended[:, world])
        if len(ends) == 0 or np.diff([-1, *ends]).max() > EPISODE:
            yield f"an episode continues after its time limit of {EPISODE} control steps"
            return


def _repeats(first: Played, again: Played, many: Played) -> Iterator[str]:
    """Yield findings on repeatability: equal seeds must give equal numbers, for any number of worlds."""
    if not _equal(first, again):
        yield "equal seeds give other numbers: draw from wp.rand_init(key, world) or w.uniform alone"
        return
    if not _equal(first, many):
        yield (
            "a world's numbers depend on how many worlds there are: index by the world's number, with world_offset; in "
            "torch, do not mix rows, and take arctangent of torch_rotations for atan2"
        )


def _equal(first: Played, other: Played) -> bool:
    """Return whether the first worlds of another run have the same numbers."""
    pairs = zip(first[:4], other[:4], strict=True)
    return all(np.array_equal(a, b[:, :WORLDS], equal_nan=a.dtype.kind == "f") for a, b in pairs)


def _leaks(first: Played, past: Played) -> Iterator[str]:
    """Yield findings on leaks: an episode must not depend on the previous one."""
    full = [p.ended[EPISODE - 1] & ~p.ended[: EPISODE - 1].any(axis=0) for p in (first, past)]
    worlds = full[0] & full[1]
    second = slice(EPISODE, 2 * EPISODE)
    start = slice(EPISODE - 1, 2 * EPISODE - 1)
    if not np.array_equal(first.observation[start][:, worlds], past.observation[start][:, worlds]):
        yield "an observation depends on the episode before: set everything at the start"
    elif not np.array_equal(first.reward[second][:, worlds], past.reward[second][:, worlds]):
        yield "a reward depends on the previous episode: reset its memory at the start"


def _starts(played: Played) -> Iterator[str]:
    """Yield findings on observations after a reset, which must differ between worlds and episodes."""
    starts = played.observation[played.ended]
    if len(starts) > 1 and len({row.tobytes() for row in starts}) == 1:
        yield "every episode starts alike: draw something at the start or in reset, from the key or with w.uniform"


def _metrics(played: Played) -> Iterator[str]:
    """Yield findings on metrics: return and length must be those of the last episode, and all metrics by world."""
    steps, worlds = played.ended.shape
    for name, values in played.metrics.items():
        if np.shape(values) != (worlds,):
            yield f"metric '{name}' has shape {np.shape(values)}, expected ({worlds},): one number a world"
            return
    for world in range(worlds):
        ends = [-1, *np.flatnonzero(played.ended[:, world])]
        if len(ends) < 2:
            return
        last = slice(ends[-2] + 1, ends[-1] + 1)
        total = float(played.reward[last, world].mean(axis=1).sum())
        if last.stop - last.start != played.metrics["length"][world] or not np.isclose(
            total, played.metrics["return"][world], rtol=1e-3, atol=1e-3
        ):
            yield (
                "return and length are not those of the last episode: leave those that Task.metrics gives as they are"
            )
            return
