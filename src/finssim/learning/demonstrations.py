"""Demonstrations on disk: Minari data sets in a user's folder, and their arrays for the learners."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.agents.agent import NOWHERE, Agent, expert_for
from finssim.agents.memory import restarted
from finssim.control.guidance import Known
from finssim.control.modes import action_mode
from finssim.control.policy import plain_data
from finssim.core.files import atomic_directory, refuse_unwritable
from finssim.core.provenance import provenance
from finssim.core.yaml_file import json_value
from finssim.tasks import Environment, make

DATASET_FILE = "metadata.json"
"""File that marks a data set of Minari."""
STATE = "state"
"""Key of the numbers in an observation with pictures."""
OURS = "finssim"
"""Key of the metadata for the demonstrations: task, vehicle, expert, seed, provenance."""


class DatasetError(ValueError):
    """A data set is missing, or does not fit."""


@dataclass(frozen=True)
class Episode:
    """One episode of one agent: T actions, T + 1 observations."""

    observation: NDArray[np.float32]
    """Observations, (T + 1, n); no action followed the last one."""
    action: NDArray[np.float32]
    """Actions of the expert before disturbance, (T, m), in [-1, 1]."""
    reward: NDArray[np.float32]
    """Rewards, (T,)."""
    terminated: bool
    """True if the task ended the episode; False if the time limit did."""
    metrics: Mapping[str, float]
    """Metrics of the task in their units, such as success."""
    pictures: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    """Pictures of a task with pictures, by name; (T + 1, height, width, 3)."""


@dataclass(frozen=True)
class Demonstrations:
    """All steps of a data set in one sequence."""

    observation: NDArray[np.float32]
    """Observations, (N, n)."""
    action: NDArray[np.float32]
    """Actions, (N, m)."""
    following: NDArray[np.float32]
    """Observation after the action, (N, n)."""
    episodes: int
    mean_return: float
    """Mean over episodes of the sum of rewards."""
    about: Mapping[str, Any]
    """Description of the demonstrations: task, observation, action, vehicle, expert, seed, provenance."""
    pictures: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    """Pictures by name, (N, height, width, 3)."""


def save(out: str | Path, episodes: Sequence[Episode], described: Mapping[str, Any]) -> Path:
    """Write a data set completely or not at all; an existing data set there is replaced.

    Args:
        out: Folder of the data set; `minari.MinariDataset(out)` can read it.
        episodes: At least one.
        described: Description of task, vehicle, expert, seed and provenance; plain data.

    Raises:
        DatasetError: There is no episode.
        OutputError: The folder cannot be written, or contains other files.
    """
    if not episodes:
        raise DatasetError("no episode to write: none ended")
    import minari
    from gymnasium import spaces
    from minari.dataset.minari_storage import MinariStorage

    first, m = episodes[0], episodes[0].action.shape[1]
    state = spaces.Box(-np.inf, np.inf, first.observation.shape[1:], np.float32)
    pictures = {name: spaces.Box(0, 255, x.shape[1:], np.uint8) for name, x in first.pictures.items()}
    with atomic_directory(out, replaces=DATASET_FILE) as folder:
        storage = MinariStorage.new(
            folder,
            observation_space=spaces.Dict({STATE: state, **pictures}) if pictures else state,
            action_space=spaces.Box(-1.0, 1.0, (m,), np.float32),
            data_format="arrow",
            jpeg_encoding=False,  # lossy: a policy would learn from other pictures than it acts on
        )
        storage.update_metadata(
            {
                "dataset_id": f"finssim/{described['task']}/{_word(str(described['expert']))}-v0",
                "minari_version": minari.__version__,
                "algorithm_name": str(described["expert"]),
                "description": f"{described['expert']} on {described['task']}, {described['vehicle']['name']}",
                OURS: json.dumps(dict(described)),
            }
        )
        storage.update_episodes(_buffers(episodes))
        storage.update_episode_metadata([{name: float(x) for name, x in e.metrics.items()} for e in episodes])
    return Path(out)


def _buffers(episodes: Iterable[Episode]) -> Iterable[Any]:
    from minari.data_collector import EpisodeBuffer

    for i, episode in enumerate(episodes):
        steps = len(episode.action)
        ends = np.zeros((2, steps), dtype=np.bool_)
        ends[0 if episode.terminated else 1, -1] = True
        yield EpisodeBuffer(
            id=i,
            observations={STATE: episode.observation, **episode.pictures}
            if episode.pictures
            else episode.observation,
            actions=episode.action,
            rewards=episode.reward,
            terminations=ends[0],
            truncations=ends[1],
            infos={},
        )


def load(folder: str | Path) -> Demonstrations:
    """Read a data set.

    Raises:
        DatasetError: There is no data set, or FinsSim did not write it.
    """
    described, episodes = about(folder), list(read_episodes(folder))
    return Demonstrations(
        observation=np.concatenate([e.observation[:-1] for e in episodes]),
        action=np.concatenate([e.action for e in episodes]),
        following=np.concatenate([e.observation[1:] for e in episodes]),
        episodes=len(episodes),
        mean_return=float(np.mean([np.sum(e.reward) for e in episodes])),
        about=described,
        pictures={
            name: np.concatenate([e.pictures[name][:-1] for e in episodes]) for name in episodes[0].pictures
        },
    )


def read_episodes(folder: str | Path) -> Iterator[Episode]:
    """Yield the episodes of a data set, one after another."""
    import minari

    dataset = minari.MinariDataset(Path(folder))
    measured = dataset.storage.get_episode_metadata(dataset.episode_indices)
    for e, metrics in zip(dataset.iterate_episodes(), measured, strict=True):
        views = dict(e.observations) if isinstance(e.observations, dict) else {STATE: e.observations}
        yield Episode(
            observation=views.pop(STATE).astype(np.float32),
            action=e.actions.astype(np.float32),
            reward=e.rewards.astype(np.float32),
            terminated=bool(e.terminations[-1]),
            metrics={name: float(x) for name, x in metrics.items() if isinstance(x, int | float)},
            pictures=views,
        )


def about(folder: str | Path) -> dict[str, Any]:
    """Return the description of a data set: task, observation, action, vehicle, expert, seed, provenance, episodes and
    steps.

    Raises:
        DatasetError: There is no data set, or FinsSim did not write it.
    """
    from minari.dataset.minari_storage import MinariStorage

    try:
        metadata = MinariStorage.read_raw_metadata(Path(folder))
    except (ValueError, OSError) as error:
        raise DatasetError(f"{folder}: no data set there: make one with finssim collect") from error
    if OURS not in metadata:
        raise DatasetError(f"{folder}: not a data set of FinsSim: task and vehicle are missing")
    described: dict[str, Any] = json_value(metadata[OURS], DatasetError, str(folder))
    return {**described, "episodes": metadata["total_episodes"], "steps": metadata["total_steps"]}


def data_sets_in(folder: str | Path) -> list[Path]:
    """Return the data sets at a path: the folder itself, or its direct subfolders.

    Raises:
        DatasetError: There is no data set.
    """
    here = Path(folder)
    data_sets = (
        [here]
        if (here / DATASET_FILE).is_file()
        else sorted(p.parent for p in here.glob(f"*/{DATASET_FILE}"))
    )
    if not data_sets:
        raise DatasetError(f"{folder}: no data set there: make one with finssim collect")
    return data_sets


def _word(name: str) -> str:
    """Return a name in Minari's alphabet: letters, digits and dashes."""
    return "".join(c if c.isalnum() else "-" for c in name).strip("-") or "expert"


