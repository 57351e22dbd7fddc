"""Trajectories: shapes, the published trajectories by name, and user-defined ones from a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError
from finssim.control.guidance import Reference
from finssim.core.rotations import quat_from_yaw, quat_inverse_rotate, wrap_angle
from finssim.core.text_table import read_text_table
from finssim.core.yaml_file import read_mapping
from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import room

# Shapes of trajectories: position and its exact derivative as functions of time.
#
# A shape lies in the horizontal plane z = `depth` (negative under water) unless stated otherwise. In the paper's
# controller frame that is the x-z plane: its x is ours, its z is our y, both at y = depth.


Array = npt.NDArray[np.float64]

Motion = Callable[[Array], tuple[Array, Array]]
"""Times since the start [s], (...) -> position [m] and velocity [m/s], world frame, (..., 3) each."""
Timed = tuple[float, Motion]
"""Motion and its duration [s]."""

DEPTH = -0.5
"""Height of the published trajectories [m]."""

TABLE_SIZE = 2048
"""Number of knots of the ellipse's table: its spline is then accurate to 1e-10 rad."""


def polyline(points: Sequence[Sequence[float]], durations: Sequence[float]) -> Timed:
    """Return straight segments between successive points, each from rest to rest: s = 3u² - 2u³.

    Points are [x, y, z, yaw] in [m] and [rad], durations in [s]; the result has the same units.

    Args:
        points: Corners, world frame [m], (n + 1, 3).
        durations: Duration of each segment [s], (n,).

    Raises:
        ControlError: Lengths do not match, or a duration is not positive.
    """
    corners, times = np.asarray(points, float), np.asarray(durations, float)
    if corners.ndim != 2 or corners.shape[1:] != (3,) or times.shape != (len(corners) - 1,):
        raise ControlError(
            f"polyline of points {corners.shape} with durations {times.shape}: expected (n + 1, 3) and (n,)"
        )
    _positive(polyline=float(times.min()))
    starts = np.concatenate([[0.0], np.cumsum(times)])

    def motion(t: Array) -> tuple[Array, Array]:
        i = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, len(times) - 1)
        s, s_dot = _smooth_step((t - starts[i]) / times[i])
        way = corners[i + 1] - corners[i]
        return corners[i] + s[..., None] * way, (s_dot / times[i])[..., None] * way

    return float(times.sum()), motion


def circle(radius: float, turns: float, duration: float, depth: float = DEPTH) -> Timed:
    """Return circles about the pool's centre at constant speed, counter-clockwise from (radius, 0).

    Lengths and the result are in [m], times in [s].

    Args:
        radius: Radius [m].
        turns: Number of circles.
        duration: Total duration [s].
        depth: Height of their plane, world frame [m]: negative under water.
    """
    _positive(radius=radius, turns=turns, duration=duration)
    return helix(radius, turns, duration, depth, depth)


def helix(radius: float, turns: float, duration: float, bottom: float, top: float) -> Timed:
    """Return a helix that rises steadily from `bottom` to `top` (heights in the world frame [m])."""
    _positive(radius=radius, turns=turns, duration=duration)
    rate, climb = 2.0 * math.pi * turns / duration, (top - bottom) / duration

    def motion(t: Array) -> tuple[Array, Array]:
        c, s = radius * np.cos(rate * t), radius * np.sin(rate * t)
        position = np.stack([c, s, bottom + climb * t], axis=-1)
        return position, np.stack([-rate * s, rate * c, np.full_like(c, climb)], axis=-1)

    return duration, motion


def gerono(a: float, b: float, duration: float, depth: float = DEPTH) -> Timed:
    """Return a figure of eight at constant phase rate: x = a sin θ, y = b sin θ cos θ (Gerono's lemniscate).

    Lengths and the result are in [m], times in [s].

    Args:
        a: Half its length along world x [m].
        b: Its width along world y [m].
        duration: Duration of one figure [s].
        depth: Height of its plane, world frame [m]: negative under water.
    """
    _positive(a=a, b=b, duration=duration)
    rate = 2.0 * math.pi / duration

    def motion(t: Array) -> tuple[Array, Array]:
        phase = rate * t
        x, y = a * np.sin(phase), 0.5 * b * np.sin(2.0 * phase)
        x_dot, y_dot = a * rate * np.cos(phase), b * rate * np.cos(2.0 * phase)
        return np.stack([x, y, np.full_like(x, depth)], axis=-1), np.stack([x_dot, y_dot, 0.0 * x], axis=-1)

    return duration, motion


