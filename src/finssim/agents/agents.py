"""Agents: a PID, a policy or a baseline of a task, for any number of vehicles, in a batch or on a robot."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from finssim.agents.controllers import CONTROLLERS, controller_for
from finssim.agents.pid import Pid, PidMemory
from finssim.control.guidance import Goal, Known, Measured, Track
from finssim.control.modes import mode_from_dict
from finssim.control.policy import DESCRIPTION_FILE, Policy
from finssim.core.rotations import (
    cross,
    matrix_to_quat,
    quat_conjugate,
    quat_from_euler,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from finssim.extensions.perception.description import device_of
from finssim.extensions.perception.docking import DISTANCE_SCALE as DOCK_SCALE
from finssim.extensions.perception.docking import CameraDocking, Docking
from finssim.extensions.perception.gate import HALF, Gate
from finssim.extensions.perception.net import RANGE_SCALE, Net
from finssim.extensions.perception.seeing import DEPTH_SCALE
from finssim.extensions.teams.formation import NEAR, Formation
from finssim.extensions.teams.pursuit import DISTANCE_SCALE as CHASE_SCALE
from finssim.extensions.teams.pursuit import PI, DriveNumbers
from finssim.sim import Recorder
from finssim.tasks.environment import Environment, Step
from finssim.tasks.fitting import coefficients_of
from finssim.tasks.moving_target import DISTANCE_SCALE as TARGET_DISTANCE_SCALE
from finssim.tasks.moving_target import TARGET_SCALE
from finssim.tasks.pipeline import Pipeline
from finssim.tasks.station_keeping import DISTANCE_SCALE as STATION_SCALE
from finssim.tasks.task import Task
from finssim.tasks.trajectory_tracking import DISTANCE_SCALE as TRACKING_SCALE
from finssim.tasks.trajectory_tracking import LOOK_AHEAD
from finssim.vehicles import Vehicle, load_vehicle

Array = NDArray[np.float64]
Rows = NDArray[np.float32]
"""Observations or actions, (n, numbers)."""
Mask = NDArray[np.bool_]
Pictures = Mapping[str, NDArray[np.uint8]]
"""Pictures by name, uint8 (n, height, width, channels)."""


# Classical controllers by task: each sees what a policy sees and acts as a policy does.


PERIOD = 0.1
"""Control step of every task [s]."""
LEVEL = (0.0, 0.0, 0.0, 1.0)
"""No rotation, xyzw."""


class Baseline(Protocol):
    """A controller without internal state: its memory is an argument and a result of every call."""

    @property
    def period(self) -> float:
        """Time between two actions [s]."""

    def reset(self, n: int) -> Any:
        """Memory at the start of n episodes: arrays with n rows, in tuples; or None."""

    def act(self, memory: Any, observation: NDArray[Any]) -> tuple[Rows, Any]:
        """Actions (n, size) for observations (n, numbers), in the task's own action mode, and the memory after."""


@dataclass(frozen=True)
class WrenchPid:
    """Base of the baselines with the full-wrench PID of `agents.pid`, whose state is read from the observation."""

    pid: Pid

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD) -> Any:
        """Gains by pole placement for a vehicle and the time between two actions [s]; a batch shows it the present."""
        return cls(Pid.from_vehicle(vehicle, coefficients_of(vehicle), period, least_lag=0.0))

    @property
    def period(self) -> float:
        """Time between two actions [s]."""
        return self.pid.period

    def reset(self, n: int) -> Any:
        """Empty integrals."""
        return self.pid.reset(n)

    def command(self, memory: PidMemory, measured: Measured, goal: Goal) -> tuple[Rows, PidMemory]:
        """Actions (n, 6), as parts of each axis' limit within ±1, and the memory after."""
        tau, memory = self.pid.command(memory, measured, goal)
        return part_of_limits(tau, np.asarray(self.pid.wrench_limits)), memory


def part_of_limits(tau: Array, limits: Array) -> Rows:
    """A wrench as a part of each axis' limit, 0 where there is none, (..., 6).

    Args:
        tau: Wrench, body frame [N, N m], (..., 6).
        limits: Largest of each axis [N, N m], (6,).
    """
    return np.divide(tau, limits, out=np.zeros_like(tau), where=limits > 0.0).astype(np.float32)


class StationPid(WrenchPid):
    """PID of T1. The goal is level, so its own axes have z up: the vehicle's pose in them is all that matters."""

    def act(self, memory: PidMemory, observation: Rows) -> tuple[Rows, PidMemory]:
        """Actions for observations of T1."""
        measured = seen_from_goal(observation)
        here = Goal(np.zeros_like(measured.position), np.broadcast_to(LEVEL, measured.quaternion.shape))
        return self.command(memory, measured, here)


def seen_from_goal(observation: Rows) -> Track:
    """The vehicle in the axes of its goal, from the first 15 numbers of T1's observation."""
    o = np.asarray(observation, float)
    q = turned_from(o)
    return Track(-quat_rotate(q, STATION_SCALE * o[..., :3]), q, o[..., 9:15])


def turned_from(o: Array) -> Array:
    """Body to goal axes, xyzw, (n, 4), from the two columns of the goal's rotation in observations (n, numbers)."""
    x, y = o[..., 3:6], o[..., 6:9]
    # The columns of R_b' R*: the goal's axes in the body. Together with their cross product they are the rotation.
    return quat_conjugate(matrix_to_quat(np.stack([x, y, cross(x, y)], axis=-1)))


class TrackingMemory(NamedTuple):
    """Memory of `TrackingPid`."""

    heading: Array
    """Heading since the start, counted from the yaw rate [rad], (n,)."""
    pid: PidMemory


class TrackingPid(WrenchPid):
    """PID of T2. The observation has no heading, and none is asked for: the vehicle keeps the one it starts with.

    The axes are level, with the vehicle at the origin and x where it pointed at the start, as its yaw rate tells.
    """

    def reset(self, n: int) -> TrackingMemory:
        """Heading zero, empty integrals."""
        return TrackingMemory(np.zeros(n), self.pid.reset(n))

    def act(self, memory: TrackingMemory, observation: Rows) -> tuple[Rows, TrackingMemory]:
        """Actions for observations of T2."""
        o = np.asarray(observation, float)
        up, nu = o[..., 21:24], o[..., 15:21]
        q = attitude_from(up, memory.heading)
        offsets = [TRACKING_SCALE * o[..., 3 * i : 3 * i + 3] for i in range(3)]
        goal = Goal(
            quat_rotate(q, offsets[0]),
            quat_from_yaw(np.zeros(len(o))),
            quat_rotate(q, o[..., 12:15]),
            quat_rotate(q, acceleration_ahead(offsets, o[..., 12:15])),
        )
        action, pid = self.command(memory.pid, Track(np.zeros_like(up), q, nu), goal)
        return action, TrackingMemory(memory.heading + self.period * heading_rate(up, nu), pid)


