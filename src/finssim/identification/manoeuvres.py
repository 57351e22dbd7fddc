"""Manoeuvres of vehicles that must move to steer: references for their autopilot, whose motion identifies them.

Speed runs determine the drag ahead; zig-zags and turning circles (Nomoto 1957; ITTC 7.5-02-06-01) determine sway and
yaw, and the lift of the rudders; depth steps determine heave, pitch, and the diving planes. Any autopilot of speed,
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
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import Trial
from finssim.vehicles import Vehicle
from finssim.vehicles.vehicle import Axis

__all__ = ["Manoeuvre", "Order", "manoeuvres", "simulate_manoeuvres", "write_manoeuvre"]

Array = NDArray[np.float64]

SETTLE = 10.0
"""Duration of the straight run at the start of each manoeuvre [s]."""
PERIOD = 0.1
"""Time between two commands of the autopilot [s]."""
DIVE = 0.75
"""Step of depth, in lengths of the vehicle."""
HARD, STOP, FAR = 3.0, 15.0, 4.0
"""Duration of the last, hard reference of a manoeuvre, of the stop after it [s], and change of depth of a
hard dive [m]."""
LOST = math.radians(60.0)
"""Pitch at which control of the vehicle is lost: it turns over [rad]."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """Reference of the autopilot until the next one."""

    duration: float
    """Duration [s]."""
    speed: float
    """Surge velocity [m/s]; if 0, the propellers stop and the fins keep their angles."""
    course: float = 0.0
    """Course relative to that of the start, counter-clockwise from above [rad]."""
    depth: float = 0.0
    """Depth relative to that of the start [m]."""
    turn: float = 0.0
    """Constant difference between commanded and present course, for a turning circle; 0 for none [rad]."""


@dataclass(frozen=True, kw_only=True)
class Manoeuvre:
    """Manoeuvre of one trial."""

    name: str
    axes: tuple[Axis, ...]
    """Axes that it excites."""
    orders: tuple[Order, ...]

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return sum(order.duration for order in self.orders)

    def at(self, t: float) -> Order:
        """Return the reference at a time since the start [s]."""
        for order in self.orders:
            if t < order.duration:
                return order
            t -= order.duration
        return self.orders[-1]


def manoeuvres(vehicle: Vehicle) -> list[Manoeuvre]:
    """Return speed runs, zig-zags at two speeds, turning circles, depth steps, and both combined.

    Each step lasts as long as the vehicle takes for ten of its lengths, at least 5 s. The speeds and the
    steps of depth leave the fins a reserve for a hull that is less stable than the file states; such motions
    have little side slip. Each manoeuvre except the speed runs therefore ends with a stop out of a hard turn
    or dive: the hull turns broadside to its motion, which reveals its drag in sway, heave, pitch and yaw.

    Args:
        vehicle: Vehicle with a course autopilot (`finssim.control.course`).
    """
    slow, middle, fast = np.quantile(course_speeds(vehicle), (0.4, 0.6, 1.0)).tolist()
    dive = DIVE * float(vehicle.body.size[0])

    def step(speed: float) -> float:
        return max(5.0, 10.0 * float(vehicle.body.size[0]) / speed)

    def trial(name: str, axes: tuple[Axis, ...], speed: float, *orders: Order, **last: float) -> Manoeuvre:
        """Return a straight run, the references, a last one at the limit of the autopilot, and the stop after it."""
        hard = Order(duration=HARD, speed=speed, **last)
        straight, stop = Order(duration=SETTLE, speed=speed), Order(duration=STOP, speed=0.0)
        return Manoeuvre(name=name, axes=axes, orders=(straight, *orders, hard, stop))

    def zigzag(speed: float, legs: int) -> list[Order]:
        return [
            Order(duration=step(speed), speed=speed, course=math.radians(60.0) * (-1.0) ** k)
            for k in range(legs)
        ]

    def dives(speed: float, legs: int) -> list[Order]:
        return [Order(duration=step(speed), speed=speed, depth=dive * (k % 2)) for k in range(1, legs + 1)]

    def circles(speed: float) -> list[Order]:
        return [Order(duration=3.0 * step(speed), speed=speed, turn=x) for x in (0.8, -0.8)]

    def corkscrew(speed: float) -> list[Order]:
        return [
            Order(duration=step(speed), speed=speed, course=0.7 * (-1.0) ** (k // 2), depth=dive * (k % 2))
            for k in range(8)
        ]

    runs = tuple(Order(duration=15.0, speed=x) for x in (slow, fast, middle, fast, slow, middle))
    lateral: tuple[Axis, ...] = ("surge", "sway", "yaw")
    upright: tuple[Axis, ...] = ("surge", "heave", "pitch")
    return [
        Manoeuvre(name="speeds", axes=("surge",), orders=runs),
        trial("zigzag_slow", lateral, middle, *zigzag(middle, 8), turn=0.8),
        trial("zigzag_fast", lateral, fast, *zigzag(fast, 10), turn=-0.8),
        trial("circles", lateral, middle, *circles(middle), turn=-0.8),
        trial("dives_slow", upright, middle, *dives(middle, 8), depth=FAR),
        trial("dives_fast", upright, fast, *dives(fast, 10), depth=-FAR),
        trial("corkscrew", (*lateral, "heave", "pitch"), fast, *corkscrew(fast), turn=0.8, depth=FAR),
    ]


def write_manoeuvre(manoeuvre: Manoeuvre, folder: Path) -> None:
    """Write the references of a manoeuvre as `programme.csv`: each is held until the time of the next.

    The table has `t` [s], `speed` [m/s], `course` [deg] relative to that of the start, counter-clockwise from
    above, `depth` [m] relative to that of the start, and `turn` [deg]: if it is not 0, the commanded course
    differs from the present one by this angle.

    Args:
        manoeuvre: Manoeuvre to write.
        folder: Folder to write to; created if missing.

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
        self.steps, self.propellers = 0, len(vehicle.thrusters)
        self.pitch = np.zeros(len(chosen))
        """Largest pitch of each manoeuvre so far, up or down [rad]."""

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
        _, pitch, heading = (np.asarray(angle) for angle in quat_to_euler(quaternion))
        if self.start is None:
            self.start = (heading, -position[:, 2])
        course, depth = self.start
        orders = [manoeuvre.at(self.steps * STEP) for manoeuvre in self.chosen]
        driven = np.array([order.speed > 0.0 for order in orders])
        self.pitch = np.maximum(self.pitch, np.where(driven, np.abs(pitch), 0.0))
        wanted = [
            now + order.turn if order.turn else first + order.course
            for now, first, order in zip(heading, course, orders, strict=True)
        ]
        channels, self.memory = self.pilot.command(
            self.memory,
            Track(position=position, quaternion=quaternion, nu=nu),
            speed=[order.speed for order in orders],
            course=wanted,
            depth=depth + [order.depth for order in orders],
        )
        self.channels = np.where(driven[:, None], channels, self.channels)
        self.channels[~driven, : self.propellers] = 0.0


