"""Docking: enter a funnel nose first, gently, and stay in its tube."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import warp as wp

from finssim.control.axis_model import axis_model
from finssim.physics.types import vec6
from finssim.sim import Dock, RectangularPool
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.measurement import TRAINING, MeasurementNoise
from finssim.tasks.task import Task
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    action_costs,
    attitude_error,
    goal_columns,
    heading_match,
    offset_length,
    own_velocity,
    tilted,
    uniform3,
)
from finssim.vehicles import Vehicle
from finssim.vehicles.capability import coefficients_of, terminal_speeds

DISTANCE_SCALE = 3.0
"""Scale of distances in the observation [m]."""


@wp.func
def in_dock(arrays: TaskArrays, p: Any, w: int, x: wp.vec3, q: wp.quat) -> wp.vec3:
    """Return the nose of a vehicle with its origin at x and attitude q, in dock axes, from the throat [m]."""
    nose = x + wp.quat_rotate(q, wp.vec3(0.5 * p.hull.length, 0.0, 0.0))
    return wp.quat_rotate_inv(arrays.goal_quaternion[w], nose - arrays.goal_position[w])


@wp.func
def berth_offset(arrays: TaskArrays, p: Any, w: int, nose: wp.vec3) -> wp.vec3:
    """Return the vector from the nose to its berth, body frame [m]."""
    R = wp.quat_to_matrix(wp.quat_inverse(arrays.quaternion[w, 0]) * arrays.goal_quaternion[w])
    return R * (wp.vec3(p.berth * p.funnel.tube_length, 0.0, 0.0) - nose)


OBSERVATION = (
    ObservationPart("nose to its berth, body frame", 3, "m", scale=DISTANCE_SCALE, term="offset"),
    ObservationPart("dock rotation relative to the body, first two columns", 6, "1", term=goal_columns),
    *own_velocity(clip=2.0),
    ObservationPart("nose from the throat, dock axes", 3, "m", scale=DISTANCE_SCALE, term="nose"),
    ObservationPart(
        "distance of the nose to its berth", 1, "m", scale=DISTANCE_SCALE, clip=1.0, term=offset_length
    ),
)

BRISK = 0.9
"""Design speed of docks in vehicle lengths per second, or the vehicle's greatest speed if that is less [1/s]."""


@dataclass(frozen=True)
class HullNumbers:
    """Properties of the vehicle that the task uses; the environment sets them. The defaults are FinsROV's, rounded."""

    length: float = 0.56
    """[m]"""
    girth: float = 0.2444
    """Distance from the body's x axis to a corner of its envelope [m]."""
    inertia: float = 27.1
    """Inertia in surge, with added mass [kg]."""
    speed: float = 0.476
    """Forward speed for which the dock is designed [m/s]."""
    thrust: float = 19.8
    """Greatest forward thrust [N]."""

    @classmethod
    def of(cls, vehicle: Vehicle) -> "HullNumbers":
        """Return the properties of a vehicle's file."""
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

    e: distance of the nose from its berth; off: distance of the nose outside the approach cone; both in vehicle
    lengths.
    θ: attitude error [rad].

    r = position · exp(-e / position_scale)      a slope that does not vanish at the berth
      - distance · e                             a slope everywhere: the dock is approached
      - corridor · off                           from the front: the direct path may hit the block's outside
      + heading · exp(-θ / heading_scale) - turn · θ     nose first, and aligned
      - contact · min(force / limit, 1)          touching is allowed, pushing through is not
      - action · mean(a²)                        the cheapest thrusts that suffice
      - change · mean(Δa²)                       commands that a motor can follow, no chatter
      - rate · min(|ω|², 4)                      no spinning
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


@wp.func
def off_corridor(p: Any, x: wp.vec3) -> float:
    """Return the distance of the nose at x [m] outside the approach cone of the berth [vehicle lengths]."""
    room = p.gap + wp.tan(p.cone) * wp.max(-x[0], 0.0)
    return wp.max(wp.length(wp.vec2(x[1], x[2])) - room, 0.0) / p.hull.length


@wp.func
def nose(state: State, arrays: TaskArrays, p: Any, w: int) -> wp.vec3:
    """Return the nose in dock axes [m]."""
    return in_dock(arrays, p, w, state.position[w, 0], state.quaternion[w, 0])


@wp.func
def seen_nose(arrays: TaskArrays, p: Any, w: int) -> wp.vec3:
    """Return the nose in dock axes, as measured [m]."""
    return in_dock(arrays, p, w, arrays.position[w, 0], arrays.quaternion[w, 0])


@wp.func
def from_berth(p: Any, x: wp.vec3) -> float:
    """Return the distance of the nose from its berth [vehicle lengths].

    The nose is at `x` [m].
    """
    return wp.length(wp.vec3(p.berth * p.funnel.tube_length - x[0], x[1], x[2])) / p.hull.length


