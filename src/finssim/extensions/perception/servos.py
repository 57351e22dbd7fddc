"""Classical baselines with perception: controllers that locate a dock, a gate, a pipeline or a net in pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.agents.baselines import (
    PERIOD,
    Array,
    Mask,
    Pictures,
    Rows,
    WrenchPid,
    attitude_from,
    heading_rate,
)
from finssim.agents.docking import DockingPid
from finssim.agents.drive import DriveBaseline, DriveNumbers
from finssim.agents.pid import PidMemory
from finssim.core.rotations import quat_conjugate, quat_from_yaw, quat_multiply, quat_rotate
from finssim.extensions.perception.camera_docking import CameraDocking
from finssim.extensions.perception.gate import HALF, Gate
from finssim.extensions.perception.net import RANGE_SCALE, Net
from finssim.extensions.perception.pipeline import Pipeline
from finssim.extensions.perception.seeing import DEPTH_SCALE
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle
from finssim.vehicles.device_files import device_of


def camera_of(vehicle: Vehicle, task: Task) -> dict[str, Any]:
    """Return the camera of a task: focal length relative to the picture's width, and position, body axes [m]."""
    device = device_of(vehicle, task.pictures[0].name)
    return {"focal_share": device.focal_length / device.width, "eye": tuple(device.mount.position.tolist())}


class SightMemory(NamedTuple):
    """Memory of `LightServo`; its frame is level, with the origin at the start and x along the initial heading."""

    position: Array
    """Position of the body origin, dead-reckoned from velocity and depth [m], (n, 3)."""
    heading: Array
    """Heading [rad], (n,)."""
    dock: Array
    """Estimated position of the dock's throat [m] and heading [rad], (n, 4)."""
    looks: Array
    """Number of pictures in the estimate, (n,)."""
    pid: PidMemory


@dataclass(frozen=True)
class LightServo(DockingPid):
    """`DockingPid` towards a dock whose pose is estimated from the four guide lights in the picture.

    The upper two are white, the lower two red, in the corners of an upright square of known side. The height
    of each pair in the picture gives its distance, their middle the bearing, the difference of the distances
    the dock's heading. Only pictures with all four lights are used; the estimate averages the last dozen, and
    between them, and in the funnel, the vehicle dead-reckons with its velocity.
    """

    focal_share: float = 0.0
    """Focal length relative to the picture's width [-]."""
    eye: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the camera, body axes [m]."""
    side: float = 1.16
    """Side of the square of lights [m]."""
    before: float = 0.78
    """Distance of the square in front of the throat [m]."""
    first: float = 2.8
    """Assumed distance of the dock before the first detection [m]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD, **more: Any) -> Any:
        """Return the baseline for a vehicle with a `front_camera`, the dock of the site `dock` and a control
        period [s]."""
        task = CameraDocking()
        return super().for_vehicle(vehicle, period, task, lead=0.4, **camera_of(vehicle, task))

    def reset(self, n: int) -> SightMemory:
        """Return the initial memory: a dock straight ahead, not yet detected."""
        dock = np.tile([self.first, 0.0, 0.0, 0.0], (n, 1))
        return SightMemory(np.zeros((n, 3)), np.zeros(n), dock, np.zeros(n), self.pid.reset(n))

    def act(self, memory: SightMemory, observation: Rows, pictures: Pictures) -> tuple[Rows, SightMemory]:  # type: ignore[override]
        """Return actions for observations and pictures of docking by camera."""
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
        """Locate the square of lights in pictures.

        Args:
            picture: uint8 (n, height, width, 3).
            up: World's up in the body [-], (n, 3).

        Returns:
            Position of its middle from the camera, body frame [m], (n, 3); its heading relative to the
            vehicle [rad], (n,); mask of pictures with all four lights, (n,).
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
        """Locate the upright square in space.

        Args:
            corners: Column and row of its upper left, upper right, lower left and lower right corner [px],
                (4, 2, n).
            visible: Mask of pictures with all four corners, (n,).
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


# Classical gate passage: each post is the column that is redder or greener than the rest of its rows.


