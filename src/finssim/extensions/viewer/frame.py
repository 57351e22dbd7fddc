"""Content of a view: the stage, which does not change, and a frame for every time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:  # not imported before the first picture of a view
    from finssim.extensions.perception import World
    from finssim.localization.overhead_camera import Pool
    from finssim.robot.messages import TagCorners
    from finssim.vehicles import Vehicle

Array = npt.NDArray[np.float64]


class ViewError(ValueError):
    """Error of a source that cannot be shown."""


class FixedBody(NamedTuple):
    """Fixed body of a world."""

    name: str
    vertices: Array
    """Vertices in the world frame [m], (v, 3)."""
    faces: npt.NDArray[np.int64]
    """Vertex indices of the triangles, (f, 3)."""
    colour: tuple[int, int, int]
    """Red, green, blue, 0 to 255."""


class BodyPose(NamedTuple):
    """Pose of the body."""

    position: Array
    """Position in the world frame [m], (3,)."""
    quaternion: Array
    """Orientation, body to world, xyzw, (4,)."""


def nowhere() -> Array:
    """Return an array of no points, (0, 3) [m]."""
    return np.zeros((0, 3))


@dataclass(frozen=True, kw_only=True)
class ViewStage:
    """The part of a view that does not change."""

    vehicle: Vehicle
    title: str
    lower: Array
    """Corner of the water's box, world frame [m], (3,)."""
    upper: Array
    """The opposite corner [m], (3,)."""
    walls: bool = True
    """True if the box is a pool; otherwise it is the space in which the vehicle may move."""
    site: Pool | None = None
    """Overhead camera, if there is one."""
    path: Array = field(default_factory=nowhere)
    """Trajectory to follow, world frame [m], (k, 3)."""
    bodies: Sequence[FixedBody] = ()
    """Bodies of the world around the vehicle."""
    events: Sequence[tuple[float, str]] = ()
    """Time since the start of the source [s] and text of all events of a recorded source, in order."""
    eyes: Sequence[str] = ()
    """Names of the vehicle's own cameras and sonars whose pictures frames have."""


@dataclass(frozen=True)
class LatestPicture:
    """Latest picture of the overhead camera."""

    image: npt.NDArray[np.uint8] | None
    """Grey values; None if only tags are known."""
    tags: Sequence[TagCorners] = ()
    size: tuple[int, int] = (720, 1280)
    """Numbers of rows and columns."""


@dataclass(frozen=True, kw_only=True)
class ViewFrame:
    """Content of the view at one time."""

    time: float
    """Time since the start of the source [s]."""
    truth: BodyPose | None = None
    estimate: BodyPose | None = None
    covariance: Array | None = None
    """Covariance of the estimated position, world frame [m²], (3, 3); None if the source has none."""
    goal: BodyPose | None = None
    force: Array = field(default_factory=lambda: np.zeros(0))
    """Forces of the thrusters, canonical order [N], (n,), or empty."""
    values: Array = field(default_factory=lambda: np.zeros(0))
    """Values of the other actuators, in the vehicle file's order [rad, m³ or m], (m,), or empty."""
    trail: Array = field(default_factory=nowhere)
    """Recent positions of the vehicle, world frame [m], (k, 3)."""
    picture: LatestPicture | None = None
    pictures: Mapping[str, npt.NDArray[np.uint8]] = field(default_factory=dict)
    """Latest pictures by name: of the vehicle's own cameras, (rows, columns, 3), and of its sonars as grey
    fans from above."""
    status: Mapping[str, str] = field(default_factory=dict)
    """Name -> short text, or a number with its unit."""
    events: Sequence[str] = ()
    """Latest events, the newest last."""
    notice: str = ""
    """Short text beside the vehicle."""


class PlotLine(NamedTuple):
    """Curve of a plot."""

    plot: str
    """Title of the plot, with the unit."""
    label: str
    time: Array
    """Times [s], (k,)."""
    value: Array
    """Values in the unit of the plot, NaN if unknown, (k,)."""


