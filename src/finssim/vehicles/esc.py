"""The speed controller of a thruster: from pulse width and battery voltage to steady shaft speed, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import model_validator

from finssim.vehicles.part import NonNegative, Part, Positive, refuse_section

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
    """Of the battery under load, at which the numbers were found [V]."""
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
        given = [getattr(self, key) for key in keys]
        if (
            sorted(given) != given
            or not self.dead_minus > self.pulse_min
            or not self.dead_plus < self.pulse_max
        ):
            raise refuse_section(
                f"pulse widths {', '.join(f'{k} {v:g}' for k, v in zip(keys, given, strict=True))} µs "
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
        found = self._inverse(omega, self._volts(voltage, omega.shape))
        slow_minus, slow_plus = self.slowest
        rounding = 1e-9 * (slow_plus - slow_minus)
        standing = (omega > slow_minus + rounding) & (omega < slow_plus - rounding)
        return np.where(standing, self.pulse_neutral, np.clip(found, self.pulse_min, self.pulse_max))

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
