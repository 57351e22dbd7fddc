"""Pursuit: approach a prey that flees with a similar vehicle, and stay with it.

In the task of three, a herder drives it into the net that two netters hold between them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import warp as wp
from numpy.typing import NDArray

from finssim.agents.drive import DriveNumbers, drive, towards
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.communication import (
    Communication,
    exchange_messages,
    key_messages,
    mate_position,
    mate_velocity,
    message_table,
    open_messages,
)
from finssim.tasks.task import Task
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    action_costs,
    each_step,
    level_direction,
    measured_velocity,
    own_velocity,
    place_at_rest,
    world_velocity,
)
from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles import Vehicle

Array = NDArray[Any]


@wp.func
def write_scripted(arrays: TaskArrays, w: int, action: wp.vec4):
    """Write the action of the only vehicle that the task commands, as wrench4, or as wrench6 without roll and
    pitch."""
    size = arrays.scripted.shape[1]
    for i in range(size):
        arrays.scripted[w, i] = 0.0
    for i in range(3):
        arrays.scripted[w, i] = action[i]
    arrays.scripted[w, size - 1] = action[3]


def slowest(vehicles: Sequence[Vehicle]) -> float:
    """Return the smallest forward speed that vehicles can hold [m/s], to which the speed of their prey is related."""
    return min(DriveNumbers.of(vehicle).top for vehicle in vehicles)


# What a pursuer observes of itself, of its prey and of its team-mates, all in its body frame.


DISTANCE_SCALE = 6.0
"""Distances are divided by this in the observation [m]."""
REACH = 4.0
"""Limit of scaled distances [-]."""
VELOCITY_CLIP = 4.0
"""Limit of velocities [m/s, rad/s]."""
PI = 3.14159265


@wp.func
def prey_gap(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return the position of the vehicle after the agents relative to agent a, body frame [m]."""
    prey = arrays.agent_reward.shape[1]
    return wp.quat_rotate_inv(arrays.quaternion[w, a], arrays.position[w, prey] - arrays.position[w, a])


