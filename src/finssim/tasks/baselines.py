"""Classical controllers by task: each sees what a policy sees and acts as a policy does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finssim.control.pid import PidMemory
from finssim.control.tracking import Goal
from finssim.geometry.rotations import cross, matrix_to_quat, quat_conjugate, quat_rotate
from finssim.tasks.docking import DISTANCE_SCALE, Docking
from finssim.tasks.formation_baselines import ConsensusFormation
from finssim.tasks.pid_baselines import PERIOD, Seen, StationPid, TargetPid, TrackingPid, WrenchPid
from finssim.tasks.pursuit_baselines import LeadPursuit
from finssim.tasks.team_pursuit_baselines import FormationPursuit
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["BASELINES", "Baseline", "BaselineError", "baseline", "restarted"]

# The classical way into a dock: come before its mouth, turn to it, and go in as far as the nose is on the axis.

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DockingPid:
    """A PID whose goal runs ahead of the nose, along the dock's axis, while nose and heading are right.

    In dock axes. Beside the axis, or turned away, the goal is the waiting place before the mouth; there is no switch
    between the two: the goal moves with how right it is.
    """

    controller: WrenchPid
    nose: float
    """Of the vehicle, from its origin [m]."""
    berth: float
    """Where the nose is to rest, along the axis [m]."""
    wait: float
    """Where the nose waits until it is right, along the axis [m]."""
    gap: float
    """How far beside the axis the nose may be in the tube [m]; towards the mouth it grows by `slope`."""
    slope: float
    lead: float
    """How far the goal runs ahead of the nose [m]: it sets the speed."""
    turn: float = np.radians(15.0)
    """How far the vehicle may be turned away [rad]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD) -> DockingPid:
        """For a vehicle and its dock, and the time between two actions [s]."""
        task = Docking().fitted([vehicle])
        dock, hull = task.dock(), task.hull
        return cls(
            WrenchPid.for_vehicle(vehicle, period),
            nose=0.5 * hull.length,
            berth=task.berth * dock.tube_length,
            wait=-dock.cone_length - 0.5 * hull.length,
            gap=dock.throat_radius - hull.girth,
            slope=0.5 * np.tan(task.cone),
            lead=0.25 * hull.length,
        )

    @property
    def period(self) -> float:
        """Time between two actions [s]."""
        return self.controller.pid.period

    def reset(self, n: int) -> PidMemory:
        """Empty integrals."""
        return self.controller.pid.reset(n)

    def act(
        self, memory: PidMemory, observation: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], PidMemory]:
        """Actions for observations of docking."""
        o = np.asarray(observation, float)
        x, y = o[..., 3:6], o[..., 6:9]
        q = quat_conjugate(matrix_to_quat(np.stack([x, y, cross(x, y)], axis=-1)))
        nose = DISTANCE_SCALE * o[..., 15:18]
        arm = np.array([self.nose, 0.0, 0.0])
        place = np.zeros_like(nose)
        place[..., 0] = self._ahead(nose, quat_rotate(q, [1.0, 0.0, 0.0]))
        level = np.broadcast_to([0.0, 0.0, 0.0, 1.0], q.shape)
        seen = Seen(nose - quat_rotate(q, arm), q, o[..., 9:15])
        return self.controller.command(memory, seen, Goal(place - arm, level))

    def _ahead(self, nose: Array, forward: Array) -> Array:
        """Where on the axis the nose is to go next [m], (n,), from where it is and points, dock axes, (n, 3)."""
        aside = np.hypot(nose[..., 1], nose[..., 2])
        allowed = self.gap + self.slope * np.maximum(-nose[..., 0], 0.0)
        turned = np.arccos(np.clip(forward[..., 0], -1.0, 1.0))
        right = np.clip(2.0 - np.maximum(aside / allowed, turned / self.turn), 0.0, 1.0)
        onward = np.minimum(nose[..., 0] + self.lead, self.berth)
        return np.asarray(self.wait + right * (np.maximum(onward, self.wait) - self.wait))


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
