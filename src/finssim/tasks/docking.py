"""Docking: enter a funnel nose first, gently, and stay in its tube."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.pole_placement import axis_model
from finssim.engine import Dock, Pool
from finssim.tasks.arrays import Berth, TaskArrays
from finssim.tasks.docking_kernels import (
    DISTANCE_SCALE,
    VELOCITY_CLIP,
    DockingParameters,
    evaluate_docking,
    observe_docking,
    spawn_docking,
)
from finssim.tasks.fitting import coefficients_of
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.task import ObservationPart, Task
from finssim.vehicles import Vehicle
from finssim.vehicles.capability import terminal_speeds

OBSERVATION = (
    ObservationPart("nose to its berth, body frame", 3, "m", scale=DISTANCE_SCALE),
    ObservationPart("dock rotation relative to the body, first two columns", 6, "1"),
    ObservationPart("linear velocity, body frame", 3, "m/s", clip=VELOCITY_CLIP),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=VELOCITY_CLIP),
    ObservationPart("nose from the throat, dock axes", 3, "m", scale=DISTANCE_SCALE),
    ObservationPart("distance of the nose to its berth", 1, "m", scale=DISTANCE_SCALE, clip=1.0),
)

BRISK = 0.9
"""Docks are built for this many vehicle lengths a second, or the vehicle's greatest speed if that is less [1/s]."""


@dataclass(frozen=True)
class Hull:
    """What the task takes from the vehicle; the environment sets it. The defaults are FinsROV's, rounded."""

    length: float = 0.56
    """[m]"""
    girth: float = 0.2444
    """From the body's x axis to a corner of its envelope [m]."""
    inertia: float = 27.1
    """In surge, with the water that goes along [kg]."""
    speed: float = 0.476
    """That the dock is built for, forwards [m/s]."""
    thrust: float = 19.8
    """Greatest, forwards [N]."""

    @classmethod
    def of(cls, vehicle: Vehicle) -> "Hull":
        """Of a vehicle's file."""
        length, width, height = map(float, vehicle.body.size)
        model = coefficients_of(vehicle)
        return cls(
            length,
            0.5 * math.hypot(width, height),
            float(axis_model(vehicle, model).inertia[0]),
            min(float(terminal_speeds(vehicle, model)[0]), BRISK * length),
            float(vehicle.wrench_limits[0]),
        )


@dataclass(frozen=True, kw_only=True)
class DockingReward:
    """Weights of the reward; each term has one reason.

    e: from the nose to its berth; off: how far the nose is outside the cone that leads there; both in vehicle
    lengths. θ: attitude error [rad].

    r = position · exp(-e / position_scale)      a slope that does not vanish at the berth
      - distance · e                             a slope everywhere: the dock is approached
      - corridor · off                           from the front: the straight way may end at the block's outside
      + heading · exp(-θ / heading_scale) - turn · θ     nose first, and straight
      - contact · min(force / limit, 1)          touching is allowed, pushing is not the way
      - action · mean(a²)                        the cheapest thrusts that do it
      - change · mean(Δa²)                       commands that a motor can follow, no chatter
      - rate · min(|ω|², 4)                      no spinning on the way
      - loss                                     once, on a crash or on getting lost: more than a bad episode costs
    """

    position: float = 1.0
    position_scale: float = 0.3
    distance: float = 0.4
    corridor: float = 0.6
    heading: float = 0.4
    heading_scale: float = 0.20
    turn: float = 0.15
    contact: float = 0.5
    action: float = 0.03
    change: float = 0.05
    rate: float = 0.02
    loss: float = 20.0


