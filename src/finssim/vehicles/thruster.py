"""Thruster of a vehicle file."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from finssim.vehicles.part import (
    Axis,
    Negative,
    NonNegative,
    NonPositive,
    Part,
    Positive,
    Vector3,
    VehicleError,
    refuse_section,
)

Array = NDArray[np.float64]


class Esc(Part):
    """Electronic speed controller and motor, for a propeller without inflow (bollard pull).

    The voltage that the pulse applies to the motor balances its back EMF and the voltage drop of the load
    current; the load torque of a propeller is proportional to ω², so

        d V = e± ω + r± ω²,   d = (pulse - zero±) / (end - neutral),   end = pulse_max or pulse_min,

    for positive and negative rotation. No controller holds a motor below some minimum speed: the shaft is at
    rest until the law yields `slowest`. Larger pulses are positive rotation; `Thruster.shaft_speed` accounts
    for reversed wiring.
    """

    pulse_neutral: Positive
    """Centre of the range, at which the motor is off [µs]."""
    pulse_min: Positive
    """Full reverse [µs]."""
    pulse_max: Positive
    """Full forward [µs]."""
    voltage: Positive
    """Battery voltage under load, at which the numbers were determined [V]."""
    dead_minus: Positive
    """Largest pulse that turns the shaft in reverse, at `voltage` [µs]."""
    dead_plus: Positive
    """Smallest pulse that turns the shaft forward, at `voltage` [µs]."""
    zero_minus: Positive
    """Zero crossing of the law of reverse rotation [µs]; inside the dead band."""
    zero_plus: Positive
    """Zero crossing of the law of forward rotation [µs]; inside the dead band."""
    emf_minus: NonNegative
    """e of reverse rotation [V s/rad]."""
    emf_plus: NonNegative
    """e of forward rotation [V s/rad]."""
    load_minus: NonNegative
    """r of reverse rotation [V s²/rad²]; includes the sag of the supply if `voltage` is that of an unloaded
    battery."""
    load_plus: NonNegative
    """r of forward rotation [V s²/rad²]."""

    @model_validator(mode="after")
    def _ordered(self) -> Esc:
        keys = (
            "pulse_min",
            "dead_minus",
            "zero_minus",
            "pulse_neutral",
            "zero_plus",
            "dead_plus",
            "pulse_max",
        )
        pulses = [getattr(self, key) for key in keys]
        if (
            sorted(pulses) != pulses
            or not self.dead_minus > self.pulse_min
            or not self.dead_plus < self.pulse_max
        ):
            raise refuse_section(
                f"pulse widths {', '.join(f'{k} {v:g}' for k, v in zip(keys, pulses, strict=True))} µs "
                "must rise in this order"
            )
        for side in ("minus", "plus"):
            if getattr(self, f"emf_{side}") == getattr(self, f"load_{side}") == 0.0:
                raise refuse_section(f"emf_{side} and load_{side} are both 0, expected one of them > 0")
        return self

    @property
    def slowest(self) -> tuple[float, float]:
        """Slowest speeds of the rotating shaft, reverse (<= 0) and forward [rad/s]."""
        edges = np.array([self.dead_minus, self.dead_plus])
        reverse, forward = self._law(edges, np.full(2, self.voltage))
        return float(reverse), float(forward)

    def dead_band(self, voltage: float | None = None) -> tuple[float, float]:
        """Return the largest pulse that turns the shaft in reverse and the smallest that turns it forward [µs].

        Args:
            voltage: Voltage of the battery [V]; `self.voltage` if None.
        """
        low, high = self._inverse(np.array(self.slowest), self._volts(voltage, (2,)))
        return float(low), float(high)

    def shaft_speed(self, pulse_us: ArrayLike, voltage: ArrayLike | None = None) -> Array:
        """Return the steady shaft speed.

        Args:
            pulse_us: Pulse widths [µs], (...,); values beyond the ends are clipped, 0 (no signal) stops the motor.
            voltage: Voltage of the battery [V], (...,), broadcast with the pulse widths; `self.voltage` if None.

        Returns:
            [rad/s], (...,), of the same sign as pulse - neutral.
        """
        pulse = np.asarray(pulse_us, dtype=np.float64)
        volts = self._volts(voltage, pulse.shape)
        omega = self._law(np.clip(pulse, self.pulse_min, self.pulse_max), volts)
        slow_minus, slow_plus = self.slowest
        rounding = 1e-9 * (slow_plus - slow_minus)
        standing = (omega > slow_minus + rounding) & (omega < slow_plus - rounding)
        return np.where(standing | (pulse <= 0.0), 0.0, omega)

    def pulse(self, shaft_speed: ArrayLike, voltage: ArrayLike | None = None) -> Array:
        """Return the pulse width for a steady shaft speed; the inverse of `shaft_speed`.

        Args:
            shaft_speed: Shaft speed [rad/s], (...,); for a speed below `slowest` the neutral pulse is
                returned, for a speed
                that the voltage cannot reach the end of the range.
            voltage: Voltage of the battery [V], (...,), broadcast with the shaft speed; `self.voltage` if None.

        Returns:
            Pulse width [µs], (...,).
        """
        omega = np.asarray(shaft_speed, dtype=np.float64)
        unlimited = self._inverse(omega, self._volts(voltage, omega.shape))
        slow_minus, slow_plus = self.slowest
        rounding = 1e-9 * (slow_plus - slow_minus)
        standing = (omega > slow_minus + rounding) & (omega < slow_plus - rounding)
        return np.where(standing, self.pulse_neutral, np.clip(unlimited, self.pulse_min, self.pulse_max))

    def _volts(self, voltage: ArrayLike | None, shape: tuple[int, ...]) -> Array:
        volts = np.asarray(self.voltage if voltage is None else voltage, dtype=np.float64)
        return np.broadcast_to(volts, np.broadcast_shapes(volts.shape, shape))

    def _law(self, pulse: Array, volts: Array) -> Array:
        """Return the signed root of d V = e ω + r ω², zero between the two zeros [rad/s]."""
        forward, reverse = (
            _root(emf, load, np.maximum(duty, 0.0) * volts)
            for duty, emf, load in (
                (self._duty(pulse, 1), self.emf_plus, self.load_plus),
                (self._duty(pulse, -1), self.emf_minus, self.load_minus),
            )
        )
        return forward - reverse

    def _duty(self, pulse: Any, sign: int) -> Any:
        """Return the fraction of the battery's voltage at the motor, positive in the given direction."""
        if sign > 0:
            return (pulse - self.zero_plus) / (self.pulse_max - self.pulse_neutral)
        return (self.zero_minus - pulse) / (self.pulse_neutral - self.pulse_min)

    def _inverse(self, omega: Array, volts: Array) -> Array:
        forward, speed = omega >= 0.0, np.abs(omega)
        emf = np.where(forward, self.emf_plus, self.emf_minus)
        load = np.where(forward, self.load_plus, self.load_minus)
        duty = (emf * speed + load * speed**2) / volts
        above = self.zero_plus + duty * (self.pulse_max - self.pulse_neutral)
        below = self.zero_minus - duty * (self.pulse_neutral - self.pulse_min)
        return np.where(np.isnan(omega), np.nan, np.where(forward, above, below))


