"""Autopilot of vehicles that must move to steer: speed, course over ground, and depth or pitch.

Its gains follow from a linear model at several speeds (`finssim.sim.free_motion.linear_model`). About level
motion at a speed U the state is

    x = (u - U, v, w, p, q, r, roll, pitch, heading, z, integrals of the errors of speed, heading, and depth or pitch)

with heading' = r and z' = w - U pitch (z up; pitch is positive bow down). Wrenches (X, K, M, N) reach the
vehicle after the lag of its actuators. The feedback of x and of the lagged wrench minimises the sum of (error
/ scale)² + (wrench / limit)²: a linear-quadratic regulator with integral action (Anderson and Moore 1990).
The bounded allocation of `finssim.control.allocation` then computes the channels closest to the demand within
the range of the fins and the limits of thrust, for a cruciform tail, an X tail or any other. Between the
speeds of the model all numbers are interpolated. An integral is held while the channels cannot follow it.

A current moves the vehicle over the ground, not through the water. Sway and heave through the water, which
are fed back, are therefore those of the model, driven by the measured rates and the commands. Their
difference from the measured sway is attributed to the current, constant in the world; the commanded heading
compensates it to achieve the requested course over ground.
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,valid-type,misc,untyped-decorator,index"

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from finssim.control import ControlError
from finssim.control.allocation import AllocationData, allocate, allocation_data
from finssim.control.guidance import Measured
from finssim.core.rotations import quat_rotate
from finssim.physics.types import MAX_THRUSTERS, vec6, vec8
from finssim.vehicles import HydrodynamicSet, Vehicle
from finssim.vehicles.capability import coefficients_of, terminal_speeds

Array = npt.NDArray[np.float64]

AXES = (0, 3, 4, 5)
"""Axes of the demanded wrench: surge, roll, pitch, yaw."""
SCALES = {
    0: 0.3,
    6: math.radians(30.0),
    7: math.radians(20.0),
    8: math.radians(15.0),
    9: 1.0,
}
"""Error of a state whose cost equals that of the full limit: speed [m/s], roll, pitch, heading [rad], depth [m]."""
INTEGRAL_TIME = 6.0
"""Duration after which the integral of a constant error costs as much as the error [s]."""
STEEPEST = math.radians(25.0)
"""Largest commanded pitch [rad]."""
WIDEST = math.radians(60.0)
"""Largest heading error in the feedback; larger ones are clipped [rad]."""
CURRENT_TIME = 3.0
"""Time constant of the current estimate [s]."""
TURNING = 0.15
"""Yaw rate at which the current estimate is updated at half the rate, since the model of a turn is not exact
[rad/s]."""
LEAST_DAMPING = 0.3
"""Least decay rate of the model's sway and heave [1/s]; a linear model lacks cross-flow drag."""
MOST_CRAB = math.radians(45.0)
"""Largest angle between heading and course to compensate a current [rad]."""
INDEPENDENT = 0.2
"""Fraction of an axis' wrench that must remain with the other axes at zero, for the axis to be controlled [-]."""
CAUTION = 1.0
"""Fraction of an axis' limit that an error of heading, depth or pitch may demand; the remainder stabilises
the hull [-]."""
SHORT = 0.02
"""Fraction of an axis' limit by which a wrench may fall short before its integral is held [-]."""
SHORTEST_LAG = 0.05
"""Least time constant of an actuator [s]."""

SLOWEST, FASTEST, SPEEDS = 0.5, 0.95, 6
"""Slowest and fastest speed of the gains, relative to top speed, and the number of speeds; also the range of
an action's speed."""
USUAL_TOP = 2.0
"""Top speed of a vehicle whose model does not determine it [m/s]."""
FARTHEST = 5.0
"""Change of depth for an action of 1 [m]."""

STATES = 13
Memory = wp.types.vector(length=11, dtype=float)
Row = wp.types.vector(length=STATES + len(AXES), dtype=float)
Wrench4 = wp.types.vector(length=len(AXES), dtype=float)


