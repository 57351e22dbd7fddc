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


# One motor: the shaft speed to command for a thrust, small thrusts as pulses that are right on average.
#
# A motor does not turn below a slowest speed, so the thrust of that speed is the least one that can be held. Anything
# smaller thrusts are delivered on average: the motor runs at its slowest speed in pulses, set by the owed impulse.
#
#     owed_dot = f - T(ω),      a pulse begins at owed = +h and ends at owed = -h,      h = T_slow t_pulse / 2
#
# ω follows the pulses through the motor's first-order lag; without lag a constant f becomes pulses and gaps of at least
# t_pulse each, with a period of t_pulse T_slow² / (f (T_slow - f)). The impulse is never much more than one pulse,
# T_slow t_pulse, away from what was asked. What jitters around zero without a mean owes nothing and starts no pulse.


class PulseMemory(NamedTuple):
    """State of one motor's pulses from one call to the next."""

    owed: float
    """Impulse that was asked for and not delivered [N s]."""
    pulse: float
    """Direction of the running pulse [-]: -1, 0 or 1."""
    shaft: float
    """Shaft speed that the pulses left, by the model [rad/s]."""


AT_REST = PulseMemory(0.0, 0.0, 0.0)
"""State of a motor at rest that owes no impulse."""


class TurningDirection(NamedTuple):
    """One direction of turning."""

    c: float
    """T = c ω² [N s²/rad²]."""
    slowest: float
    """Least thrust that is held steadily [N]; 0 where every speed turns the shaft."""
    half: float
    """Half a pulse, h [N s]."""


@dataclass(frozen=True)
class Motor:
    """Numbers of one motor."""

    plus: TurningDirection
    minus: TurningDirection
    lag: float
    """Time constant of the shaft speed [s]."""

    def step(self, requested: float, memory: PulseMemory, dt: float) -> tuple[float, PulseMemory]:
        """The shaft speed to command until the next call.

        Args:
            requested: Thrust within the limits [N].
            memory: From the call before, or `AT_REST`.
            dt: How long the command will stand [s].

        Returns:
            Speed [rad/s]: exactly 0 for a thrust of 0, which also forgets what is owed; and the memory after.
        """
        if requested == 0.0:
            return 0.0, AT_REST
        direction, side = (1.0, self.plus) if requested > 0.0 else (-1.0, self.minus)
        size = requested * direction
        if size >= side.slowest:
            # How a held thrust builds up and dies away is the lag of any motor, and not owed to anybody.
            return direction * math.sqrt(size / side.c), PulseMemory(memory.owed, 0.0, 0.0)
        # A pulse never runs against the request: of another sign, what is owed is worked off by the gaps.
        running = memory.pulse == direction
        on = memory.owed * direction > (-side.half if running else side.half)
        pulse = direction if on else 0.0
        target = pulse * math.sqrt(side.slowest / side.c)
        shaft, delivered = self._lagged(memory.shaft, target, dt)
        return target, PulseMemory(memory.owed + requested * dt - delivered, pulse, shaft)

    def _lagged(self, speed: float, target: float, dt: float) -> tuple[float, float]:
        """Shaft speed after dt of a first-order lag [rad/s], and the impulse of its thrust meanwhile [N s].

        ∫(a + b e^{-t/τ})² dt = a² dt + 2 a b τ (1 - e) + b² τ (1 - e²) / 2,    a = target, b = speed - a, e = e^{-dt/τ}

        A change of sign in between is charged to the direction that lasts longer.
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
"""State of the map from one call to the next, one entry per thruster in canonical order."""

RPM = 2.0 * math.pi / 60.0
"""One rpm in rad/s."""
SLOWEST_MARGIN = 1.1
"""Ratio of the speed of a pulse to the slowest speed in the vehicle file, at which a motor might not turn."""
SHORTEST_PULSE = 0.05
"""[s]; three periods of a loop at 60 Hz, for motors faster than that."""


class MotorMap:
    """Thrusts in canonical order to normalised shaft speeds in the motor controller's order, and back.

    Note:
        The controller regulates shaft speed, so the lag is taken to act on it, whatever `domain` the simulator uses.
    """

    def __init__(
        self,
        thrusters: Sequence[Any],
        index: Sequence[int],
        sign: Sequence[int],
        full_scale: float,
        outputs: int,
    ) -> None:
        """Tables of one vehicle.

        Args:
            thrusters: `vehicles.Thruster`, canonical order, n of them.
            index: Output of each, (n,).
            sign: Between positive thrust and positive command, (n,).
            full_scale: Shaft speed of a command of 1 [rpm].
            outputs: Outputs of the controller.

        Raises:
            ControlError: Outputs that do not exist or are used twice.
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
        # Short of full scale by rounding, so that no command comes out as 1.0000000000000002.
        reach = self._c * (np.minimum(np.abs(rpm), full_scale) * RPM) ** 2 * (1.0 - 1e-12)
        self.lower: Array = -np.minimum([-t.force_min for t in thrusters], reach[0])
        self.upper: Array = np.minimum([t.force_max for t in thrusters], reach[1])
        dead = _sides([t.dead_rpm_minus for t in thrusters], [t.dead_rpm_plus for t in thrusters])
        slowest = self._c * (SLOWEST_MARGIN * dead * RPM) ** 2
        self.slowest: Array = np.minimum(slowest, np.stack([-self.lower, self.upper]))
        """Least thrust that is held steadily, reverse and forward, as magnitudes [N], (2, n)."""
        self._motors = [self._motor(k, t.time_constant) for k, t in enumerate(thrusters)]
        self._channels = list(
            zip(index, (self.sign / (full_scale * RPM)).tolist(), self._motors, strict=True)
        )

    @classmethod
    def from_vehicle(cls, vehicle: Any) -> MotorMap:
        """Map of a vehicle; canonical order where no thruster names a motor, sign +1 where it names none.

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
        """Memory of motors at rest that owe nothing."""
        return (AT_REST,) * self.thrusters

    def limited(self, force: npt.ArrayLike) -> Array:
        """Thrusts within force, shaft speed and full-scale limits, canonical order [N], (..., n).

        Args:
            force: Thrusts along the thrusters' axes, canonical order [N], (..., n).
        """
        limited: Array = np.minimum(np.maximum(np.asarray(force, float), self.lower), self.upper)
        return limited

    def force(self, rpm: npt.ArrayLike) -> Array:
        """Steady thrust of canonical shaft speeds [rpm] -> [N], (..., n)                      (paper, eq. 16)."""
        omega = np.asarray(rpm, float) * RPM
        return np.asarray(np.where(omega < 0.0, self._c[0], self._c[1]) * omega * np.abs(omega))

    def canonical_rpm(self, motor_rpm: npt.ArrayLike) -> Array:
        """Shaft speeds in canonical order, positive for positive thrust, from those of the outputs, (..., n) [rpm]."""
        return np.asarray(np.asarray(motor_rpm, float)[..., self.index] * self.sign)

    def normalised(
        self, force: npt.ArrayLike, memory: MotorMemory, dt: float
    ) -> tuple[Array, Array, MotorMemory]:
        """Return the command to send to the controller until the next call.

        Args:
            force: Thrusts asked for, along the thrusters' axes, canonical order [N], (n,); finite.
            memory: From the call before, or `reset()`.
            dt: How long the command will stand; the time since the call before will do [s].

        Returns:
            Part of full scale per output, (outputs,), in [-1, 1]; the thrusts delivered on average [N], (n,), which
            are those asked for within the limits; and the memory after.
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
    """Reverse and forward numbers stacked, (2, n)."""
    return np.stack([np.array(minus, float), np.array(plus, float)])