@dataclass(frozen=True)
class PostServo(LightServo):
    """`LightServo` through a gate, whose posts are the sides of the upright square: the left red, the right green.

    A post is the column in which its colour exceeds the row medians most; if both posts are completely in the
    picture, their lengths determine distance and heading.
    """

    side: float = 1.5
    before: float = 0.0
    least: float = 60.0
    """Least total level of its colour in a post's column, summed over the rows."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD, **more: Any) -> PostServo:
        """Return the baseline for a vehicle with a `front_camera`, the gate of the site `gate` and a control
        period [s]."""
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
        """Locate the square between the posts; see `LightServo`."""
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


# Classical pipeline following: fit a line to pixels that are yellower than their surroundings, and steer along it.


@dataclass(frozen=True, kw_only=True)
class LineFollower(DriveBaseline):
    """Pipeline follower that fits a line to the yellow pixels of the picture, and steers to it and along it.

    Yellow is (red + green)/2 - blue above the median of a picture's row. A row below the horizon views the
    bottom at one distance, which follows from the pipe's charted depth; a straight line is fitted to all
    rows, weighted by the square of the yellow level. Pictures with too little yellow do not change the
    estimate.
    """

    cruise: float
    """Speed along the pipe [m/s]."""
    charted: float
    """Depth of the pipe's axis [m]."""
    height: float
    """Height above the pipe's axis [m]."""
    focal_share: float
    """Focal length relative to the picture's width [-]."""
    eye: tuple[float, float, float]
    """Position of the camera, body axes [m]."""
    least: float = 60.0
    """Squared yellow level, summed over a picture, below which the picture is not used."""
    gain: float = 0.5
    """Lateral and vertical speed per distance [1/s]."""
    memory_share: float = 0.8
    """Weight of the previous estimate in the next one [-]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> LineFollower:
        """Return the baseline for a vehicle with a `front_camera`, and the site `pipeline`."""
        task = Pipeline().fitted([vehicle])
        return cls(
            drive=DriveNumbers.of(vehicle), cruise=task.cruise, charted=-task.bottom, height=task.height,
            **camera_of(vehicle, task),
        )  # fmt: skip

    def reset(self, n: int) -> Array:  # type: ignore[override]
        """Return the initial line, straight below and ahead, as [m] and slope [-] like `line`, (n, 2)."""
        return np.zeros((n, 2))

    def act(self, memory: Array, observation: Rows, pictures: Pictures) -> tuple[Rows, Array]:  # type: ignore[override]
        """Return actions for observations and pictures of following a pipeline."""
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
        """Locate the pipe in pictures.

        Args:
            picture: uint8 (n, height, width, 3).
            up: World's up in the body [-], (n, 3).
            above: Height of the body origin above the pipe's axis [m], (n,).

        Returns:
            Its distance to the left of the vehicle [m] and its slope to the left, (n, 2); mask of pictures
            with enough yellow, (n,).
        """
        red, green, blue = np.moveaxis(picture.astype(float), -1, 0)
        yellow = 0.5 * (red + green) - blue
        yellow -= np.median(yellow, axis=2, keepdims=True)
        height, width = yellow.shape[1:]
        focal = self.focal_share * width
        down = (np.arange(height) - 0.5 * (height - 1)) / focal
        fall = down + up[:, :1]  # fall of a row's rays per metre ahead, including the vehicle's pitch
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


# Classical net inspection: straight sides through the strongest echoes, and height from the altimeter.


class NetSide(NamedTuple):
    """Straight side of a net, as observed by a ping, in the plane of the body's x and y axes."""

    angle: Array
    """Angle of its normal, pointing away from the vehicle [rad], (n,)."""
    distance: Array
    """Distance of its straight line along the normal [m], (n,)."""
    right: Array
    """Start of the side, measured along the line to the left from the point nearest to the vehicle [m], (n,)."""
    left: Array
    """End of the side, measured likewise [m]."""

    @property
    def nearest(self) -> Array:
        """Point of the side nearest to the vehicle [m], (n, 2)."""
        along = np.where(self.right < self.left, np.clip(0.0, self.right - 0.1, self.left + 0.1), 0.0)
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.column_stack([self.distance * c - along * s, self.distance * s + along * c])

    def meets(self, other: NetSide, reach: float) -> Mask:
        """Return whether the two lines cross at 3° to 40° and within a distance of an end of each [m], (n,)."""
        turn = other.angle - self.angle
        sine = np.where(np.abs(turn) < 0.05, 1.0, np.sin(turn))
        beyond = np.zeros_like(turn)
        for side, far, sign in ((self, other, -1.0), (other, self, 1.0)):
            along = sign * (side.distance * np.cos(turn) - far.distance) / sine
            gap = np.minimum(np.abs(along - side.right), np.abs(along - side.left))
            beyond = np.maximum(beyond, gap)
        return (np.abs(turn) > 0.05) & (np.abs(turn) < 0.7) & (beyond < reach)


