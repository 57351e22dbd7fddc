"""Classical controllers by task: each sees what a policy sees and acts as a policy does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finssim.tasks.docking_baseline import DockingPid
from finssim.tasks.formation_baselines import ConsensusFormation
from finssim.tasks.pid_baselines import StationPid, TargetPid, TrackingPid
from finssim.tasks.pursuit_baselines import LeadPursuit
from finssim.tasks.team_pursuit_baselines import FormationPursuit
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["BASELINES", "Baseline", "BaselineError", "baseline", "restarted"]


class BaselineError(ValueError):
    """A baseline that does not exist."""


class Baseline(Protocol):
    """A controller that keeps no state of its own: its memory goes in with every call and comes back."""

    @property
    def period(self) -> float:
        """Time between two actions [s]."""

    def reset(self, n: int) -> Any:
        """Memory at the start of n episodes: arrays with n rows, in tuples or dataclasses; or None."""

    def act(self, memory: Any, observation: NDArray[Any]) -> tuple[NDArray[np.float32], Any]:
        """Actions (n, size) for observations (n, numbers), in the task's own action mode, and the memory after."""


BASELINES: dict[str, dict[str, Callable[..., Baseline]]] = {
    "t1": {"pid": StationPid.for_vehicle},
    "t2": {"pid": TrackingPid.for_vehicle},
    "t3": {"pid": TargetPid.for_vehicle},
    "docking": {"align-insert": DockingPid.for_vehicle},
    "pursuit": {"lead": LeadPursuit.for_vehicle},
    "team-pursuit": {"formation": FormationPursuit.for_vehicle},
    "formation": {"consensus": ConsensusFormation.for_vehicle},
}
"""Task -> name -> maker of the baseline for a vehicle; its `period` is the task's control step."""


def baseline(task: str, name: str, vehicle: Vehicle | str = "finsrov") -> Baseline:
    """A task's baseline by name.

    Raises:
        BaselineError: The task has none of that name.
        ControlError: The vehicle's file does not give what it needs.
    """
    have = BASELINES.get(task, {})
    if name not in have:
        raise BaselineError(
            f"unknown baseline '{name}' of task '{task}'; available: {', '.join(have) or 'none'}"
        )
    return have[name](vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle))


def restarted(memory: Any, fresh: Any, mask: NDArray[Any]) -> Any:
    """A baseline's memory after some episodes started over.

    Args:
        memory: What `act` gave.
        fresh: What `reset` gives for as many episodes.
        mask: Which episodes started over, bool, (n,).

    Returns:
        The rows of `fresh` where mask is true, those of `memory` elsewhere.
    """
    if memory is None:
        return None
    if isinstance(memory, np.ndarray):
        return np.where(mask.reshape(-1, *[1] * (memory.ndim - 1)), fresh, memory)
    if is_dataclass(memory) and not isinstance(memory, type):
        names = [field.name for field in fields(memory)]
        return replace(
            memory, **{name: restarted(getattr(memory, name), getattr(fresh, name), mask) for name in names}
        )
    if isinstance(memory, tuple):
        rows = [restarted(old, new, mask) for old, new in zip(memory, fresh, strict=True)]
        return type(memory)(*rows) if hasattr(memory, "_fields") else tuple(rows)
    raise TypeError(
        f"memory of a baseline is a {type(memory).__name__}, expected arrays in tuples or dataclasses"
    )