def simulate_manoeuvres(
    chosen: Sequence[Manoeuvre],
    vehicle: Vehicle,
    *,
    truth: Vehicle | None = None,
    seed: int = 0,
    **options: Any,
) -> list[Trial]:
    """Return a trial of each manoeuvre, run by the vehicle's autopilot in the simulator and measured with noise.

    It starts at the speed of the first reference: at rest, no fin would hold an unstable or buoyant hull.

    Args:
        chosen: Manoeuvres to run.
        vehicle: Vehicle of the file: the autopilot is tuned to it, and the trials name it.
        truth: Vehicle that is simulated instead, such as the file with other numbers; the same if None.
        seed: Seed of initial conditions and noise.
        options: Further arguments of `finssim.identification.synthetic.simulate_programme`.

    Raises:
        CalibrationError: A motion does not stay finite, the autopilot loses control of the vehicle, or an
            option is invalid.
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
    given = {"inputs": ("rpm",), "speed": [one.orders[0].speed for one in chosen]} | options
    helm = _Helm(chosen, vehicle)
    trials = simulate_programme(programmes, truth or vehicle, seed=seed, each_step=helm, **given)
    lost = [one.name for one, pitch in zip(chosen, helm.pitch, strict=True) if pitch > LOST]
    if lost:
        raise CalibrationError(
            f"{', '.join(lost)}: the vehicle turned over, as the autopilot, tuned to the file, cannot control it: "
            "give a vehicle closer to the file, or references with less depth and more speed"
        )
    return trials