class Source(Protocol):
    """Source of frames. A recorded one has frames of all times; a live one only advances."""

    stage: ViewStage
    duration: float
    """Duration [s]; infinite for a live source."""

    def frame(self, time: float) -> ViewFrame:
        """Return the frame at a time since the start [s]."""

    def curves(self) -> Sequence[PlotLine]:
        """Return the known errors over time. Curves of one plot have the same times."""

    def close(self) -> None:
        """Release all resources."""


class Placeholder:
    """Vehicle at rest, shown until the source of a view is ready."""

    duration = math.inf

    def __init__(self, vehicle: Vehicle, title: str, notice: str, *, placed: bool = True) -> None:
        """
        Args:
            vehicle: Vehicle to show.
            title: Title of the view.
            notice: Short text about what is being waited for.
            placed: False hides the vehicle, if it is not yet known.
        """
        deep = max(0.5, float(vehicle.body.size[2]))
        room = max(4.0, 3.0 * float(vehicle.body.size[0]))
        lower, upper = box_of(vehicle, (room, 0.5 * room, 2.0 * deep), nowhere())
        self.stage = ViewStage(vehicle=vehicle, title=title, lower=lower, upper=upper)
        pose = BodyPose(np.array([0.0, 0.0, -deep]), np.array([0.0, 0.0, 0.0, 1.0]))
        self._pose, self._notice = pose if placed else None, notice

    def frame(self, time: float) -> ViewFrame:
        """Return the vehicle, which does not move, at a time since the start [s]."""
        return ViewFrame(time=time, truth=self._pose, status={"state": self._notice}, notice=self._notice)

    def curves(self) -> Sequence[PlotLine]:
        """Return no curves."""
        return ()

    def close(self) -> None:
        """Do nothing, because nothing is open."""


# The box of water that is drawn.

AROUND = 4.0
"""Half the width of the shown part of a world, around its viewpoint [m]."""
MARGIN = 0.5
"""Margin around a motion without bounds [m]."""


def box_of(
    vehicle: Vehicle, basin: tuple[float, float, float] | None, positions: Array
) -> tuple[Array, Array]:
    """Return the lower and upper corner of a pool, otherwise of the vehicle's workspace, or of the motion
    [m], (3,).

    Args:
        vehicle: Vehicle, whose file may limit its workspace.
        basin: Length, width and depth [m], centred on the world's z axis under z = 0.
        positions: Positions to be included, world frame [m], (k, 3).
    """
    if basin is not None:
        half = np.array([0.5 * basin[0], 0.5 * basin[1]])
        return np.array([*-half, -basin[2]]), np.array([*half, 0.0])
    if "safety" not in vehicle.defaults:
        lower = np.array(vehicle.safety.workspace_lower, float)
        upper = np.array(vehicle.safety.workspace_upper, float)
        if np.isfinite([lower, upper]).all():
            upper[2] = 0.0
            return lower, upper
    finite = positions[np.isfinite(positions).all(axis=1)] if len(positions) else np.zeros((1, 3))
    lower, upper = finite.min(axis=0) - MARGIN, finite.max(axis=0) + MARGIN
    upper[2] = 0.0
    return lower, upper


def box_of_world(world: World) -> tuple[Array, Array]:
    """Return the lower and upper corner of a world: its basin, or around its viewpoint down to the seabed
    [m], (3,)."""
    if world.basin is not None:
        length, width, depth = world.basin.size
        return np.array([-0.5 * length, -0.5 * width, -depth]), np.array([0.5 * length, 0.5 * width, 0.0])
    x, y, z = world.viewpoint.position
    depth = 2.0 * abs(z) if world.seabed is None else world.seabed.depth
    return np.array([x - AROUND, y - AROUND, -depth]), np.array([x + AROUND, y + AROUND, 0.0])