class LinearModel(NamedTuple):
    """Linear model of a vehicle with c channels about level motion at n speeds, body frame.

    Channels are in their own units: thrust [N], angle [rad], volume [m³] or position [m].
    """

    speeds: Array
    """Surge velocity U, in equal steps [m/s], (n,)."""
    A: Array
    """State matrix A of x' = A x + B (channels - trim), with x = (nu, roll, pitch) [m/s, rad/s, rad], (n, 8, 8)."""
    B: Array
    """Acceleration per unit of a channel [m/s² or rad/s²], (n, 8, c)."""
    trim: Array
    """Channels that hold the speed [N], (n, c); channels other than thrusts are 0."""
    rest: Array
    """Acceleration that remains at the trim, for example by buoyancy [m/s², rad/s²], (n, 6)."""
    inertia: Array
    """Mass matrix with the added mass, about the body origin [kg, kg m, kg m²], (6, 6)."""
    lower: Array
    """Least value of each channel [N, rad, m³, m], (c,)."""
    upper: Array
    """Greatest value of each channel [N, rad, m³, m], (c,)."""
    lag: Array
    """Time constant of each channel [s], (c,)."""

    @property
    def travel(self) -> Array:
        """Half the range of each channel, in its unit, (c,)."""
        return 0.5 * (self.upper - self.lower)


@wp.struct
class CourseData:
    """Numbers of each vehicle for `steer`, built by `course_data`: the first index is the vehicle, the second
    the speed."""

    first: wp.array(dtype=float)
    """Least speed [m/s]."""
    spacing: wp.array(dtype=float)
    """Step between speeds [m/s]."""
    gains: wp.array3d(dtype=Row)
    """Feedback of the state and of the lagged wrench, by axis: for depth, then for pitch, (vehicles, 2 n, 4)."""
    slip: wp.array3d(dtype=Row)
    """Acceleration of sway and heave by state and lagged wrench [m/s² per their units], (vehicles, n, 2)."""
    rest: wp.array2d(dtype=wp.vec2)
    """Acceleration of sway and heave that remains at the trim [m/s²], (vehicles, n)."""
    reach: wp.array2d(dtype=Wrench4)
    """Limits of the errors in the feedback: speed [m/s], pitch, heading [rad], height [m], (vehicles, 2 n)."""
    slack: wp.array2d(dtype=Wrench4)
    """Missing wrench up to which integrals are updated [N, N m], (vehicles, n)."""
    hold: wp.array2d(dtype=float)
    """Surge force of the trim [N], (vehicles, n)."""
    trim: wp.array2d(dtype=vec8)
    """Channels that hold the speed [N], (vehicles, n)."""
    columns: wp.array3d(dtype=Wrench4)
    """Wrench (X, K, M, N) by channel, (vehicles, n, 8) [N or N m per unit of the channel]."""
    share: wp.array(dtype=Wrench4)
    """Fraction of its change that a wrench with lag completes in one period [-], (vehicles,)."""
    travel: wp.array(dtype=vec8)
    """Half the range of each channel, in its unit, (vehicles,)."""
    allocation: AllocationData
    """Allocation to fractions of `travel` from the trim; its vehicle type is vehicle * n + speed."""
    period: float
    """Interval between two commands [s]."""


@wp.struct
class CourseReference:
    """Reference of the autopilot."""

    speed: float  # requested surge velocity [m/s]
    turn: float  # requested minus present course over ground, counter-clockwise from above [rad]
    rise: float  # requested minus present height [m]; unused if the pitch is held
    pitch: float  # requested pitch, positive bow down [rad]; if the depth is held, slope of the path
    by_pitch: int  # 1 to hold the pitch; 0 to hold the depth


@wp.struct
class CourseCommand:
    """Commands of the autopilot, and its memory."""

    channels: vec8
    """Commands, in the units of the channels."""
    memory: Memory
    """Integrals of speed [m], of course [rad s], and of depth [m s] or pitch [rad s]; the lagged wrench [N, N
    m]; sway and heave through the water [m/s]; and the current, world x and y [m/s]."""


@wp.func
def between(low: Any, high: Any, share: float):
    """Return the interpolation between `low` and `high` at a fraction `share`."""
    return low + share * (high - low)


@wp.func
def initial_memory() -> Memory:
    """Return the initial memory [m, rad s, N, N m, m/s], with an unknown current."""
    memory = Memory()
    memory[9] = wp.nan
    return memory