@wp.func
def prey_motion(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return its velocity relative to the agent's, body frame [m/s]."""
    relative = measured_velocity(arrays, w, arrays.agent_reward.shape[1]) - measured_velocity(arrays, w, a)
    return wp.quat_rotate_inv(arrays.quaternion[w, a], relative)


@wp.func
def gap_to(arrays: TaskArrays, w: int, a: int, b: int) -> wp.vec3:
    """Return the position of agent b relative to agent a, as known to a, body frame of a [m]."""
    return wp.quat_rotate_inv(arrays.quaternion[w, a], mate_position(arrays, w, a, b) - arrays.position[w, a])


@wp.func
def motion_of(arrays: TaskArrays, w: int, a: int, b: int) -> wp.vec3:
    """Return the velocity of agent b relative to agent a, as known to a, body frame of a [m/s]."""
    relative = mate_velocity(arrays, w, a, b) - measured_velocity(arrays, w, a)
    return wp.quat_rotate_inv(arrays.quaternion[w, a], relative)


@wp.func
def prey_distance(gap: wp.vec3) -> float:
    """Return the distance to the prey [m]."""
    return wp.length(gap)


@wp.func
def prey_bearing(gap: wp.vec3) -> float:
    """Return the bearing of the prey, positive to the left [rad].

    Its relative position is `gap`, body frame [m].
    """
    return wp.atan2(gap[1], gap[0])


CHASE = (
    *own_velocity(clip=VELOCITY_CLIP),
    ObservationPart("prey from here, body frame", 3, "m", DISTANCE_SCALE, REACH, term="gap"),
    ObservationPart(
        "prey's velocity less one's own, body frame", 3, "m/s", clip=VELOCITY_CLIP, term=prey_motion
    ),
    ObservationPart("distance to the prey", 1, "m", DISTANCE_SCALE, REACH, term=prey_distance),
    ObservationPart("bearing of the prey, positive to the left", 1, "rad", PI, 1.0, term=prey_bearing),
)
"""14 numbers of a pursuer, for a task that shares `prey_gap` as `gap`."""


def mate(k: int, gap: Any, motion: Any) -> tuple[ObservationPart, ...]:
    """Return the parts with the 6 numbers of the k-th team-mate: its relative position and velocity."""
    moves = "team-mate's velocity less one's own, body frame"
    return (
        ObservationPart("team-mate from here, body frame", 3, "m", DISTANCE_SCALE, REACH, gap, k),
        ObservationPart(moves, 3, "m/s", clip=VELOCITY_CLIP, term=motion, index=k),
    )


# The scripted prey: a vehicle that wanders, keeps its direction or flees, with its own thrusters, up to a given speed.


PREY_MODES = ("random", "straight", "hybrid", "line-of-sight", "mixed")
"""Behaviours of a prey.

random: a new direction and speed every few seconds. straight: one direction, drawn for the episode, at full speed.
hybrid: flees obliquely from all pursuers nearby, and wanders if there are none. line-of-sight: always flees
directly from the nearest pursuer. mixed: one of the four, drawn for the episode.
"""

RESERVE = 0.9
"""Largest target speed of a prey, as a share of the speed it can hold; the rest is left for steering."""


@dataclass(frozen=True, kw_only=True)
class Prey:
    """Behaviour of the prey. Its speed is given by the task, as a share of the speed that the slowest pursuer
    can hold."""

    mode: str = "mixed"
    """One of `PREY_MODES`."""
    alarm: float = 3.0
    """Distance within which a hybrid prey flees from pursuers [m]."""
    retarget: float = 4.0
    """Time after which the direction, or the side to flee to, is drawn again [s]."""
    range: float = 9.0
    """Distance from the origin at which it turns along the border [m]."""
    low: float = -5.0
    """Lowest height of the prey [m]."""
    high: float = -1.0
    """Greatest height of the prey [m]."""

    def __post_init__(self) -> None:
        if self.mode not in PREY_MODES:
            raise EnvironmentSetupError(
                f"unknown prey mode '{self.mode}'; available: {', '.join(PREY_MODES)}"
            )
        if not (self.retarget > 0.0 and self.range > 0.0 and self.low < self.high < 0.0):
            raise EnvironmentSetupError(
                f"prey: retarget is {self.retarget} s, range {self.range} m, heights {self.low} to {self.high} m; "
                "expected times and ranges above 0 and heights below the surface, the lower one first"
            )

    @property
    def kind(self) -> int:
        """Return the number of the mode."""
        return PREY_MODES.index(self.mode)


@wp.func
def most_climb(p: Any) -> float:
    """Return the largest vertical speed [m/s]."""
    return wp.min(0.5 * p.speed, RESERVE * p.prey_drive.terminal[2])


@wp.func
def wander(p: Any, key: int, w: int, draw: int) -> wp.vec3:
    """Return the velocity of a random walk in its n-th section [m/s]."""
    rng = wp.rand_init(wp.randi(wp.rand_init(key, 4 * w + 2)), draw)
    direction = level_direction(wp.randf(rng, -3.14159265, 3.14159265))
    pace = wp.randf(rng, 0.3, 1.0) * p.speed
    return pace * direction + wp.vec3(0.0, 0.0, wp.randf(rng, -1.0, 1.0) * most_climb(p))


@wp.func
def flight(state: State, arrays: TaskArrays, w: int, reach: float) -> wp.vec3:
    """Return the sum of unit directions away from all pursuers within reach [m], each divided by d² [1/m²];
    zero without any."""
    pursuers = arrays.agent_reward.shape[1]
    x = state.position[w, pursuers]
    away = wp.vec3()
    for a in range(pursuers):
        gap = x - state.position[w, a]
        d = wp.max(wp.length(gap), 1.0e-3)
        if d < reach:
            away += gap / (d * d * d)
    return away


@wp.func
def nearest_pursuer(state: State, arrays: TaskArrays, w: int) -> float:
    """Return the distance from the prey to the nearest pursuer [m]."""
    pursuers = arrays.agent_reward.shape[1]
    x = state.position[w, pursuers]
    d = wp.length(x - state.position[w, 0])
    for a in range(1, pursuers):
        d = wp.min(d, wp.length(x - state.position[w, a]))
    return d


@wp.func
def kept_inside(p: Any, x: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Return the velocity v [m/s] at x [m], changed so that it does not leave the prey's range.

    At the border it is turned along the border, at the same speed.
    """
    pace = wp.sqrt(v[0] * v[0] + v[1] * v[1])
    r = wp.sqrt(x[0] * x[0] + x[1] * x[1])
    out = wp.vec3(x[0], x[1], 0.0) / wp.max(r, 1.0e-6)
    radial = v[0] * out[0] + v[1] * out[1]
    inside = v
    if r > p.prey.range and radial > 0.0:
        around = wp.vec3(-out[1], out[0], 0.0)
        side = wp.where(wp.dot(around, v) < 0.0, -1.0, 1.0)
        inside = pace * wp.normalize(side * around - 0.2 * out) + wp.vec3(0.0, 0.0, v[2])
    climb = wp.clamp(inside[2], -most_climb(p), most_climb(p))
    climb = wp.where(x[2] > p.prey.high, -0.5 * most_climb(p), climb)
    climb = wp.where(x[2] < p.prey.low, 0.5 * most_climb(p), climb)
    return wp.vec3(inside[0], inside[1], climb)


@wp.func
def prey_velocity(state: State, arrays: TaskArrays, p: Any, key: int, w: int) -> wp.vec3:
    """Return the target velocity of the prey, world frame; its horizontal part is no faster than `speed` [m/s]."""
    pi = 3.14159265
    rng = wp.rand_init(key, 4 * w + 3)
    heading = wp.randf(rng, -pi, pi)
    mode = wp.where(p.prey.kind == 4, wp.randi(rng, 0, 4), p.prey.kind)
    draw = int(float(state.steps[w]) * p.control_step / p.prey.retarget + 1.0e-4)
    v = wander(p, key, w, draw)
    if mode == 1:
        v = p.speed * level_direction(heading)
    if mode == 3:
        v = flight(state, arrays, w, nearest_pursuer(state, arrays, w) * 1.0001 + 1.0e-3)
    if mode == 2:
        away = flight(state, arrays, w, p.prey.alarm)
        if wp.length(away) > 0.0:
            turn = wp.where(wp.randf(wp.rand_init(key + draw, 4 * w + 1)) < 0.5, -0.6, 0.6)
            v = wp.quat_rotate(wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), turn), away)
    if mode >= 2 and (mode == 3 or nearest_pursuer(state, arrays, w) < p.prey.alarm):
        pace = wp.sqrt(v[0] * v[0] + v[1] * v[1])
        v = v * (p.speed / wp.max(pace, 1.0e-6))
    return kept_inside(p, state.position[w, arrays.agent_reward.shape[1]], v)


@wp.func
def command_prey(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Write the action of the prey, which is the vehicle after the pursuers; it uses the true state."""
    pursuers = arrays.agent_reward.shape[1]
    q = state.quaternion[w, pursuers]
    target = towards(q, prey_velocity(state, arrays, p, key + 7, w))
    write_scripted(arrays, w, drive(p.prey_drive, q, state.velocity[w, pursuers], target))


# Common parts of the tasks in open water: start and end of episodes, the prey, and the team.


@dataclass(frozen=True, kw_only=True)
class OpenWater(Task):
    """Base of the tasks in open water: start and end of episodes. Lengths in metres, world frame with z up."""

    action: ClassVar[str] = "wrench4"
    pool: ClassVar[None] = None
    needs: ClassVar[tuple[str, ...]] = ("surge", "sway", "heave", "yaw")

    time_limit: float = 60.0
    spawn_radius: float = 2.5
    """Largest horizontal distance of agents from the origin at the start [m]."""
    low: float = -4.0
    """Lowest height at the start [m]."""
    high: float = -2.0
    """Greatest height at the start [m]."""
    bounds: float = 12.0
    """Horizontal distance from the origin beyond which the episode ends [m]."""
    ceiling: float = 0.3
    """Height above which the episode ends [m]."""
    depth: float = 8.0
    """Depth below which the episode ends [m]."""
    nearest: float = 2.0
    """Smallest distance of the target or prey from the agents at the start [m]."""
    farthest: float = 5.0
    """Largest of these distances [m]."""
    speed: float = 0.0
    """Speed of the target or prey [m/s]; determined from the vehicles."""


@dataclass(frozen=True, kw_only=True)
class Chase(OpenWater):
    """Base of the tasks with a prey, which is the vehicle after the agents."""

    others: ClassVar[tuple[str, ...]] = ("prey",)
    succeeds: ClassVar[str] = "captured"
    moving: ClassVar[bool] = True

    prey: Prey = field(default_factory=Prey)
    """Behaviour of the prey, which knows the positions of all agents."""
    prey_drive: DriveNumbers | None = field(default=None, repr=False)
    """Thrusters of the prey; determined from its vehicle."""

    def with_prey_speed(self, part: float, vehicles: Sequence[Vehicle], **changes: Any) -> Any:
        """Return the task with the prey's thrust of its vehicle, and with its speed.

        Args:
            part: Share of the speed that the slowest agent can hold.
            vehicles: Agents, then the prey.
            changes: Changes of other settings.
        """
        if not 0.0 <= part <= 1.0:
            raise EnvironmentSetupError(
                f"prey_speed is {part}, expected 0 to 1: a part of the slowest pursuer's speed"
            )
        drive = DriveNumbers.of(vehicles[-1])
        speed = min(part * slowest(vehicles[:-1]), RESERVE * drive.top)
        return replace(self, speed=speed, prey_drive=drive, **changes)


@dataclass(frozen=True, kw_only=True)
class TeamTask(OpenWater):
    """Base of the tasks of several agents."""

    collision: float = 0.6
    """Distance between agents below which they bump [m]; their motion is not affected."""
    communication: Communication | None = None
    """Messages between agents; None: every agent knows the states of all others."""

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the messages, if there are any."""
        arrays.messages = message_table(
            self.communication, worlds, len(self.agents), self.control_step, 2.0 * self.bounds, device
        )


@wp.func
def any_outside(state: State, arrays: TaskArrays, p: Any, w: int) -> bool:
    """Return whether an agent is out of bounds."""
    out = bool(False)
    for a in range(arrays.agent_reward.shape[1]):
        x = state.position[w, a]
        if x[0] * x[0] + x[1] * x[1] > p.bounds * p.bounds or x[2] > p.ceiling or x[2] < -p.depth:
            out = True
    return out


@wp.func
def bumps(state: State, arrays: TaskArrays, p: Any, w: int, a: int) -> float:
    """Return the number of agents nearer than `collision`."""
    count = float(0.0)
    for b in range(arrays.agent_reward.shape[1]):
        if b != a and wp.length(state.position[w, b] - state.position[w, a]) < p.collision:
            count += 1.0
    return count


@wp.func
def prey_start(p: Any, rng: wp.uint32, x: wp.vec3) -> wp.vec3:
    """Return a start position of the prey: at a random distance and direction from x, at about the same height.

    Both in [m].
    """
    angle = wp.randf(rng, -3.14159265, 3.14159265)
    away = wp.randf(rng, p.nearest, p.farthest)
    height = wp.clamp(x[2] + wp.randf(rng, -0.5, 0.5), p.low, p.high)
    level = x + away * level_direction(angle)
    return wp.vec3(level[0], level[1], height)


# The task of one pursuer.


@dataclass(frozen=True, kw_only=True)
class PursuitReward:
    """Weights of the reward.

    r = progress · (closing speed) · dt          for approaching; over an episode it sums to the distance gained [m]
      - distance · min(d / 8 m, 1)               a gradient everywhere, also behind a prey that keeps its distance
      + heading · cos(angle to the prey)         for pointing the bow, where thrust and camera are best, at the prey
      + near, within near_radius                 for staying with it before it counts as captured
      - spin · r²                                against turning on the spot
      - action · mean(a²) - change · mean(Δa²)   for small thrusts, and commands that a motor can follow
      - step                                     for success as early as possible
      + capture                                  once; more than all others of an episode (published: 50)
      - loss                                     once, for leaving the bounds (published: 1, cheaper than continuing)

    The end of the time limit costs nothing (published: 5): the time is not observed, so nothing can be learnt from it.
    """

    progress: float = 0.9
    distance: float = 0.08
    heading: float = 0.01
    near: float = 0.03
    near_radius: float = 1.2
    spin: float = 0.002
    action: float = 0.001
    change: float = 0.0015
    step: float = 0.0005
    capture: float = 20.0
    loss: float = 20.0


@wp.func
def relative_motion(state: State, w: int) -> wp.vec3:
    """Return the prey's velocity relative to the pursuer's, world frame [m/s]."""
    return world_velocity(state, w, 1) - world_velocity(state, w, 0)


@wp.func
def way_to_prey(state: State, w: int) -> wp.vec3:
    """Return the position of the prey relative to the pursuer, world frame [m]."""
    return state.position[w, 1] - state.position[w, 0]


@wp.func
def distance_of(way: wp.vec3) -> float:
    """Return the distance to the prey [m], never 0."""
    return wp.max(wp.length(way), 1.0e-6)


@wp.func
def way_gained(p: Any, way: wp.vec3, motion: wp.vec3, d: float) -> float:
    """Return by how much the prey came nearer in the step: closing speed times the step [m]."""
    return -wp.dot(way, motion) / d * p.control_step


@wp.func
def distance_share(d: float) -> float:
    """Return the distance to the prey divided by 8 m, at most 1.

    The distance `d` is in [m].
    """
    return wp.min(d / 8.0, 1.0)


@wp.func
def is_near(p: Any, d: float) -> float:
    """Return 1 at a distance `d` within `near_radius` of the prey [m], otherwise 0."""
    return wp.where(d < p.reward.near_radius, 1.0, 0.0)


@wp.func
def yaw_rate_squared(state: State, w: int) -> float:
    """Return the square of the yaw rate [rad²/s²]."""
    return state.velocity[w, 0][5] * state.velocity[w, 0][5]


@wp.func
def has_held(p: Any, held: float) -> bool:
    """Return whether the tolerance of success was met for `hold` [s]; `held` is the time so far."""
    return held > 0.0 and held >= p.hold - 0.1 * p.control_step


@wp.func
def closest(was: float, d: float) -> float:
    """Return the smallest distance to the prey so far [m]."""
    return wp.min(was, d)


@wp.func
def with_prey(p: Any, d: float, motion: wp.vec3) -> bool:
    """Return whether the prey is within `radius` [m], at a relative speed of at most `relative_speed` [m/s]."""
    return d <= p.radius and wp.length(motion) <= p.relative_speed


@wp.func
def facing(state: State, w: int, way: wp.vec3, d: float) -> float:
    """Return the cosine of the angle between the bow and the direction to the prey."""
    ahead = wp.quat_rotate(state.quaternion[w, 0], wp.vec3(1.0, 0.0, 0.0))
    return wp.dot(ahead, way) / d


@wp.func
def start(state: State, p: Any, key: int, w: int):
    """Start an episode: pursuer near the origin, prey at a random distance, both at rest."""
    pi = 3.14159265
    rng = wp.rand_init(key, 4 * w)
    away = p.spawn_radius * wp.sqrt(wp.randf(rng)) * level_direction(wp.randf(rng, -pi, pi))
    x = wp.vec3(away[0], away[1], wp.randf(rng, p.low, p.high))
    place_at_rest(state, w, 0, x, wp.randf(rng, -pi, pi))
    heading = wp.randf(rng, -pi, pi)
    place_at_rest(state, w, 1, prey_start(p, wp.rand_init(wp.randi(rng)), x), heading)


@dataclass(frozen=True, kw_only=True)
class Pursuit(Chase):
    """1-v-1 pursuit. Captured: within `radius` at a relative speed of at most `relative_speed`, for `hold` seconds."""

    agents: ClassVar[tuple[str, ...]] = ("pursuer",)
    title: ClassVar[str] = "catch a prey, one against one"
    baselines: ClassVar = {"lead": "finssim.extensions.teams.baselines:LeadPursuit"}
    name: str = "pursuit"
    observation: tuple[ObservationPart, ...] = field(default=CHASE, repr=False)
    prey_speed: float = 0.6
    """Speed of the prey, as a share of the speed that the pursuer can hold (published: 2 m/s, four times that
    speed)."""
    radius: float = 0.8
    """Largest distance of a capture [m]."""
    relative_speed: float = 0.35
    """Largest relative speed of a capture [m/s]."""
    hold: float = 0.5
    """Time for which both must be met [s]."""
    reward: PursuitReward = field(default_factory=PursuitReward)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Pursuit":
        """Return the task with the prey's speed and thrust adapted to the vehicles: pursuer, prey."""
        return self.with_prey_speed(self.prey_speed, vehicles)

    def success_rule(self) -> str:
        """See `Task`."""
        return f"within {self.radius:g} m at no more than {self.relative_speed:g} m/s for {self.hold:g} s"

    def terms(self) -> Terms:
        """See `PursuitReward`."""
        r = self.reward
        return Terms(
            start=start,
            command=command_prey,
            shared={
                "way": way_to_prey,
                "d": distance_of,
                "motion": relative_motion,
            },
            seen={"gap": prey_gap},
            meanings={
                "near": f"1 within {r.near_radius:g} m of the prey, otherwise 0.",
                "captured": f"The prey {self.success_rule()}.",
            },
            rewards=(
                RewardTerm("progress", way_gained, r.progress),
                RewardTerm("distance", distance_share, -r.distance),
                RewardTerm("heading", facing, r.heading),
                RewardTerm("near", is_near, r.near),
                RewardTerm("spin", yaw_rate_squared, -r.spin),
                *action_costs(r.action, r.change),
                RewardTerm("step", each_step, -r.step),
            ),
            ends=(
                End("captured", has_held, r.capture),
                End("left", any_outside, -r.loss),
            ),
            inside=with_prey,
            totals=(Total("closest", closest, first="d"),),
        )


# The task of three: a herder drives the prey into the net that two netters hold between them.


AGENTS = 3
PREY = 3

CAPTURE_MODES = ("net", "touch", "proximity", "either")
"""Rules of capture, published as modes 0 to 3.

net: the prey is within `net_reach` of the net for `hold` seconds. touch: its hull touches the net. proximity:
a vehicle is within `proximity` of it. either: net or proximity.
"""


@dataclass(frozen=True)
class Level:
    """A level of the published curriculum. Its speeds were 0.25, 0.30 and 0.40 m/s, with a pursuer's top
    speed of 0.5 m/s."""

    capture: str
    """One of `CAPTURE_MODES`."""
    proximity: float
    """Distance of a vehicle from the prey that counts as a capture [m]."""
    net_reach: float
    """Distance of the net from the prey that counts as a capture [m]."""
    hold: float
    """Time for which the prey must be in the net [s]."""
    prey_speed: float
    """Speed of the prey, as a share of the speed that the slowest agent can hold."""
    stake: float
    """Reward of a capture, and cost of an agent out of bounds, for all agents."""
    from_step: int
    """Number of agent-steps of training after which the level begins."""

    @property
    def mode(self) -> int:
        """Return the number of the capture mode."""
        return CAPTURE_MODES.index(self.capture)


LEVELS = (
    Level("proximity", 1.5, net_reach=1.0, hold=0.10, prey_speed=0.5, stake=25.0, from_step=0),
    Level("net", 1.0, net_reach=1.0, hold=0.10, prey_speed=0.6, stake=25.0, from_step=1_500_000),
    Level("net", 1.0, net_reach=0.8, hold=0.25, prey_speed=0.8, stake=30.0, from_step=4_000_000),
    Level("touch", 1.0, net_reach=0.8, hold=0.25, prey_speed=0.8, stake=30.0, from_step=7_000_000),
)
"""The published curriculum in three levels, which the formation baseline solves, and a fourth, which is the task."""


@wp.func
def other(a: int, k: int) -> int:
    """Return the number of the k-th team-mate of agent a, the lowest number first."""
    return wp.where(k == 1, wp.where(a == 0, 1, 0), wp.where(a == 2, 1, 2))


@wp.func
def mate_role(a: int, k: int) -> wp.vec2:
    """Return the role of the k-th team-mate: (1, 0) a herder, (0, 1) a netter [-]."""
    herds = other(a, k) == 0
    return wp.vec2(wp.where(herds, 1.0, 0.0), wp.where(herds, 0.0, 1.0))


@wp.func
def mate_gap(arrays: TaskArrays, w: int, a: int, k: int) -> wp.vec3:
    """Return the position of the k-th team-mate relative to the agent, body frame [m]."""
    return gap_to(arrays, w, a, other(a, k))


@wp.func
def mate_motion(arrays: TaskArrays, w: int, a: int, k: int) -> wp.vec3:
    """Return the velocity of the k-th team-mate relative to the agent's, body frame [m/s]."""
    return motion_of(arrays, w, a, other(a, k))


TEAM = (
    *CHASE,
    *(
        part
        for k in (1, 2)
        for part in (
            ObservationPart("team-mate's role: herder, netter", 2, "1", term=mate_role, index=k),
            *mate(k, mate_gap, mate_motion),
        )
    ),
)
"""30 numbers of each agent."""


@dataclass(frozen=True, kw_only=True)
class TeamReward:
    """Weights of the reward, besides the level's stake.

    team: progress · (distance gained to a capture)       by the rule of the level; over an episode it sums to the
                                                          whole distance [m]; a small weight would be negligible
                                                          beside the stake
        - distance · min(gap / 8 m, 1) - step             a gradient everywhere, and success as early as possible
    herder: + drive · cos(angle between the directions to the prey and from it to the net)     to stay behind the prey
            - stray · min(d / 8 m, 1)                     to stay near the prey, which it could otherwise not drive
    netters: - spread · | span - 0.7 net_length |         for an open net that is not torn
    each: - bump, nearer than `collision` to another      - action · mean(a²) - change · mean(Δa²)
    """

    progress: float = 4.0
    distance: float = 0.05
    step: float = 0.005
    drive: float = 0.01
    stray: float = 0.05
    spread: float = 0.005
    bump: float = 0.05
    action: float = 0.001
    change: float = 0.0015


@wp.func
def net_distance(x: wp.vec3, left: wp.vec3, right: wp.vec3, height: float) -> float:
    """Return the distance from a point to the net's surface [m].

    The net extends from one netter to the other, half of its height above and half below this line, in the
    direction perpendicular to the line that is nearest to vertical. With one netter above the other it
    shrinks to the line.

    Args:
        x: Point, world frame [m].
        left: Position of one netter, world frame [m].
        right: Position of the other netter, world frame [m].
        height: Height of the net [m].
    """
    span = right - left
    length = wp.max(wp.length(span), 1.0e-6)
    along = span / length
    up = wp.vec3(0.0, 0.0, 1.0) - along[2] * along
    rise = wp.length(up)
    up = up / wp.max(rise, 1.0e-3)
    gap = x - left
    s = wp.clamp(wp.dot(gap, along), 0.0, length)
    t = wp.clamp(wp.dot(gap, up), -0.5 * height, 0.5 * height)
    return wp.length(gap - s * along - t * up)


@wp.func
def net_gap(state: State, p: Any, w: int) -> float:
    """Return the distance from the prey to the net [m]; beyond the net's length, twice the excess is added:
    no capture."""
    left = state.position[w, 1]
    right = state.position[w, 2]
    excess = wp.max(wp.length(right - left) - p.net_length, 0.0)
    return net_distance(state.position[w, PREY], left, right, p.net_height) + 2.0 * excess


@wp.func
def missing(p: Any, net: float, near: float) -> float:
    """Return how much nearer the prey must come to be captured, by the rule of the mode [m]; 0: near enough."""
    by_net = net - p.rules.net_reach
    by_vehicle = near - p.rules.proximity
    gap = by_net
    if p.rules.mode == 1:
        gap = net - p.prey_radius - p.touch
    if p.rules.mode == 2:
        gap = by_vehicle
    if p.rules.mode == 3:
        gap = wp.min(by_net, by_vehicle)
    return wp.max(gap, 0.0)


@wp.func
def shortened(gap: float, gap_now: float) -> float:
    """Return by how much the remaining distance to a capture decreased in the step [m]."""
    return gap - gap_now


@wp.func
def gap_share(gap_now: float) -> float:
    """Return the remaining distance to a capture [m] divided by 8 m, at most 1."""
    return wp.min(gap_now / 8.0, 1.0)


@wp.func
def closest_agent(was: float, near: float) -> float:
    """Return the smallest distance of an agent to the prey so far [m]."""
    return wp.min(was, near)


@wp.func
def closest_to_net(was: float, net: float) -> float:
    """Return the smallest distance of the prey to the net so far [m]."""
    return wp.min(was, net)


@wp.func
def in_net(p: Any, net: float) -> bool:
    """Return whether the prey is within `net_reach` of the net [m]."""
    return net <= p.rules.net_reach


@wp.func
def driving(state: State, w: int, a: int) -> float:
    """Return, for the herder, the cosine of the angle between the directions to the prey and from it to the
    net's centre."""
    prey = state.position[w, PREY]
    middle = 0.5 * (state.position[w, 1] + state.position[w, 2])
    ahead = wp.normalize(prey - state.position[w, a])
    return wp.where(a == 0, wp.dot(ahead, wp.normalize(middle - prey)), 0.0)


@wp.func
def straying(state: State, w: int, a: int) -> float:
    """Return, for the herder, min(d / 8 m, 1) [-], with d its distance to the prey."""
    away = wp.length(state.position[w, PREY] - state.position[w, a])
    return wp.where(a == 0, wp.min(away / 8.0, 1.0), 0.0)


@wp.func
def misfit(state: State, p: Any, w: int, a: int) -> float:
    """Return, for netters, |span - 0.7 net_length|, at most the net's length [m]."""
    span = wp.length(state.position[w, 2] - state.position[w, 1])
    return wp.where(a == 0, 0.0, wp.min(wp.abs(span - 0.7 * p.net_length), p.net_length))


@wp.func
def is_captured(p: Any, net: float, near: float, held: float) -> bool:
    """Return whether the prey is captured by the mode's rule; in the modes net and either, the net must hold
    it for `hold` without a break.

    Distances `net` and `near` are in [m], the time `held` in [s].
    """
    netted = held > 0.0 and held >= p.rules.hold - 0.1 * p.control_step
    caught = netted and (p.rules.mode == 0 or p.rules.mode == 3)
    if p.rules.mode == 1:
        caught = net - p.prey_radius <= p.touch
    if p.rules.mode >= 2 and near <= p.rules.proximity:
        caught = True
    return caught


@wp.func
def start_team(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode: the team around the origin, the prey at a random distance."""
    pi = 3.14159265
    rng = wp.rand_init(key, 4 * w)
    turn = wp.randf(rng, -pi, pi)
    height = wp.randf(rng, p.low, p.high)
    for a in range(AGENTS):
        angle = turn + (float(a) + wp.randf(rng, -0.2, 0.2)) * 2.0 * pi / 3.0
        away = wp.randf(rng, 0.5, 1.0) * p.spawn_radius
        x = away * level_direction(angle) + wp.vec3(0.0, 0.0, height + wp.randf(rng, -0.3, 0.3))
        place_at_rest(state, w, a, x, wp.randf(rng, -pi, pi))
    heading = wp.randf(rng, -pi, pi)
    prey = prey_start(p, wp.rand_init(wp.randi(rng)), wp.vec3(0.0, 0.0, height))
    place_at_rest(state, w, PREY, prey, heading)
    key_messages(arrays, key, w)


@dataclass(frozen=True, kw_only=True)
class TeamPursuit(TeamTask, Chase):
    """3-v-1 pursuit. The capture rule, the prey's speed and the stake are as of the `Level`, unless given here."""

    agents: ClassVar[tuple[str, ...]] = ("herder", "left_netter", "right_netter")
    title: ClassVar[str] = "drive a prey into a net, three against one"
    baselines: ClassVar = {"formation": "finssim.extensions.teams.baselines:FormationPursuit"}
    name: str = "team-pursuit"
    observation: tuple[ObservationPart, ...] = field(default=TEAM, repr=False)
    spawn_radius: float = 1.5
    level: int = 3
    """Index of `LEVELS`."""
    capture: str | None = None
    """One of `CAPTURE_MODES`; None: that of the level. The same holds for the next five settings."""
    proximity: float | None = None
    net_reach: float | None = None
    hold: float | None = None
    prey_speed: float | None = None
    stake: float | None = None
    touch: float = 0.02
    """Distance from the net within which it touches a hull, in mode touch [m]."""
    net_length: float = 4.0
    """Length beyond which the net does not catch [m]."""
    net_height: float = 1.0
    """Height of the net [m]."""
    prey: Prey = field(default_factory=lambda: Prey(mode="hybrid"))
    nearest: float = 3.5
    reward: TeamReward = field(default_factory=TeamReward)
    prey_radius: float = 0.0
    """Horizontal radius of its hull [m]; determined from its vehicle."""

    def __post_init__(self) -> None:
        if not 0 <= self.level < len(LEVELS):
            raise EnvironmentSetupError(f"level is {self.level}, expected 0 to {len(LEVELS) - 1}")
        if self.rules.capture not in CAPTURE_MODES:
            raise EnvironmentSetupError(
                f"unknown capture mode '{self.rules.capture}'; available: {', '.join(CAPTURE_MODES)}"
            )

    @property
    def rules(self) -> Level:
        """Return the level's rules, with the changes of this task."""
        stated = {setting.name: getattr(self, setting.name, None) for setting in fields(Level)}
        return replace(
            LEVELS[self.level], **{name: value for name, value in stated.items() if value is not None}
        )

    def fitted(self, vehicles: Sequence[Vehicle]) -> "TeamPursuit":
        """Return the task with the prey's speed, size and thrust adapted to the vehicles: herder, netters, prey."""
        size = vehicles[-1].body.size
        return self.with_prey_speed(
            self.rules.prey_speed, vehicles, prey_radius=float(0.25 * (size[0] + size[1]))
        )

    def success_rule(self) -> str:
        """See `Task`."""
        rules = self.rules
        net = f"the prey within {rules.net_reach:g} m of the net for {rules.hold:g} s"
        near = f"a vehicle within {rules.proximity:g} m of the prey"
        return {
            "net": net,
            "touch": f"the net touches the prey, to {self.touch:g} m",
            "proximity": near,
            "either": f"{net}, or {near}",
        }[rules.capture]

    def terms(self) -> Terms:
        """See `TeamReward`."""
        r, stake = self.reward, self.rules.stake
        return Terms(
            start=start_team,
            begin=open_messages,
            advance=exchange_messages,
            command=command_prey,
            seen={"gap": prey_gap},
            shared={"net": net_gap, "near": nearest_pursuer, "gap_now": missing},
            rewards=(
                RewardTerm("progress", shortened, r.progress),
                RewardTerm("distance", gap_share, -r.distance),
                RewardTerm("step", each_step, -r.step),
                RewardTerm("drive", driving, r.drive),
                RewardTerm("stray", straying, -r.stray),
                RewardTerm("spread", misfit, -r.spread),
                RewardTerm("bump", bumps, -r.bump),
                *action_costs(r.action, r.change),
            ),
            ends=(End("captured", is_captured, stake), End("left", any_outside, -stake)),
            inside=in_net,
            totals=(
                Total("closest", closest_agent, first="near"),
                Total("closest_to_net", closest_to_net, first="net"),
                Total("gap", "gap_now", first="gap_now"),
            ),
        )
