"""The classical way into a dock: come before its mouth, turn to it, and go in as far as the nose is on the axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.control.pid import PidMemory
from finssim.control.tracking import Goal
from finssim.geometry.rotations import cross, matrix_to_quat, quat_conjugate, quat_rotate
from finssim.tasks.docking import DISTANCE_SCALE, Docking
from finssim.tasks.pid_baselines import PERIOD, Seen, WrenchPid
from finssim.vehicles import Vehicle

__all__ = ["DockingPid"]

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