@wp.struct
class LevelMotion:
    """Horizontal motion of a vehicle over ground."""

    heading: float  # heading of the bow [rad]
    ahead: wp.vec2  # unit vector along the heading
    left: wp.vec2  # unit vector to the left of it
    way: wp.vec2  # velocity over ground, world x and y [m/s]
    current: wp.vec2  # velocity of the water, world x and y [m/s]
    surge: float  # forward speed through the water [m/s]


@wp.struct
class Place:
    """Interpolation point of a vehicle's speed among those of its model."""

    k: int  # index of the next lower speed
    s: float  # fraction of the interval from there to the next speed [-]
    row: int  # row of the gains of the lower speed, for depth or for pitch
    reach: Wrench4  # limits of the errors: speed [m/s], pitch, heading [rad], height [m]


@wp.func
def level_motion(q: wp.quat, nu: vec6, memory: Memory) -> LevelMotion:
    """Return the horizontal motion, from the twist over ground nu, body frame [m/s, rad/s], and the memory of
    `steer`."""
    bow = wp.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    ground = wp.quat_rotate(q, wp.vec3(nu[0], nu[1], nu[2]))
    found = LevelMotion()
    found.heading = wp.atan2(bow[1], bow[0])
    ahead = wp.vec2(wp.cos(found.heading), wp.sin(found.heading))
    left = wp.vec2(-ahead[1], ahead[0])
    found.ahead = ahead
    found.left = left
    found.way = wp.vec2(ground[0], ground[1])
    found.current = wp.vec2(memory[9], memory[10])
    if wp.isnan(memory[9]):
        across = wp.dot(found.way, left)
        found.current = wp.vec2(across * left[0], across * left[1])
    found.surge = nu[0] - wp.dot(found.current, ahead)
    return found


@wp.func
def speed_index(speed: float, vehicle: int, data: CourseData) -> float:
    """Return the fractional index of a speed [m/s] among those of a vehicle's model: 0 is the lowest, 1 the
    next [-]."""
    count = data.trim.shape[1]
    return wp.clamp((speed - data.first[vehicle]) / data.spacing[vehicle], 0.0, float(count - 1))


@wp.func
def place_of(surge: float, by_pitch: int, vehicle: int, data: CourseData) -> Place:
    """Return the interpolation point of a speed through the water [m/s]; `by_pitch` is 1 to hold the pitch,
    otherwise 0."""
    count = data.trim.shape[1]
    place = speed_index(surge, vehicle, data)
    found = Place()
    found.k = wp.min(int(place), count - 2)
    found.s = place - float(found.k)
    found.row = found.k + by_pitch * count
    found.reach = between(data.reach[vehicle, found.row], data.reach[vehicle, found.row + 1], found.s)
    return found


@wp.func
def heading_error(reference: CourseReference, level: LevelMotion, vehicle: int, data: CourseData) -> float:
    """Return the heading minus the one that achieves the requested course in the current [rad]; not wrapped."""
    least = data.first[vehicle]
    course = float(level.heading)
    if wp.dot(level.way, level.ahead) > 0.5 * least:
        course = wp.atan2(level.way[1], level.way[0])
    course += reference.turn
    drift = wp.dot(level.current, wp.vec2(-wp.sin(course), wp.cos(course))) / wp.max(level.surge, least)
    greatest = wp.static(math.sin(MOST_CRAB))
    return level.heading - course + wp.asin(wp.clamp(drift, -greatest, greatest))


@wp.func
def errors_of(
    reference: CourseReference, q: wp.quat, nu: vec6, memory: Memory, off: float, reach: Wrench4
) -> Row:
    """Return the state in the feedback, and the lagged wrench [m/s, rad/s, rad, m, N, N m].

    Args:
        reference: Reference, as for `steer`.
        q: Attitude, body to world.
        nu: Velocity over ground, body frame [m/s, rad/s].
        memory: Memory after the previous command [m, rad s, N, N m, m/s].
        off: Heading error [rad].
        reach: Limits of the errors [m/s, rad, rad, m].
    """
    up = wp.quat_rotate_inv(q, wp.vec3(0.0, 0.0, 1.0))
    x = Row()
    for i in range(1, 6):
        x[i] = nu[i]
    x[1] = memory[7]
    x[2] = memory[8]
    x[0] = wp.clamp(nu[0] - reference.speed, -reach[0], reach[0])
    x[6] = wp.atan2(up[1], up[2])
    x[7] = wp.clamp(wp.asin(wp.clamp(-up[0], -1.0, 1.0)) - reference.pitch, -reach[1], reach[1])
    x[8] = wp.clamp(wp.atan2(wp.sin(off), wp.cos(off)), -reach[2], reach[2])
    x[9] = wp.clamp(-reference.rise, -reach[3], reach[3])
    for i in range(3):
        x[10 + i] = memory[i]
    for i in range(4):
        x[13 + i] = memory[3 + i]
    return x