# `finssim collect`: record episodes of an expert as a data set.


WORLDS = 64
"""Greatest number of worlds."""


@dataclass(frozen=True, kw_only=True)
class CollectSettings:
    """Settings of demonstrations: the vehicle and its water, its actions, and the expert's observations."""

    vehicle: str = "finsrov"
    """(NAME|FILE) Vehicle in the catalogue, or path of a vehicle file."""
    hydrodynamics: str = "calibrated"
    """(MODEL) Hydrodynamic model: calibrated, simplified or mesh."""
    action: str | None = None
    """Action mode: wrench6, wrench4, thruster8, pilot6, surfaces, course or course_pitch; the
    task's own if not given."""
    randomize: str | None = None
    """(FILE) Ranges of vehicle and water parameters, by name or file."""
    observe: str = "training"
    """(FILE|NAME) Observation: training (the task's noise), sensors (the vehicle's own and position fixes, through a
    filter), a file of other fixes, estimator (typical errors of localization) or truth."""
    disturb: float = 0.0
    """Noise on the executed but not on the stored action, as a fraction of full action, so that the data contain
    recoveries."""
    seed: int = 1
    """Seed of every random number; equal seeds give equal results."""


def collect(
    expert: str | Path,
    task: str,
    *,
    episodes: int,
    out: Path,
    settings: CollectSettings = CollectSettings(),
    show: Callable[[float], None] = lambda part: None,
) -> dict[str, Any]:
    """Run an expert and write its episodes as a data set.

    Args:
        expert: A policy directory, or a baseline of the task by name.
        task: Key of `TASKS`.
        episodes: Number of episodes; with several agents, each agent's is a separate episode.
        out: Folder of the data set; an existing data set there is replaced.
        settings: Vehicle, actions, observations, noise and seed.
        show: Called with the completed fraction.

    Returns:
        The description in the data set, with `episodes`, `steps`, and in `metrics` the means of the task's metrics.

    Raises:
        DatasetError: A number is out of range.
        EnvironmentSetupError, AgentError, PolicyError, VehicleError, OutputError: See these exceptions.
    """
    seed, disturb = settings.seed, settings.disturb
    if episodes < 1 or not 0.0 <= disturb < 1.0:
        raise DatasetError(f"episodes {episodes} and disturb {disturb}: expected 1 or more, and 0 to below 1")
    refuse_unwritable(atomic_directory(out, replaces=DATASET_FILE))
    environment = make(
        task, worlds=min(episodes, WORLDS), vehicle=settings.vehicle, hydrodynamics=settings.hydrodynamics,
        action=settings.action, randomize=settings.randomize, observe=settings.observe, seed=seed,
    )  # fmt: skip
    body = environment.simulator.vehicles[0]
    driver = expert_for(expert, body, environment.task, environment.action_mode)
    recorded = record_episodes(environment, driver, episodes, disturb=disturb, seed=seed, show=show)
    described = {
        "task": environment.task.name,
        "title": environment.task.title,
        "period": environment.task.control_step,
        "expert": driver.name,
        "observation": environment.task.schema.model_dump(mode="json"),
        "action": action_mode(environment.action_mode, body).describe(),
        "vehicle": {"name": body.name, "sha256": body.sha256},
        "hydrodynamics": settings.hydrodynamics,
        "randomize": settings.randomize,
        "observe": settings.observe,
        "disturb": disturb,
        "seed": seed,
        "provenance": provenance(),
    }
    save(out, recorded, plain_data(described))
    means = {
        name: float(np.nanmean(values))
        if np.isfinite(values := np.array([e.metrics[name] for e in recorded])).any()
        else None
        for name in recorded[0].metrics
    }
    steps = sum(len(e.action) for e in recorded)
    return {**described, "episodes": len(recorded), "steps": steps, "metrics": means}