class SonarNumbers(NamedTuple):
    """Parameters of a vehicle's sonar."""

    sector: float
    """Field of view [rad]."""
    bin_length: float
    """Length of a range cell [m]."""
    position: tuple[float, float, float]
    """Position, body axes [m]."""


@dataclass(frozen=True, kw_only=True)
class WallFollower(DriveBaseline):
    """Net follower that fits the net's sides to the two strongest echoes of each beam, faces its nearest
    point and moves left.

    The dominant side is the one with the most votes of a Hough transform, refined by least squares with less
    weight on outliers such as fish. From the remaining echoes, a second and a third side are estimated
    likewise, and accepted if they meet the first near its end and their own. The altimeter measures the slant
    range of the tube at the net's lower edge, which gives the height with the net's distance; an implausible
    range is ignored.
    """

    speed: float
    """Speed along the net [m/s]."""
    distance: float
    """Distance from the net [m]."""
    height: float
    """Height above the net's lower edge [m]."""
    sonar: SonarNumbers
    under: float
    """Distance of the altimeter below the body origin [m]."""
    least: float = 60.0
    """Least picture level of an echo that is used."""
    behind: float = 0.03
    """Distance of the strongest echo behind the net's plane, since it comes from above or below the beam's
    middle [m]."""
    echoes: int = 12
    """Least number of echoes on a side for it to be used."""
    reach: float = 0.45
    """Largest distance from the last echo of each side to the point where two sides meet [m]."""
    tube: float = 0.14
    """Radius of the tube at the net's lower edge [m]."""
    gain: float = 0.5
    """Speed per distance [1/s]."""
    integral: float = 0.3
    """Integral gain of the ground speed error [1/s], which compensates a current."""
    jump: float = 0.25
    """Largest change of distance and heading from ping to ping [m, rad]."""
    memory_share: float = 0.5
    """Weight of the previous distance and heading in the next estimate [-]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> WallFollower:
        """Return the baseline for a vehicle with `sonar` and `altimeter`, and the site `net`."""
        task = Net()
        sonar: Any = task.pictures[0].device(vehicle)
        altimeter = device_of(vehicle, task.ranges[0])
        return cls(
            drive=DriveNumbers.of(vehicle), speed=task.speed, distance=task.distance, height=task.height,
            sonar=SonarNumbers(sonar.sector, sonar.range / sonar.bins, tuple(sonar.mount.position.tolist())),
            under=-float(altimeter.mount.position[2]),
        )  # fmt: skip

    def reset(self, n: int) -> Array:  # type: ignore[override]
        """Return the net straight ahead at its set distance [m, rad], and zero speed corrections [m/s], (n, 5)."""
        return np.tile([self.distance, 0.0, 0.0, 0.0, 0.0], (n, 1))

    def act(self, memory: Array, observation: Rows, pictures: Pictures) -> tuple[Rows, Array]:  # type: ignore[override]
        """Return actions for observations and pictures of inspecting a net."""
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
        """Locate the net in pings.

        Args:
            picture: uint8 (n, beams, range cells, 1).
            before: Previous distance of the net [m], (n,).

        Returns:
            Its nearest point, from the body origin along x and y [m], (n, 2); mask of pings in which it is
            located, (n,).
        """
        levels = picture[..., 0].astype(float)
        count, cells = levels.shape[1:]
        azimuth = self.sonar.sector * (0.5 - (np.arange(count) + 0.5) / count)
        rows = []
        for _ in range(2):
            cell = levels.argmax(2)
            r = (cell + 0.5) * self.sonar.bin_length - self.behind
            # The spacing of beams along a side grows with the range.
            weight = r * (levels.max(2) >= self.least)
            rows.append((r * np.cos(azimuth) + self.sonar.position[0], r * np.sin(azimuth), weight))
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

    def side(self, x: Array, y: Array, weight: Array) -> tuple[NetSide, Mask]:
        """Return the straight side with the greatest weight, and a mask of the points on it.

        Args:
            x: Points, forward from the body origin [m], (n, points).
            y: Points, left of the body origin [m], (n, points).
            weight: Weights of the points [-], (n, points).
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
        right = np.sort(np.where(on, along, np.inf), 1)[
            :, 3
        ]  # not the outermost point: one fish may lie on the line
        left = -np.sort(np.where(on, -along, np.inf), 1)[:, 3]
        return NetSide(angle, distance, right, left), on