@wp.func
def demanded(speed: float, x: Row, at: Place, vehicle: int, data: CourseData) -> Wrench4:
    """Return the demanded wrench (X, K, M, N) [N, N m]; the requested surge velocity `speed` is in [m/s]."""
    k = at.k
    goal = speed_index(speed, vehicle, data)
    k_goal = wp.min(int(goal), data.trim.shape[1] - 2)
    wrench = Wrench4()
    for i in range(4):
        gains = between(data.gains[vehicle, at.row, i], data.gains[vehicle, at.row + 1, i], at.s)
        wrench[i] = -wp.dot(gains, x)
    wrench[0] += between(data.hold[vehicle, k_goal], data.hold[vehicle, k_goal + 1], goal - float(k_goal))
    wrench[0] -= between(data.hold[vehicle, k], data.hold[vehicle, k + 1], at.s)
    return wrench


@wp.func
def grown_integrals(
    reference: CourseReference,
    x: Row,
    short: Wrench4,
    memory: Memory,
    at: Place,
    vehicle: int,
    data: CourseData,
) -> Memory:
    """Return the memory with updated integrals, except those that the channels cannot follow.

    The missing wrench `short` is in [N, N m]; `x` is the result of `errors_of`; the memory is that of `steer`.
    """
    after = memory
    reach = at.reach
    errors = wp.vec3(x[0], wp.clamp(-reference.turn, -reach[2], reach[2]), x[9 - 2 * reference.by_pitch])
    bounds = wp.vec3(reach[0], reach[2], reach[3 - 2 * reference.by_pitch])
    for i in range(3):
        axis = wp.where(i == 0, 0, wp.where(i == 1, 3, 2))
        push = -data.gains[vehicle, at.row, axis][10 + i] * errors[i]
        follows = short[axis] * push <= 0.0 or wp.abs(short[axis]) <= data.slack[vehicle, at.k][axis]
        if follows and wp.abs(errors[i]) < bounds[i]:
            after[i] = memory[i] + data.period * errors[i]
    return after


@wp.func
def steer(
    reference: CourseReference, q: wp.quat, nu: vec6, memory: Memory, vehicle: int, data: CourseData
) -> CourseCommand:
    """Return the channels that execute a reference, and the memory for the next call.

    Args:
        reference: Reference of the autopilot.
        q: Attitude, body to world.
        nu: Velocity over ground, body frame [m/s, rad/s].
        memory: Memory after the previous command [m, rad s, N, N m, m/s]; `initial_memory` initially.
        vehicle: First index into `data`.
        data: Numbers from `course_data`.
    """
    level = level_motion(q, nu, memory)
    at = place_of(level.surge, reference.by_pitch, vehicle, data)
    k, s = at.k, at.s
    x = errors_of(reference, q, nu, memory, heading_error(reference, level, vehicle, data), at.reach)
    wrench = demanded(reference.speed, x, at, vehicle, data)

    tau = vec6(wrench[0], 0.0, 0.0, wrench[1], wrench[2], wrench[3])
    travel, speeds = data.travel[vehicle], vehicle * data.trim.shape[1]
    low = wp.cw_mul(travel, allocate(tau, speeds + k, data.allocation))
    high = wp.cw_mul(travel, allocate(tau, speeds + k + 1, data.allocation))
    achieved = Wrench4()
    for i in range(MAX_THRUSTERS):
        achieved += (1.0 - s) * low[i] * data.columns[vehicle, k, i]
        achieved += s * high[i] * data.columns[vehicle, k + 1, i]

    command = CourseCommand()
    command.channels = between(data.trim[vehicle, k] + low, data.trim[vehicle, k + 1] + high, s)
    after = grown_integrals(reference, x, wrench - achieved, memory, at, vehicle, data)
    for i in range(4):
        after[3 + i] = between(memory[3 + i], achieved[i], data.share[vehicle][i])
    rest = between(data.rest[vehicle, k], data.rest[vehicle, k + 1], s)
    for i in range(2):
        slip = wp.dot(between(data.slip[vehicle, k, i], data.slip[vehicle, k + 1, i], s), x)
        after[7 + i] += data.period * (slip + rest[i])
    more = wp.dot(level.way, level.left) - memory[7] - wp.dot(level.current, level.left)
    turning = nu[5] / wp.static(TURNING)
    follow = data.period / wp.static(CURRENT_TIME) / (1.0 + turning * turning)
    current = level.current + follow * more * level.left
    after[9] = current[0]
    after[10] = current[1]
    command.memory = after
    return command


