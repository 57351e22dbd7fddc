"""One thruster of a vehicle file."""

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
    """Electronic speed controller and motor, at rest in the water (bollard pull).

    The voltage that the pulse switches onto the motor balances its back EMF and the drop that its load current makes;
    the load torque of a propeller grows as ω², so

        d V = e± ω + r± ω²,   d = (pulse - zero±) / (end - neutral),   end = pulse_max or pulse_min,

    for positive and negative rotation. No controller holds a motor below some speed: the shaft stands still until the
    law asks for `slowest`. Larger pulses are positive rotation; `Thruster.shaft_speed` knows about reversed wiring.
    """

    pulse_neutral: Positive
    """Middle of the range: the motor is off [µs]."""
    pulse_min: Positive
    """Full reverse [µs]."""
    pulse_max: Positive
    """Full forward [µs]."""
    voltage: Positive
    """Voltage of the battery under load, at which the numbers were determined [V]."""
    dead_minus: Positive
    """Largest pulse that turns the shaft in reverse, at `voltage` [µs]."""
    dead_plus: Positive
    """Smallest pulse that turns the shaft forward, at `voltage` [µs]."""
    zero_minus: Positive
    """Pulse at which the law of reverse rotation passes through zero [µs]; inside the dead band."""
    zero_plus: Positive
    """Pulse at which the law of forward rotation passes through zero [µs]; inside the dead band."""
    emf_minus: NonNegative
    """e of reverse rotation [V s/rad]."""
    emf_plus: NonNegative
    """e of forward rotation [V s/rad]."""
    load_minus: NonNegative
    """r of reverse rotation [V s²/rad²]; holds the sag of the supply where `voltage` is that of an unloaded battery."""
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
        """Slowest speeds at which the shaft turns, reverse (<= 0) and forward [rad/s]."""
        edges = np.array([self.dead_minus, self.dead_plus])
        reverse, forward = self._law(edges, np.full(2, self.voltage))
        return float(reverse), float(forward)

    def dead_band(self, voltage: float | None = None) -> tuple[float, float]:
        """Largest pulse that turns the shaft in reverse and smallest that turns it forward [µs].

        Args:
            voltage: Of the battery [V]; `self.voltage` where not given.
        """
        low, high = self._inverse(np.array(self.slowest), self._volts(voltage, (2,)))
        return float(low), float(high)

    def shaft_speed(self, pulse_us: ArrayLike, voltage: ArrayLike | None = None) -> Array:
        """Steady shaft speed.

        Args:
            pulse_us: Pulse widths [µs], (...,); those beyond the ends act as the ends, 0 (no signal) stops the motor.
            voltage: Of the battery [V], (...,), broadcast with the other; `self.voltage` where not given.

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
        """Pulse width that makes a steady shaft speed; the inverse of `shaft_speed`.

        Args:
            shaft_speed: [rad/s], (...,); speeds slower than `slowest` give the neutral pulse, speeds that the voltage
                cannot reach the end of the range.
            voltage: Of the battery [V], (...,), broadcast with the other; `self.voltage` where not given.

        Returns:
            [µs], (...,).
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
        """The signed root of d V = e ω + r ω², zero between the two zeros [rad/s]."""
        forward, reverse = (
            _root(emf, load, np.maximum(duty, 0.0) * volts)
            for duty, emf, load in (
                (self._duty(pulse, 1), self.emf_plus, self.load_plus),
                (self._duty(pulse, -1), self.emf_minus, self.load_minus),
            )
        )
        return forward - reverse

    def _duty(self, pulse: Any, sign: int) -> Any:
        """Share of the battery's voltage that the motor sees, positive in the given direction."""
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
    """Positive root ω of volts = emf ω + load ω², in the form that loses no digits [rad/s]."""
    denominator = emf + np.sqrt(emf**2 + 4.0 * load * volts)
    return np.divide(2.0 * volts, denominator, out=np.zeros_like(denominator), where=denominator != 0.0)


class Inflow(Part):
    """Thrust and torque that a propeller loses as water flows towards it: T = c ω|ω| - a |ω| V_a.

    V_a is (1 - w) times the velocity of the disc along the axis, relative to the water. Of a propeller with
    K_T = K_0 + K_1 J and diameter D: c = ρ D⁴ K_0 / (2π)², a = -ρ D³ K_1 / (2π); of K_Q, b = -ρ D⁴ K_1 / (2π).
    """

    thrust_loss: NonNegative
    """a [N s²/(m rad)]."""
    torque_loss: Annotated[float, Field(strict=True, allow_inf_nan=False)] = 0.0
    """b of the torque k ω|ω| - b |ω| V_a on the water about the axis [N s²/rad]; of the sign of `torque_constant`."""
    wake_fraction: Annotated[float, Field(strict=True, ge=0.0, lt=1.0)] = 0.0
    """w [-]."""