@wp.func
def at_berth(p: Any, e: float) -> float:
    """Return 1 with the nose in its berth, 1/e at a distance `e` of `position_scale` [vehicle lengths]."""
    return wp.exp(-e / p.reward.position_scale)


@wp.func
def contact_force(arrays: TaskArrays, w: int) -> float:
    """Return the greatest contact force in the step [N]."""
    return arrays.funnel.force[w, 0]


@wp.func
def contact(p: Any, force: float) -> float:
    """Return the greatest contact force in the step as a fraction of the limit that ends the episode, at most 1.

    The force is in [N].
    """
    return wp.min(force / p.force_limit, 1.0)


@wp.func
def crashes(p: Any, force: float) -> bool:
    """Return whether the contact force is above `force_limit` [N]."""
    return force > p.force_limit


@wp.func
def contact_impulse(arrays: TaskArrays, w: int, was: float) -> float:
    """Return the contact force, integrated over the episode [N s]."""
    return was + arrays.funnel.impulse[w, 0]


@wp.func
def peak_force(was: float, force: float) -> float:
    """Return the greatest contact force so far [N]."""
    return wp.max(was, force)


@wp.func
def is_lost(state: State, arrays: TaskArrays, p: Any, w: int) -> bool:
    """Return True if the vehicle is half a length out of the water, or farther from the dock than the tank is wide."""
    x = state.position[w, 0]
    away = wp.length(x - arrays.goal_position[w])
    return x[2] > 0.5 * p.hull.length or away > p.tank[0] * p.hull.length


@wp.func
def is_docked(state: State, p: Any, w: int, x: wp.vec3) -> bool:
    """Return True if the nose at `x` [m] is far enough in the tube, and the vehicle is slow."""
    nu = state.velocity[w, 0]
    still = wp.length(wp.vec3(nu[0], nu[1], nu[2])) <= p.slow * p.hull.speed
    deep = x[0] >= p.inside * p.funnel.tube_length
    return deep and wp.length(wp.vec2(x[1], x[2])) <= 2.0 * p.gap and still