@wp.func
def reference_of(
    speed: float, turn: float, dive: float, by_pitch: int, vehicle: int, data: CourseData
) -> CourseReference:
    """Return the reference for an action of mode `course` or `course_pitch`.

    Args:
        speed: Fraction of the range from the middle speed to the greatest, or to the least if negative [-].
        turn: Fraction of `WIDEST` by which to turn the course, counter-clockwise from above [-].
        dive: Fraction of `FARTHEST` to descend, or of `STEEPEST` to pitch the bow down [-].
        by_pitch: 1: pitch; 0: depth.
        vehicle: First index into `data`.
        data: Numbers from `course_data`.
    """
    reference = CourseReference()
    whole = data.spacing[vehicle] * float(data.trim.shape[1] - 1)
    reference.speed = data.first[vehicle] + 0.5 * (1.0 + wp.clamp(speed, -1.0, 1.0)) * whole
    reference.turn = wp.static(WIDEST) * wp.clamp(turn, -1.0, 1.0)
    reference.by_pitch = by_pitch
    if by_pitch != 0:
        reference.pitch = wp.static(STEEPEST) * wp.clamp(dive, -1.0, 1.0)
    else:
        reference.rise = -wp.static(FARTHEST) * wp.clamp(dive, -1.0, 1.0)
    return reference


@wp.kernel(enable_backward=False)
def steer_rows(
    references: wp.array(dtype=CourseReference),
    q: wp.array(dtype=wp.quat),
    nu: wp.array(dtype=vec6),
    memory: wp.array(dtype=Memory),
    data: CourseData,
    channels: wp.array(dtype=vec8),
    after: wp.array(dtype=Memory),
):
    """Run `steer` for the first vehicle, row by row.

    Args:
        references: References, (N,).
        q: Attitudes, body to world, (N,).
        nu: Velocities over ground, body frame [m/s, rad/s], (N,).
        memory: Memory after the previous command [m, rad s, N, N m, m/s], (N,).
        data: Numbers from `course_data`.
        channels: Resulting commands, in the units of the channels [N, rad, m³, m], (N,).
        after: Resulting memory for the next command [m, rad s, N, N m, m/s], (N,).
    """
    i = wp.tid()
    command = steer(references[i], q[i], nu[i], memory[i], 0, data)
    channels[i] = command.channels
    after[i] = command.memory


def top_speed(vehicle: Vehicle, hydrodynamics: str) -> float:
    """Return the top speed ahead for a hydrodynamic set [m/s]; `USUAL_TOP` if it has no coefficients or no
    finite speed."""
    if not isinstance(vehicle.hydrodynamics[hydrodynamics], HydrodynamicSet):
        return USUAL_TOP
    reached = float(terminal_speeds(vehicle, hydrodynamics)[0])
    return reached if 0.0 < reached < math.inf else USUAL_TOP


def course_speeds(vehicle: Vehicle) -> Array:
    """Return the speeds of a vehicle's autopilot, from the lowest to the highest [m/s], (n,)."""
    top = top_speed(vehicle, coefficients_of(vehicle))
    return np.linspace(SLOWEST * top, FASTEST * top, SPEEDS)


class Tuning(NamedTuple):
    """Numbers of one vehicle at its n speeds."""

    gains: Array
    """Feedback of the state [N or N m per its unit], for depth and then for pitch, (2 n, 4, 17)."""
    slip: Array
    """Acceleration of sway and heave by the state and the lagged wrench [m/s² per their units], (n, 2, 17)."""
    reach: Array
    """Limits of the errors in the feedback: speed [m/s], pitch, heading [rad], height [m], (2 n, 4)."""
    columns: Array
    """Wrench (X, K, M, N) per unit of a channel [N or N m], (n, 4, c)."""
    limits: Array
    """Wrench on each of the four axes at half the range of the channels, 0 for an uncontrolled axis [N, N m],
    (n, 4)."""
    weights: Array
    """Weights of the six axes in the allocation [1/N, 1/(N m)], (n, 6)."""
    lag: Array
    """Time constant of each axis [s], (4,)."""