class TargetPid(TrackingPid):
    """PID of T3 with the target's velocity fed forward. The observation has no attitude: it is taken to be level.

    The heading is the one at the start, as the yaw rate tells; roll and pitch are left to the water and their rates.
    """

    def act(self, memory: TrackingMemory, observation: Rows) -> tuple[Rows, TrackingMemory]:
        """Actions for observations of T3."""
        o = np.asarray(observation, float)
        q, nu = quat_from_yaw(memory.heading), o[..., 6:12]
        goal = Goal(
            quat_rotate(q, TARGET_DISTANCE_SCALE * o[..., :3]),
            quat_from_yaw(np.zeros(len(o))),
            quat_rotate(q, TARGET_SCALE * o[..., 3:6]),
        )
        action, pid = self.command(memory.pid, Track(np.zeros((len(o), 3)), q, nu), goal)
        return action, TrackingMemory(memory.heading + self.period * nu[..., 5], pid)


def attitude_from(up: Array, heading: Array) -> Array:
    """Body to level axes, xyzw, (n, 4), from the world's up in the body, (n, 3), and a heading [rad], (n,)."""
    roll = np.arctan2(up[..., 1], up[..., 2])
    pitch = np.arctan2(-up[..., 0], np.hypot(up[..., 1], up[..., 2]))
    return quat_from_euler(roll, pitch, heading)


def heading_rate(up: Array, nu: Array) -> Array:
    """(q sin φ + r cos φ) / cos θ, with up = [-sin θ, cos θ sin φ, cos θ cos φ].

    Args:
        up: World's up in the body frame [-], (n, 3).
        nu: Twist, body frame [m/s, rad/s], (n, 6).

    Returns:
        [rad/s], (n,).
    """
    level = np.maximum(up[..., 1] ** 2 + up[..., 2] ** 2, 1e-6)
    return np.asarray((nu[..., 4] * up[..., 1] + nu[..., 5] * up[..., 2]) / level)


def acceleration_ahead(offsets: list[Array], velocity: Array) -> Array:
    """Acceleration of a reference from where it is now, one and two `LOOK_AHEAD` later, and its velocity.

    p(k) - p(0) = v k + a k²/2 + j k³/6; of k and 2k together the jerk j falls out.

    Args:
        offsets: Way to the reference at the three times, in one frame [m], (n, 3) each.
        velocity: Of the reference, same frame [m/s], (n, 3).

    Returns:
        Same frame [m/s²], (n, 3).
    """
    near, far = offsets[1] - offsets[0], offsets[2] - offsets[0]
    return np.asarray((8.0 * near - far - 6.0 * LOOK_AHEAD * velocity) / (2.0 * LOOK_AHEAD**2))


# Lead pursuit: a baseline of 1-v-1 pursuit that steers to where the prey will be.


@dataclass(frozen=True, kw_only=True)
class DriveBaseline:
    """Base of the baselines that steer by a vehicle's thrust and drag; it remembers nothing, and acts by wrench4."""

    drive: DriveNumbers
    period: float = PERIOD
    turn_first: float = math.inf
    """A heading error above this is turned away before anything else [rad]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> Any:
        """Return the baseline with the numbers of a vehicle."""
        return cls(drive=DriveNumbers.of(vehicle))

    def reset(self, n: int) -> None:
        """It remembers nothing."""
        return None

    def act(self, memory: None, observation: Rows) -> tuple[Rows, None]:
        """Actions for observations, (n, numbers)."""
        o = np.asarray(observation, dtype=float)
        target, turn = self.wanted(o)
        velocity = np.column_stack([o[:, 0:3], o[:, 5]])
        action = self.drive.action(velocity, np.column_stack([target, self.drive.turned(turn)]))
        action[np.abs(turn) > self.turn_first, :2] = 0.0
        return action, None

    def wanted(self, o: Array) -> tuple[Array, Array]:
        """Velocity of the body, body frame [m/s], (n, 3), and the heading error to turn away [rad], (n,)."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class LeadPursuit(DriveBaseline):
    """Point at where the prey will be, turn first while that is far to the side, then come up and keep its speed.

    The point aimed at lies `lead` seconds ahead of the prey. Closing in, the speed wanted is the prey's plus
    `approach` times the way that is left to `stand_off`, so that the relative speed vanishes there.
    """

    lead: float = 0.30
    """[s]"""
    turn_first: float = math.radians(15.0)
    approach: float = 0.5
    """[1/s]"""
    stand_off: float = 0.5
    """Distance that is gone to [m]."""

    def wanted(self, o: Array) -> tuple[Array, Array]:
        """See `DriveBaseline`."""
        velocity, gap, relative = o[:, 0:3], CHASE_SCALE * o[:, 6:9], o[:, 9:12]
        aim = gap + self.lead * relative
        distance = np.maximum(np.linalg.norm(gap, axis=1, keepdims=True), 1e-6)
        target = velocity + relative + self.approach * (distance - self.stand_off) * aim / distance
        top = np.array([self.drive.top, *self.drive.terminal[1:3]])
        return np.clip(target, -top, top), np.arctan2(aim[:, 1], aim[:, 0])


# The classical controller of formation keeping: a consensus on the shape, and a state machine for where to go.


@dataclass(frozen=True, kw_only=True)
class ConsensusFormation(DriveBaseline):
    """Each agent pulls its edges to equal sides and its height to the others', and adds what the state asks for.

    gather, while an edge is off by more than `loose`: the shape alone. approach: the net's middle goes to the target.
    carry, while the net has the target: on to the goal, with the target kept in the middle. Which state it is follows
    from the observation alone, so that all three agree without a word, as far as they see the same.
    """

    side: float
    """Side of the net [m]."""
    reach: float
    """Distance from the net within which it has the target [m]."""
    shape: float = 0.6
    """Speed per error of an edge or of the height [1/s]."""
    go: float = 0.4
    """Speed per distance [1/s]."""
    cruise: float = 0.5
    """Largest speed of the net's middle, as a part of the vehicle's slowest steady speed."""
    loose: float = 0.15
    """[sides]"""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> ConsensusFormation:
        """Return the baseline with the numbers of a vehicle, for the net that three of them carry by default."""
        task = Formation().fitted([vehicle])
        return cls(drive=DriveNumbers.of(vehicle), side=task.side, reach=task.reach)

    def wanted(self, o: Array) -> tuple[Array, Array]:
        """See `DriveBaseline`; of observations (n, 34)."""
        mates = CHASE_SCALE * np.stack([o[:, 14:17], o[:, 20:23]], axis=1)
        return self.shaping(mates) + self.going(o, mates.sum(axis=1) / 3.0), PI * o[:, 13]

    def shaping(self, mates: Array) -> Array:
        """Velocity towards equal sides and equal heights, from the team-mates' places, (n, 2, 3)."""
        length = np.maximum(np.linalg.norm(mates, axis=2, keepdims=True), 1e-6)
        pull = np.sum((length - self.side) * mates / length, axis=1)
        pull[:, 2] = mates[:, :, 2].sum(axis=1)
        return np.asarray(self.shape * pull)

    def going(self, o: Array, middle: Array) -> Array:
        """Velocity of the net's middle, from the observation and from where the middle is."""
        target, goal = NEAR * o[:, 6:9], NEAR * o[:, 26:29]
        has = (NEAR * o[:, 32] <= self.reach) & (o[:, 33] >= 0.0)
        way = np.where(has[:, None], goal - target + 0.5 * (target - middle), target - middle)
        speed = self.go * np.linalg.norm(way, axis=1, keepdims=True)
        top = self.cruise * min(self.drive.top, *self.drive.terminal[1:3])
        going = self.go * way * np.minimum(1.0, top / np.maximum(speed, 1e-6))
        loose = np.abs(o[:, 29:32]).max(axis=1) > self.loose
        return np.asarray(np.where(loose[:, None], 0.0, going))