def ellipse(a: float, b: float, duration: float, depth: float = DEPTH) -> Timed:
    """Return one revolution on an ellipse from rest to rest, slower at its four vertices.

    The speed along the arc is proportional to 0.5 + 0.5 sin² 2θ, and time is scaled by s = 3u² - 2u³. This
    interpretation of the publication results in the published peak: 0.1031 m/s for half axes of 1.0 and 0.4 m
    in 92.70 s.

    Lengths and the result are in [m], times in [s].

    Args:
        a: Half axis along world x [m].
        b: Half axis along world y [m].
        duration: Duration of the revolution [s].
        depth: Height of its plane, world frame [m]: negative under water.
    """
    _positive(a=a, b=b, duration=duration)
    theta = np.linspace(0.0, 2.0 * math.pi, TABLE_SIZE + 1)

    def slowness(angle: Array) -> Array:
        """Return the time per angle, up to a factor: |dr/dθ| / (0.5 + 0.5 sin² 2θ)."""
        stretch = np.hypot(a * np.sin(angle), b * np.cos(angle))
        return np.asarray(stretch / (0.5 + 0.5 * np.sin(2.0 * angle) ** 2))

    @cache  # computed on first use: importing the splines takes half a second
    def turned() -> tuple[Any, Any]:
        """Return the angle as a function of the path fraction, and its derivative."""
        from scipy.interpolate import CubicHermiteSpline

        middle = slowness(0.5 * (theta[1:] + theta[:-1]))
        ends = slowness(theta)
        pieces = (ends[:-1] + 4.0 * middle + ends[1:]) * np.diff(theta) / 6.0  # Simpson's rule
        table = np.concatenate([[0.0], np.cumsum(pieces)])
        angle = CubicHermiteSpline(table / table[-1], theta, table[-1] / ends)
        return angle, angle.derivative()

    def motion(t: Array) -> tuple[Array, Array]:
        s, s_dot = _smooth_step(t / duration)
        angle, rate = (of(s) for of in turned())
        rate = rate * s_dot / duration
        c, n = np.cos(angle), np.sin(angle)
        position = np.stack([a * c, b * n, np.full_like(c, depth)], axis=-1)
        return position, np.stack([-a * rate * n, b * rate * c, 0.0 * c], axis=-1)

    return duration, motion


SHAPES: dict[str, Callable[..., Timed]] = {
    "polyline": polyline,
    "circle": circle,
    "helix": helix,
    "gerono": gerono,
    "ellipse": ellipse,
}
"""Shapes by the name that trajectory files use."""


def _smooth_step(u: Array) -> tuple[Array, Array]:
    """Return 3u² - 2u³ and its derivative."""
    return u * u * (3.0 - 2.0 * u), 6.0 * u * (1.0 - u)


def _positive(**numbers: float) -> None:
    for name, number in numbers.items():
        if not (math.isfinite(number) and number > 0.0):
            raise ControlError(f"{name} is {number}, expected a positive number")


TANGENT_SPAN = 0.1
"""Half the interval over which the tangent is computed [s], so that it is defined at rests and corners as well."""

CHECK_STEP = 0.02
"""Interval at which limits are checked [s]."""

