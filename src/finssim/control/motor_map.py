"""From thrusts to what a motor controller is told: curve, order, sign, and small thrusts as pulses.

A motor does not turn below a slowest speed, so the thrust of that speed is the least one that can be held. Anything
smaller is delivered on average: the motor runs at its slowest speed in pulses, begun and ended by what is owed.

    owed_dot = T(ω_ideal) - T(ω),      pulse begins at owed = +h, ends at owed = -h,      h = T_slow t_pulse / 2

ω follows what is commanded and ω_ideal what was asked for, both through the same first-order lag, so the lag itself
owes nothing. A constant request f < T_slow becomes pulses and gaps of at least t_pulse each, with a period
of about t_pulse T_slow² / (f (T_slow - f)); the impulse is never more than about one pulse away from what was asked.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.control.errors import ControlError

__all__ = ["MotorMap", "MotorMemory"]

Array = npt.NDArray[np.float64]

RPM = 2.0 * math.pi / 60.0
"""One rpm in rad/s."""
SLOWEST_MARGIN = 1.1
"""Speed of a pulse over the slowest speed in the vehicle file: right at its edge a motor might stand still."""
SHORTEST_PULSE = 0.05
"""[s]; three periods of a loop at 60 Hz, for motors faster than that."""


class MotorMemory(NamedTuple):
    """What the map carries from one call to the next, canonical order, (n,) each."""

    owed: Array
    """Impulse that was asked for and not delivered [N s]."""
    pulse: Array
    """Direction of the running pulse: -1, 0 or 1."""
    shaft: Array
    """Modelled shaft speed [rad/s]."""
    ideal: Array
    """Shaft speed of a motor without a slowest speed [rad/s]."""


class MotorMap:
    """Thrusts in canonical order to normalised shaft speeds in the motor controller's order, and back.

    Note:
        The controller regulates shaft speed, so the lag is taken to act on it, whatever `domain` the simulator uses.
    """

    def __init__(self, thrusters: Any, index: Any, sign: Any, full_scale: float, outputs: int) -> None:
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
        self.index = np.array(index, dtype=np.int64)
        if len(set(index)) != len(index) or self.index.min() < 0 or self.index.max() >= outputs:
            raise ControlError(
                f"motor outputs {list(index)} must differ and lie in 0 to {outputs - 1}: correct motor_index"
            )
        self.sign: Array = np.array(sign, float)
        self.outputs = outputs
        self.full_scale = float(full_scale)
        self._per_speed: Array = self.sign / (full_scale * RPM)
        self._c = _sides([t.c_minus for t in thrusters], [t.c_plus for t in thrusters])
        self._lag: Array = np.array([t.time_constant for t in thrusters])
        rpm = _sides([t.rpm_min for t in thrusters], [t.rpm_max for t in thrusters])
        # Short of full scale by rounding, so that no command comes out as 1.0000000000000002.
        reach = self._c * (np.minimum(np.abs(rpm), full_scale) * RPM) ** 2 * (1.0 - 1e-12)
        self.lower: Array = -np.minimum([-t.force_min for t in thrusters], reach[0])
        self.upper: Array = np.minimum([t.force_max for t in thrusters], reach[1])
        dead = _sides([t.dead_rpm_minus for t in thrusters], [t.dead_rpm_plus for t in thrusters])
        slowest = self._c * (SLOWEST_MARGIN * dead * RPM) ** 2
        self.slowest: Array = np.minimum(slowest, np.stack([-self.lower, self.upper]))
        self._half: Array = 0.5 * self.slowest * np.maximum(self._lag, SHORTEST_PULSE)
        self._columns = np.arange(len(self.index))

    @classmethod
    def from_vehicle(cls, vehicle: Any) -> MotorMap:
        """Map of a vehicle; without an `mcu` section canonical order, sign +1, and its fastest shaft as full scale.

        Raises:
            ControlError: There is an `mcu` section, but a thruster without `motor_index` or `motor_sign`.
        """
        thrusters = list(vehicle.thrusters.values())
        if vehicle.mcu is None:
            fastest = max(max(t.rpm_max, -t.rpm_min) for t in thrusters)
            n = len(thrusters)
            return cls(thrusters, range(n), [1] * n, fastest, n)
        for name, t in vehicle.thrusters.items():
            if t.motor_index is None or t.motor_sign is None:
                raise ControlError(
                    f"{vehicle.name}: thruster '{name}' has no motor_index or motor_sign, which an mcu needs: give both"
                )
        index, sign = [t.motor_index for t in thrusters], [t.motor_sign for t in thrusters]
        return cls(thrusters, index, sign, vehicle.mcu.rpm_full_scale, vehicle.mcu.outputs)

    @property
    def thrusters(self) -> int:
        """Number of thrusters n."""
        return len(self.index)

    def reset(self) -> MotorMemory:
        """Memory of motors at rest that owe nothing."""
        return MotorMemory(*(np.zeros(self.thrusters) for _ in range(4)))

    def speed(self, force: npt.ArrayLike) -> Array:
        """Shaft speed of a steady thrust, ω = sign(T) sqrt(|T| / c±) [rad/s], canonical, (..., n)."""
        wanted = np.asarray(force, float)
        c = np.where(wanted < 0.0, self._c[0], self._c[1])
        return np.asarray(np.copysign(np.sqrt(np.abs(wanted) / c), wanted))

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
        """What to tell the controller until the next call.

        Args:
            force: Thrusts asked for, canonical order [N], (n,); finite.
            memory: From the call before, or `reset()`.
            dt: How long the command will stand; the time since the call before will do [s].

        Returns:
            Part of full scale per output, (outputs,), in [-1, 1]; the thrusts delivered on average [N], (n,), which
            are those asked for within the limits; and the memory after.
        """
        asked = np.minimum(np.maximum(np.asarray(force, float), self.lower), self.upper)
        direction = np.sign(asked)
        side = (asked >= 0.0).astype(np.int64)
        slowest, c = self.slowest[side, self._columns], self._c[side, self._columns]
        size = np.abs(asked)
        small = size < slowest
        owed = memory.owed * direction
        half = self._half[side, self._columns]
        on = small & (owed > np.where(memory.pulse == direction, -half, half))
        on &= direction != 0.0
        ideal_target = direction * np.sqrt(size / c)
        target = np.where(small, np.where(on, direction * np.sqrt(slowest / c), 0.0), ideal_target)
        told = np.zeros(self.outputs)
        told[self.index] = target * self._per_speed
        return told, asked, self._after(memory, direction, on, target, ideal_target, dt)

    def _after(
        self, memory: MotorMemory, direction: Array, on: Any, target: Array, ideal_target: Array, dt: float
    ) -> MotorMemory:
        """Memory once the command has stood for dt; a request of zero forgets what is owed."""
        decay = np.exp(-dt / self._lag)
        shaft, delivered = self._lagged(memory.shaft, target, decay, dt)
        ideal, wanted = self._lagged(memory.ideal, ideal_target, decay, dt)
        asked = direction != 0.0
        owed = np.where(asked, memory.owed + wanted - delivered, 0.0)
        return MotorMemory(owed, direction * on, shaft, np.where(asked, ideal, shaft))

    def _lagged(self, speed: Array, target: Array, decay: Array, dt: float) -> tuple[Array, Array]:
        """Shaft speed after dt of a first-order lag [rad/s], and the impulse of its thrust meanwhile [N s].

        ∫(a + b e^{-t/τ})² dt = a² dt + 2 a b τ (1 - e) + b² τ (1 - e²) / 2,    a = target, b = speed - a, e = e^{-dt/τ}

        A change of sign in between is charged to the direction that lasts longer.
        """
        gap = speed - target
        after = target + gap * decay
        left = 1.0 - decay
        square = target * target * dt + gap * self._lag * left * (2.0 * target + 0.5 * gap * (1.0 + decay))
        way = speed + after
        return after, np.where(way < 0.0, -self._c[0], self._c[1]) * square


def _sides(minus: Any, plus: Any) -> Array:
    """Reverse and forward numbers stacked, (2, n)."""
    return np.stack([np.array(minus, float), np.array(plus, float)])
