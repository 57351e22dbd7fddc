"""One motor: the shaft speed to command for a thrust, small thrusts as pulses that are right on average.

A motor does not turn below a slowest speed, so the thrust of that speed is the least one that can be held. Anything
smaller is delivered on average: the motor runs at its slowest speed in pulses, begun and ended by what is owed.

    owed_dot = f - T(ω),      a pulse begins at owed = +h and ends at owed = -h,      h = T_slow t_pulse / 2

ω follows the pulses through the motor's first-order lag; without lag a constant f becomes pulses and gaps of at least
t_pulse each, with a period of t_pulse T_slow² / (f (T_slow - f)). The impulse is never much more than one pulse,
T_slow t_pulse, away from what was asked. What jitters around zero without a mean owes nothing and starts no pulse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

__all__ = ["AT_REST", "Motor", "PulseMemory", "Side"]


class PulseMemory(NamedTuple):
    """What one motor's pulses carry from one call to the next."""

    owed: float
    """Impulse that was asked for and not delivered [N s]."""
    pulse: float
    """Direction of the running pulse: -1, 0 or 1."""
    shaft: float
    """Shaft speed that the pulses left, by the model [rad/s]."""


AT_REST = PulseMemory(0.0, 0.0, 0.0)
"""A motor that stands and owes nothing."""


class Side(NamedTuple):
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

    plus: Side
    minus: Side
    lag: float
    """Time constant of the shaft speed [s]."""

    def step(self, asked: float, memory: PulseMemory, dt: float) -> tuple[float, PulseMemory]:
        """The shaft speed to command until the next call.

        Args:
            asked: Thrust within the limits [N].
            memory: From the call before, or `AT_REST`.
            dt: How long the command will stand [s].

        Returns:
            Speed [rad/s]: exactly 0 for a thrust of 0, which also forgets what is owed; and the memory after.
        """
        if asked == 0.0:
            return 0.0, AT_REST
        direction, side = (1.0, self.plus) if asked > 0.0 else (-1.0, self.minus)
        size = asked * direction
        if size >= side.slowest:
            # How a held thrust builds up and dies away is the lag of any motor, and not owed to anybody.
            return direction * math.sqrt(size / side.c), PulseMemory(memory.owed, 0.0, 0.0)
        # A pulse never runs against the request: of another sign, what is owed is worked off by the gaps.
        running = memory.pulse == direction
        on = memory.owed * direction > (-side.half if running else side.half)
        pulse = direction if on else 0.0
        target = pulse * math.sqrt(side.slowest / side.c)
        shaft, delivered = self._lagged(memory.shaft, target, dt)
        return target, PulseMemory(memory.owed + asked * dt - delivered, pulse, shaft)

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
