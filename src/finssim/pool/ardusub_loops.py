"""Control loops with which ArduSub 4.5 holds attitude and depth: stick inputs to demands of the mixer.

Gains, dead zones and limits are the autopilot's own parameters, by their names there. Its axes are forward, right, down
in north, east, down; heights are positive upwards. Reference: ArduSub 4.5.0 (modes STABILIZE, ACRO and ALT_HOLD;
attitude and position controllers), with whose recorded steady states the tests compare.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.rotations import (
    quat_conjugate,
    quat_from_euler,
    quat_inverse_rotate,
    quat_multiply,
    quat_to_rotvec,
    wrap_angle,
)

__all__ = ["AttitudeLoop", "DepthLoop", "climb_rate", "lean_angles", "yaw_rate"]

Array = NDArray[np.float64]

AXES = ("RLL", "PIT", "YAW")
FULL_STICK = math.radians(45.0)
"""Angle of a full roll, pitch or yaw stick, before gains [rad]."""
SETTLING = 0.25
"""Time after a turn during which the vehicle slows down before its heading is held [s]."""
LEAD = math.radians(45.0)
"""Greatest lead of the target heading over the vehicle's heading [rad]."""
DEPTH_LEAD = 2.0
"""Greatest distance of the target height from the vehicle's height [m]."""
BUFFER = 0.05
"""Distance below SURFACE_DEPTH at which a vehicle is held after reaching the surface [m]."""


def _beyond(width: float, dead: float, half: float = 400.0) -> float:
    """Return the deflection of a stick beyond its dead zone, in [-1, 1]; arguments in µs from the middle."""
    return math.copysign(min(max(abs(width) - dead, 0.0) / (half - dead), 1.0), width)


def lean_angles(roll: float, pitch: float, parameters: Mapping[str, float]) -> tuple[float, float]:
    """Return the roll and pitch [rad] commanded by sticks [µs from the middle], together at most ANGLE_MAX.

    `parameters` are those of the autopilot [its own units].
    """
    limit = math.radians(0.01 * min(max(parameters["ANGLE_MAX"], 1000.0), 8000.0))
    r, p = limit * _beyond(roll, parameters["RC2_DZ"]), limit * _beyond(pitch, parameters["RC1_DZ"])
    scale = min(1.0, limit / max(math.hypot(r, p), 1e-9))
    r, p = scale * r, scale * p
    return math.atan(math.cos(p) * math.tan(r)), p


def yaw_rate(yaw: float, gain: float, parameters: Mapping[str, float]) -> float:
    """Return the rate [rad/s] commanded by the yaw stick [µs from the middle]; the pilot's gain scales its dead
    zone."""
    return parameters["ACRO_YAW_P"] * FULL_STICK * _beyond(yaw, gain * parameters["RC4_DZ"])


def climb_rate(throttle: float, gain: float, parameters: Mapping[str, float]) -> float:
    """Return the climb rate [m/s] commanded by the throttle stick.

    The stick has the range 0 to 1000, from the lower end plus its dead zone to the upper end; the dead zone around its
    middle is THR_DZ times the pilot's gain.

    Args:
        throttle: Input of the throttle [µs].
        gain: Pilot's gain [-].
        parameters: Parameters of the autopilot, by name [its own units].
    """
    low = parameters["RC3_MIN"] + parameters["RC3_DZ"]
    high = parameters["RC3_MAX"]
    stick = 1000.0 * min(max((throttle - low) / (high - low), 0.0), 1.0)
    middle = 1000.0 * (0.5 * (parameters["RC3_MIN"] + high) - low) / (high - low)
    zone = gain * min(max(parameters["THR_DZ"], 0.0), 400.0)
    up = 0.01 * parameters["PILOT_SPEED_UP"]
    down = 0.01 * parameters["PILOT_SPEED_DN"] or up
    if stick < middle - zone:
        return down * (stick / (middle - zone) - 1.0)
    return up * max(stick - middle - zone, 0.0) / (1000.0 - middle - zone)


