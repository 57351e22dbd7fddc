"""Messages on the links of a robot, as plain values in SI units; `robot.links` encodes and decodes them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ThrusterCommand:
    """Command to the motor controller, with its own order of outputs and its own signs."""

    enable: bool
    """False: motors off, regardless of the numbers."""
    normalised: tuple[float, ...]
    """Fraction of the full-scale shaft speed per motor output, in [-1, 1]."""
    setpoints: tuple[float, ...] = ()
    """Values of the actuators besides thrusters, in the order of the vehicle file [rad, m³ or m]."""


@dataclass(frozen=True)
class Telemetry:
    """Telemetry of the motor controller."""

    sequence: int
    """Counter, modulo 2¹⁶."""
    mcu_ms: int
    """The controller's clock [ms], modulo 2³²."""
    quaternion: tuple[float, float, float, float]
    """Rotation from the IMU frame to the level world frame of its own attitude filter, xyzw (wxyz on the wire)."""
    gyro: tuple[float, float, float]
    """Angular rate, IMU frame [rad/s]."""
    accel: tuple[float, float, float]
    """Specific force, IMU frame [m/s²]; +9.81 upwards at rest."""
    depth: float
    """Depth of the pressure port, positive down [m]."""
    pressure: float
    """Absolute pressure [Pa]."""
    flags: int
    """Status bits (see `robot.links`)."""
    motor_rpm: tuple[float, ...] | None
    """Speed per motor output, with the controller's own signs [rpm]; None from a firmware that does not report it."""
    actuators: tuple[float, ...] = ()
    """Values of the actuators besides thrusters, in the order of the vehicle file [rad, m³ or m]; empty if there are
    none, or the firmware uses version 1 of the protocol."""


@dataclass(frozen=True)
class CommandEcho:
    """The motor controller's echo of a command, sent on request."""

    sequence: int
    mcu_ms: int
    command_count: int
    receive_ms: int
    command_crc: int
    enabled: bool
    accepted: bool
    reject_flags: int
    received: tuple[float, ...]
    """Received commands, in the unit of the command."""
    applied: tuple[float, ...]
    """Executed commands, in the unit of the command."""
    debug_mask: int
    decimation: int


@dataclass(frozen=True)
class NavigationAid:
    """Reading of a navigation instrument, aboard (DVL, compass) or external (positioning)."""

    sequence: int
    """Counter, modulo 2¹⁶."""
    kind: int
    """`VELOCITY`, `HEADING`, `POSITION` or `POSE`."""
    age: float
    """Time between measurement and sending [s]."""
    values: tuple[float, float, float]
    """VELOCITY: over the floor, DVL's axes [m/s]. HEADING: left positive from world x [rad], 0, 0. POSITION: x, y, z
    and POSE: x, y, yaw of the body origin, world frame [m, rad]."""
    std: tuple[float, float]
    """Standard deviation of a velocity [m/s] or position [m], per axis, and of a yaw [rad]; 0 if it is not given."""


VELOCITY, HEADING, POSITION, POSE = 1, 2, 3, 4
"""Kinds of `NavigationAid`."""
POSITION_STD, YAW_STD = 0.5, 0.1
"""Standard deviations of a fix without its own [m, rad]."""


@dataclass(frozen=True)
class TagCorners:
    """A tag detected by a camera's own processor."""

    tag_id: int
    corners: Array
    """Corners as in `localization.detection.Detection.corners`, (4, 2) [px]."""


@dataclass(frozen=True)
class Picture:
    """One exposure of the overhead camera, as grey values or detected tags; or one reading of a camera, sonar or
    altimeter of the vehicle."""

    time: float
    """Time of arrival, robot's clock [s]; the exposure is earlier by `Pool.latency`, or by that of the sensor."""
    sequence: int
    image: npt.NDArray[np.uint8] | None = None
    """Grey (rows, columns), red green blue (rows, columns, 3), or for a sonar (beams, range cells), beam 0 at the left;
    None if only tags or ranges are sent."""
    tags: tuple[TagCorners, ...] = ()
    source: str = ""
    """Name in the vehicle's `perception`; the overhead camera if empty."""
    ranges: npt.NDArray[np.float32] | None = None
    """Ranges of an altimeter, a rangefinder or a DVL's beams [m], infinite without an echo, (beams,)."""


@dataclass(frozen=True)
class Delivery:
    """Everything that has reached the robot's computer up to a time."""

    time: float
    """Robot's clock [s]."""
    frames: tuple[tuple[float, bytes], ...] = ()
    """Datagrams of the motor controller, each with its time of arrival [s]."""
    pictures: tuple[Picture, ...] = field(default=())