# The formation baseline of 3-v-1 pursuit: netters abreast of the prey, herder behind it.


def level_unit(x: Array) -> Array:
    """Level directions of vectors (n, 3); zero where there is none."""
    level = x * np.array([1.0, 1.0, 0.0])
    length = np.linalg.norm(level, axis=1, keepdims=True)
    return level / np.maximum(length, 1e-6)


@dataclass(frozen=True, kw_only=True)
class FormationPursuit(DriveBaseline):
    """Each agent goes to its place relative to the prey, from its own observation and with the prey's velocity added.

    The way ahead leads from the herder through the prey. Netters stand `forward` ahead of the prey and half of
    `spacing` to either side of the way, so that the net lies across it; the herder stays `behind`. Published with 6, 2
    and 3 m for vehicles twelve times as fast; here 0.4 times that.
    """

    spacing: float = 2.4
    forward: float = 0.8
    behind: float = 1.2
    gain: float = 0.6
    """Speed per distance to one's place [1/s]."""

    def places(self, observation: Array) -> Array:
        """Return the place of each agent relative to itself, body frame [m], (n, 3); one row per agent."""
        prey = CHASE_SCALE * observation[:, 6:9]
        mates = CHASE_SCALE * np.stack([observation[:, 16:19], observation[:, 24:27]], axis=1)
        herds = observation[:, [14, 22]]
        herder = herds.max(axis=1) < 0.5
        ahead = level_unit(prey - np.einsum("nm,nmk->nk", herds, mates))
        across = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))])
        other = np.einsum("nm,nmk->nk", 1.0 - herds, mates)
        # Of two netters the one farther to the left of the way takes the left place.
        side = np.where(np.sum(other * across, axis=1) < 0.0, 1.0, -1.0)[:, None]
        netter = prey + self.forward * ahead + 0.5 * self.spacing * side * across
        drives = level_unit(0.5 * mates.sum(axis=1) - prey)
        return np.asarray(np.where(herder[:, None], prey - self.behind * drives, netter))

    def wanted(self, o: Array) -> tuple[Array, Array]:
        """See `DriveBaseline`; of observations (n, 30)."""
        target = o[:, 0:3] + o[:, 9:12] + self.gain * self.places(o)
        # Faster than the vehicle goes is the same direction as fast as it goes.
        level = np.maximum(np.linalg.norm(target[:, :2], axis=1, keepdims=True) / self.drive.top, 1.0)
        target[:, :2] /= level
        target[:, 2] = np.clip(target[:, 2], -self.drive.terminal[2], self.drive.terminal[2])
        moving = np.linalg.norm(target[:, :2], axis=1) > 0.05
        return target, np.where(moving, np.arctan2(target[:, 1], target[:, 0]), 0.0)


# The classical way into a dock: come before its mouth, turn to it, and go in as far as the nose is on the axis.


@dataclass(frozen=True)
class DockingPid(WrenchPid):
    """A PID whose goal runs ahead of the nose, along the dock's axis, while nose and heading are right.

    In dock axes. Beside the axis, or turned away, the goal is the waiting place before the mouth; there is no switch
    between the two: the goal moves with how right it is.
    """

    nose: float
    """Distance of the vehicle's nose from its origin [m]."""
    berth: float
    """Final place of the nose, along the axis [m]."""
    wait: float
    """Place where the nose waits until it is aligned, along the axis [m]."""
    gap: float
    """Greatest distance of the nose from the axis in the tube [m]; towards the mouth it grows by `slope`."""
    slope: float
    lead: float
    """Distance of the goal ahead of the nose [m], which sets the speed."""
    turn: float = np.radians(15.0)
    """Greatest angle away from the axis [rad]."""

    @classmethod
    def for_vehicle(
        cls,
        vehicle: Vehicle,
        period: float = PERIOD,
        task: Docking | None = None,
        lead: float = 0.25,
        **more: Any,
    ) -> Any:
        """For a vehicle and its dock.

        Args:
            vehicle: Its file.
            period: Time between two actions [s].
            task: Whose dock it is; None: that of `Docking`.
            lead: How far the goal runs ahead of the nose, in lengths of the vehicle.
            more: Further fields.
        """
        task = (task or Docking()).fitted([vehicle])
        dock, hull = task.dock(), task.hull
        return cls(
            WrenchPid.for_vehicle(vehicle, period).pid,
            nose=0.5 * hull.length,
            berth=task.berth * dock.tube_length,
            wait=-dock.cone_length - 0.5 * hull.length,
            gap=dock.throat_radius - hull.girth,
            slope=0.5 * np.tan(task.cone),
            lead=lead * hull.length,
            **more,
        )

    def act(self, memory: PidMemory, observation: Rows) -> tuple[Rows, PidMemory]:
        """Actions for observations of docking."""
        o = np.asarray(observation, float)
        return self.steer(memory, DOCK_SCALE * o[..., 15:18], turned_from(o), o[..., 9:15])

    def steer(self, memory: PidMemory, nose: Array, q: Array, nu: Array) -> tuple[Rows, PidMemory]:
        """Actions for where the nose is.

        Args:
            memory: Of the PID.
            nose: From the throat, dock axes [m], (n, 3).
            q: Body to dock axes, xyzw, (n, 4).
            nu: Twist, body frame [m/s, rad/s], (n, 6).
        """
        arm = np.array([self.nose, 0.0, 0.0])
        aim = np.zeros_like(nose)
        aim[..., 0] = self._ahead(nose, quat_rotate(q, [1.0, 0.0, 0.0]))
        level = np.broadcast_to(LEVEL, q.shape)
        track = Track(nose - quat_rotate(q, arm), q, nu)
        return self.command(memory, track, Goal(aim - arm, level))

    def _ahead(self, nose: Array, forward: Array) -> Array:
        """Return the nose's next place on the axis [m], (n,), from its position and direction, dock axes, (n, 3)."""
        aside = np.hypot(nose[..., 1], nose[..., 2])
        allowed = self.gap + self.slope * np.maximum(-nose[..., 0], 0.0)
        turned = np.arccos(np.clip(forward[..., 0], -1.0, 1.0))
        right = np.clip(2.0 - np.maximum(aside / allowed, turned / self.turn), 0.0, 1.0)
        onward = np.minimum(nose[..., 0] + self.lead, self.berth)
        return np.asarray(self.wait + right * (np.maximum(onward, self.wait) - self.wait))


