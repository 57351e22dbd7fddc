"""Autopilot of a vehicle that is commanded by axes: ArduSub, its frame, and full-stick demands."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from finssim.vehicles.part import Part, Positive, did_you_mean, refuse_section, refuse_value

__all__ = ["DEMANDS", "FRAMES", "Autopilot"]

Array = NDArray[np.float64]

DEMANDS = ("roll", "pitch", "yaw", "throttle", "forward", "lateral")
"""Demands of ArduSub's mixer, in the order of a motor's factors: right side down, nose up, clockwise from
above, up, forward, right."""

_HORIZONTAL: list[list[float]] = [
    [0, 0, 1, 0, -1, 1],
    [0, 0, -1, 0, -1, -1],
    [0, 0, -1, 0, 1, 1],
    [0, 0, 1, 0, 1, -1],
]

FRAMES: dict[int, tuple[str, list[list[float]]]] = {
    0: (
        "BLUEROV1",
        [
            [0, 0, -1, 0, 1, 0],
            [0, 0, 1, 0, 1, 0],
            [-0.5, 0.5, 0, 0.45, 0, 0],
            [0.5, 0.5, 0, 0.45, 0, 0],
            [0, -1, 0, 1, 0, 0],
            [-0.25, 0, 0, 0, 0, 1],
        ],
    ),
    1: ("VECTORED", [*_HORIZONTAL, [1, 0, 0, -1, 0, 0], [-1, 0, 0, -1, 0, 0]]),
    2: (
        "VECTORED_6DOF",
        [
            *_HORIZONTAL,
            [1, -1, 0, -1, 0, 0],
            [-1, -1, 0, -1, 0, 0],
            [1, 1, 0, -1, 0, 0],
            [-1, 1, 0, -1, 0, 0],
        ],
    ),
    4: ("SIMPLEROV_3", [[0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 1, 0], [0, 0, 0, -1, 0, 0]]),
    5: (
        "SIMPLEROV_4",
        [[0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 1, 0], [1, 0, 0, -1, 0, 0], [-1, 0, 0, -1, 0, 0]],
    ),
    6: (
        "SIMPLEROV_5",
        [
            [0, 0, -1, 0, 1, 0],
            [0, 0, 1, 0, 1, 0],
            [1, 0, 0, -1, 0, 0],
            [-1, 0, 0, -1, 0, 0],
            [0, 0, 0, 0, 0, 1],
        ],
    ),
}
"""FRAME_CONFIG -> name, and the factors of the `DEMANDS` for each motor (ArduPilot, AP_Motors6DOF::setup_motors)."""


class Autopilot(Part):
    """ArduSub between a pilot's axes and the thrusters' speed controllers (docs/bluerov2.md)."""

    firmware: Literal["ardusub"] = "ardusub"
    frame: str | tuple[tuple[float, ...], ...]
    """Name of `FRAMES`, or a table with the factors of the `DEMANDS` for each motor, in the order of motor_index."""
    directions: tuple[Literal[-1, 1], ...] = ()
    """MOT_n_DIRECTION of each motor; 1 where the file omits it."""
    gain: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    """Fraction of an axis's full output that action 1 of `pilot6` represents [-]; the vehicle's own pilot
    gain (JS_GAIN_DEFAULT) must be at least as large."""
    voltage: Positive | None = None
    """Battery voltage under load, at which pulses are converted to thrusts [V]; the thrusters' `esc.voltage`
    if None."""

    @field_validator("frame")
    @classmethod
    def _known(cls, value: Any) -> Any:
        names = [name for name, _ in FRAMES.values()]
        if isinstance(value, str):
            if value not in names:
                raise refuse_value(
                    f"is '{value}'{did_you_mean(value, names)} expected {', '.join(names)} or a table of factors"
                )
        elif not value or any(len(row) != len(DEMANDS) for row in value):
            raise refuse_value(
                f"is a table whose rows are not {len(DEMANDS)} long: give each motor its factors of "
                f"{', '.join(DEMANDS)}"
            )
        return value

    @property
    def name(self) -> str:
        """Name of the frame; `table` if the file contains factors."""
        return self.frame if isinstance(self.frame, str) else "table"

    @property
    def factors(self) -> Array:
        """Factors of the `DEMANDS` by motor, before directions are applied [-], (motors, 6)."""
        named = dict(FRAMES.values())
        return np.array(named[self.frame] if isinstance(self.frame, str) else self.frame, float)

    def signs(self, motors: int) -> Array:
        """Return the sign of each motor's direction, -1 or 1 [-], (motors,)."""
        return np.array([*self.directions, *[1] * (motors - len(self.directions))], float)


def refuse_misfit(autopilot: Autopilot, thrusters: dict[str, Any], control_matrix: Array) -> None:
    """Refuse an autopilot whose motors do not push in the directions of its frame.

    Args:
        autopilot: Autopilot with its frame and directions.
        thrusters: `Thruster` by name, canonical order, n of them.
        control_matrix: Wrench = B f, body frame [-, m], (6, n).
    """
    factors = autopilot.factors
    if len(factors) != len(thrusters) or len(autopilot.directions) > len(thrusters):
        raise refuse_section(
            f"autopilot: frame {autopilot.name} has {len(factors)} motors and {len(autopilot.directions)} directions, "
            f"the vehicle {len(thrusters)} thrusters"
        )
    signs = autopilot.signs(len(factors))
    for k, (name, thruster) in enumerate(thrusters.items()):
        motor = k if thruster.motor_index is None else thruster.motor_index
        if motor >= len(factors):
            raise refuse_section(
                f"autopilot: thruster '{name}' names motor {motor}, the frame has {len(factors)}"
            )
        _, _, _, throttle, forward, lateral = factors[motor] * signs[motor] * (thruster.motor_sign or 1)
        push = np.array([forward, -lateral, throttle]) @ control_matrix[:3, k]
        if not push > 0.0:
            raise refuse_section(
                f"autopilot: a positive output of motor {motor + 1} pushes thruster '{name}' opposite to what frame "
                f"{autopilot.name} expects: reverse its axis, motor_sign or directions[{motor}]"
            )
