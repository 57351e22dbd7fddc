"""Terms: small named functions that define a task, and the terms that tasks share.

A term is a `wp.func`, whose arguments are bound by their names, or the name of a value that the task shares between
its terms, such as `"e"`. See `finssim.tasks.task` for the names. Observations use `arrays`, which contains
measurements; rewards and ends use `state`, the true state.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from finssim.control.course import initial_memory
from finssim.physics.types import vec6
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays


@dataclass(frozen=True)
class ObservationPart:
    """A named group of consecutive numbers in the observation: value / scale, then limited to ±clip."""

    name: str
    size: int
    unit: str
    scale: float = 1.0
    clip: float | None = None
    term: Any = field(default=None, repr=False)
    """Term that computes the value from measurements: a float, or a vector of `size`. None in a task in plain
    torch."""
    index: int = 0
    """Argument `k` of the term: the index of a team-mate, of a preview time, ..."""
    errors: tuple[int, ...] = ()
    """Indices of its numbers that are 0 at the goal and may be integrated."""


@dataclass(frozen=True)
class RewardTerm:
    """One reward of every step: weight times the value of the term."""

    name: str
    term: Any
    """-> float; that of one agent if it has the argument `a`, otherwise that of all agents together."""
    weight: float


@dataclass(frozen=True)
class End:
    """Condition that ends an episode early, counted by name; if several are true, the first one counts."""

    name: str
    term: Any
    """-> bool"""
    reward: float = 0.0
    """Reward of every agent at the end."""


@dataclass(frozen=True)
class Total:
    """A quantity accumulated over the episode; one of the task's metrics, by its name."""

    name: str
    term: Any
    """-> float: the total after a step; `was` is the total before."""
    first: Any = 0.0
    """Value at the start of an episode: a number, or a term that is evaluated at the start."""
    index: int = 0
    """Argument `k` of the term."""


@dataclass(frozen=True)
class Terms:
    """All parts of a task other than its `observation`."""

    start: Any
    """Term that sets the initial state of vehicles and goal, drawn only from `key` and the world."""
    rewards: Sequence[RewardTerm] = ()
    ends: Sequence[End] = ()
    inside: Any = None
    """-> bool: within the tolerance of success; the uninterrupted time within it is `arrays.held`."""
    totals: Sequence[Total] = ()
    advance: Any = None
    """Term that changes the world besides the vehicles, after each step and before its evaluation."""
    begin: Any = None
    """Term before the first observation, after the start has been measured."""
    shared: Mapping[str, Any] = field(default_factory=dict)
    """Shared expressions: name -> term of the true state, evaluated once per step; terms have arguments of these
    names."""
    seen: Mapping[str, Any] = field(default_factory=dict)
    """Shared expressions of observation terms: name -> term of measurements, evaluated once for each agent."""
    meanings: Mapping[str, str] = field(default_factory=dict)
    """Description of a reward, an end or a total with the task's numbers, instead of the function's docstring: name ->
    sentence with the unit."""
    shown: bool = True
    """True if the terms of the observation's parts write it; False if the task writes it."""
    command: Any = None
    """Term that writes `arrays.scripted`, the actions of the vehicles that the task commands, before each step."""


@wp.func
def open_episode(arrays: TaskArrays, w: int):
    """Reset everything that persists within an episode."""
    arrays.time[w] = 0.0
    arrays.held[w] = 0.0
    arrays.episode_return[w] = 0.0
    for i in range(arrays.totals.shape[1]):
        arrays.totals[w, i] = 0.0
    for i in range(arrays.earned.shape[1]):
        arrays.earned[w, i] = 0.0
    for i in range(arrays.action.shape[1]):
        arrays.previous_action[w, i] = 0.0
    for v in range(arrays.steering.shape[1]):
        arrays.steering[w, v] = initial_memory()


@wp.func
def close_episode(state: State, arrays: TaskArrays, w: int):
    """Store the last observation and the totals of an episode that ends."""
    for i in range(arrays.observation.shape[1]):
        arrays.final_observation[w, i] = arrays.observation[w, i]
    arrays.final_return[w] = arrays.episode_return[w]
    arrays.final_length[w] = state.steps[w]
    arrays.final_held[w] = arrays.held[w]
    for i in range(arrays.totals.shape[1]):
        arrays.final_totals[w, i] = arrays.totals[w, i]
    for i in range(arrays.earned.shape[1]):
        arrays.final_earned[w, i] = arrays.earned[w, i]


@wp.func
def report_frozen(state: State, arrays: TaskArrays, w: int):
    """End the episode of a frozen world, without rewards, until it is reported."""
    for a in range(arrays.agent_reward.shape[1]):
        arrays.agent_reward[w, a] = 0.0
    arrays.reward[w] = 0.0
    arrays.terminated[w] = 1
    arrays.truncated[w] = 0
    arrays.done[w] = 0
    close_episode(state, arrays, w)