# Docking by camera the classical way: find the guide lights by their colours, measure the dock by them, and go in.


def camera_of(vehicle: Vehicle, task: Task) -> dict[str, Any]:
    """Return the camera of a task: focal length as a share of its width, and position, body axes [m]."""
    device = device_of(vehicle, task.pictures[0].name)
    return {"focal_share": device.focal_length / device.width, "eye": tuple(device.mount.position.tolist())}


class SightMemory(NamedTuple):
    """Memory of `LightServo`; the axes are level, at the start, with x in the vehicle's initial direction."""

    position: Array
    """Position of the body origin, by its velocity and depth [m], (n, 3)."""
    heading: Array
    """[rad], (n,)."""
    dock: Array
    """Its throat [m] and heading [rad] as far as known, (n, 4)."""
    looks: Array
    """Pictures that it is the mean of, (n,)."""
    pid: PidMemory


@dataclass(frozen=True)
class LightServo(DockingPid):
    """`DockingPid` towards a dock whose pose comes from the four guide lights in the picture.

    The upper two are white, the lower two red, in the corners of an upright square of known side. The height of each
    pair in the picture gives its distance, their middle the bearing, the difference of the distances the dock's
    heading. A picture counts where all four are in it; the estimate is the mean of the last dozen, and between them,
    and in the funnel, the vehicle dead-reckons by its velocity.
    """

    focal_share: float = 0.0
    """Focal length as a share of the picture's width."""
    eye: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the camera, body axes [m]."""
    side: float = 1.16
    """Side of the square of lights [m]."""
    before: float = 0.78
    """Distance of the square before the throat [m]."""
    first: float = 2.8
    """Assumed distance of the dock until it has been found [m]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD, **more: Any) -> Any:
        """For a vehicle with a `front_camera`, the dock of the site `dock`, and the time between two actions [s]."""
        task = CameraDocking()
        return super().for_vehicle(vehicle, period, task, lead=0.4, **camera_of(vehicle, task))

    def reset(self, n: int) -> SightMemory:
        """A dock straight ahead, unseen."""
        dock = np.tile([self.first, 0.0, 0.0, 0.0], (n, 1))
        return SightMemory(np.zeros((n, 3)), np.zeros(n), dock, np.zeros(n), self.pid.reset(n))

    def act(self, memory: SightMemory, observation: Rows, pictures: Pictures) -> tuple[Rows, SightMemory]:  # type: ignore[override]
        """Actions for observations and pictures of docking by camera."""
        o = np.asarray(observation, float)
        up, nu, depth = o[:, :3], o[:, 3:9], DEPTH_SCALE * o[:, 9]
        q, position = attitude_from(up, memory.heading), memory.position.copy()
        position[:, 2] = -depth
        fresh = memory.looks == 0.0
        dock = memory.dock.copy()
        dock[fresh, 2] = position[fresh, 2]
        bearing, heading, visible = self.measure(next(iter(pictures.values())), up)
        measured_dock = np.column_stack(
            [position + quat_rotate(q, bearing + self.eye), memory.heading + heading]
        )
        count = memory.looks + visible
        share = np.where(visible, 1.0 / np.clip(count, 1.0, 12.0), 0.0)[:, None]
        dock += share * np.where(visible[:, None], measured_dock - dock, 0.0)
        q_dock = quat_from_yaw(dock[:, 3])
        throat = dock[:, :3] + quat_rotate(q_dock, [self.before, 0.0, 0.0]) * (count > 0.0)[:, None]
        nose = position + quat_rotate(q, [self.nose, 0.0, 0.0]) - throat
        own = quat_multiply(quat_conjugate(q_dock), q)
        action, pid = self.steer(memory.pid, quat_rotate(quat_conjugate(q_dock), nose), own, nu)
        moved = position + self.period * quat_rotate(q, nu[:, :3])
        turned = memory.heading + self.period * heading_rate(up, nu)
        return action, SightMemory(moved, turned, dock, count, pid)

    def measure(self, picture: NDArray[np.uint8], up: Array) -> tuple[Array, Array, Mask]:
        """The square of lights in pictures.

        Args:
            picture: uint8 (n, height, width, 3).
            up: World's up in the body [-], (n, 3).

        Returns:
            Its middle from the camera, body frame [m], (n, 3); its heading from the vehicle's [rad], (n,); where all
            four lights are in the picture, (n,).
        """
        red, green, blue = np.moveaxis(picture.astype(float), -1, 0)
        rows, columns = np.mgrid[: red.shape[1], : red.shape[2]]
        lamps = {"white": np.minimum(np.minimum(red, green), blue) > 235.0}
        lamps["red"] = (red > 200.0) & (red - np.maximum(green, blue) > 50.0)
        corners, visible = [], np.ones(len(red), bool)
        for lit in lamps.values():
            count = np.maximum(lit.sum((1, 2)), 1)
            middle = (lit * columns).sum((1, 2)) / count
            for side in (columns < middle[:, None, None], columns > middle[:, None, None]):
                of_side = lit & side
                number = np.maximum(of_side.sum((1, 2)), 1)
                corners.append([(of_side * grid).sum((1, 2)) / number for grid in (columns, rows)])
                visible &= of_side.any((1, 2))
        return self.locate(np.array(corners), visible, red.shape[1:])

    def locate(self, corners: Array, visible: Mask, shape: Sequence[int]) -> tuple[Array, Array, Mask]:
        """The upright square in space.

        Args:
            corners: Column and row of its upper left, upper right, lower left and lower right corner [px], (4, 2, n).
            visible: Where all four are in the picture, (n,).
            shape: Height and width of the picture [px].

        Returns:
            As `measure`.
        """
        x, y = np.moveaxis(corners, 1, 0)
        focal = self.focal_share * shape[1]
        y0, right = (focal * self.side / np.maximum(y[i + 2] - y[i], 0.5) for i in (0, 1))
        visible = visible & (y[2] - y[0] > 3.0) & (y[3] - y[1] > 3.0) & (x[1] - x[0] > 3.0)
        ahead = 0.5 * (y0 + right)
        aside = (0.5 * (shape[1] - 1) - x.mean(0)) / focal
        above = (0.5 * (shape[0] - 1) - y.mean(0)) / focal
        heading = np.arcsin(np.clip((right - y0) / self.side, -0.7, 0.7))
        return ahead[:, None] * np.column_stack([np.ones_like(aside), aside, above]), heading, visible


# Passing a gate the classical way: its posts are what is redder and greener than the rest of a row, in one column.