@wp.func
def docked_gently(p: Any, docked: bool, force: float) -> bool:
    """Return True if the vehicle is docked and the contact force [N] is within its limit."""
    return docked and not force > p.force_limit


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode with a dock at a random pose, and a vehicle at rest in front of its mouth."""
    length = p.hull.length
    rng = wp.rand_init(key, 4 * w + 3)
    q_d = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), wp.randf(rng, -3.14159265, 3.14159265))
    middle = wp.vec3(0.0, 0.0, -0.5 * p.tank[1])
    low, high = length * (middle - p.dock_spread), length * (middle + p.dock_spread)
    arrays.goal_position[w] = uniform3(wp.rand_init(key, 4 * w), low, high)
    arrays.goal_quaternion[w] = q_d
    arrays.funnel.force[w, 0] = 0.0
    arrays.funnel.impulse[w, 0] = 0.0
    roll = wp.randf(rng, -p.tilt, p.tilt)
    pitch = wp.randf(rng, -p.tilt, p.tilt)
    q = q_d * tilted(roll, pitch, wp.randf(rng, -p.turn, p.turn))
    near = p.funnel.cone_length + length * p.start[0]
    far = p.funnel.cone_length + length * p.start[1]
    across = length * p.start_aside[0]
    up = length * p.start_aside[1]
    x = uniform3(wp.rand_init(key, 4 * w + 1), wp.vec3(-far, -across, -up), wp.vec3(-near, across, up))
    state.position[w, 0] = (
        arrays.goal_position[w] + wp.quat_rotate(q_d, x) - wp.quat_rotate(q, wp.vec3(0.5 * length, 0.0, 0.0))
    )
    state.quaternion[w, 0] = q
    state.velocity[w, 0] = vec6()


@dataclass(frozen=True, kw_only=True)
class Docking(Task):
    """Docking. Times in seconds; lengths in vehicle lengths, unless stated otherwise, and in girths across the dock.

    An episode continues after success: staying docked is rewarded. Sizes are our own choice; none are published.
    """

    succeeds: ClassVar[str] = "once"
    fails: ClassVar[tuple[str, ...]] = ("crash",)
    title: ClassVar[str] = "enter a funnel nose first, gently"
    needs: ClassVar[tuple[str, ...]] = ("surge", "sway", "heave", "yaw")
    baselines: ClassVar = {"align-insert": "finssim.agents.docking:DockingPid"}
    name: str = "docking"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 40.0
    hull: HullNumbers = HullNumbers()
    """Hull of the vehicle; the environment sets it."""
    throat: float = 1.2
    """Radius of the tube [girths]."""
    mouth: float = 2.0
    """Radius of the cone's wide end [girths]."""
    cone: float = math.radians(35.0)
    """Half angle of the cone [rad]."""
    tube: float = 0.5
    """Length of the tube [lengths]."""
    rim: float = 0.5
    """Thickness of the block [girths]."""
    give: float = 0.15
    """Penetration depth of a hull point at the design speed of the dock [girths]."""
    damping: float = 0.2
    """Damping of a contact point that carries the vehicle's mass, as a fraction of the critical damping."""
    berth: float = 0.75
    """Final position of the nose, as a fraction of the tube's length from the throat."""
    inside: float = 0.5
    """Position from which the nose counts as inside, as a fraction of the tube's length."""
    dock_spread: tuple[float, float, float] = (1.5, 1.5, 0.8)
    """Greatest distance of the dock from the middle of the tank [lengths]."""
    start: tuple[float, float] = (1.5, 4.0)
    """Range of the nose's starting distance before the mouth [lengths]."""
    start_aside: tuple[float, float] = (1.5, 0.8)
    """Largest starting distance beside the axis, and above or below it [lengths]."""
    turn: float = math.radians(60.0)
    """Largest starting angle from the axis [rad]."""
    tilt: float = math.radians(10.0)
    """Largest roll and pitch at the start [rad]."""
    tank: tuple[float, float] = (18.0, 6.0)
    """Width and depth of the tank [lengths]."""
    slow: float = 0.1
    """Greatest speed for success with the nose inside, as a fraction of the design speed of the dock."""
    hold: float = 2.0
    """Time for which the vehicle must stay docked for success [s]."""
    hard: float = 0.5
    """Impact speed at which the contact force ends the episode, as a fraction of the dock's design speed; the limit
    also includes the vehicle's full thrust."""
    reward: DockingReward = field(default_factory=DockingReward)
    training_noise: MeasurementNoise = TRAINING

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Docking":
        """Return the task with a dock scaled to the vehicle."""
        return replace(self, hull=HullNumbers.of(vehicles[0]))

    @property
    def force_limit(self) -> float:
        """Contact force above which an episode ends [N]: a spring stops a mass m at speed v with √(k m) v."""
        hit = self.hard * self.hull.speed * math.sqrt(self.dock().stiffness * self.hull.inertia)
        return self.hull.thrust + hit

    def dock(self) -> Dock:
        """Return the dock with its shape and stiffness [m, N/m, N s/m]."""
        girth, length, inertia = self.hull.girth, self.hull.length, self.hull.inertia
        # m v² = k give²: the spring of one point absorbs the energy at the greatest speed.
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

    def arena(self) -> RectangularPool:
        """Return a tank with walls as stiff as the dock."""
        dock, (width, depth) = self.dock(), self.tank
        return RectangularPool(
            length=width * self.hull.length, width=width * self.hull.length, depth=depth * self.hull.length,
            stiffness=dock.stiffness, damping=dock.damping,
        )  # fmt: skip

    @property
    def funnel(self) -> Dock:
        """The dock, for the terms."""
        return self.dock()

    @property
    def gap(self) -> float:
        """Distance between the envelope's corners and the tube [m]."""
        return self.dock().throat_radius - self.hull.girth

    def success_rule(self) -> str:
        """Return the rule of success; see `Task`."""
        return f"nose in the tube, slow, for {self.hold:g} s, without a crash"

    def terms(self) -> Terms:
        """Return the terms; see `DockingReward`."""
        r = self.reward
        return Terms(
            start=start,
            shared={
                "x": nose,
                "e": from_berth,
                "theta": attitude_error,
                "force": contact_force,
                "docked": is_docked,
            },
            seen={"nose": seen_nose, "offset": berth_offset},
            meanings={
                "position": f"1 with the nose in its berth, 1/e at {r.position_scale:.3g} vehicle lengths from it.",
                "heading": f"1 in the dock's attitude, 1/e at {r.heading_scale:.3g} rad from it.",
                "crash": f"A contact force above {self.force_limit:.3g} N.",
            },
            rewards=(
                RewardTerm("position", at_berth, r.position),
                RewardTerm("distance", "e", -r.distance),
                RewardTerm("corridor", off_corridor, -r.corridor),
                RewardTerm("heading", heading_match, r.heading),
                RewardTerm("turn", "theta", -r.turn),
                RewardTerm("contact", contact, -r.contact),
                *action_costs(r.action, r.change, r.rate),
            ),
            ends=(End("crash", crashes, -r.loss), End("lost", is_lost, -r.loss)),
            inside=docked_gently,
            totals=(
                Total("contact_impulse", contact_impulse),
                Total("peak_force", peak_force),
            ),
        )
