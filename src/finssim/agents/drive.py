"""Following a commanded velocity with a vehicle's own thrust, for vehicles controlled by a script and for
baselines."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.agents.baselines import PERIOD, Rows
from finssim.physics.types import vec6
from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles import HydrodynamicSet, Vehicle
from finssim.vehicles.capability import level_speed, terminal_speeds

Array = NDArray[Any]

RATE = 1.2
"""Decay rate of a velocity error [1/s]: as fast as motors and a control step of 0.1 s allow."""
YAW_RATE = 3.0
"""Decay rate of a yaw-rate error [1/s]: three times that of the heading, since the heading would oscillate
otherwise."""
TURN = 1.0
"""Requested yaw rate per heading error [1/s]."""
MOST_TURN = 0.8
"""Largest requested yaw rate [rad/s]."""
ROWS = [0, 1, 2, 5]
"""Indices, in a wrench, of the axes that these tasks use: surge, sway, heave, yaw."""


@wp.func
def drive(d: Any, q: wp.quat, nu: vec6, target: wp.vec4) -> wp.vec4:
    """Return the action that drives the velocity to a commanded one.

    tau = d1 v* + d2 |v*| v* + RATE m (v* - v) + (weight - buoyancy) up,  action = shared(tau / limit)

    Args:
        d: `DriveNumbers` of the vehicle.
        q: Quaternion from body to world.
        nu: Velocity, body frame [m/s, rad/s].
        target: v*: commanded surge, sway, heave and yaw rate, body frame [m/s, rad/s].

    Returns:
        Fractions of the limits on surge, sway, heave and yaw, each in [-1, 1].
    """
    v = wp.vec4(nu[0], nu[1], nu[2], nu[5])
    up = wp.quat_rotate_inv(q, wp.vec3(0.0, 0.0, 1.0))
    tau = d.sink * wp.vec4(up[0], up[1], up[2], 0.0)
    a = wp.vec4()
    for i in range(4):
        tau[i] = tau[i] + (d.d1[i] + d.d2[i] * wp.abs(target[i])) * target[i]
        tau[i] = tau[i] + wp.where(i == 3, YAW_RATE, RATE) * d.mass[i] * (target[i] - v[i])
        a[i] = tau[i] / d.limit[i]
    return shared(a)


@wp.func
def shared(a: wp.vec4) -> wp.vec4:
    """Return actions with surge, sway and yaw limited jointly, since they use the same thrusters.

    Yaw gets at most half, the others the rest.
    """
    yaw = wp.clamp(a[3], -0.5, 0.5)
    part = wp.min(1.0, (1.0 - wp.abs(yaw)) / wp.max(wp.abs(a[0]) + wp.abs(a[1]), 1.0e-6))
    return wp.vec4(part * a[0], part * a[1], wp.clamp(a[2], -1.0, 1.0), yaw)


@wp.func
def towards(q: wp.quat, velocity: wp.vec3) -> wp.vec4:
    """Return a world velocity in the body frame, with a yaw rate that turns the body's x axis towards it.

    Returns:
        Surge, sway, heave and yaw rate [m/s, rad/s].
    """
    v = wp.quat_rotate_inv(q, velocity)
    ahead = wp.quat_rotate_inv(q, wp.vec3(velocity[0], velocity[1], 0.0))
    moving = ahead[0] * ahead[0] + ahead[1] * ahead[1] > 1.0e-8
    error = wp.where(moving, wp.atan2(ahead[1], ahead[0]), 0.0)
    return wp.vec4(v[0], v[1], v[2], wp.clamp(TURN * error, -MOST_TURN, MOST_TURN))


@dataclass(frozen=True)
class DriveNumbers:
    """Parameters for following a velocity; rows are surge, sway, heave, yaw."""

    d1: tuple[float, float, float, float]
    """Linear damping [N s/m, N m s]."""
    d2: tuple[float, float, float, float]
    """Quadratic damping [N s²/m², N m s²]."""
    mass: tuple[float, float, float, float]
    """Inertia with added mass [kg, kg m²]."""
    limit: tuple[float, float, float, float]
    """Wrench of an action of 1 [N, N m]."""
    terminal: tuple[float, float, float, float]
    """Terminal speed at the limit [m/s, rad/s]."""
    sink: float
    """Weight minus buoyancy [N]."""
    level: float
    """Forward speed up to which the vehicle's pitch stiffness exceeds the Munk moment [m/s]; see `level_speed`."""

    @property
    def top(self) -> float:
        """Largest forward speed that thrust and pitch stability allow [m/s]."""
        return min(self.terminal[0], self.level)

    @classmethod
    def of(cls, vehicle: Vehicle) -> DriveNumbers:
        """Return the parameters of a vehicle, from its first hydrodynamic set with coefficients.

        Raises:
            EnvironmentSetupError: The vehicle has no coefficients.
        """
        sets = [name for name, model in vehicle.hydrodynamics.items() if isinstance(model, HydrodynamicSet)]
        if not sets:
            raise EnvironmentSetupError(
                f"vehicle '{vehicle.name}' has no damping coefficients, which pursuit and formation require: use "
                "another vehicle"
            )
        hydro: Any = vehicle.hydrodynamics[sets[0]]
        columns = (
            np.diag(hydro.linear_damping), hydro.axis_drag, np.diag(vehicle.mass_matrix(sets[0])),
            vehicle.wrench_limits, terminal_speeds(vehicle, sets[0]),
        )  # fmt: skip
        rows = (tuple(column[ROWS].tolist()) for column in columns)
        return cls(*rows, sink=vehicle.weight - vehicle.buoyancy, level=level_speed(vehicle, sets[0]))

    def action(self, velocity: Array, target: Array) -> NDArray[np.float32]:
        """Return the result of `drive` for a level vehicle.

        Args:
            velocity: Surge, sway, heave and yaw rate [m/s, rad/s], (n, 4).
            target: Commanded velocity, body frame [m/s, rad/s], (n, 4).

        Returns:
            Fractions of the limits on the four axes, (n, 4), each in [-1, 1].
        """
        d1, d2, mass, limit = (np.array(row) for row in (self.d1, self.d2, self.mass, self.limit))
        rate = np.array([RATE, RATE, RATE, YAW_RATE])
        tau = (d1 + d2 * np.abs(target)) * target + rate * mass * (target - velocity)
        tau[:, 2] += self.sink
        a = tau / limit
        a[:, 2:] = np.clip(a[:, 2:], [-1.0, -0.5], [1.0, 0.5])
        remaining = 1.0 - np.abs(a[:, 3])
        a[:, :2] *= np.minimum(1.0, remaining / np.maximum(np.abs(a[:, :2]).sum(axis=1), 1e-6))[:, None]
        return a.astype(np.float32)

    def turned(self, error: Array) -> Array:
        """Return the yaw rate [rad/s] that reduces a heading error [rad]."""
        return np.clip(TURN * error, -MOST_TURN, MOST_TURN)


@dataclass(frozen=True, kw_only=True)
class DriveBaseline:
    """Base of the baselines that steer with a vehicle's thrust and drag, in action mode wrench4 and without
    memory."""

    drive: DriveNumbers
    period: float = PERIOD
    """Time between two commands [s]."""
    turn_first: float = math.inf
    """Heading error above which the vehicle only turns [rad]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> Any:
        """Return the baseline with the parameters of a vehicle."""
        return cls(drive=DriveNumbers.of(vehicle))

    def reset(self, n: int) -> None:
        """Return None, the memory of these baselines."""
        return None

    def act(self, memory: None, observation: Rows) -> tuple[Rows, None]:
        """Return the actions for observations, (n, numbers)."""
        o = np.asarray(observation, dtype=float)
        target, turn = self.wanted(o)
        velocity = np.column_stack([o[:, 0:3], o[:, 5]])
        action = self.drive.action(velocity, np.column_stack([target, self.drive.turned(turn)]))
        action[np.abs(turn) > self.turn_first, :2] = 0.0
        return action, None

    def wanted(self, o: Array) -> tuple[Array, Array]:
        """Return the requested velocity, body frame [m/s], (n, 3), and the heading error to reduce [rad], (n,)."""
        raise NotImplementedError