@dataclass(frozen=True)
class PostServo(LightServo):
    """`LightServo` through a gate, whose posts are the sides of the upright square: the left red, the right green.

    A post is the column with the most of its colour above the median of each row; where both are in the picture from
    head to foot their lengths give distance and heading.
    """

    side: float = 1.5
    before: float = 0.0
    least: float = 60.0
    """Levels of its colour that a post has in its column, all rows together."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD, **more: Any) -> PostServo:
        """For a vehicle with a `front_camera`, the gate of the site `gate`, and the time between two actions [s]."""
        task = Gate().fitted([vehicle])
        length = task.hull.length
        return cls(
            WrenchPid.for_vehicle(vehicle, period).pid,
            nose=0.5 * length,
            berth=2.0 * length,
            wait=-2.0 * length,
            gap=0.4 * float(HALF),
            slope=0.5,
            lead=0.6 * length,
            **camera_of(vehicle, task),
        )

    def measure(self, picture: NDArray[np.uint8], up: Array) -> tuple[Array, Array, Mask]:
        """The square between the posts; see `LightServo`."""
        red, green, blue = np.moveaxis(picture.astype(float), -1, 0)
        n, height, width = red.shape
        ends, visible = [], np.ones(n, bool)
        for post in (red - np.maximum(green, blue), green - np.maximum(red, blue)):
            post = post - np.median(post, axis=2, keepdims=True)
            post = np.maximum(post - 2.0 * np.median(np.abs(post), axis=(1, 2), keepdims=True), 0.0)
            best = np.clip(post.sum(1).argmax(1), 1, width - 2)
            near = best[:, None] + np.arange(-1, 2)
            strip = np.take_along_axis(post, near[:, None], 2)  # three columns around the post
            share = strip.sum(1)
            total, profile = share.sum(1), strip.sum(2)
            lit = profile > 0.3 * profile.max(1, keepdims=True)
            top, foot = lit.argmax(1), height - 1 - lit[:, ::-1].argmax(1)
            visible &= (total > self.least) & (top > 0) & (foot < height - 1)
            column = (share * near).sum(1) / np.maximum(total, 1e-9)
            ends.append([[column, top - 0.5], [column, foot + 0.5]])
        (first, right) = ends
        return self.locate(np.array([first[0], right[0], first[1], right[1]]), visible, (height, width))


# Following a pipeline the classical way: a line through what is yellower than its surroundings, and steer along it.


@dataclass(frozen=True, kw_only=True)
class LineFollower(DriveBaseline):
    """Fits a line over the bottom to the yellow pixels of the picture, and steers to it and along it.

    Yellow is (red + green)/2 - blue above the median of a picture's row. A row below the horizon looks at the bottom at
    one distance, which the pipe's charted depth tells; a straight line is fitted to all rows, weighted by the square of
    the yellow, and its estimate is followed where a picture shows too little.
    """

    cruise: float
    """[m/s]"""
    charted: float
    """Depth of the pipe's axis [m]."""
    height: float
    """Above it [m]."""
    focal_share: float
    """Focal length as a share of the picture's width."""
    eye: tuple[float, float, float]
    """Position of the camera, body axes [m]."""
    least: float = 60.0
    """Squared numbers of yellow, summed over a picture, below which it shows too little."""
    gain: float = 0.5
    """Speed to the side and down per distance [1/s]."""
    memory_share: float = 0.8
    """Share of the line before, in the next estimate."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> LineFollower:
        """For a vehicle with a `front_camera`, and the site `pipeline`."""
        task = Pipeline().fitted([vehicle])
        return cls(
            drive=DriveNumbers.of(vehicle), cruise=task.cruise, charted=-task.bottom, height=task.height,
            **camera_of(vehicle, task),
        )  # fmt: skip

    def reset(self, n: int) -> Array:  # type: ignore[override]
        """The line straight below and ahead, (n, 2)."""
        return np.zeros((n, 2))

    def act(self, memory: Array, observation: Rows, pictures: Pictures) -> tuple[Rows, Array]:  # type: ignore[override]
        """Actions for observations and pictures of following a pipeline."""
        o = np.asarray(observation, float)
        depth = DEPTH_SCALE * o[:, 9]
        line, enough = self.line(next(iter(pictures.values())), o[:, :3], self.charted - depth)
        share = np.where(enough, 1.0 - self.memory_share, 0.0)[:, None]
        line = memory + share * (line - memory)
        turn = np.arctan(line[:, 1] + 0.5 * line[:, 0])
        target = np.column_stack(
            [
                self.cruise * np.clip(1.5 - 1.5 * np.abs(turn), 0.2, 1.0),
                np.clip(self.gain * line[:, 0], -0.1, 0.1),
                np.clip(self.gain * (depth - self.charted + self.height), -0.1, 0.1),
                self.drive.turned(turn),
            ]
        )
        return self.drive.action(o[:, [3, 4, 5, 8]], target), line

    def line(self, picture: NDArray[np.uint8], up: Array, above: Array) -> tuple[Array, Mask]:
        """The pipe in pictures.

        Args:
            picture: uint8 (n, height, width, 3).
            up: World's up in the body [-], (n, 3).
            above: Height of the body origin above the pipe's axis [m], (n,).

        Returns:
            How far it lies to the left below the vehicle [m], and its slope to the left, (n, 2); where there is enough
            of it in the picture, (n,).
        """
        red, green, blue = np.moveaxis(picture.astype(float), -1, 0)
        yellow = 0.5 * (red + green) - blue
        yellow -= np.median(yellow, axis=2, keepdims=True)
        height, width = yellow.shape[1:]
        focal = self.focal_share * width
        down = (np.arange(height) - 0.5 * (height - 1)) / focal
        fall = down + up[:, :1]  # of a row's rays per metre ahead, pitched by the vehicle
        ahead = np.where(fall > 0.15, (above + self.eye[2])[:, None] / np.maximum(fall, 0.15), 0.0)
        aside = ahead[:, :, None] * (0.5 * (width - 1) - np.arange(width)) / focal
        noise = 1.5 * np.median(np.abs(yellow), axis=(1, 2), keepdims=True)
        weight = np.maximum(yellow - noise, 0.0) ** 2 * ((ahead > 0.0) & (ahead < 5.0))[:, :, None]
        total = np.maximum(weight.sum((1, 2)), 1e-9)
        x = np.broadcast_to(ahead[:, :, None] + self.eye[0], weight.shape)
        mean_x, mean_y = (weight * x).sum((1, 2)) / total, (weight * aside).sum((1, 2)) / total
        dx = x - mean_x[:, None, None]
        slope = (weight * dx * aside).sum((1, 2)) / np.maximum((weight * dx * dx).sum((1, 2)), 1e-9)
        slope = np.clip(slope, -1.0, 1.0)
        return np.column_stack([mean_y - slope * mean_x, slope]), total > self.least


# Along a net the classical way: straight sides through the loudest echoes, and the altimeter for the height.


class Side(NamedTuple):
    """A straight side of a net, as a ping shows it, in the plane of the body's x and y axes."""

    angle: Array
    """Angle of its normal, away from the vehicle [rad], (n,)."""
    distance: Array
    """Along that, of its straight line [m], (n,)."""
    right: Array
    """Along the line to the left from the point nearest to the vehicle: where it begins [m], (n,), ..."""
    left: Array
    """... and where it ends."""

    @property
    def nearest(self) -> Array:
        """Its point nearest to the vehicle [m], (n, 2)."""
        along = np.where(self.right < self.left, np.clip(0.0, self.right - 0.1, self.left + 0.1), 0.0)
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.column_stack([self.distance * c - along * s, self.distance * s + along * c])

    def meets(self, other: Side, reach: float) -> Mask:
        """Return whether the two lines cross within a distance beyond an end of each [m], at 3° to 40°, (n,)."""
        turn = other.angle - self.angle
        sine = np.where(np.abs(turn) < 0.05, 1.0, np.sin(turn))
        beyond = np.zeros_like(turn)
        for side, far, sign in ((self, other, -1.0), (other, self, 1.0)):
            along = sign * (side.distance * np.cos(turn) - far.distance) / sine
            gap = np.minimum(np.abs(along - side.right), np.abs(along - side.left))
            beyond = np.maximum(beyond, gap)
        return (np.abs(turn) > 0.05) & (np.abs(turn) < 0.7) & (beyond < reach)


