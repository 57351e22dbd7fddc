"""Demonstrations on disk: Minari data sets in a folder of one's own, and the arrays that learners take from them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.files import atomic_directory
from finssim.yaml_file import json_value

__all__ = ["DATASET_FILE", "DatasetError", "Demonstrations", "Episode", "about", "found_in", "load", "save"]

DATASET_FILE = "metadata.json"
"""Which marks a data set of Minari."""
OURS = "finssim"
"""Key of the metadata under which stands what was demonstrated: task, vehicle, expert, seed, provenance."""


class DatasetError(ValueError):
    """A data set that is not there, or that does not fit."""


@dataclass(frozen=True)
class Episode:
    """One episode of one agent: T actions, T + 1 observations."""

    observation: NDArray[np.float32]
    """(T + 1, n); the last one was not acted on."""
    action: NDArray[np.float32]
    """(T, m), what the expert wanted, in [-1, 1]."""
    reward: NDArray[np.float32]
    """(T,)"""
    terminated: bool
    """Ended by the task; else by its time."""
    metrics: Mapping[str, float]
    """Of the task, such as success."""


@dataclass(frozen=True)
class Demonstrations:
    """All steps of a data set in a row."""

    observation: NDArray[np.float32]
    """(N, n)"""
    action: NDArray[np.float32]
    """(N, m)"""
    following: NDArray[np.float32]
    """Observation after the action, (N, n)."""
    episodes: int
    mean_return: float
    about: Mapping[str, Any]
    """What was demonstrated: task, observation, action, vehicle, expert, seed, provenance."""


def save(out: str | Path, episodes: Sequence[Episode], described: Mapping[str, Any]) -> Path:
    """Write a data set whole or not at all; an earlier one at that place is replaced.

    Args:
        out: Folder of the data set; `minari.MinariDataset(out)` reads it too.
        episodes: At least one.
        described: What is kept of task, vehicle, expert, seed and provenance; plain data.

    Raises:
        DatasetError: There is no episode.
        OutputError: The folder cannot be written, or has other files.
    """
    if not episodes:
        raise DatasetError("no episode to write: none ended")
    import minari
    from gymnasium import spaces
    from minari.dataset.minari_storage import MinariStorage

    n, m = episodes[0].observation.shape[1], episodes[0].action.shape[1]
    with atomic_directory(out, replaces=DATASET_FILE) as folder:
        storage = MinariStorage.new(
            folder,
            observation_space=spaces.Box(-np.inf, np.inf, (n,), np.float32),
            action_space=spaces.Box(-1.0, 1.0, (m,), np.float32),
            data_format="arrow",
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
            observations=episode.observation,
            actions=episode.action,
            rewards=episode.reward,
            terminations=ends[0],
            truncations=ends[1],
            infos={},
        )


def load(place: str | Path) -> Demonstrations:
    """Read a data set.

    Raises:
        DatasetError: There is none, or it was not made by FinsSim.
    """
    import minari

    described = about(place)
    dataset = minari.MinariDataset(Path(place))
    rows = [(e.observations, e.actions, float(np.sum(e.rewards))) for e in dataset.iterate_episodes()]
    return Demonstrations(
        observation=np.concatenate([o[:-1] for o, _, _ in rows]).astype(np.float32),
        action=np.concatenate([a for _, a, _ in rows]).astype(np.float32),
        following=np.concatenate([o[1:] for o, _, _ in rows]).astype(np.float32),
        episodes=len(rows),
        mean_return=float(np.mean([total for _, _, total in rows])),
        about=described,
    )


def about(place: str | Path) -> dict[str, Any]:
    """What a data set is of: task, observation, action, vehicle, expert, seed, provenance, episodes and steps.

    Raises:
        DatasetError: There is none, or it was not made by FinsSim.
    """
    from minari.dataset.minari_storage import MinariStorage

    try:
        found = MinariStorage.read_raw_metadata(Path(place))
    except (ValueError, OSError) as error:
        raise DatasetError(f"{place}: no data set there: make one with finssim collect") from error
    if OURS not in found:
        raise DatasetError(
            f"{place}: not a data set of FinsSim: it does not say of which task and vehicle it is"
        )
    described: dict[str, Any] = json_value(found[OURS], DatasetError, str(place))
    return {**described, "episodes": found["total_episodes"], "steps": found["total_steps"]}


def found_in(place: str | Path) -> list[Path]:
    """The data sets at a place: itself, or those right under it.

    Raises:
        DatasetError: There is none.
    """
    here = Path(place)
    found = (
        [here]
        if (here / DATASET_FILE).is_file()
        else sorted(p.parent for p in here.glob(f"*/{DATASET_FILE}"))
    )
    if not found:
        raise DatasetError(f"{place}: no data set there: make one with finssim collect")
    return found


def _word(name: str) -> str:
    """A name as Minari takes it: letters, digits and dashes."""
    return "".join(c if c.isalnum() else "-" for c in name).strip("-") or "expert"