def _root(emf: float, load: float, volts: Array) -> Array:
    """Return the positive root ω of volts = emf ω + load ω², in the numerically stable form [rad/s]."""
    denominator = emf + np.sqrt(emf**2 + 4.0 * load * volts)
    return np.divide(2.0 * volts, denominator, out=np.zeros_like(denominator), where=denominator != 0.0)


class Inflow(Part):
    """Loss of thrust and torque of a propeller in an inflow: T = c ω|ω| - a |ω| V_a.

    V_a is (1 - w) times the velocity of the disc along the axis, relative to the water. For a propeller with K_T =
    K_0 + K_1 J and diameter D: c = ρ D⁴ K_0 / (2π)², a = -ρ D³ K_1 / (2π); from K_Q, b = -ρ D⁴ K_1 / (2π).
    """

    thrust_loss: NonNegative
    """Coefficient a [N s²/(m rad)]."""
    torque_loss: Annotated[float, Field(strict=True, allow_inf_nan=False)] = 0.0
    """Coefficient b of the torque k ω|ω| - b |ω| V_a on the water about the axis [N s²/rad]; it has the sign
    of `torque_constant`."""
    wake_fraction: Annotated[float, Field(strict=True, ge=0.0, lt=1.0)] = 0.0
    """Wake fraction w [-]."""