@dataclass(frozen=True, kw_only=True)
class WallFollower(DriveBaseline):
    """Finds the net's sides among the two loudest echoes of each beam, faces its nearest point and goes to the left.

    The side on which most echoes lie is the one with the most votes of a Hough transform, refined by least squares with
    less weight on what is far off it, as fish are. Of what is left, a second and a third side are found likewise, and
    believed where they meet the first near its end and theirs. The altimeter hears the tube at the net's foot, whose
    slant range and the distance give the height; a range that does not fit is left out.
    """

    speed: float
    """Along the net [m/s]."""
    distance: float
    """Distance from the net [m]."""
    height: float
    """Above its foot [m]."""
    sector: float
    """Sector of the sonar [rad]."""
    bin_length: float
    """[m]"""
    eye: tuple[float, float, float]
    """Position of the sonar, body axes [m]."""
    under: float
    """Distance of the altimeter below the body origin [m]."""
    least: float = 60.0
    """Level of an echo in the picture that counts."""
    behind: float = 0.03
    """The loudest echo of twine comes from so far behind the net's plane, from above or below the beam's middle [m]."""
    echoes: int = 12
    """Least number of echoes on a side for it to be used."""
    reach: float = 0.45
    """Sides that meet do so at most this beyond the last echo on each [m]."""
    tube: float = 0.14
    """Radius of the tube at the net's foot [m]."""
    gain: float = 0.5
    """Speed per distance [1/s]."""
    integral: float = 0.3
    """Integral gain of the error of the speed over ground [1/s], which compensates a stream."""
    jump: float = 0.25
    """Distance and heading change by less from ping to ping [m, rad]."""
    memory_share: float = 0.5
    """Share of distance and heading before, in the next estimate."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> WallFollower:
        """For a vehicle with `sonar` and `altimeter`, and the site `net`."""
        task = Net()
        sonar: Any = task.pictures[0].device(vehicle)
        altimeter = device_of(vehicle, task.ranges[0])
        return cls(
            drive=DriveNumbers.of(vehicle), speed=task.speed, distance=task.distance, height=task.height,
            sector=sonar.sector, bin_length=sonar.range / sonar.bins, eye=tuple(sonar.mount.position.tolist()),
            under=-float(altimeter.mount.position[2]),
        )  # fmt: skip

    def reset(self, n: int) -> Array:  # type: ignore[override]
        """The net square ahead at its distance, and no integral of the speeds along x, y, z, (n, 5)."""
        return np.tile([self.distance, 0.0, 0.0, 0.0, 0.0], (n, 1))

    def act(self, memory: Array, observation: Rows, pictures: Pictures) -> tuple[Rows, Array]:  # type: ignore[override]
        """Actions for observations and pictures of inspecting a net."""
        o = np.asarray(observation, float)
        point, enough = self.nearest(next(iter(pictures.values())), memory[:, 0])
        measured = np.column_stack([np.hypot(point[:, 0], point[:, 1]), np.arctan2(point[:, 1], point[:, 0])])
        share = np.where(enough, 1.0 - self.memory_share, 0.0)[:, None]
        line = memory[:, :2] + share * np.clip(measured - memory[:, :2], -self.jump, self.jump)
        away, turn = line.T
        slant = self.height + RANGE_SCALE * o[:, 9] + self.tube
        above = np.sqrt(np.maximum(slant**2 - away**2, 0.0)) + self.under - self.height
        towards = np.clip(self.gain * (away - self.distance), -0.15, 0.15)
        target = np.column_stack(
            [
                towards * np.cos(turn) - self.speed * np.sin(turn),
                towards * np.sin(turn) + self.speed * np.cos(turn),
                np.where(np.abs(above) < 1.0, np.clip(-self.gain * above, -0.1, 0.1), 0.0),
                self.drive.turned(turn),
            ]
        )
        lag = memory[:, 2:] + self.period * self.integral * (target[:, :3] - o[:, 3:6])
        lag = np.clip(lag, -self.speed, self.speed)
        target[:, :3] += lag
        return self.drive.action(o[:, [3, 4, 5, 8]], target), np.column_stack([line, lag])

    def nearest(self, picture: NDArray[np.uint8], before: Array) -> tuple[Array, Mask]:
        """The net in pings.

        Args:
            picture: uint8 (n, beams, range cells, 1).
            before: Its distance before [m], (n,).

        Returns:
            Its nearest point, from the body origin along x and y [m], (n, 2); where there is one, (n,).
        """
        levels = picture[..., 0].astype(float)
        count, cells = levels.shape[1:]
        azimuth = self.sector * (0.5 - (np.arange(count) + 0.5) / count)
        rows = []
        for _ in range(2):
            cell = levels.argmax(2)
            r = (cell + 0.5) * self.bin_length - self.behind
            weight = r * (
                levels.max(2) >= self.least
            )  # the way along a side from beam to beam grows with the range
            rows.append((r * np.cos(azimuth) + self.eye[0], r * np.sin(azimuth), weight))
            levels = np.where(np.abs(np.arange(cells) - cell[..., None]) <= 3, 0.0, levels)
        x, y, weight = (np.concatenate(parts, 1) for parts in zip(*rows, strict=True))
        first, on = self.side(x, y, weight)
        point, found = first.nearest, on.sum(1) >= self.echoes
        for _ in range(2):
            weight = np.where(on, 0.0, weight)
            other, on = self.side(x, y, weight)
            away = np.hypot(*other.nearest.T)
            likely = (away < np.hypot(*point.T)) & (np.abs(away - before) < self.jump)
            use = likely & (on.sum(1) >= self.echoes) & first.meets(other, self.reach)
            point = np.where(use[:, None], other.nearest, point)
        return point, found

    def side(self, x: Array, y: Array, weight: Array) -> tuple[Side, Mask]:
        """The straight side on which the greatest weight lies, and which points lie on it.

        Args:
            x: Of the points, from the body origin [m], (n, points).
            y: Likewise.
            weight: Likewise [-].
        """
        n, angles, step, rows = len(x), np.radians(np.arange(-48.0, 49.0, 3.0)), 0.05, 80
        distance = x[..., None] * np.cos(angles) + y[..., None] * np.sin(angles)
        row = np.clip(distance / step, 0, rows - 1).astype(int)
        index = (np.arange(n)[:, None, None] * len(angles) + np.arange(len(angles))) * rows + row
        votes = np.bincount(
            index.ravel(), np.broadcast_to(weight[..., None], row.shape).ravel(), n * len(angles) * rows
        ).reshape(n, len(angles), rows)
        votes[..., 1:-1] = votes[..., :-2] + votes[..., 1:-1] + votes[..., 2:]
        best = votes.reshape(n, -1).argmax(1)
        angle, distance = angles[best // rows], (best % rows + 0.5) * step
        for width in (0.15, 0.1, 0.1):
            off = x * np.cos(angle)[:, None] + y * np.sin(angle)[:, None] - distance[:, None]
            w = weight * np.maximum(1.0 - (off / width) ** 2, 0.0) ** 2
            total = np.maximum(w.sum(1), 1e-9)
            mean_x, mean_y = (w * x).sum(1) / total, (w * y).sum(1) / total
            dx, dy = x - mean_x[:, None], y - mean_y[:, None]
            spread = (w * (dx * dx - dy * dy)).sum(1)
            angle = 0.5 * np.arctan2(-2.0 * (w * dx * dy).sum(1), -spread)  # of the normal
            distance = mean_x * np.cos(angle) + mean_y * np.sin(angle)
        off = x * np.cos(angle)[:, None] + y * np.sin(angle)[:, None] - distance[:, None]
        on = (np.abs(off) < 0.12) & (weight > 0.0)
        along = y * np.cos(angle)[:, None] - x * np.sin(angle)[:, None]
        right = np.sort(np.where(on, along, np.inf), 1)[:, 3]  # not the last: one fish may lie on the line
        left = -np.sort(np.where(on, -along, np.inf), 1)[:, 3]
        return Side(angle, distance, right, left), on


class BaselineError(ValueError):
    """A baseline that does not exist."""


BASELINES: dict[str, dict[str, Callable[..., Baseline]]] = {
    "t1": {"pid": StationPid.for_vehicle},
    "t2": {"pid": TrackingPid.for_vehicle},
    "t3": {"pid": TargetPid.for_vehicle},
    "docking": {"align-insert": DockingPid.for_vehicle},
    "camera-docking": {"light-servo": LightServo.for_vehicle},
    "pipeline": {"line-follower": LineFollower.for_vehicle},
    "gate": {"post-servo": PostServo.for_vehicle},
    "net": {"wall-follower": WallFollower.for_vehicle},
    "pursuit": {"lead": LeadPursuit.for_vehicle},
    "team-pursuit": {"formation": FormationPursuit.for_vehicle},
    "formation": {"consensus": ConsensusFormation.for_vehicle},
}
"""Task -> name -> maker of the baseline for a vehicle; its `period` is the task's control step."""


