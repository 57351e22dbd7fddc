"""Messages on the wires of a robot, as plain values in SI units; `robot.links` encodes and decodes them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ThrusterCommand:
    """Command to the motor controller, in its own order of outputs and with its own signs."""

    enable: bool
    """False: motors off, whatever the numbers are."""
    normalised: tuple[float, ...]
    """Part of the full-scale shaft speed per motor output, in [-1, 1]."""
    setpoints: tuple[float, ...] = ()
    """Values of the actuators besides thrusters, in the order of the vehicle file [rad, m³ or m]."""


@dataclass(frozen=True)
class Telemetry:
    """A snapshot of the vehicle as its motor controller sends it."""

    sequence: int
    """Counts up, modulo 2¹⁶."""
    mcu_ms: int
    """The controller's clock [ms], modulo 2³²."""
    quaternion: tuple[float, float, float, float]
    """Rotation from the IMU frame to the level world of its own attitude filter, xyzw (wxyz on the wire)."""
    gyro: tuple[float, float, float]
    """IMU frame [rad/s]."""
    accel: tuple[float, float, float]
    """Specific force, IMU frame [m/s²]; +9.81 upwards at rest."""
    depth: float
    """Depth of the pressure port, positive down [m]."""
    pressure: float
    """Absolute [Pa]."""
    flags: int
    """Status bits (see `robot.links`)."""
    motor_rpm: tuple[float, ...] | None
    """Speed per motor output, with the controller's own signs [rpm]; None from a firmware that does not report it."""
    actuators: tuple[float, ...] = ()
    """Values of the actuators besides thrusters, in the order of the vehicle file [rad, m³ or m]; empty where there are
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
    """Commands as they came, in the unit of the command."""
    applied: tuple[float, ...]
    """Commands that the motors were given, in the unit of the command."""
    debug_mask: int
    decimation: int


@dataclass(frozen=True)
class NavigationAid:
    """Reading of a navigation instrument, aboard (Doppler log, compass) or beside the water (positioning)."""

    sequence: int
    """Counts up, modulo 2¹⁶."""
    kind: int
    """`VELOCITY`, `HEADING`, `POSITION` or `POSE`."""
    age: float
    """Since it was measured, when it was sent [s]."""
    values: tuple[float, float, float]
    """VELOCITY: over the floor, log's axes [m/s]. HEADING: left positive from world x [rad], 0, 0. POSITION: x, y, z
    and POSE: x, y, yaw of the body origin, world frame [m, rad]."""
    std: tuple[float, float]
    """Standard deviation of a velocity [m/s] or position [m], per axis, and of a yaw [rad]; 0 if it is not given."""


VELOCITY, HEADING, POSITION, POSE = 1, 2, 3, 4
"""Kinds of `NavigationAid`."""
POSITION_STD, YAW_STD = 0.5, 0.1
"""Standard deviations of a fix that does not give its own [m, rad]."""


@dataclass(frozen=True)
class TagCorners:
    """A tag that a camera's own processor found."""

    tag_id: int
    corners: Array
    """Corners as in `localization.detection.Detection.corners`, (4, 2) [px]."""


@dataclass(frozen=True)
class Picture:
    """One exposure of the overhead camera, grey values or the tags already found in them; or one reading of a camera,
    sonar or altimeter of the vehicle."""

    time: float
    """When it came, robot's clock [s]; the exposure is `Pool.latency`, or that of the sensor, earlier."""
    sequence: int
    image: npt.NDArray[np.uint8] | None = None
    """Grey (rows, columns), red green blue (rows, columns, 3), or of a sonar (beams, range cells), beam 0 at the left;
    None where only tags or ranges are sent."""
    tags: tuple[TagCorners, ...] = ()
    source: str = ""
    """Name in the vehicle's `perception`; the overhead camera if empty."""
    ranges: npt.NDArray[np.float32] | None = None
    """Ranges of an altimeter, a rangefinder or a DVL's beams [m], infinite if nothing is in reach, (beams,)."""


@dataclass(frozen=True)
class Delivery:
    """Everything that reached the robot's computer up to a time."""

    time: float
    """Robot's clock [s]."""
    frames: tuple[tuple[float, bytes], ...] = ()
    """Datagrams of the motor controller, each with its time of arrival [s]."""
    pictures: tuple[Picture, ...] = field(default=())