def record_episodes(
    environment: Environment,
    expert: Agent,
    count: int,
    *,
    disturb: float = 0.0,
    seed: int = 0,
    show: Callable[[float], None] = lambda part: None,
) -> list[Episode]:
    """Return episodes of every agent; every world contributes an equal number, give or take one, so that short episodes
    are not overrepresented.

    Episodes of a world in which a number stopped being finite are omitted, and counted.

    Args:
        environment: Environment; its episodes are restarted.
        expert: Agent that acts.
        count: Number of episodes.
        disturb: Noise on executed actions [fraction of full action].
        seed: Seed of that noise.
        show: Called with the completed fraction.

    Raises:
        DatasetError: Far more episodes are omitted than kept.
    """
    rng = np.random.default_rng(seed)
    worlds, agents = environment.worlds, environment.agents
    rows = worlds * agents
    quota = np.full(worlds, count // rows)
    quota[: -(-(count - int(quota.sum()) * agents) // agents)] += 1
    fresh = expert.reset(rows)
    memory, (observed, pictures) = fresh, _separated(environment.reset(seed=environment.seed), rows)
    running: list[list[Any]] = [[] for _ in range(rows)]
    episodes: list[Episode] = []
    broken = 0
    while len(episodes) < count and quota.any():
        action, memory = expert.act(memory, Known(observed, pictures=pictures or None), NOWHERE)
        action = np.clip(action, -1.0, 1.0)
        done = np.clip(action + disturb * rng.standard_normal(action.shape), -1.0, 1.0).astype(np.float32)
        shape = (worlds, -1) if agents == 1 else (worlds, agents, -1)
        step = environment.step(done.reshape(shape))
        reward = step.reward.reshape(rows)
        for i in range(rows):
            if quota[i // agents]:
                views = {name: x[i].copy() for name, x in pictures.items()}
                running[i].append((observed[i], views, action[i], float(reward[i])))
        ended = step.terminated | step.truncated
        if ended.any():
            last, final_pictures = _separated(step.final_observation, rows)
            measured = environment.task.metrics(environment.arrays)
            broke = ended & (
                environment.arrays.done.numpy() == 0
            )  # restarted after a number that was not finite
            broken += int(np.count_nonzero(broke & (quota > 0)))
            if broken > 10 * (count + rows):
                raise DatasetError(
                    f"{broken} episodes ended in a number that is not finite, {len(episodes)} did not: narrow the "
                    "ranges, or check the vehicle file"
                )
            for w in np.flatnonzero(ended & (quota > 0)):
                quota[w] -= not broke[w]
                complete = {name: float(values[w]) for name, values in measured.items()}
                for i in range(w * agents, (w + 1) * agents):
                    if not broke[w]:
                        views = {name: x[i] for name, x in final_pictures.items()}
                        episodes.append(
                            _episode(running[i], last[i], views, bool(step.terminated[w]), complete)
                        )
                    running[i] = []
            memory = restarted(memory, fresh, np.repeat(ended, agents))
        observed, pictures = _separated(step.observation, rows)
        show(min(len(episodes) / count, 1.0))
    return episodes[:count]


def _separated(observation: Any, rows: int) -> tuple[NDArray[np.float32], dict[str, NDArray[np.uint8]]]:
    """Return numbers (rows, n) and pictures by name of an observation, as copies."""
    if not isinstance(observation, dict):
        return observation.reshape(rows, -1).copy(), {}
    pictures = {name: x.copy() for name, x in observation.items() if name != STATE}
    return observation[STATE].reshape(rows, -1).copy(), pictures


def _episode(
    steps: list[Any],
    last: NDArray[np.float32],
    views: dict[str, NDArray[np.uint8]],
    terminated: bool,
    metrics: dict[str, float],
) -> Episode:
    observation, pictures, action, reward = zip(*steps, strict=True)
    return Episode(
        observation=np.array([*observation, last], dtype=np.float32),
        action=np.array(action, dtype=np.float32),
        reward=np.array(reward, dtype=np.float32),
        terminated=terminated,
        metrics=metrics,
        pictures={
            name: np.stack([*(views_of_step[name] for views_of_step in pictures), x])
            for name, x in views.items()
        },
    )
