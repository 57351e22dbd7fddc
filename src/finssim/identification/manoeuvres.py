"""Manoeuvres of vehicles that must move to steer: orders to their autopilot whose motion identifies them.

Speed runs determine the drag ahead; zig-zags and turning circles (Nomoto 1957; ITTC 7.5-02-06-01) sway and yaw, and
the lift of the fins that turn the vehicle; depth steps heave, pitch, and the fins that dive it. Any autopilot of speed,
course and depth can run them; a log needs speeds, rates, attitude, shaft speeds and `actuator_NAME` of every fin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.course import CoursePilot, course_speeds
from finssim.control.guidance import Track
from finssim.core.rotations import quat_to_euler
from finssim.core.text_table import write_csv
from finssim.identification.programme import RATE, Programme
from finssim.identification.synthetic import STEP, simulate_programme
from finssim.sim import Simulator
from finssim.sim.free_motion import linear_model
from finssim.trials.trial import Trial
from finssim.vehicles import Vehicle
from finssim.vehicles.vehicle import Axis

__all__ = ["Manoeuvre", "Order", "manoeuvres", "simulate_manoeuvres", "write_manoeuvre"]

Array = NDArray[np.float64]

SETTLE = 10.0
"""Straight way at the start of each manoeuvre [s]."""
PERIOD = 0.1
"""Time between two commands of the autopilot [s]."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """Reference of the autopilot until the next order."""

    duration: float
    """[s]"""
    speed: float
    """Surge [m/s]."""
    course: float = 0.0
    """Course from that of the start, counter-clockwise from above [rad]."""
    depth: float = 0.0
    """Depth below that of the start [m]."""
    turn: float = 0.0
    """Constant difference of the commanded course from the present one, for a turning circle; 0 for none [rad]."""


@dataclass(frozen=True, kw_only=True)
class Manoeuvre:
    """One trial."""

    name: str
    axes: tuple[Axis, ...]
    """Axes that it excites."""
    orders: tuple[Order, ...]

    @property
    def duration(self) -> float:
        """[s]"""
        return sum(order.duration for order in self.orders)

    def at(self, t: float) -> Order:
        """Return the order of a time since the start [s]."""
        for order in self.orders:
            if t < order.duration:
                return order
            t -= order.duration
        return self.orders[-1]


def manoeuvres(vehicle: Vehicle) -> list[Manoeuvre]:
    """Return speed runs, zig-zags at two speeds, turning circles, depth steps, and both together.

    Each step lasts as long as the vehicle takes for ten of its lengths, at least 5 s.

    Args:
        vehicle: With an autopilot of course (`finssim.control.course`).
    """
    slow, middle, fast = np.quantile(course_speeds(vehicle), (0.25, 0.6, 1.0))

    def step(speed: float) -> float:
        return max(5.0, 10.0 * float(vehicle.body.size[0]) / speed)

    def zigzag(speed: float, angle: float, legs: int) -> tuple[Order, ...]:
        way = [angle * (-1.0) ** k for k in range(legs)]
        return (
            Order(duration=SETTLE, speed=speed),
            *(Order(duration=step(speed), speed=speed, course=x) for x in way),
        )

    def dives(speed: float, depth: float, legs: int) -> tuple[Order, ...]:
        return (
            Order(duration=SETTLE, speed=speed),
            *(Order(duration=step(speed), speed=speed, depth=depth * (k % 2)) for k in range(1, legs + 1)),
        )

    def circles(speed: float) -> tuple[Order, ...]:
        turns = (Order(duration=3.0 * step(speed), speed=speed, turn=x) for x in (0.8, -0.8))
        return (Order(duration=SETTLE, speed=speed), *turns)

    def corkscrew(speed: float) -> tuple[Order, ...]:
        return tuple(
            Order(duration=step(speed), speed=speed, course=0.35 * (-1.0) ** (k // 2), depth=1.5 * (k % 2))
            for k in range(8)
        )

    runs = tuple(Order(duration=15.0, speed=float(x)) for x in (slow, fast, middle, fast, slow, middle))
    lateral: tuple[Axis, ...] = ("surge", "sway", "yaw")
    upright: tuple[Axis, ...] = ("surge", "heave", "pitch")
    return [
        Manoeuvre(name="speeds", axes=("surge",), orders=runs),
        Manoeuvre(name="zigzag_slow", axes=lateral, orders=zigzag(float(middle), math.radians(20.0), 8)),
        Manoeuvre(name="zigzag_fast", axes=lateral, orders=zigzag(float(fast), math.radians(20.0), 10)),
        Manoeuvre(name="circles", axes=lateral, orders=circles(float(middle))),
        Manoeuvre(name="dives_slow", axes=upright, orders=dives(float(middle), 2.0, 8)),
        Manoeuvre(name="dives_fast", axes=upright, orders=dives(float(fast), 2.0, 10)),
        Manoeuvre(
            name="corkscrew", axes=("surge", "sway", "heave", "pitch", "yaw"), orders=corkscrew(float(fast))
        ),
    ]


def write_manoeuvre(manoeuvre: Manoeuvre, folder: Path) -> None:
    """Write the orders of a manoeuvre as `programme.csv`: each holds from its time until the next.

    The table has `t` [s], `speed` [m/s], `course` [deg] from that of the start, counter-clockwise from above, `depth`
    [m] below that of the start, and `turn` [deg]: where it is not 0, the course is always that much from the present
    one.

    Args:
        manoeuvre: Which.
        folder: To write into; made if missing.

    Raises:
        OutputError: The system refused to write.
    """
    starts = np.cumsum([0.0, *(order.duration for order in manoeuvre.orders)])
    rows = [
        [t, order.speed, math.degrees(order.course), order.depth, math.degrees(order.turn)]
        for t, order in zip(starts, (*manoeuvre.orders, manoeuvre.orders[-1]), strict=True)
    ]
    names = ["t", "speed", "course", "depth", "turn"]
    write_csv(folder / "programme.csv", names, ([f"{x:.6g}" for x in row] for row in rows))


class _Helm:
    """Autopilots of all worlds of a simulator, one manoeuvre each, called before every step."""

    def __init__(self, chosen: Sequence[Manoeuvre], vehicle: Vehicle) -> None:
        self.chosen = chosen
        self.pilot = CoursePilot(linear_model(vehicle), vehicle.name, PERIOD)
        self.memory = self.pilot.reset(len(chosen))
        self.channels = np.zeros((len(chosen), len(vehicle.channel_names)))
        self.start: tuple[Array, Array] | None = None
        self.steps = 0

    def __call__(self, simulator: Simulator) -> None:
        if self.steps % round(PERIOD / STEP) == 0:
            self._steer(simulator)
        self.steps += 1
        view = simulator.command.thrust.numpy()
        view[:, 0, : self.channels.shape[1]] = self.channels

    def _steer(self, simulator: Simulator) -> None:
        position, quaternion, nu = (
            simulator.numpy(name)[:, 0].astype(float) for name in ("position", "quaternion", "velocity")
        )
        heading = np.asarray(quat_to_euler(quaternion)[2])
        if self.start is None:
            self.start = (heading, -position[:, 2])
        course, depth = self.start
        orders = [manoeuvre.at(self.steps * STEP) for manoeuvre in self.chosen]
        wanted = [
            now + order.turn if order.turn else first + order.course
            for now, first, order in zip(heading, course, orders, strict=True)
        ]
        self.channels, self.memory = self.pilot.command(
            self.memory,
            Track(position=position, quaternion=quaternion, nu=nu),
            speed=[order.speed for order in orders],
            course=wanted,
            depth=depth + [order.depth for order in orders],
        )


def simulate_manoeuvres(
    chosen: Sequence[Manoeuvre],
    vehicle: Vehicle,
    *,
    truth: Vehicle | None = None,
    seed: int = 0,
    **options: Any,
) -> list[Trial]:
    """Return a trial of each manoeuvre, run by the vehicle's autopilot in the simulator and measured with noise.

    Args:
        chosen: What to run.
        vehicle: The vehicle file: the autopilot is tuned to it, and the trials name it.
        truth: What moves in its place, such as the file with other numbers; the same if None.
        seed: Of initial conditions and noise.
        options: Further arguments of `finssim.identification.synthetic.simulate_programme`.

    Raises:
        CalibrationError: A motion does not stay finite, or an option cannot be.
        ControlError: The vehicle cannot be steered by course.
    """
    programmes = []
    for manoeuvre in chosen:
        n = round(manoeuvre.duration * RATE)
        programmes.append(
            Programme(
                name=manoeuvre.name,
                axes=manoeuvre.axes,
                rate=RATE,
                tau_desired=np.zeros((n, 6)),
                phase=np.full(n, "excitation"),
            )
        )
    helm = _Helm(chosen, vehicle)
    return simulate_programme(
        programmes, truth or vehicle, seed=seed, each_step=helm, **({"inputs": ("rpm",)} | options)
    )