class Thruster(Part):
    """Thruster: its position, its steady thrust T = c± ω|ω| (paper, eq. 16) and its response to commands."""

    position: Vector3
    """Position of the propeller disc, from the body origin, body frame [m], (3,)."""
    axis: Axis
    """Direction of the force on the vehicle for positive thrust, body frame, unit length, (3,)."""
    force_min: Negative
    """Strongest reverse thrust [N]."""
    force_max: Positive
    """Strongest forward thrust [N]."""
    c_plus: Positive
    """Coefficient of T = c_plus ω² for ω > 0 [N s²/rad²]."""
    c_minus: Positive
    """Coefficient of T = -c_minus ω² for ω < 0 [N s²/rad²]."""
    torque_constant: Annotated[float, Field(strict=True, allow_inf_nan=False)] = 0.0
    """k of the propeller's torque k ω|ω| on the water, about `axis` [N m s²/rad²]: above 0 if the shaft
    rotates about `axis` for positive thrust (right-handed), below 0 otherwise. The reaction on the vehicle
    has the opposite sign."""
    inflow: Inflow | None = None
    """Loss of thrust and torque in an inflow; none if the file omits it."""
    diameter: Positive | None = None
    """Diameter of the propeller [m]."""
    rpm_min: Negative
    """Fastest reverse shaft speed [rpm]."""
    rpm_max: Positive
    """Fastest forward shaft speed [rpm]."""
    dead_rpm_minus: NonPositive = 0.0
    """Slowest reverse speed of the rotating shaft [rpm]."""
    dead_rpm_plus: NonNegative = 0.0
    """Slowest forward speed of the rotating shaft [rpm]."""
    domain: Literal["force", "speed"]
    """Quantity to which lag and slew limit apply: thrust [N] or shaft speed [rad/s]."""
    time_constant: Positive
    """Time constant of the first-order lag [s]."""
    delay: NonNegative = 0.0
    """Pure delay of the command [s]."""
    slew: Positive = math.inf
    """Fastest change [N/s] (`domain: force`) or [rad/s²] (`domain: speed`); no limit if the file omits it."""
    group: str = ""
    """Name of the `thruster_groups` entry with the common numbers."""
    motor_index: Annotated[int, Field(strict=True, ge=0)] | None = None
    """Output of the motor controller that drives this thruster, from 0."""
    motor_sign: Literal[-1, 1] | None = None
    """Sign between positive thrust and the controller's positive command."""
    esc: Esc | None = None
    """Speed controller, for vehicles that log or accept pulse widths."""

    @property
    def reaction(self) -> float:
        """Ratio of the reaction moment about `axis` on the vehicle to the thrust [m]: -k / c, with the mean
        of c_plus and c_minus."""
        return -2.0 * self.torque_constant / (self.c_plus + self.c_minus)

    def thrust(self, shaft_speed: ArrayLike) -> Array:
        """Return the steady thrust T = c± ω|ω| [N] (paper, eq. 16), positive along `axis`.

        Args:
            shaft_speed: ω [rad/s], (...,).

        Returns:
            Thrust [N], (...,); force limits, speed limits and the dead zone are not applied.
        """
        omega = np.asarray(shaft_speed, dtype=np.float64)
        return np.where(omega >= 0.0, self.c_plus, self.c_minus) * omega * np.abs(omega)

    def speed(self, force: ArrayLike) -> Array:
        """Return the shaft speed [rad/s] whose steady thrust is `force`: the inverse of `thrust`.

        Args:
            force: Thrust along `axis`, body frame [N], (...,).
        """
        target = np.asarray(force, dtype=np.float64)
        c = np.where(target >= 0.0, self.c_plus, self.c_minus)
        return np.sign(target) * np.sqrt(np.abs(target) / c)

    def shaft_speed(self, pulse_us: ArrayLike, voltage: ArrayLike | None = None) -> Array:
        """Return the steady shaft speed at a pulse width; if `motor_sign` is -1, small pulses are positive thrust.

        Args:
            pulse_us: Pulse widths [µs], (...,).
            voltage: Voltage of the battery [V], (...,), broadcast with the pulse widths; that of the ESC if None.

        Returns:
            Shaft speed [rad/s], (...,), positive for positive thrust.

        Raises:
            VehicleError: The vehicle file defines no `esc` for this thruster.
        """
        esc = self._need_esc()
        pulse = np.asarray(pulse_us, dtype=np.float64)
        mirrored = np.where(pulse <= 0.0, pulse, 2.0 * esc.pulse_neutral - pulse)
        return esc.shaft_speed(mirrored if self.motor_sign == -1 else pulse, voltage)

    def pulse(self, shaft_speed: ArrayLike, voltage: ArrayLike | None = None) -> Array:
        """Return the pulse width [µs] for a steady shaft speed: the inverse of `shaft_speed`.

        Args:
            shaft_speed: Shaft speed [rad/s], (...,), positive for positive thrust.
            voltage: Voltage of the battery [V], (...,), broadcast with the shaft speed; that of the ESC if None.

        Raises:
            VehicleError: The vehicle file defines no `esc` for this thruster.
        """
        esc = self._need_esc()
        pulse = esc.pulse(shaft_speed, voltage)
        return 2.0 * esc.pulse_neutral - pulse if self.motor_sign == -1 else pulse

    def _need_esc(self) -> Esc:
        if self.esc is None:
            raise VehicleError(
                "this thruster has no 'esc' section, so pulse widths cannot be converted to shaft speeds: fit one with "
                "'finssim calibrate thruster', or give shaft speeds or thrusts instead"
            )
        return self.esc