LONGEST = 86400.0
"""Longest duration of a trajectory, one day [s]."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Requested motion from 0 to `duration`, held constant before and after."""

    name: str
    duration: float
    """Duration [s]."""
    motion: Motion = field(repr=False)
    """Function that returns position and velocity at times within the duration."""
    heading: Literal["fixed", "tangent"] = "fixed"
    """Heading mode: keep the heading `yaw`, or follow the tangent of the path (plus `yaw`)."""
    yaw: float = 0.0
    """Heading, or offset from the tangent [rad]."""
    turning: Callable[[Array], Array] | None = field(default=None, repr=False)
    """Function that returns the heading at times within the duration [rad], instead of a fixed one; `yaw` is
    added."""
    knots: Array | None = field(default=None, repr=False, compare=False)
    """Times of the points that it passes through [s], (n,); None without points."""

    def __post_init__(self) -> None:
        if not 0.0 < self.duration <= LONGEST:
            raise ControlError(
                f"trajectory {self.name}: duration is {self.duration:g} s, expected more than 0 and at most {LONGEST:g}"
            )
        if self.heading not in ("fixed", "tangent"):
            raise ControlError(
                f"trajectory {self.name}: heading is '{self.heading}', expected fixed or tangent"
            )

    def at(self, t: npt.ArrayLike) -> Reference:
        """Return the reference at times since the start [s], (...).

        The velocity is the exact derivative of the position, and zero where the trajectory is held.
        """
        time = np.asarray(t, float)
        inside = np.clip(time, 0.0, self.duration)
        position, velocity = self.motion(inside)
        moving = (time >= 0.0) & (time <= self.duration)
        velocity = np.where(moving[..., None], velocity, 0.0)
        return Reference(position, velocity, self._yaw(inside), inside / self.duration)

    def scaled(self, factor: float) -> Trajectory:
        """Return the same trajectory in the same time, with lengths, depth and speeds multiplied by a factor."""

        def motion(t: Array) -> tuple[Array, Array]:
            position, velocity = self.motion(t)
            return factor * position, factor * velocity

        return self if factor == 1.0 else replace(self, motion=motion)

    def _yaw(self, t: Array) -> Array:
        if self.heading == "fixed":
            turned = 0.0 if self.turning is None else self.turning(t)
            return wrap_angle(np.broadcast_to(turned + self.yaw, np.shape(t)))
        before, after = (
            self.motion(np.clip(t + span, 0.0, self.duration))[0] for span in (-TANGENT_SPAN, TANGENT_SPAN)
        )
        way = after - before
        return wrap_angle(np.arctan2(way[..., 1], way[..., 0]) + self.yaw)


def _catalogue() -> dict[str, Trajectory]:
    near, right = (-1.0, -0.4, DEPTH), (1.0, 0.4, DEPTH)
    corners = [near, right, (1.0, -0.4, DEPTH), (-1.0, 0.4, DEPTH), near]
    motions = {
        "straight": polyline([near, right], [30.0]),
        "broken": polyline(corners, [32.0, 13.0, 32.0, 13.0]),
        "ellipse": ellipse(1.0, 0.4, 92.70),
        "lemniscate": gerono(0.4, 0.2, 30.0),
        "circle": circle(0.5, 3.0, 960.0 / 7.0),
        "figure_eight": gerono(1.0, 0.8, 117.0857),
        "helix": helix(0.4, 2.0, 80.0, -0.6, -0.4),
    }
    return {name: Trajectory(name=name, duration=time, motion=way) for name, (time, way) in motions.items()}


TRAJECTORIES = _catalogue()
"""Published trajectories, and a helix of ours, by name. The heading is always 0: the paper states none."""

PUBLISHED_NAMES = {"straight_pro": "broken"}
"""Name in the published configuration -> our name."""


def load_trajectory(
    name_or_file: str | Path,
    *,
    heading: Literal["fixed", "tangent"] | None = None,
    yaw: float | None = None,
    vehicle: Vehicle | None = None,
) -> Trajectory:
    """Return a trajectory by name or from a YAML or CSV file.

    Args:
        name_or_file: Key of `TRAJECTORIES`, or a file for `read_trajectory`.
        heading: Fixed heading, or tangent to the path; that of the trajectory if None.
        yaw: Fixed heading, or angle to the path [rad]; that of the trajectory if None.
        vehicle: Vehicle whose required room (1 for FinsROV) scales a published trajectory; a trajectory that
            it cannot follow or that leaves its workspace is refused.

    Raises:
        ControlError: There is no such trajectory, the file is invalid, or the vehicle cannot follow it.
    """
    name = PUBLISHED_NAMES.get(str(name_or_file), str(name_or_file))
    if name in TRAJECTORIES:
        trajectory = TRAJECTORIES[name].scaled(1.0 if vehicle is None else room(vehicle.body.size))
    elif Path(name_or_file).is_file():
        trajectory = read_trajectory(Path(name_or_file))
    else:
        available = ", ".join(TRAJECTORIES)
        raise ControlError(f"no trajectory '{name_or_file}': give a YAML or CSV file or one of {available}")
    if heading is not None:
        trajectory = replace(trajectory, heading=heading)
    if yaw is not None:
        trajectory = replace(trajectory, yaw=yaw)
    if vehicle is not None:
        check_vehicle(trajectory, vehicle)
    return trajectory