@wp.func
def either(a: bool, b: bool) -> bool:
    """Return True if one of two is true."""
    return a or b


@wp.func
def first_time(now: bool, before: bool) -> bool:
    """Return True if a condition is true now and was not before."""
    return now and not before


@wp.func
def remember_actions(arrays: TaskArrays, w: int):
    """Store the actions for the next step's change."""
    for i in range(arrays.action.shape[1]):
        arrays.previous_action[w, i] = wp.clamp(arrays.action[w, i], -1.0, 1.0)


@wp.func
def uniform3(rng: wp.uint32, low: wp.vec3, high: wp.vec3) -> wp.vec3:
    """Return a point drawn uniformly from a box, in the unit of the box; the caller passes a separate stream."""
    a = wp.randf(rng)
    b = wp.randf(rng)
    c = wp.randf(rng)
    return low + wp.cw_mul(wp.vec3(a, b, c), high - low)


@wp.func
def tilted(roll: float, pitch: float, yaw: float) -> wp.quat:
    """Return the attitude of a yaw about world z, then pitch, then roll [rad]."""
    about_x = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), roll)
    about_y = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), pitch)
    return wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw) * about_y * about_x


@wp.func
def start_upright(state: State, w: int, rng: wp.uint32, tilt: float, speed: float):
    """Draw any heading, roll and pitch up to `tilt` [rad], and a velocity up to `speed` per axis [m/s]."""
    roll = wp.randf(rng, -tilt, tilt)
    pitch = wp.randf(rng, -tilt, tilt)
    state.quaternion[w, 0] = tilted(roll, pitch, wp.randf(rng, -3.14159265, 3.14159265))
    nu = vec6()
    for k in range(3):
        nu[k] = wp.randf(rng, -speed, speed)
    state.velocity[w, 0] = nu


@wp.func
def level_direction(angle: float) -> wp.vec3:
    """Return the unit vector at an angle [rad] from the world's x axis, counter-clockwise from above, world frame."""
    return wp.vec3(wp.cos(angle), wp.sin(angle), 0.0)


@wp.func
def place_at_rest(state: State, w: int, v: int, x: wp.vec3, yaw: float):
    """Set the position of a vehicle, level and at rest.

    Args:
        state: State to write.
        w: World.
        v: Vehicle.
        x: Body origin, world frame [m].
        yaw: [rad].
    """
    state.position[w, v] = x
    state.quaternion[w, v] = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
    state.velocity[w, v] = vec6()


@wp.func
def place_tilted(state: State, w: int, x: wp.vec3, q: wp.quat, rng: wp.uint32, tilt: float, turn: float):
    """Set the position of vehicle 0 at rest, rotated from an attitude by a random yaw, pitch and roll.

    Args:
        state: State to write.
        w: World.
        x: Body origin, world frame [m].
        q: Attitude before the rotation, body to world, xyzw.
        rng: Stream of the draws.
        tilt: Largest roll and pitch [rad].
        turn: Largest yaw [rad].
    """
    roll = wp.randf(rng, -tilt, tilt)
    pitch = wp.randf(rng, -tilt, tilt)
    state.position[w, 0] = x
    state.quaternion[w, 0] = q * tilted(roll, pitch, wp.randf(rng, -turn, turn))
    state.velocity[w, 0] = vec6()


@wp.func
def world_velocity(state: State, w: int, v: int) -> wp.vec3:
    """Return the velocity of a vehicle, world frame [m/s]."""
    nu = state.velocity[w, v]
    return wp.quat_rotate(state.quaternion[w, v], wp.vec3(nu[0], nu[1], nu[2]))


@wp.func
def angular_velocity(state: State, w: int) -> wp.vec3:
    """Return the angular velocity of vehicle 0, body frame [rad/s]."""
    nu = state.velocity[w, 0]
    return wp.vec3(nu[3], nu[4], nu[5])


@wp.func
def turn_rate(state: State, w: int) -> float:
    """Return the magnitude of the angular velocity of vehicle 0 [rad/s]."""
    return wp.length(angular_velocity(state, w))


@wp.func
def position_error(state: State, arrays: TaskArrays, w: int) -> float:
    """Return the distance from vehicle 0 to its goal [m]."""
    return wp.length(arrays.goal_position[w] - state.position[w, 0])


@wp.func
def attitude_error(state: State, arrays: TaskArrays, w: int) -> float:
    """Return the angle of the rotation from vehicle 0's attitude to its goal's [rad], in [0, π]."""
    d = wp.quat_inverse(state.quaternion[w, 0]) * arrays.goal_quaternion[w]
    return 2.0 * wp.atan2(wp.length(wp.vec3(d[0], d[1], d[2])), wp.abs(d[3]))


@wp.func
def heading_match(p: Any, theta: float) -> float:
    """Return 1 in the goal's attitude, 1/e at an error `theta` of `reward.heading_scale` [rad]."""
    return wp.exp(-theta / p.reward.heading_scale)


