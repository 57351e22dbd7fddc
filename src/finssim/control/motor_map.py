"""Conversion between thrusts and commands of a motor controller: curve, order, sign, and pulses for small thrusts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError

__all__ = ["AT_REST", "Motor", "MotorMap", "MotorMemory", "PulseMemory", "TurningDirection"]


# One motor: the shaft speed to command for a thrust, with small thrusts as pulses that are correct on average.
#
# A motor does not turn below a minimum speed, so the thrust at that speed is the least that can be held. Smaller
# thrusts are delivered on average: the motor runs at its minimum speed in pulses, controlled by the owed impulse.
#
#     owed_dot = f - T(ω),      a pulse begins at owed = +h and ends at owed = -h,      h = T_slow t_pulse / 2
#
# ω follows the pulses through the motor's first-order lag; without lag a constant f results in pulses and gaps of at
# least t_pulse each, with a period of t_pulse T_slow² / (f (T_slow - f)). The impulse differs from the requested one by
# hardly more than one pulse, T_slow t_pulse. A request that jitters around zero mean starts no pulse.


class PulseMemory(NamedTuple):
    """State of one motor's pulses between calls."""

    owed: float
    """Impulse that was requested and not yet delivered [N s]."""
    pulse: float
    """Direction of the running pulse [-]: -1, 0 or 1."""
    shaft: float
    """Modelled shaft speed due to the pulses [rad/s]."""


AT_REST = PulseMemory(0.0, 0.0, 0.0)
"""State of a motor at rest that owes no impulse."""


class TurningDirection(NamedTuple):
    """Parameters of one direction of rotation."""

    c: float
    """Coefficient of T = c ω² [N s²/rad²]."""
    slowest: float
    """Least thrust that can be held steadily [N]; 0 if every speed turns the shaft."""
    half: float
    """Half of a pulse, h [N s]."""


@dataclass(frozen=True)
class Motor:
    """Parameters of one motor."""

    plus: TurningDirection
    minus: TurningDirection
    lag: float
    """Time constant of the shaft speed [s]."""

    def step(self, requested: float, memory: PulseMemory, dt: float) -> tuple[float, PulseMemory]:
        """Return the shaft speed to command until the next call.

        Args:
            requested: Thrust within the limits [N].
            memory: Memory from the previous call, or `AT_REST`.
            dt: Duration of the command [s].

        Returns:
            Speed [rad/s]: exactly 0 for a thrust of 0, which also clears the owed impulse; and the new memory.
        """
        if requested == 0.0:
            return 0.0, AT_REST
        direction, side = (1.0, self.plus) if requested > 0.0 else (-1.0, self.minus)
        size = requested * direction
        if size >= side.slowest:
            # The build-up and decay of a held thrust is the lag of any motor, and is not counted as owed.
            return direction * math.sqrt(size / side.c), PulseMemory(memory.owed, 0.0, 0.0)
        # A pulse never opposes the request: an owed impulse of the other sign is reduced by the gaps.
        running = memory.pulse == direction
        on = memory.owed * direction > (-side.half if running else side.half)
        pulse = direction if on else 0.0
        target = pulse * math.sqrt(side.slowest / side.c)
        shaft, delivered = self._lagged(memory.shaft, target, dt)
        return target, PulseMemory(memory.owed + requested * dt - delivered, pulse, shaft)

    def _lagged(self, speed: float, target: float, dt: float) -> tuple[float, float]:
        """Return the shaft speed after dt of a first-order lag [rad/s], and the impulse of its thrust in that
        time [N s].

        ∫(a + b e^{-t/τ})² dt = a² dt + 2 a b τ (1 - e) + b² τ (1 - e²) / 2,    a = target, b = speed - a, e = e^{-dt/τ}

        A change of sign in between is attributed to the direction that lasts longer.
        """
        decay = math.exp(-dt / self.lag)
        gap = speed - target
        after = target + gap * decay
        square = target * target * dt + gap * self.lag * (1.0 - decay) * (
            2.0 * target + 0.5 * gap * (1.0 + decay)
        )
        return after, square * (self.plus.c if speed + after >= 0.0 else -self.minus.c)


Array = npt.NDArray[np.float64]
MotorMemory = tuple[PulseMemory, ...]
"""State of the map between calls, one entry per thruster in canonical order."""

RPM = 2.0 * math.pi / 60.0
"""Angular velocity of one rpm [rad/s]."""
SLOWEST_MARGIN = 1.1
"""Ratio of the speed of a pulse to the minimum speed in the vehicle file, at which a motor might not turn."""
SHORTEST_PULSE = 0.05
"""Duration of the shortest pulse [s]; three periods of a loop at 60 Hz, for motors with a shorter lag."""


