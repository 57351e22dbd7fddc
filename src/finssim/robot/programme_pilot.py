"""A pilot that plays an excitation programme: a wrench over time on some axes, the others held where they were."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.control.controllers import controller
from finssim.control.errors import ControlError
from finssim.control.guidance import Guide, goal_at
from finssim.control.modes import Wrench6
from finssim.control.tracking import Goal, Measured
from finssim.geometry.rotations import quat_inverse_rotate, quat_rotate
from finssim.vehicles import AXES, Vehicle

__all__ = ["ProgrammePilot"]

Array = npt.NDArray[np.float64]

HELD = ("surge", "sway", "heave", "yaw")
"""Axes that are held while others are excited; roll and pitch right themselves."""
HELD_IN_TURNS = ("heave",)
"""The same while the heading is excited: a place cannot be held in axes that go round."""


class ProgrammePilot:
    """Commands a programme open-loop on its axes. The other axes a PID keeps at the guide's pose.

    Without that, propellers that are not alike turn a vehicle around on a way of two metres. What a fit needs is the
    wrench that acted, whoever asked for it.
    """

    needs_state = True
    name = "programme"

    def __init__(
        self,
        tau_desired: npt.ArrayLike,
        phase: Sequence[str] | npt.NDArray[np.str_],
        rate: float,
        axes: Sequence[str],
        vehicle: Vehicle,
        *,
        room: float | None = None,
        ascent_speed: float | None = None,
        ascent_time: float = 2.0,
        hold: str | None = "pid",
        period: float = 0.05,
    ) -> None:
        """
        Args:
            tau_desired: Wrench about `vehicle.wrench_reference`, body frame, held over each row [N, N m], (n, 6).
            phase: A word for every row; rows of `excitation` may end early, see `room`.
            rate: Of the rows [Hz].
            axes: That the programme excites.
            vehicle: Whose thrusters; its model gives the gains of the PID.
            room: Longest way from where the programme began, after which the excitation ends [m].
            ascent_speed: A coast ends when the vehicle has risen faster than this [m/s] for `ascent_time` [s].
            ascent_time: [s]
            hold: Name of the PID; None leaves the other axes alone.
            period: Time between two decisions [s].

        Raises:
            ControlError: Rows and phases differ in number, or an unknown axis or PID.
        """
        self._tau, self._phase = np.asarray(tau_desired, float), np.asarray(phase)
        unknown = [axis for axis in axes if axis not in AXES]
        if self._tau.shape != (len(self._phase), 6) or not len(self._phase) or unknown:
            raise ControlError(
                f"a programme of shape {self._tau.shape} with {len(self._phase)} phases on {', '.join(axes)}: "
                f"expected a wrench and a phase for every row, on axes of {', '.join(AXES)}"
            )
        self.period, self._rate, self._room = period, rate, room
        self._ascent, self._ascent_time = ascent_speed, ascent_time
        self._mode = Wrench6.from_vehicle(vehicle)
        self._limits = np.asarray(vehicle.wrench_limits, float)
        kept = HELD_IN_TURNS if "yaw" in axes else HELD
        self._driven = [AXES.index(axis) for axis in axes]  # type: ignore[arg-type]
        self._held = [AXES.index(a) for a in kept if hold is not None and a not in axes]
        self._hold = controller(hold, vehicle, period=period) if hold is not None else None
        self.reset()

    def reset(self) -> None:
        """Begin again."""
        self._memory: Any = self._hold.reset() if self._hold is not None else None
        self._skipped = 0
        self._origin: Array | None = None
        self._rising_since: float | None = None
        self.phase = ""
        """The word of the row that was commanded last; empty before and after the programme."""
        self.finished = False
        """Whether the programme is over."""

    def describe(self) -> dict[str, Any]:
        """Name, rate and length."""
        length = len(self._phase) / self._rate
        return {"name": self.name, "kind": "programme", "period_s": self.period, "duration_s": length}

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,); none after the end."""
        row = self._row(reading, t)
        self.finished = self.finished or row >= len(self._phase)
        if self.finished:
            self.phase = ""
            return np.zeros(self._mode.allocator.thrusters)
        self.phase = str(self._phase[row])
        tau = self._tau[row].copy()
        if self._hold is not None:
            goal = self._beside(goal_at(guide, t), reading)
            wanted, self._memory = self._hold.command(self._memory, reading, goal)
            tau[self._held] = wanted[self._held]
        return self._mode.allocator.allocate(np.clip(tau, -self._limits, self._limits))[0]

    def _beside(self, goal: Goal, reading: Measured) -> Goal:
        """The goal moved along the excited axes to where the vehicle is.

        Left behind, a way of s metres and a heading error ψ would look like s sin ψ on an axis that is held, and
        correcting that turns the vehicle further.
        """
        q = np.asarray(goal.quaternion, float)
        away = quat_inverse_rotate(q, np.asarray(reading.position, float) - np.asarray(goal.position, float))
        along = np.where([axis in self._driven for axis in range(3)], away, 0.0)
        return replace(goal, position=np.asarray(goal.position, float) + quat_rotate(q, along))

    def _row(self, reading: Measured, t: float) -> int:
        """Which row it is the turn of; excitations and coasts that have done their work are left early."""
        if self._origin is None:
            self._origin = np.array(reading.position, float)
        row = int(t * self._rate + 1e-6) + self._skipped
        if row >= len(self._phase):
            return row
        word = self._phase[row]
        way = float(np.linalg.norm(np.asarray(reading.position) - self._origin))
        done = word == "excitation" and self._room is not None and way > self._room
        if done or (word == "coast" and self._risen(reading, t)):
            later = np.flatnonzero(self._phase[row:] != word)
            end = row + int(later[0]) if len(later) else len(self._phase)
            self._skipped += end - row
            row = end
        return row

    def _risen(self, reading: Measured, t: float) -> bool:
        """Whether the vehicle has risen steadily for long enough."""
        if self._ascent is None:
            return False
        velocity = quat_rotate(reading.quaternion, np.asarray(reading.nu)[:3])
        if float(velocity[2]) <= self._ascent:
            self._rising_since = None
            return False
        self._rising_since = t if self._rising_since is None else self._rising_since
        return t - self._rising_since >= self._ascent_time