def check_vehicle(trajectory: Trajectory, vehicle: Vehicle) -> None:
    """Refuse a trajectory that leaves a vehicle's workspace or exceeds its speed, axis by axis.

    Raises:
        ControlError: A limit is exceeded; the message states which, and when.
    """
    from finssim.vehicles.capability import terminal_speeds

    t = np.linspace(0.0, trajectory.duration, max(3, math.ceil(trajectory.duration / CHECK_STEP) + 1))
    reference = trajectory.at(t)
    lower, upper = (
        np.asarray(x, float) for x in (vehicle.safety.workspace_lower, vehicle.safety.workspace_upper)
    )
    outside = (reference.position < lower) | (reference.position > upper)
    if outside.any():
        i, axis = np.argwhere(outside)[0]
        raise ControlError(
            f"trajectory {trajectory.name}: {'xyz'[axis]} is {reference.position[i, axis]:.4g} m at {t[i]:.2f} s, "
            f"expected {lower[axis]:g} to {upper[axis]:g}: move it into the workspace"
        )
    speed = np.abs(quat_inverse_rotate(quat_from_yaw(reference.yaw), reference.velocity))
    able = terminal_speeds(vehicle)[:3]
    if np.any(speed > able):
        i, axis = np.argwhere(speed > able)[0]
        raise _too_fast(
            trajectory, ("surge", "sway", "heave")[axis], speed[i, axis], t[i], able[axis], vehicle
        )


def check_speed(trajectory: Trajectory, vehicle: Vehicle) -> None:
    """Refuse a trajectory that is faster than a vehicle in any direction, whatever the position of its points.

    Raises:
        ControlError: The speed is exceeded; the message states it, and when.
    """
    from finssim.vehicles.capability import terminal_speeds

    t = np.linspace(0.0, trajectory.duration, 2001)
    if trajectory.knots is not None:
        t = np.unique(
            np.concatenate([t, trajectory.knots, 0.5 * (trajectory.knots[1:] + trajectory.knots[:-1])])
        )
    speed = np.linalg.norm(trajectory.at(t).velocity, axis=-1)
    able = float(np.linalg.norm(terminal_speeds(vehicle)[:3]))
    if np.any(speed > able):
        i = int(np.argmax(speed))
        raise _too_fast(trajectory, "a speed", speed[i], t[i], able, vehicle)


def _too_fast(
    trajectory: Trajectory, what: str, speed: float, time: float, able: float, vehicle: Vehicle
) -> ControlError:
    return ControlError(
        f"trajectory {trajectory.name}: {what} of {speed:.4g} m/s at {time:.4g} s, but {vehicle.name} goes "
        f"{able:.4g} m/s at most: make it longer or smaller"
    )


# Trajectory files: points in time as CSV or YAML, or a shape with its dimensions as YAML.


COLUMNS = ("t", "x", "y", "z", "yaw")
"""Columns of a table of points: time [s], world position [m], and optionally the heading [rad]."""

KEYS = {"name", "heading", "yaw", "points", "shape"}


def read_trajectory(path: Path) -> Trajectory:
    """Return a trajectory from a file.

    CSV: a header `t,x,y,z` or `t,x,y,z,yaw`, one row per point. YAML: `points`, a list of such rows, or
    `shape`, a mapping of `kind` (key of `SHAPES`) and its arguments such as radius and duration; optionally `name`,
    `heading` (fixed or tangent) and `yaw` [rad].

    Raises:
        ControlError: The file cannot be read, or its content is not a trajectory; one sentence with the file's name.
    """
    try:
        if path.suffix.lower() == ".csv":
            table = read_text_table(path, ControlError)
            if tuple(table.names) not in (COLUMNS, COLUMNS[:4]):
                raise ControlError(
                    f"its header is '{','.join(table.names)}', expected t,x,y,z or t,x,y,z,yaw"
                )
            return through_points(path.stem, table.rows)
        data = read_mapping(path, ControlError, such_as="points: [[0, 0, 0, -0.5], [10, 1, 0, -0.5]]")
        return _from_mapping(path.stem, data)
    except ControlError as error:
        message = str(error)
        raise ControlError(message if message.startswith(str(path)) else f"{path}: {message}") from None


