"""Classical docking: wait in front of the mouth, align, and advance according to the alignment of the nose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from finssim.agents.baselines import LEVEL, PERIOD, Array, Rows, WrenchPid, turned_from
from finssim.agents.pid import PidMemory
from finssim.control.guidance import Goal, Track
from finssim.core.rotations import quat_rotate
from finssim.tasks.docking import DISTANCE_SCALE as DOCK_SCALE
from finssim.tasks.docking import Docking
from finssim.vehicles import Vehicle


@dataclass(frozen=True)
class DockingPid(WrenchPid):
    """PID with a goal that leads the nose along the dock's axis as long as nose and heading are aligned.

    All is in dock axes. Off the axis, or turned away from it, the goal is the waiting position in front of the mouth.
    There is no switch between the two: the goal varies continuously with the alignment.
    """

    nose: float
    """Distance of the vehicle's nose from its origin [m]."""
    berth: float
    """Final position of the nose along the axis [m]."""
    wait: float
    """Position along the axis where the nose waits until it is aligned [m]."""
    gap: float
    """Greatest distance of the nose from the axis in the tube [m]; it grows by `slope` towards the mouth."""
    slope: float
    """Growth of that distance towards the mouth, per distance from the tube [m/m]."""
    lead: float
    """Distance by which the goal leads the nose [m], which determines the speed."""
    turn: float = np.radians(15.0)
    """Greatest angle to the axis [rad]."""

    @classmethod
    def for_vehicle(
        cls,
        vehicle: Vehicle,
        period: float = PERIOD,
        task: Docking | None = None,
        lead: float = 0.25,
        **more: Any,
    ) -> Any:
        """Return the baseline for a vehicle and its dock.

        Args:
            vehicle: Vehicle.
            period: Time between two actions [s].
            task: Task with the dock; `Docking` with its defaults if None.
            lead: Distance by which the goal leads the nose, as a fraction of the vehicle's length.
            more: Further fields.
        """
        task = (task or Docking()).fitted([vehicle])
        dock, hull = task.dock(), task.hull
        return cls(
            WrenchPid.for_vehicle(vehicle, period).pid,
            nose=0.5 * hull.length,
            berth=task.berth * dock.tube_length,
            wait=-dock.cone_length - 0.5 * hull.length,
            gap=dock.throat_radius - hull.girth,
            slope=0.5 * np.tan(task.cone),
            lead=lead * hull.length,
            **more,
        )

    def act(self, memory: PidMemory, observation: Rows) -> tuple[Rows, PidMemory]:
        """Return the actions for observations of docking."""
        o = np.asarray(observation, float)
        return self.steer(memory, DOCK_SCALE * o[..., 15:18], turned_from(o), o[..., 9:15])

    def steer(self, memory: PidMemory, nose: Array, q: Array, nu: Array) -> tuple[Rows, PidMemory]:
        """Return the actions for a position of the nose.

        Args:
            memory: Memory of the PID.
            nose: Position of the nose relative to the throat, dock axes [m], (n, 3).
            q: Quaternion from body to dock axes, xyzw, (n, 4).
            nu: Twist, body frame [m/s, rad/s], (n, 6).
        """
        arm = np.array([self.nose, 0.0, 0.0])
        aim = np.zeros_like(nose)
        aim[..., 0] = self._ahead(nose, quat_rotate(q, [1.0, 0.0, 0.0]))
        level = np.broadcast_to(LEVEL, q.shape)
        track = Track(nose - quat_rotate(q, arm), q, nu)
        return self.command(memory, track, Goal(aim - arm, level))

    def _ahead(self, nose: Array, forward: Array) -> Array:
        """Return the next position of the nose on the axis [m], (n,), from its position and direction, dock
        axes, (n, 3)."""
        aside = np.hypot(nose[..., 1], nose[..., 2])
        allowed = self.gap + self.slope * np.maximum(-nose[..., 0], 0.0)
        turned = np.arccos(np.clip(forward[..., 0], -1.0, 1.0))
        right = np.clip(2.0 - np.maximum(aside / allowed, turned / self.turn), 0.0, 1.0)
        onward = np.minimum(nose[..., 0] + self.lead, self.berth)
        return np.asarray(self.wait + right * (np.maximum(onward, self.wait) - self.wait))