def tuned(model: LinearModel, name: str) -> Tuning:
    """Return the gains of a vehicle from its linear model.

    Args:
        model: The model.
        name: Name of the vehicle, for messages.

    Raises:
        ControlError: Its actuators do not control surge, pitch and yaw, or an uncontrolled motion is unstable.
    """
    wrenches = model.inertia @ model.B[:, :6]
    columns = wrenches[:, AXES]
    limits = _authority(columns * model.travel)
    if not (limits[:, [0, 2, 3]] > 0.0).all():
        raise ControlError(
            f"{name}: its actuators do not control surge, pitch and yaw independently of each other, as the autopilot "
            "requires: use a vehicle with fins or thrusters for them"
        )
    share = (columns[-1] * model.travel) ** 2
    lag = np.divide(
        share @ np.maximum(model.lag, SHORTEST_LAG),
        share.sum(axis=1),
        out=np.full(4, SHORTEST_LAG),
        where=share.sum(axis=1) > 0.0,
    )
    weights = np.zeros((len(columns), 6))
    weights[:, AXES] = np.divide(1.0, limits, out=np.zeros_like(limits), where=limits > 0.0)
    n = len(columns)
    rows = [
        _regulator(model, i, weights[i], limits[i], lag, by_pitch, name)
        for by_pitch in (False, True)
        for i in range(n)
    ]
    gains, slip = (np.stack(part) for part in zip(*rows, strict=True))
    reach = np.full((2 * n, 4), np.inf)
    reach[:, 0] = 2.0 * SCALES[0]
    turning, diving = (CAUTION * np.tile(limits[:, axis], 2) for axis in (3, 2))
    reach[:, 2] = np.minimum(WIDEST, turning / np.abs(gains[:, 3, 8]))
    reach[:, 1] = np.minimum(STEEPEST, diving / np.abs(gains[:, 2, 7]))
    reach[:n, 3] = (reach[:, 1] * np.abs(gains[:, 2, 7]))[:n] / np.abs(gains[:n, 2, 9])
    return Tuning(gains, slip[:n], reach, columns, limits, weights, lag)


def _authority(wrench: Array) -> Array:
    """Return the wrench that each of the four axes can reach without wrench on the others, 0 if impossible, (n, 4).

    Args:
        wrench: Wrench of every channel at half its range [N, N m], (n, 4, c).
    """
    found = np.zeros(wrench.shape[:2])
    for i, rows in enumerate(wrench):
        scaled = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
        for axis in range(4):
            others = scaled[[k for k in (0, 2, 3) if k != axis]]  # roll is controlled if possible
            free = scaled[axis] - others.T @ np.linalg.lstsq(others.T, scaled[axis], rcond=1e-6)[0]
            if np.linalg.norm(free) > INDEPENDENT:
                found[i, axis] = np.abs(rows[axis, np.abs(free) > 1e-9]).sum()
    return found