@dataclass(frozen=True, kw_only=True)
class Docking(Task):
    """Lengths in vehicle lengths, unless said otherwise; the dock's section in parts of the vehicle's girth.

    An episode goes on when it has succeeded: staying in is what pays. Sizes are ours: nothing is published.
    """

    title: ClassVar[str] = "enter a funnel nose first, gently"
    name: str = "docking"
    totals: ClassVar[tuple[str, ...]] = ("success", "success_time", "contact_impulse", "peak_force", "crash")
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 40.0
    hull: Hull = Hull()
    """Of the vehicle; the environment sets it."""
    throat: float = 1.2
    """Radius of the tube, in girths."""
    mouth: float = 2.0
    """Radius of the cone's wide end, in girths."""
    cone: float = math.radians(35.0)
    """Half angle of the cone [rad]."""
    tube: float = 0.5
    """Length of the tube."""
    rim: float = 0.5
    """Thickness of the block, in girths."""
    give: float = 0.15
    """How far a hull point sinks in when the vehicle hits the dock at the speed it is built for, in girths."""
    damping: float = 0.2
    """Of a contact point with the vehicle's mass on it, as a part of the critical."""
    berth: float = 0.75
    """Where the nose is to rest, in parts of the tube from the throat."""
    inside: float = 0.5
    """From where on it counts as inside, in parts of the tube."""
    dock_spread: tuple[float, float, float] = (1.5, 1.5, 0.8)
    """The dock stands this far from the middle of the tank at most."""
    start: tuple[float, float] = (1.5, 4.0)
    """The nose starts this far before the mouth, ..."""
    start_aside: tuple[float, float] = (1.5, 0.8)
    """... this far beside the axis and above or below it at most, ..."""
    turn: float = math.radians(60.0)
    """... turned away from it by this at most [rad]."""
    tilt: float = math.radians(10.0)
    """Largest roll and pitch at the start [rad]."""
    tank: tuple[float, float] = (18.0, 6.0)
    """Width and depth of the tank."""
    slow: float = 0.1
    """Success: the nose inside, at most this fast, in parts of the speed the dock is built for, ..."""
    hold: float = 2.0
    """... for this long [s]."""
    hard: float = 0.5
    """A contact force ends the episode above that of a hit at this part of the speed the dock is built for, and of a
    press with all the vehicle's thrust on top."""
    reward: DockingReward = field(default_factory=DockingReward)
    training_noise: MeasurementNoise = MeasurementNoise(
        position_std=0.01, yaw_std=math.radians(1.0), velocity_std=0.02, rate_std=0.02
    )

    evaluate = staticmethod(evaluate_docking)
    spawn = staticmethod(spawn_docking)
    observe = staticmethod(observe_docking)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Docking":
        """With a dock that fits the vehicle."""
        return replace(self, hull=Hull.of(vehicles[0]))

    @property
    def force_limit(self) -> float:
        """Contact force above which an episode ends [N]: a spring stops a mass m at speed v with √(k m) v."""
        hit = self.hard * self.hull.speed * math.sqrt(self.dock().stiffness * self.hull.inertia)
        return self.hull.thrust + hit

    def dock(self) -> Dock:
        """The dock's shape and stiffness [m, N/m, N s/m]."""
        girth, length, inertia = self.hull.girth, self.hull.length, self.hull.inertia
        # m v² = k give²: all the energy of the greatest speed in one point's spring.
        stiffness = inertia * (self.hull.speed / (self.give * girth)) ** 2
        return Dock(
            mouth_radius=self.mouth * girth,
            throat_radius=self.throat * girth,
            cone_length=(self.mouth - self.throat) * girth / math.tan(self.cone),
            tube_length=self.tube * length,
            rim=self.rim * girth,
            stiffness=stiffness,
            damping=2.0 * self.damping * math.sqrt(stiffness * inertia),
            slip=0.1 * self.hull.speed,
        )

    def arena(self) -> Pool:
        """A tank with walls as stiff as the dock."""
        dock, (width, depth) = self.dock(), self.tank
        return Pool(
            length=width * self.hull.length, width=width * self.hull.length, depth=depth * self.hull.length,
            stiffness=dock.stiffness, damping=dock.damping,
        )  # fmt: skip

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Where the vehicle's nose comes to rest."""
        place = Berth()
        place.nose, place.depth = 0.5 * self.hull.length, self.berth * self.dock().tube_length
        arrays.berth = place

    def success_rule(self) -> str:
        """See `Task`."""
        return f"nose in the tube, slow, for {self.hold:g} s, without a crash"

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """As every task's; success (docked for `hold` at any time, and no crash), its time [s], contact.

        `success_time` is not a number where there was no success; contact_impulse [N s], peak_force [N], crash 0 or 1.
        """
        measured = super().metrics(arrays)
        measured["success"] *= 1.0 - measured["crash"]
        measured["success_time"][measured["success"] == 0.0] = np.nan
        return measured

    def parameters(self) -> Any:
        """The struct that the kernels take."""
        p, r, dock, length = DockingParameters(), self.reward, self.dock(), self.hull.length
        p.inside, p.gap, p.length = (
            self.inside * dock.tube_length,
            dock.throat_radius - self.hull.girth,
            length,
        )
        p.slope = math.tan(self.cone)
        middle = wp.vec3(0.0, 0.0, -0.5 * self.tank[1])
        spread = wp.vec3(*self.dock_spread)
        p.dock_low, p.dock_high = length * (middle - spread), length * (middle + spread)
        across, up = (length * s for s in self.start_aside)
        near, far = (dock.cone_length + length * s for s in self.start)
        p.start_low, p.start_high = wp.vec3(-far, -across, -up), wp.vec3(-near, across, up)
        p.ceiling, p.range = 0.5 * length, self.tank[0] * length
        p.slow, p.force_limit = self.slow * self.hull.speed, self.force_limit
        for name in ("turn", "tilt", "hold", "time_limit", "control_step"):
            setattr(p, name, getattr(self, name))
        for name in (
            "position",
            "distance",
            "corridor",
            "heading",
            "turn",
            "contact",
            "action",
            "change",
            "rate",
        ):
            setattr(p, f"{name}_weight", getattr(r, name))
        p.position_scale, p.heading_scale, p.loss = r.position_scale, r.heading_scale, r.loss
        return p