def baseline(task: str, name: str, vehicle: Vehicle | str = "finsrov") -> Baseline:
    """A task's baseline by name.

    Raises:
        BaselineError: The task has none of that name.
        ControlError: The vehicle's file does not give what it needs.
    """
    have = BASELINES.get(task, {})
    if name not in have:
        raise BaselineError(
            f"unknown baseline '{name}' of task '{task}'; available: {', '.join(have) or 'none'}"
        )
    return have[name](load_vehicle(vehicle))


def mapped(function: Callable[..., Any], memory: Any, *others: Any) -> Any:
    """A baseline's memory, which is arrays in tuples, or None, with a function applied to every array.

    Args:
        function: Takes an array and those of `others` in its place.
        memory: Its classes are those of the result.
        others: Memories of the same baseline.
    """
    if memory is None or isinstance(memory, np.ndarray):
        return None if memory is None else function(memory, *others)
    if not isinstance(memory, tuple):
        raise TypeError(f"memory of a baseline is a {type(memory).__name__}, expected arrays in tuples")
    parts = [mapped(function, *each) for each in zip(memory, *others, strict=True)]
    return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)


def memory_leaves(memory: Any) -> list[Any]:
    """The arrays of a baseline's memory in their order; of None none."""
    leaves: list[Any] = []
    mapped(leaves.append, memory)
    return leaves


def memory_from(leaves: Iterable[Any], fresh: Any) -> Any:
    """Return the memory whose leaves `memory_leaves` listed.

    Args:
        leaves: What it gave.
        fresh: A memory of the same baseline, whose classes are taken.
    """
    rest = iter(leaves)
    return mapped(lambda _: next(rest), fresh)


def restarted(memory: Any, fresh: Any, mask: NDArray[Any]) -> Any:
    """A baseline's memory after some episodes started over.

    Args:
        memory: What `act` gave.
        fresh: What `reset` gives for as many episodes.
        mask: Which episodes started over, bool, (n,).

    Returns:
        The rows of `fresh` where mask is true, those of `memory` elsewhere.
    """
    return mapped(lambda old, new: np.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old), memory, fresh)


# Agents.


TASKS_OF_PIDS = ("t1", "t2")
"""Tasks that the robot's own PIDs do."""


NOWHERE = Goal(np.zeros((0, 3)), np.zeros((0, 4)))
"""A goal without content: of an agent whose observation holds all that it may know."""


class AgentError(ValueError):
    """An agent that does not exist, or that acts otherwise than it is asked to."""


def known_in(environment: Environment) -> Known:
    """Return the measurements of an environment: the observation of every agent of every world, the first vehicle's
    state."""
    arrays = environment.arrays
    observed: Rows = arrays.observation.numpy()
    state = (arrays.position, arrays.quaternion, arrays.velocity)
    sight = environment.sight
    return Known(
        observed.reshape(len(observed) * environment.agents, -1),
        *(np.asarray(array.numpy()[:, 0], dtype=float) for array in state),
        pictures=None if sight is None else {name: x.numpy() for name, x in sight.pictures.items()},
    )


class Agent(Protocol):
    """An agent without internal state: it sees measurements and a goal; its memory is an argument and a result."""

    name: str
    period: float
    """Time between two actions [s]."""
    action: str
    """Action mode."""
    wrench_scale: Any
    """Share of each wrench limit that action 1 means, one number or (6,)."""

    def reset(self, n: int) -> Any:
        """Memory before the first of n episodes' actions: arrays with n rows, in tuples; or None."""

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Actions (n, size) and the memory after."""

    def describe(self) -> dict[str, Any]:
        """Return the agent's description as plain data."""