class MotorMap:
    """Map from thrusts in canonical order to normalised shaft speeds in the motor controller's order, and back.

    Note:
        The controller regulates shaft speed, so the lag is assumed to apply to it, whatever `domain` the
        simulator uses.
    """

    def __init__(
        self,
        thrusters: Sequence[Any],
        index: Sequence[int],
        sign: Sequence[int],
        full_scale: float,
        outputs: int,
    ) -> None:
        """Create the map of one vehicle.

        Args:
            thrusters: `vehicles.Thruster`, canonical order, n of them.
            index: Output of each thruster, (n,).
            sign: Sign between positive thrust and positive command, (n,).
            full_scale: Shaft speed at a command of 1 [rpm].
            outputs: Number of outputs of the controller.

        Raises:
            ControlError: An output does not exist or is used twice.
        """
        if len(set(index)) != len(index) or any(not 0 <= k < outputs for k in index):
            raise ControlError(
                f"motor outputs {list(index)} must differ and lie in 0 to {outputs - 1}: correct motor_index"
            )
        self.index = np.array(index, dtype=np.int64)
        self.sign: Array = np.array(sign, float)
        self.outputs = outputs
        self.full_scale = float(full_scale)
        self._c = _sides([t.c_minus for t in thrusters], [t.c_plus for t in thrusters])
        rpm = _sides([t.rpm_min for t in thrusters], [t.rpm_max for t in thrusters])
        # Slightly below full scale, so that no command is rounded to 1.0000000000000002.
        reach = self._c * (np.minimum(np.abs(rpm), full_scale) * RPM) ** 2 * (1.0 - 1e-12)
        self.lower: Array = -np.minimum([-t.force_min for t in thrusters], reach[0])
        self.upper: Array = np.minimum([t.force_max for t in thrusters], reach[1])
        dead = _sides([t.dead_rpm_minus for t in thrusters], [t.dead_rpm_plus for t in thrusters])
        slowest = self._c * (SLOWEST_MARGIN * dead * RPM) ** 2
        self.slowest: Array = np.minimum(slowest, np.stack([-self.lower, self.upper]))
        """Least thrust that can be held steadily, reverse and forward, as magnitudes [N], (2, n)."""
        self._motors = [self._motor(k, t.time_constant) for k, t in enumerate(thrusters)]
        self._channels = list(
            zip(index, (self.sign / (full_scale * RPM)).tolist(), self._motors, strict=True)
        )

    @classmethod
    def from_vehicle(cls, vehicle: Any) -> MotorMap:
        """Return the map of a vehicle; canonical order if no thruster names a motor, sign +1 if it is omitted.

        Raises:
            ControlError: Only some thrusters have `motor_index` and `motor_sign`.
        """
        thrusters = list(vehicle.thrusters.values())
        if all(t.motor_index is None for t in thrusters):
            signs = [t.motor_sign or 1 for t in thrusters]
            mcu = vehicle.mcu
            return cls(thrusters, range(len(thrusters)), signs, mcu.rpm_full_scale, mcu.outputs)
        for name, t in vehicle.thrusters.items():
            if t.motor_index is None or t.motor_sign is None:
                raise ControlError(
                    f"{vehicle.name}: thruster '{name}' has no motor_index or motor_sign, others do: give both to each"
                )
        index, sign = [t.motor_index for t in thrusters], [t.motor_sign for t in thrusters]
        return cls(thrusters, index, sign, vehicle.mcu.rpm_full_scale, vehicle.mcu.outputs)

    @property
    def thrusters(self) -> int:
        """Number of thrusters n."""
        return len(self._motors)

    def reset(self) -> MotorMemory:
        """Return the memory of motors at rest without owed impulse."""
        return (AT_REST,) * self.thrusters

    def limited(self, force: npt.ArrayLike) -> Array:
        """Return thrusts limited by force, shaft speed and full scale, canonical order [N], (..., n).

        Args:
            force: Thrusts along the thrusters' axes, canonical order [N], (..., n).
        """
        limited: Array = np.minimum(np.maximum(np.asarray(force, float), self.lower), self.upper)
        return limited

    def force(self, rpm: npt.ArrayLike) -> Array:
        """Return the steady thrust of canonical shaft speeds [rpm] -> [N], (..., n) (paper, eq. 16)."""
        omega = np.asarray(rpm, float) * RPM
        return np.asarray(np.where(omega < 0.0, self._c[0], self._c[1]) * omega * np.abs(omega))

    def canonical_rpm(self, motor_rpm: npt.ArrayLike) -> Array:
        """Return shaft speeds in canonical order, positive for positive thrust, from those of the outputs,
        (..., n) [rpm]."""
        return np.asarray(np.asarray(motor_rpm, float)[..., self.index] * self.sign)

    def normalised(
        self, force: npt.ArrayLike, memory: MotorMemory, dt: float
    ) -> tuple[Array, Array, MotorMemory]:
        """Return the command to send to the controller until the next call.

        Args:
            force: Requested thrusts, along the thrusters' axes, canonical order [N], (n,); finite.
            memory: Memory from the previous call, or `reset()`.
            dt: Duration of the command, approximately the time since the previous call [s].

        Returns:
            Fraction of full scale per output, (outputs,), in [-1, 1]; the thrusts delivered on average [N],
            (n,), which are the requested ones within the limits; and the new memory.
        """
        requested = self.limited(force)
        outputs = [0.0] * self.outputs
        after = []
        for (output, per_speed, motor), thrust, before in zip(
            self._channels, requested.tolist(), memory, strict=True
        ):
            speed, memory_after = motor.step(thrust, before, dt)
            outputs[output] = speed * per_speed
            after.append(memory_after)
        return np.array(outputs), requested, tuple(after)

    def _motor(self, k: int, lag: float) -> Motor:
        shortest = max(lag, SHORTEST_PULSE)
        minus, plus = (
            TurningDirection(c, slowest, 0.5 * slowest * shortest)
            for c, slowest in zip(self._c[:, k].tolist(), self.slowest[:, k].tolist(), strict=True)
        )
        return Motor(plus=plus, minus=minus, lag=lag)


def _sides(minus: Any, plus: Any) -> Array:
    """Return reverse and forward numbers stacked, (2, n)."""
    return np.stack([np.array(minus, float), np.array(plus, float)])
