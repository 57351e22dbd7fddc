"""What an ablation takes away from a pilot: noise on the state that it sees."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.control.guidance import Guide
from finssim.control.tracking import Measured
from finssim.geometry.rotations import quat_from_yaw, quat_multiply
from finssim.robot.pilots import Pilot

__all__ = ["NoisyInput"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _Seen:
    """The state as the pilot sees it."""

    position: Array
    quaternion: Array
    nu: Array


class NoisyInput:
    """A pilot that sees its position and heading with independent errors, drawn anew for every decision.

    The published ablation "+ localization noise" has 5 cm per axis and 10 degrees; it touches the controller's input
    alone.
    """

    def __init__(
        self,
        pilot: Pilot,
        *,
        position_std: float = 0.05,
        yaw_std: float = math.radians(10.0),
        seed: int = 0,
    ) -> None:
        """
        Args:
            pilot: Who decides.
            position_std: Standard deviation of each coordinate [m].
            yaw_std: Of the heading [rad].
            seed: Of the errors; `reset` starts them again.
        """
        self._pilot, self._stds, self._seed = pilot, (position_std, yaw_std), seed
        self._random = np.random.default_rng(seed)

    @property
    def name(self) -> str:
        """That of the pilot."""
        return self._pilot.name

    @property
    def period(self) -> float:
        """Time between two decisions [s]."""
        return self._pilot.period

    @property
    def needs_state(self) -> bool:
        """As the pilot."""
        return self._pilot.needs_state

    def describe(self) -> dict[str, Any]:
        """The pilot and the noise."""
        position_std, yaw_std = self._stds
        noise = {"position_std_m": position_std, "yaw_std_rad": yaw_std, "seed": self._seed}
        return {**self._pilot.describe(), "input_noise": noise}

    def reset(self) -> None:
        """Forget what was before, the errors too."""
        self._random = np.random.default_rng(self._seed)
        self._pilot.reset()

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,)."""
        position_std, yaw_std = self._stds
        moved = np.asarray(reading.position, float) + self._random.normal(0.0, position_std, 3)
        turned = quat_multiply(quat_from_yaw(self._random.normal(0.0, yaw_std)), reading.quaternion)
        return self._pilot.act(_Seen(moved, turned, np.asarray(reading.nu, float)), guide, t)
