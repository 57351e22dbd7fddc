"""What the motors of a vehicle make of commanded forces: the engine's actuation in NumPy, exact in time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles import Vehicle

__all__ = ["Motors", "delivered", "thruster_motors", "wrench_motors"]

Array = NDArray[np.float64]

NO_LIMIT = 1.0e9
"""Force and slew of a motor that has no limit."""


@dataclass(frozen=True, kw_only=True)
class Motors:
    """Limits, dead zone, delay, lag and slew of k channels, (k,) each."""

    lower: Array
    """[N]"""
    upper: Array
    """[N]"""
    dead_minus: Array
    """Commands between this and `dead_plus` give nothing [N]."""
    dead_plus: Array
    """[N]"""
    delay: Array
    """[s]"""
    time_constant: Array
    """[s]"""
    slew: Array
    """[N/s], or [rad/s²] where `speed`."""
    speed: NDArray[np.bool_]
    """Whether lag and slew act on shaft speed rather than on thrust."""
    c_plus: Array
    """T = c± ω|ω| [N s²/rad²]."""
    c_minus: Array
    """[N s²/rad²]"""


def thruster_motors(vehicle: Vehicle) -> Motors:
    """Motors of the vehicle's thrusters, in canonical order."""
    thrusters = list(vehicle.thrusters.values())
    speed = np.array([t.domain == "speed" for t in thrusters])

    def column(name: str) -> Array:
        return np.array([getattr(t, name) for t in thrusters], dtype=float)

    def force_at(name: str) -> Array:
        at = [t.thrust(getattr(t, name) * 2.0 * np.pi / 60.0) for t in thrusters]
        return np.where(speed, at, 0.0)  # a motor that lags in force has no dead zone in the engine

    return Motors(
        lower=column("force_min"),
        upper=column("force_max"),
        dead_minus=force_at("dead_rpm_minus"),
        dead_plus=force_at("dead_rpm_plus"),
        delay=column("delay"),
        time_constant=column("time_constant"),
        slew=np.minimum(column("slew"), NO_LIMIT),
        speed=speed,
        c_plus=column("c_plus"),
        c_minus=column("c_minus"),
    )


def wrench_motors(vehicle: Vehicle) -> Motors:
    """Six equal motors for the axes of a wrench that was asked for: the mean delay and lag of the vehicle's thrusters.

    Exact while all thrusters are equal, lag in force and keep away from their limits; who allocated the wrench, and
    how, is not in the log.
    """
    own = thruster_motors(vehicle)
    six = np.ones(6)
    return Motors(
        lower=-NO_LIMIT * six,
        upper=NO_LIMIT * six,
        dead_minus=0.0 * six,
        dead_plus=0.0 * six,
        delay=own.delay.mean() * six,
        time_constant=own.time_constant.mean() * six,
        slew=NO_LIMIT * six,
        speed=np.zeros(6, bool),
        c_plus=six,
        c_minus=six,
    )


def delivered(motors: Motors, t: Array, command: Array, at: Array) -> Array:
    """Thrust at given times for commands that are held until the next.

    u(t) = admissible(command(t - delay)),   x_dot = clip((u - x) / time_constant, ±slew),   T = x or c± x|x|

    solved exactly between the changes of u. Before its first row a command is taken to have been held for long.

    Args:
        motors: Of the k channels.
        t: Times of the commands, increasing [s], (n,).
        command: [N], (n, k).
        at: Times asked for [s], (m,).

    Returns:
        [N], (m, k).
    """
    f = np.clip(command, motors.lower, motors.upper)
    f = np.where((f > motors.dead_minus) & (f < motors.dead_plus), 0.0, f)
    c = np.where(f >= 0.0, motors.c_plus, motors.c_minus)
    target = np.where(motors.speed, np.sign(f) * np.sqrt(np.abs(f) / c), f)
    x = np.stack(
        [
            _followed(
                *_changes(t + motors.delay[k], target[:, k]), at, motors.time_constant[k], motors.slew[k]
            )
            for k in range(command.shape[1])
        ],
        axis=-1,
    )
    c = np.where(x >= 0.0, motors.c_plus, motors.c_minus)
    return np.where(motors.speed, c * x * np.abs(x), x)


def _changes(t: Array, u: Array) -> tuple[Array, Array]:
    """The rows at which a held value changes."""
    rows = np.concatenate([[True], np.diff(u) != 0.0])
    return t[rows], u[rows]


def _followed(t: Array, u: Array, at: Array, time_constant: float, slew: float) -> Array:
    """x(at) of x_dot = clip((u - x) / time_constant, ±slew), at rest on u[0] before t[0]; u is held from t on."""
    x = np.empty(len(t))
    x[0] = now = float(u[0])
    for j, (goal, dt) in enumerate(zip(u.tolist(), np.diff(t).tolist(), strict=False)):
        way = goal - now
        ramp = max(abs(way) - slew * time_constant, 0.0) / slew
        if ramp > 0.0:
            now += math.copysign(slew * min(ramp, dt), way)
            dt = max(dt - ramp, 0.0)
        x[j + 1] = now = goal + (now - goal) * math.exp(-dt / time_constant)
    last = np.maximum(np.searchsorted(t, at, side="right") - 1, 0)
    since = np.maximum(at - t[last], 0.0)
    ways = u[last] - x[last]
    ramps = np.minimum(np.maximum(np.abs(ways) - slew * time_constant, 0.0) / slew, since)
    left = ways - np.sign(ways) * slew * ramps
    return np.asarray(u[last] - left * np.exp(-(since - ramps) / time_constant))