def _regulator(
    model: LinearModel, i: int, weights: Array, limits: Array, lag: Array, by_pitch: bool, name: str
) -> tuple[Array, Array]:
    """Return the gains at one speed [N or N m per unit of the state], (4, 17), and rows of sway and heave, (2, 17)."""
    from scipy.linalg import solve_continuous_are

    n = STATES
    weighted = weights[:, None] * (model.inertia @ model.B[i, :6]) * model.travel
    mix = model.travel[:, None] * np.linalg.pinv(weighted, rcond=1e-6)[:, AXES] * weights[list(AXES)]
    A, B, Q = np.zeros((n + 4, n + 4)), np.zeros((n + 4, 4)), np.zeros(n + 4)
    A[:8, :8] = model.A[i]
    A[0, 1:8] = A[1:8, 0] = 0.0  # speed is controlled by thrust, the other states by the fins
    A[8, 5] = 1.0
    A[9, 2], A[9, 7] = 1.0, -model.speeds[i]
    A[[10, 11, 12], [0, 8, 7 if by_pitch else 9]] = 1.0
    A[:8, n:] = model.B[i] @ mix
    A[0, n + 1 :] = A[1:8, n] = 0.0
    A[n:, n:], B[n:] = -np.diag(1.0 / lag), np.diag(1.0 / lag)
    for state, scale in SCALES.items():
        Q[state] = scale**-2
    for k, state in ((10, 0), (11, 8), (12, 7 if by_pitch else 9)):
        Q[k] = (SCALES[state] * INTEGRAL_TIME) ** -2
    driven = np.flatnonzero(limits > 0.0)
    dropped = {n + k for k in range(4) if k not in driven} | ({9} if by_pitch else set())
    if 1 not in driven:
        dropped |= {3, 6}  # roll is not controlled
    kept = np.array([k for k in range(n + 4) if k not in dropped])
    a, b, r = A[np.ix_(kept, kept)], B[np.ix_(kept, driven)], np.diag(limits[driven] ** -2)
    try:
        P = solve_continuous_are(a, b, np.diag(Q[kept]), r)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ControlError(
            f"{name}: at {model.speeds[i]:.3g} m/s a motion that its actuators do not control is unstable"
        ) from error
    gains = np.zeros((4, n + 4))
    gains[np.ix_(driven, kept)] = np.linalg.solve(r, b.T @ P)
    for k in (1, 2):
        A[k, k] = min(A[k, k], -LEAST_DAMPING)
    return gains, A[1:3]


def course_data(
    models: Sequence[LinearModel], names: Sequence[str], period: float, device: Any = "cpu"
) -> CourseData:
    """Return the numbers of the autopilots of one or more vehicles, with equal numbers of speeds.

    Args:
        models: Linear model of each vehicle.
        names: Names of the vehicles.
        period: Interval between two commands [s].
        device: Warp device.

    Raises:
        ControlError: A vehicle cannot be steered in this way.
    """
    found = [tuned(model, name) for model, name in zip(models, names, strict=True)]
    data = CourseData()

    def stored(rows: Any, dtype: Any) -> Any:
        return wp.array(np.asarray(rows, dtype=np.float32), dtype=dtype, device=device)

    def padded(rows: Array) -> Array:
        return np.pad(rows, [(0, 0)] * (rows.ndim - 1) + [(0, MAX_THRUSTERS - rows.shape[-1])])

    data.first = stored([model.speeds[0] for model in models], float)
    data.spacing = stored([model.speeds[1] - model.speeds[0] for model in models], float)
    data.gains = stored([one.gains for one in found], Row)
    data.slip = stored([one.slip for one in found], Row)
    data.rest = stored([model.rest[:, 1:3] for model in models], wp.vec2)
    data.reach = stored([np.minimum(one.reach, 1e6) for one in found], Wrench4)
    data.slack = stored([SHORT * one.limits for one in found], Wrench4)
    data.hold = stored(
        [
            np.einsum("nc,nc->n", one.columns[:, 0], model.trim)
            for model, one in zip(models, found, strict=True)
        ],
        float,
    )
    data.trim = stored([padded(model.trim) for model in models], vec8)
    data.columns = stored([np.swapaxes(padded(one.columns), 1, 2) for one in found], Wrench4)
    data.share = stored([1.0 - np.exp(-period / one.lag) for one in found], Wrench4)
    data.travel = stored([padded(model.travel) for model in models], vec8)
    rows = []  # relative to the range: the channels have different units
    for model, one in zip(models, found, strict=True):
        for i, trim in enumerate(model.trim):
            low, high = (model.lower - trim) / model.travel, (model.upper - trim) / model.travel
            wrench = model.inertia @ model.B[i, :6] * model.travel
            rows.append((wrench, np.minimum(low, 0.0), np.maximum(high, 0.0), one.weights[i]))
    B, lower, upper, weights = zip(*rows, strict=True)
    data.allocation = allocation_data(B, lower, upper, weights, device=device)
    data.period = period
    return data