class Thruster(Part):
    """A thruster: its position, its steady thrust T = c± ω|ω| (paper, eq. 16) and its response to commands."""

    position: Vector3
    """Position of the propeller disc, from the body origin, body frame [m], (3,)."""
    axis: Axis
    """Direction of the force on the vehicle for positive thrust, body frame, unit length, (3,)."""
    force_min: Negative
    """Strongest reverse thrust [N]."""
    force_max: Positive
    """Strongest forward thrust [N]."""
    c_plus: Positive
    """T = c_plus ω² for ω > 0 [N s²/rad²]."""
    c_minus: Positive
    """T = -c_minus ω² for ω < 0 [N s²/rad²]."""
    torque_constant: Annotated[float, Field(strict=True, allow_inf_nan=False)] = 0.0
    """k of the propeller's torque k ω|ω| on the water, about `axis` [N m s²/rad²]: above 0 where the shaft turns about
    `axis` for positive thrust (right-handed), below 0 where it turns against it. The vehicle feels the opposite."""
    inflow: Inflow | None = None
    """Loss of thrust and torque in a flow; none where the file gives none."""
    diameter: Positive | None = None
    """Diameter of the propeller [m]."""
    rpm_min: Negative
    """Fastest reverse shaft speed [rpm]."""
    rpm_max: Positive
    """Fastest forward shaft speed [rpm]."""
    dead_rpm_minus: NonPositive = 0.0
    """Slowest reverse speed that turns the shaft [rpm]."""
    dead_rpm_plus: NonNegative = 0.0
    """Slowest forward speed that turns the shaft [rpm]."""
    domain: Literal["force", "speed"]
    """The quantity on which lag and slew limit act: thrust [N] or shaft speed [rad/s]."""
    time_constant: Positive
    """Time constant of the first-order lag [s]."""
    delay: NonNegative = 0.0
    """Pure delay of the command [s]."""
    slew: Positive = math.inf
    """Fastest change [N/s] (`domain: force`) or [rad/s²] (`domain: speed`); no limit where the file gives none."""
    group: str = ""
    """Name of the `thruster_groups` entry that gave the common numbers."""
    motor_index: Annotated[int, Field(strict=True, ge=0)] | None = None
    """Output of the motor controller that drives this thruster, from 0."""
    motor_sign: Literal[-1, 1] | None = None
    """Sign between positive thrust and the controller's positive command."""
    esc: Esc | None = None
    """Speed controller, for vehicles that log or take pulse widths."""

    @property
    def reaction(self) -> float:
        """Moment about `axis` on the vehicle over the thrust [m]: -k / c, with the mean of c_plus and c_minus."""
        return -2.0 * self.torque_constant / (self.c_plus + self.c_minus)

    def thrust(self, shaft_speed: ArrayLike) -> Array:
        """Steady thrust T = c± ω|ω| [N] (paper, eq. 16), positive along `axis`.

        Args:
            shaft_speed: ω [rad/s], (...,).

        Returns:
            Thrust [N], (...,); force and speed limits and the dead zone do not enter.
        """
        omega = np.asarray(shaft_speed, dtype=np.float64)
        return np.where(omega >= 0.0, self.c_plus, self.c_minus) * omega * np.abs(omega)

    def speed(self, force: ArrayLike) -> Array:
        """Shaft speed [rad/s] whose steady thrust is `force`: the inverse of `thrust`.

        Args:
            force: Along `axis`, body frame [N], (...,).
        """
        target = np.asarray(force, dtype=np.float64)
        c = np.where(target >= 0.0, self.c_plus, self.c_minus)
        return np.sign(target) * np.sqrt(np.abs(target) / c)

    def shaft_speed(self, pulse_us: ArrayLike, voltage: ArrayLike | None = None) -> Array:
        """Steady shaft speed at a pulse width; where `motor_sign` is -1, small pulses are positive thrust.

        Args:
            pulse_us: [µs], (...,).
            voltage: Of the battery [V], (...,), broadcast with the other; that of the ESC's numbers where not given.

        Returns:
            [rad/s], (...,), positive for positive thrust.

        Raises:
            VehicleError: The vehicle file gives this thruster no `esc`.
        """
        esc = self._need_esc()
        pulse = np.asarray(pulse_us, dtype=np.float64)
        mirrored = np.where(pulse <= 0.0, pulse, 2.0 * esc.pulse_neutral - pulse)
        return esc.shaft_speed(mirrored if self.motor_sign == -1 else pulse, voltage)

    def pulse(self, shaft_speed: ArrayLike, voltage: ArrayLike | None = None) -> Array:
        """Pulse width [µs] that makes a steady shaft speed: the inverse of `shaft_speed`.

        Args:
            shaft_speed: [rad/s], (...,), positive for positive thrust.
            voltage: Of the battery [V], (...,), broadcast with the other; that of the ESC's numbers where not given.

        Raises:
            VehicleError: The vehicle file gives this thruster no `esc`.
        """
        esc = self._need_esc()
        pulse = esc.pulse(shaft_speed, voltage)
        return 2.0 * esc.pulse_neutral - pulse if self.motor_sign == -1 else pulse

    def _need_esc(self) -> Esc:
        if self.esc is None:
            raise VehicleError(
                "this thruster has no 'esc' section, so pulse widths cannot become shaft speeds: fit one with "
                "'finssim calibrate thruster', or give shaft speeds or thrusts instead"
            )
        return self.esc