class PolicyAgent:
    """A policy directory, run with onnxruntime."""

    def __init__(self, directory: str | Path, vehicle: Vehicle, task: Task) -> None:
        """Load a policy for the vehicle and task.

        Args:
            directory: Of the policy.
            vehicle: It must be the very one that the policy was trained for.
            task: It must have been trained for.

        Raises:
            PolicyError, ControlError: It was trained for another vehicle, task, observation or other limits.
        """
        schema = task.schema.model_dump(mode="json")
        task_data = {"name": task.name, "observation": schema}
        policy = Policy.load(directory, vehicle=vehicle, task=task_data)
        mode = mode_from_dict(policy.description.action, vehicle)
        self.period = policy.description.control_period
        self.action = mode.name
        self.wrench_scale = mode.scale if mode.wrench else 1.0
        self.policy = policy
        self.name = Path(directory).resolve().name

    def reset(self, n: int) -> Any:
        """Memory of the policy, if it has one."""
        return self.policy.reset(n)

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Actions for the environment's observations, a row for each agent of each world."""
        return self.policy.step(memory, reading.observation, reading.pictures)

    def describe(self) -> dict[str, Any]:
        """Name, network, and what it was trained in."""
        d = self.policy.description
        randomization = d.training.get("randomization")
        return {
            "name": self.name,
            "kind": "policy",
            "action": self.action,
            "period_s": self.period,
            "hydrodynamics": d.hydrodynamics,
            "randomization": randomization["name"] if randomization else None,
            "seed": d.seed,
            "files": dict(d.files),
        }


class PidAgent:
    """A PID by name: its wrench, as a part of each axis' limit, goes through the same allocation as a policy's."""

    kind, action, wrench_scale = "pid", "wrench6", 1.0

    def __init__(self, name: str, vehicle: Vehicle, task: str = "t1") -> None:
        """Make the controller of that name for a vehicle and a task."""
        self.name = name
        self.controller: Any = controller_for(task, name, vehicle)
        self.period = self.controller.period
        self._limits = np.asarray(vehicle.wrench_limits, dtype=float)

    def reset(self, n: int) -> Any:
        """Memory before the first of n episodes' actions: empty integrals."""
        return self.controller.reset(n)

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Wrench of each world, as a part of the limits; more than a limit is limited axis by axis."""
        tau, memory = self.controller.command(memory, reading, goal)
        return part_of_limits(tau, self._limits), memory

    def describe(self) -> dict[str, Any]:
        """Name and rate."""
        return {"name": self.name, "kind": self.kind, "action": self.action, "period_s": self.period}


class BaselineAgent(PidAgent):
    """A baseline of a task, which sees the observation alone."""

    kind = "baseline"

    def __init__(self, name: str, vehicle: Vehicle, task: Task, scale: Any = 1.0) -> None:
        """Make the task's baseline of that name for a vehicle; action 1 is `scale` of each limit in the worlds."""
        self.name, self.action, self.scale = name, task.action, scale
        self.controller = baseline(task.name, name, vehicle)
        self.period = self.controller.period

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Actions, a row for each agent of each world."""
        pictures = () if reading.pictures is None else (reading.pictures,)
        action, memory = self.controller.act(memory, reading.observation, *pictures)
        return np.clip(action / self.scale, -1.0, 1.0).astype(np.float32), memory


def agent_for(
    name_or_directory: str | Path, vehicle: Vehicle, task: Task
) -> PolicyAgent | PidAgent | BaselineAgent:
    """A PID or another baseline by its name, or the policy of a directory.

    The PIDs of T1 and T2 are the robot's, which know state and goal; other baselines see what a policy sees.

    Raises:
        AgentError: It is neither.
        PolicyError, ControlError: It does not fit the vehicle or the task.
    """
    name = str(name_or_directory)
    controllers = tuple(CONTROLLERS) if task.name in TASKS_OF_PIDS else ()
    baselines = BASELINES.get(task.name, {})
    if name in controllers:
        return PidAgent(name, vehicle, task.name)
    if name in baselines:
        return BaselineAgent(name, vehicle, task)
    if not Path(name_or_directory).exists():
        have = ", ".join([*controllers, *baselines])
        raise AgentError(
            f"'{name}' is neither a policy directory nor a controller of task '{task.name}'; controllers: "
            f"{have or 'none'}"
        )
    return PolicyAgent(name_or_directory, vehicle, task)


def expert_for(
    name_or_directory: str | Path, vehicle: Vehicle, task: Task, action: str, scale: Any = 1.0
) -> PolicyAgent | BaselineAgent:
    """Return the expert: a baseline of the task or the policy of a directory, which see the observation alone.

    Args:
        name_or_directory: Which.
        vehicle: Theirs.
        task: Theirs.
        action: Mode of the learner's actions.
        scale: Part of each wrench limit that action 1 of the learner stands for [1].

    Raises:
        AgentError: There is neither, or it acts in another mode than `action`.
        PolicyError: The policy was trained for another vehicle or task.
    """
    baselines = BASELINES.get(task.name, {})
    if str(name_or_directory) in baselines:
        if action != task.action:
            raise AgentError(
                f"baseline '{name_or_directory}' acts by {task.action}, expected {action}: leave --action out"
            )
        return BaselineAgent(str(name_or_directory), vehicle, task, scale)
    if not (Path(name_or_directory) / DESCRIPTION_FILE).is_file():
        raise AgentError(
            f"expert '{name_or_directory}' is neither a policy directory nor a baseline of task '{task.name}'; "
            f"baselines: {', '.join(baselines) or 'none'}"
        )
    expert = PolicyAgent(name_or_directory, vehicle, task)
    if expert.action != action:
        raise AgentError(
            f"{name_or_directory} acts by {expert.action}, expected {action}: collect and train with --action "
            f"{expert.action}"
        )
    return expert


# An agent in a batch of worlds, decision after decision.


def rollout(
    agent: Agent,
    environment: Environment,
    steps: int,
    goal: Callable[[float], Goal],
    *,
    record: Path | None = None,
) -> Iterator[tuple[int, Step | None]]:
    """Let an agent act, and yield before each decision and after the last.

    Args:
        agent: Who acts; several agents of a world share it.
        environment: As it stands.
        steps: How many decisions, unless the iteration is ended before.
        goal: Where to go at a time since the start [s].
        record: New folder for every state, command and thrust; none if None.

    Yields:
        How many decisions were made, and what the environment said to the last one; None before the first.
    """
    worlds, agents = environment.worlds, environment.agents
    shape = (worlds, -1) if agents == 1 else (worlds, agents, -1)
    memory = agent.reset(worlds * agents)
    step: Step | None = None
    with nullcontext() if record is None else Recorder(environment.simulator, record) as recorder:
        for k in range(steps + 1):
            yield k, step
            if recorder is not None:
                recorder.record()
            if k < steps:
                action, memory = agent.act(memory, known_in(environment), goal(k * agent.period))
                step = environment.step(np.asarray(action, dtype=np.float32).reshape(shape))