@wp.func
def near_match(p: Any, e: float) -> float:
    """Return 1 without an error, 1/e at an error `e` of `reward.near_scale` [m]."""
    return wp.exp(-e / p.reward.near_scale)


@wp.func
def each_step() -> float:
    """Return 1 in every step [1]: sooner is better."""
    return 1.0


@wp.func
def action_effort(arrays: TaskArrays, w: int, a: int) -> float:
    """Return the mean square of the action: the cheapest thrusts that suffice."""
    effort = float(0.0)
    for i in range(arrays.action_size):
        u = wp.clamp(arrays.action[w, a * arrays.action_size + i], -1.0, 1.0)
        effort += u * u
    return effort / float(arrays.action_size)


@wp.func
def action_change(arrays: TaskArrays, w: int, a: int) -> float:
    """Return the mean square of the action's change since the last step: commands that a motor can follow."""
    change = float(0.0)
    for i in range(arrays.action_size):
        k = a * arrays.action_size + i
        d = wp.clamp(arrays.action[w, k], -1.0, 1.0) - arrays.previous_action[w, k]
        change += d * d
    return change / float(arrays.action_size)


@wp.func
def turning(state: State, w: int) -> float:
    """Return the square of the turn rate, at most 4: no spinning [rad²/s²]."""
    omega = angular_velocity(state, w)
    return wp.min(wp.dot(omega, omega), 4.0)


@wp.func
def tilt_angle(state: State, w: int) -> float:
    """Return the angle between the body z axis and the vertical [rad]."""
    up = wp.quat_rotate(state.quaternion[w, 0], wp.vec3(0.0, 0.0, 1.0))[2]
    return wp.acos(wp.clamp(up, -1.0, 1.0))


@wp.func
def out_of_pool(state: State, p: Any, w: int) -> bool:
    """Return True if the vehicle is outside `bounds`, above `ceiling` or below `depth`, scaled to the vehicle."""
    x = state.position[w, 0] / p.fit.size
    return wp.abs(x[0]) > p.bounds[0] or wp.abs(x[1]) > p.bounds[1] or x[2] > p.ceiling or x[2] < -p.depth


@wp.func
def linear_velocity(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return the measured velocity of an agent, body frame [m/s]."""
    nu = arrays.velocity[w, a]
    return wp.vec3(nu[0], nu[1], nu[2])


@wp.func
def turn_rates(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return the measured angular velocity of an agent, body frame [rad/s]."""
    nu = arrays.velocity[w, a]
    return wp.vec3(nu[3], nu[4], nu[5])


@wp.func
def measured_velocity(arrays: TaskArrays, w: int, v: int) -> wp.vec3:
    """Return the measured velocity of a vehicle, world frame [m/s]."""
    nu = arrays.velocity[w, v]
    return wp.quat_rotate(arrays.quaternion[w, v], wp.vec3(nu[0], nu[1], nu[2]))


@wp.func
def goal_offset(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return the vector from an agent to the goal, body frame [m]."""
    return wp.quat_rotate_inv(arrays.quaternion[w, a], arrays.goal_position[w] - arrays.position[w, a])


@wp.func
def goal_columns(arrays: TaskArrays, w: int, a: int) -> vec6:
    """Return the first two columns of the goal's rotation matrix relative to an agent's body."""
    R = wp.quat_to_matrix(wp.quat_inverse(arrays.quaternion[w, a]) * arrays.goal_quaternion[w])
    return vec6(R[0, 0], R[1, 0], R[2, 0], R[0, 1], R[1, 1], R[2, 1])


@wp.func
def offset_length(offset: wp.vec3) -> float:
    """Return the remaining distance [m]: the length of `offset`."""
    return wp.length(offset)


@wp.func
def world_up(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return the world's up, a unit vector, body frame."""
    return wp.quat_rotate_inv(arrays.quaternion[w, a], wp.vec3(0.0, 0.0, 1.0))


@wp.func
def measured_depth(arrays: TaskArrays, w: int, a: int) -> float:
    """Return the measured depth of an agent below the surface [m]."""
    return -arrays.position[w, a][2]


def action_costs(action: float, change: float, rate: float | None = None) -> tuple[RewardTerm, ...]:
    """Return the reward terms with these weights on effort, changes of the action, and turning."""
    effort = (RewardTerm("action", action_effort, -action), RewardTerm("change", action_change, -change))
    return effort if rate is None else (*effort, RewardTerm("rate", turning, -rate))


def own_velocity(clip: float) -> tuple[ObservationPart, ...]:
    """Return the agent's linear and angular velocity, limited to ±clip [m/s, rad/s]."""
    return (
        ObservationPart("linear velocity, body frame", 3, "m/s", clip=clip, term=linear_velocity),
        ObservationPart("angular velocity, body frame", 3, "rad/s", clip=clip, term=turn_rates),
    )