@dataclass
class AttitudeLoop:
    """Target heading and integrals of the attitude controller.

        rate = P_angle · e + R^T (0, 0, ψ̇),   demand = P_rate (rate - ω) + ∫ I_rate (rate - ω) dt

    with e the rotation from the attitude to its target.
    """

    heading: float | None = None
    """Heading to hold [rad]; None before the first step."""
    since_turn: float = math.inf
    """Time since the yaw stick was last used [s]."""
    integral: Array = field(default_factory=lambda: np.zeros(3))
    """Integrals of roll, pitch, yaw [-]."""
    lead: Array = field(default_factory=lambda: np.zeros(3))
    """Lead of the commanded rotation over the vehicle's, in ACRO [rad]."""

    def step(
        self,
        dt: float,
        lean: tuple[float, float],
        turn: float,
        attitude: Array,
        quaternion: Array,
        rates: Array,
        parameters: Mapping[str, float],
    ) -> list[float]:
        """Return demands of roll, pitch and yaw in [-1, 1].

        Args:
            dt: Time since the last step [s].
            lean: Roll and pitch to hold [rad].
            turn: Rate of turn, clockwise from above [rad/s]; 0 holds the heading.
            attitude: Roll, pitch, yaw [rad], (3,).
            quaternion: The same attitude, x y z w, body to north, east, down, (4,).
            rates: Body rates [rad/s], (3,).
            parameters: Parameters of the autopilot, by name [its own units].
        """
        yaw = float(attitude[2])
        self.since_turn = 0.0 if turn else self.since_turn + dt
        if self.heading is None or (not turn and self.since_turn < SETTLING):
            self.heading = yaw
        lead = float(wrap_angle(self.heading + turn * dt - yaw))
        self.heading = float(wrap_angle(yaw + min(max(lead, -LEAD), LEAD)))
        error = quat_multiply(quat_conjugate(quaternion), quat_from_euler(*lean, self.heading))
        turning = quat_inverse_rotate(quaternion, np.array([0.0, 0.0, turn]))
        rate = _gains("ANG", "P", parameters) * quat_to_rotvec(error) + turning
        return self.track(dt, rate, rates, parameters)

    def turn_by(self, dt: float, rate: Array, rates: Array, parameters: Mapping[str, float]) -> list[float]:
        """Return demands of roll, pitch and yaw in [-1, 1] with which the vehicle follows the integral of body rates.

        Args:
            dt: Time since the last step [s].
            rate: Commanded body rates [rad/s], (3,).
            rates: Body rates of the vehicle [rad/s], (3,).
            parameters: Parameters of the autopilot, by name [its own units].
        """
        self.lead = np.clip(self.lead + (rate - rates) * dt, -LEAD, LEAD)
        return self.track(dt, rate + _gains("ANG", "P", parameters) * self.lead, rates, parameters)

    def track(self, dt: float, rate: Array, rates: Array, parameters: Mapping[str, float]) -> list[float]:
        """Return demands of roll, pitch and yaw in [-1, 1] with which the vehicle follows body rates [rad/s], (3,).

        Args:
            dt: Time since the last step [s].
            rate: Commanded body rates [rad/s], (3,).
            rates: Body rates of the vehicle [rad/s], (3,).
            parameters: Parameters of the autopilot, by name [its own units].
        """
        error, most = rate - rates, _gains("RAT", "IMAX", parameters)
        self.integral = np.clip(self.integral + _gains("RAT", "I", parameters) * error * dt, -most, most)
        demands: Any = np.clip(_gains("RAT", "P", parameters) * error + self.integral, -1.0, 1.0).tolist()
        return list(demands)


def _gains(kind: str, name: str, parameters: Mapping[str, float]) -> Array:
    """Return one gain of ATC_<kind>_<axis> for the three axes, (3,)."""
    return np.array([parameters[f"ATC_{kind}_{axis}_{name}"] for axis in AXES])


@dataclass
class DepthLoop:
    """Target height and integral of the depth controller.

        v = ż_t + P_pos (z_t - z),   a = P_vel (v - ż),   throttle = 0.1 (P_acc (a - z̈) + ∫ I_acc (a - z̈) dt)

    with lengths in m; throttle is in [-1/2, 1/2] about the hovering one.
    """

    height: float | None = None
    """Height to hold [m]; None before the first step."""
    rate: float = 0.0
    """Climb rate of the target [m/s]."""
    integral: float = 0.0
    """Integral of the acceleration error, times its gain [m/s^2]."""

    def step(
        self,
        dt: float,
        climb: float,
        height: float,
        speed: float,
        acceleration: float,
        surfaced: bool,
        parameters: Mapping[str, float],
    ) -> float:
        """Return the demand of throttle in [-1, 1].

        Args:
            dt: Time since the last step [s].
            climb: Climb rate [m/s]; 0 holds the height.
            height: Height of the vehicle, 0 at the surface [m].
            speed: Upward speed [m/s].
            acceleration: Upward acceleration, without gravity [m/s^2].
            surfaced: Whether the vehicle is above SURFACE_DEPTH.
            parameters: Parameters of the autopilot, by name [its own units].
        """
        p, most = parameters, 0.01 * parameters["PILOT_ACCEL_Z"] * dt
        if self.height is None:
            self.height = height
        self.rate += min(max(climb - self.rate, -most), most)
        self.height += self.rate * dt
        self.height = min(max(self.height, height - DEPTH_LEAD), height + DEPTH_LEAD)
        if surfaced and climb == 0.0:
            self.height = min(self.height, 0.01 * p["SURFACE_DEPTH"] - BUFFER)
        wanted = p["PSC_VELZ_P"] * (self.rate + p["PSC_POSZ_P"] * (self.height - height) - speed)
        error, limit = wanted - acceleration, 0.01 * p["PSC_ACCZ_IMAX"]
        self.integral = min(max(self.integral + p["PSC_ACCZ_I"] * error * dt, -limit), limit)
        return min(max(0.2 * (p["PSC_ACCZ_P"] * error + self.integral), -1.0), 1.0)