class CoursePilot:
    """Autopilot of a vehicle, for one or for a batch of them; its memory is an argument and a result."""

    def __init__(self, model: LinearModel, name: str, period: float) -> None:
        """Tune the autopilot.

        Args:
            model: Linear model of the vehicle.
            name: Name of the vehicle.
            period: Interval between two commands [s].

        Raises:
            ControlError: The vehicle cannot be steered in this way, or the period is not positive.
        """
        if not period > 0.0:
            raise ControlError(f"period is {period}, expected a positive time in seconds")
        self.period, self.model = period, model
        self.data = course_data([model], [name], period)

    def reset(self, n: int = 1) -> Array:
        """Return the initial memory of n vehicles [m, rad s, N, N m, m/s], (n, 11)."""
        memory = np.zeros((n, 11))
        memory[:, 9] = np.nan
        return memory

    def command(
        self,
        memory: Array,
        measured: Measured,
        *,
        speed: npt.ArrayLike,
        course: npt.ArrayLike,
        depth: npt.ArrayLike | None = None,
        pitch: npt.ArrayLike = 0.0,
    ) -> tuple[Array, Array]:
        """Return the channels [N, rad, m³, m], (n, c), and the memory for the next command, (n, 11).

        Args:
            memory: Memory from `reset` or after the previous command [m, rad s, N, N m, m/s], (n, 11).
            measured: The vehicles' states, with n rows.
            speed: Requested surge velocity [m/s], (n,).
            course: Requested course over ground, counter-clockwise from the world's x axis [rad], (n,).
            depth: Requested depth below the surface [m], (n,); None to hold the pitch.
            pitch: Requested pitch, positive bow down [rad], (n,); with a depth, slope of the path.
        """
        q, nu = (np.atleast_2d(np.asarray(x, float)) for x in (measured.quaternion, measured.nu))
        ground = quat_rotate(q, nu[:, :3])
        bow = quat_rotate(q, [1.0, 0.0, 0.0])
        known = (ground[:, :2] * bow[:, :2]).sum(axis=1) >= 0.5 * self.model.speeds[0] * np.hypot(
            *bow[:, :2].T
        )
        way = np.where(known[:, None], ground, bow)
        references = self._references(len(q))
        references["speed"], references["pitch"] = speed, pitch
        references["turn"] = np.asarray(course) - np.arctan2(way[:, 1], way[:, 0])
        if depth is None:
            references["by_pitch"] = 1
        else:
            references["rise"] = -np.asarray(depth, float) - np.atleast_2d(measured.position)[:, 2]
        return self._carry_out(references, measured, memory)

    def act(
        self, memory: Array, measured: Measured, action: npt.ArrayLike, *, by_pitch: bool
    ) -> tuple[Array, Array]:
        """Return channels and memory like `command`, for actions of mode `course` or `course_pitch`.

        Args:
            memory: Memory from `reset` or after the previous command [m, rad s, N, N m, m/s], (n, 11).
            measured: The vehicles' states, with n rows.
            action: Speed, change of course, and dive, as for `reference_of` [-], (n, 3).
            by_pitch: True if the third component is pitch, False if it is depth.
        """
        speed, turn, dive = np.clip(np.atleast_2d(np.asarray(action, float)), -1.0, 1.0).T
        references = self._references(len(speed))
        low, high = self.model.speeds[0], self.model.speeds[-1]
        references["speed"], references["turn"] = low + 0.5 * (1.0 + speed) * (high - low), WIDEST * turn
        references["by_pitch"] = int(by_pitch)
        references["pitch" if by_pitch else "rise"] = STEEPEST * dive if by_pitch else -FARTHEST * dive
        return self._carry_out(references, measured, memory)

    def _references(self, n: int) -> Any:
        struct: Any = CourseReference
        return np.zeros(n, dtype=struct.numpy_dtype())

    def _carry_out(self, references: Any, measured: Measured, memory: Array) -> tuple[Array, Array]:
        q, nu = (np.atleast_2d(np.asarray(x, float)) for x in (measured.quaternion, measured.nu))
        n = len(q)
        rows = ((q, wp.quat), (nu, vec6), (memory, Memory))
        given: list[Any] = [wp.array(x.astype(np.float32), dtype=kind, device="cpu") for x, kind in rows]
        given.insert(0, wp.array(references, dtype=CourseReference, device="cpu"))
        out = [wp.zeros(n, dtype=kind, device="cpu") for kind in (vec8, Memory)]
        wp.launch(steer_rows, n, [*given, self.data, *out], device="cpu")
        channels, after = (array.numpy().astype(float) for array in out)
        return channels[:, : self.model.trim.shape[1]], after