def through_points(name: str, points: npt.ArrayLike, **options: Any) -> Trajectory:
    """Return a smooth trajectory through points in time that overshoots no two neighbours on any axis.

    Piecewise cubic with the slopes of Fritsch and Carlson (1980), at rest at both ends: a rest between two
    equal points remains a rest.

    Args:
        name: Name of the trajectory.
        points: t [s] from 0 on, x, y, z [m] and optionally yaw [rad], (n, 4) or (n, 5).
        options: Fields `heading` and `yaw` of `Trajectory`.

    Raises:
        ControlError: There are fewer than two points, numbers are not finite, or times do not increase from 0.
    """
    from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

    table = _checked_points(points)
    t = table[:, 0]
    table[:, 4:] = np.unwrap(table[:, 4:], axis=0)
    slopes = PchipInterpolator(t, table[:, 1:]).derivative()(t)
    slopes[[0, -1]] = 0.0
    position = CubicHermiteSpline(t, table[:, 1:4], slopes[:, :3])
    drift = position.derivative()

    def motion(time: Array) -> tuple[Array, Array]:
        return position(time), drift(time)

    options["knots"] = t
    if table.shape[1] == 5:
        options["turning"] = CubicHermiteSpline(t, table[:, 4], slopes[:, 3])
    return Trajectory(name=name, duration=float(t[-1]), motion=motion, **options)


def _from_mapping(name: str, data: Mapping[str, Any]) -> Trajectory:
    unknown = sorted(map(str, data.keys() - KEYS))
    if unknown:
        raise ControlError(f"unknown key '{unknown[0]}'; available: {', '.join(sorted(KEYS))}")
    if ("points" in data) == ("shape" in data):
        raise ControlError("expected either 'points' or 'shape'")
    yaw = data.get("yaw", 0.0)
    if isinstance(yaw, bool) or not isinstance(yaw, int | float):
        raise ControlError(f"yaw is {yaw!r}, expected a number")
    options: dict[str, Any] = {"heading": data.get("heading", "fixed"), "yaw": float(yaw)}
    name = str(data.get("name", name))
    if "points" in data:
        return through_points(name, data["points"], **options)
    shape = data["shape"]
    if not isinstance(shape, Mapping) or shape.get("kind") not in SHAPES:
        raise ControlError(
            f"shape is {shape!r}, expected a mapping whose 'kind' is one of {', '.join(SHAPES)}"
        )
    try:
        arguments = {str(key): value for key, value in shape.items() if key != "kind"}
        duration, motion = SHAPES[shape["kind"]](**arguments)
    except (TypeError, ValueError) as error:
        raise ControlError(f"shape: {str(error).replace('()', '')}") from None
    return Trajectory(name=name, duration=duration, motion=motion, **options)


def _checked_points(points: Any) -> Array:
    try:
        table = np.array(points, dtype=float)
    except (TypeError, ValueError):
        raise ControlError(
            "points: expected rows of 4 or 5 numbers, all of equal length: t, x, y, z and yaw"
        ) from None
    if table.ndim != 2 or table.shape[1] not in (4, 5) or len(table) < 2:
        raise ControlError(
            f"points are {table.shape}, expected two or more rows of t, x, y, z and optionally yaw"
        )
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0, 0])
        raise ControlError(f"point {row + 1} is {table[row].tolist()}, expected finite numbers")
    if table[0, 0] != 0.0:
        raise ControlError(f"the first time is {table[0, 0]:g} s, expected 0: times count from the start")
    late = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
    if len(late):
        row = int(late[0]) + 2
        raise ControlError(f"point {row} is at {table[row - 1, 0]:g} s, not after the one before it")
    return table
