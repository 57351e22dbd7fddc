"""Data of a robot as ROS 2 messages: topics with their QoS policies, types, and functions that create the messages.

Frames are map, base_link and imu_link, units SI.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import resources
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.core.optics import Lens
from finssim.core.rotations import quat_conjugate, quat_from_yaw, quat_multiply, quat_to_matrix
from finssim.core.sonar_fan import fan_picture
from finssim.robot.messages import (
    HEADING,
    POSE,
    POSITION,
    POSITION_STD,
    VELOCITY,
    YAW_STD,
    CommandEcho,
    NavigationAid,
    Picture,
    Telemetry,
)
from finssim.robot.pictures import jpeg
from finssim.robot.reading import Reading
from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import with_navigation
from finssim.vehicles.device_files import CameraDevice, Device, RangeDevice, SonarDevice, device_of

# Names, types, frames and QoS policies of all data of a robot: one table, for topics, records and the documentation.


STREAM, COMMAND, LATCHED, SENSOR = "stream", "command", "latched", "sensor"

QUALITIES = {
    STREAM: "reliable, volatile, depth 10",
    COMMAND: "reliable, volatile, depth 1",
    LATCHED: "reliable, transient local, depth 1",
    SENSOR: "best effort, volatile, depth 5",
}
"""QoS policies in use. A best-effort publisher is incompatible with a reliable subscription; every other pair
matches."""


INFINITE = (9223372036, 854775807)
"""RMW_DURATION_INFINITE [s, ns]."""


def is_reliable(quality: str) -> bool:
    """Return whether lost messages are sent again."""
    return quality != SENSOR


def is_latched(quality: str) -> bool:
    """Return whether a late subscriber receives the last message."""
    return quality == LATCHED


def depth_of(quality: str) -> int:
    """Return the depth of the history, the number of stored messages."""
    return {STREAM: 10, SENSOR: 5}.get(quality, 1)


def offered_qos(quality: str) -> str:
    """Return the topic's QoS policies in the form of rosbag2: a list of profiles in YAML, as numbers, which every
    release reads.

    Names of policies came with Jazzy, whose reader tries numbers first; Humble's reader supports only numbers.
    """
    forever = f"{{sec: {INFINITE[0]}, nsec: {INFINITE[1]}}}"
    policies = {
        "history": 1,
        "depth": depth_of(quality),
        "reliability": 1 if is_reliable(quality) else 2,
        "durability": 1 if is_latched(quality) else 2,
        "deadline": forever,
        "lifespan": forever,
        "liveliness": 1,
        "liveliness_lease_duration": forever,
        "avoid_ros_namespace_conventions": "false",
    }
    return "- " + "\n  ".join(f"{name}: {value}" for name, value in policies.items())


@dataclass(frozen=True)
class Topic:
    """One topic."""

    name: str
    """Name below the vehicle's namespace, unless it begins with a slash."""
    type: str
    """Type such as `nav_msgs/msg/Odometry`."""
    quality: str
    """One of `QUALITIES`."""
    frame: str
    """`frame_id` of its header; empty if it has none."""
    sender: str
    """Nodes that publish it."""
    meaning: str

    def under(self, vehicle: str) -> str:
        """Return the full name for a vehicle."""
        return self.name if self.name.startswith("/") else f"/{vehicle}/{self.name}"


TOPICS = {
    "imu": Topic("imu", "sensor_msgs/msg/Imu", SENSOR, "base_link", "hardware_bridge, sim",
        "inertial sample, body axes"),
    "pressure": Topic("pressure", "sensor_msgs/msg/FluidPressure", SENSOR, "base_link", "hardware_bridge, sim",
        "absolute pressure [Pa]"),
    "telemetry": Topic("telemetry", "finssim_msgs/msg/HardwareTelemetry", STREAM, "imu_link", "hardware_bridge",
        "snapshot of the motor controller, as it came"),
    "shafts": Topic("joint_states", "sensor_msgs/msg/JointState", STREAM, "base_link", "hardware_bridge",
        "shafts' speeds"),
    "actuators": Topic("actuator_states", "sensor_msgs/msg/JointState", STREAM, "base_link", "hardware_bridge, sim",
        "values of actuators besides thrusters as position: fin and gimbal [rad], moving mass [m], buoyancy [m³]"),
    "setpoints": Topic("actuator_cmd", "sensor_msgs/msg/JointState", COMMAND, "base_link", "controller, you",
        "requested values of these actuators as position; they act with the next thruster_cmd, and are ignored when "
        "stale"),
    "odometry": Topic("odom", "nav_msgs/msg/Odometry", STREAM, "map", "state_estimation, sim",
        "state: pose in map, twist in base_link (`child_frame_id`)"),
    "estimator": Topic("estimator_status", "finssim_msgs/msg/EstimatorStatus", STREAM, "map", "state_estimation, sim",
        "whether the state may be acted on, and why not"),
    "fix": Topic("vision/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", STREAM, "map", "localizer",
        "pose from one picture, through the refracting water"),
    "positioning": Topic(
        "positioning/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", SENSOR, "map", "hardware_bridge",
        "fix of motion capture (x, y, yaw) or acoustic positioning (x, y, z), by wire; what is not measured has 1e6",
    ),
    "dvl": Topic("dvl/twist", "geometry_msgs/msg/TwistWithCovarianceStamped", SENSOR, "dvl_link", "hardware_bridge",
        "velocity over the floor by the Doppler log, its axes; a covariance greater than the vehicle file's counts"),
    "compass": Topic("compass/imu", "sensor_msgs/msg/Imu", SENSOR, "base_link", "hardware_bridge",
        "heading in the map as an orientation; it has no rates and no specific force"),
    "goal": Topic("goal", "geometry_msgs/msg/PoseStamped", COMMAND, "map", "you", "pose to hold"),
    "path": Topic("path", "nav_msgs/msg/Path", LATCHED, "map", "controller",
        "trajectory that is followed, each pose stamped with its time"),
    "follow": Topic("follow_path", "nav_msgs/msg/Path", COMMAND, "map", "you",
        "trajectory to follow from now on: a level pose at each time, counted from the first one's"),
    "trajectory": Topic("trajectory", "std_msgs/msg/String", COMMAND, "", "you",
        "name or file of a trajectory to follow from now on"),
    "mode": Topic("mode", "std_msgs/msg/String", COMMAND, "", "teleop, you",
        "controller to use: pid, pid-paper, policy or teleop"),
    "wrench": Topic("wrench_cmd", "geometry_msgs/msg/WrenchStamped", COMMAND, "base_link", "teleop, you",
        "requested wrench [N, N m]"),
    "command": Topic("thruster_cmd", "finssim_msgs/msg/ThrusterCommand", COMMAND, "base_link", "controller",
        "requested thrust of each thruster [N]; ignored when stale"),
    "thrusters": Topic(
        "thruster_state", "finssim_msgs/msg/ThrusterState", STREAM, "base_link", "hardware_bridge, sim",
        "armed or not and why, thrusts as limited and as measured",
    ),
    "echo": Topic("command_echo", "finssim_msgs/msg/CommandEcho", STREAM, "base_link", "hardware_bridge",
        "a command as executed by the motor controller"),
    "policy": Topic("policy_info", "finssim_msgs/msg/PolicyInfo", STREAM, "base_link", "controller",
        "one decision, in and out"),
    "arm": Topic("arm", "std_msgs/msg/Bool", COMMAND, "", "teleop, you",
        "true arms, false disarms; nothing else arms"),
    "stop": Topic("stop", "std_msgs/msg/Empty", COMMAND, "", "controller, teleop, you",
        "zero thrust until acknowledged"),
    "acknowledge": Topic("acknowledge", "std_msgs/msg/Empty", COMMAND, "", "teleop, you",
        "ends a fault; leaves it disarmed"),
    "image": Topic("camera/image", "sensor_msgs/msg/Image", SENSOR, "camera_optical", "camera", "picture, mono8"),
    "picture": Topic("camera/image/compressed", "sensor_msgs/msg/CompressedImage", SENSOR, "camera_optical", "camera",
        "the same as JPEG"),
    "camera_info": Topic("camera/camera_info", "sensor_msgs/msg/CameraInfo", LATCHED, "camera_optical", "camera",
        "its calibration"),
    "tags": Topic("camera/tags", "std_msgs/msg/String", STREAM, "", "camera, localizer",
        "tags found in a picture, JSON"),
    "event": Topic("events", "std_msgs/msg/String", STREAM, "", "every node", "what happened, JSON"),
    "diagnostics": Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", STREAM, "", "every node",
        "health of each part once a second: localization, link, watchdogs, pictures, control, record"),
    "transform": Topic("/tf", "tf2_msgs/msg/TFMessage", STREAM, "map", "state_estimation, sim",
        "map to odom, odom to base_link"),
    "fixed_transform": Topic("/tf_static", "tf2_msgs/msg/TFMessage", LATCHED, "base_link", "state_estimation, sim",
        "base_link to all that is mounted on it, map to camera_link, camera_link to camera_optical"),
    "robot": Topic("robot_description", "std_msgs/msg/String", LATCHED, "", "state_estimation, sim",
        "URDF of the vehicle file"),
    "clock": Topic("/clock", "rosgraph_msgs/msg/Clock", SENSOR, "", "sim, virtual_pool", "simulated time"),
    "done": Topic("/clock_done", "std_msgs/msg/Header", STREAM, "", "every node in lock-step",
        "the node named by frame_id has done its work of a time of /clock"),
    "sent": Topic("messages/sent", "finssim_msgs/msg/TeamMessage", STREAM, "", "you",
        "message to the other vehicles of a team"),
    "received": Topic("messages/received", "finssim_msgs/msg/TeamMessage", STREAM, "", "virtual_pool",
        "message of another vehicle, as late as sound and processing make it, if it is not lost"),
}  # fmt: skip
"""Key -> topic."""
OWN_TOPICS = {
    "camera": {
        "image": Topic("NAME/image", "sensor_msgs/msg/Image", SENSOR, "NAME_optical", "camera",
            "picture of a camera of the vehicle, rgb8"),
        "picture": Topic("NAME/image/compressed", "sensor_msgs/msg/CompressedImage", SENSOR, "NAME_optical", "camera",
            "the same as JPEG; of a sonar its fan from above, ahead upwards"),
        "camera_info": Topic("NAME/camera_info", "sensor_msgs/msg/CameraInfo", SENSOR, "NAME_optical", "camera",
            "its lens, with each picture; behind a flat port the lens in air"),
    },
    "sonar": {
        "sonar": Topic("NAME/sonar_image", "marine_acoustic_msgs/msg/ProjectedSonarImage", SENSOR, "NAME_acoustic",
            "camera", "ping of an imaging sonar, 8 bits, all beams of a range together"),
        "picture": Topic("NAME/image/compressed", "sensor_msgs/msg/CompressedImage", SENSOR, "NAME_link", "camera",
            "the same as JPEG; of a sonar its fan from above, ahead upwards"),
    },
    "range": {
        "range": Topic("NAME/range", "sensor_msgs/msg/Range", SENSOR, "NAME_link", "camera",
            "of an altimeter or rangefinder along x, inf where nothing is in reach; of several beams the shortest"),
    },
    "beams": {
        "beams": Topic("NAME/beams", "marine_acoustic_msgs/msg/Dvl", SENSOR, "NAME_acoustic", "camera",
            "ranges of the four beams of a Doppler log; velocities are not known (NaN)"),
    },
}  # fmt: skip
"""Kind of a sensor of the vehicle -> key -> topic, for NAME in its `perception`."""
FAN_ROWS = 400
"""Height of a sonar's fan [px]."""


def own_kind(device: Device) -> str:
    """Return the kind of a device, a key of `OWN_TOPICS`."""
    if isinstance(device, CameraDevice):
        return "camera"
    return "sonar" if isinstance(device, SonarDevice) else "beams" if device.beams == 4 else "range"


def own_topics(vehicle: Vehicle) -> dict[str, Topic]:
    """Return the topics of the cameras, sonars and altimeters of a vehicle, by key: `front_camera/image`.

    Raises:
        DeviceError: A device description is invalid.
    """
    return {
        f"{name}/{key}": replace(
            topic, name=topic.name.replace("NAME", name), frame=topic.frame.replace("NAME", name)
        )
        for name in vehicle.perception
        for key, topic in OWN_TOPICS[own_kind(device_of(vehicle, name))].items()
    }


# The ROS 2 types of a record's messages: definitions, constructors and CDR through rosbags.


class RecordError(ValueError):
    """A record cannot be read, or not played as requested."""


METADATA = "finssim"
"""Name of the metadata record that describes the record."""


@cache
def types() -> Any:
    """Return a rosbags type store of ROS 2 Humble's messages, those for sonars, and FinsSim's own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for package in (resources.files("finssim") / "robot" / "interfaces").iterdir():
        for file in sorted((package / "msg").iterdir(), key=lambda file: file.name):
            name = f"{package.name}/msg/{file.name.removesuffix('.msg')}"
            store.register(get_types_from_msg(file.read_text(encoding="utf-8"), name))
    return store


def definition(kind: str) -> str:
    """Return the text of a type and of all types that it uses."""
    text, _ = types().generate_msgdef(kind, ros_version=2)
    return str(text)


LENS_MODELS = {"plumb_bob": "plumb_bob", "rational": "rational_polynomial", "fisheye": "equidistant"}
"""FinsSim's name of a lens model -> that of ROS, with the same coefficients in the same order."""

MAP, BASE, IMU, LOG = "map", "base_link", "imu_link", "dvl_link"
SHARED = ("", MAP, "camera", "camera_link", "camera_optical")
"""Frames of the pool and its camera, which several vehicles share."""

IMU_VARIANCES = ((0.02, 0.02, 0.05), (0.01,) * 3, (0.1,) * 3)
"""Variances of attitude [rad²], rates [rad²/s²] and specific force [m²/s⁴], as in the published bridge."""

UNKNOWN = 1.0e6
"""Variance of unknown quantities [m², rad², m²/s²]."""

DIAGONAL = np.diag_indices(6)

PRESSURE_VARIANCE = (0.05 * 9.81e3) ** 2
"""Variance of 0.05 m of water [Pa²]: the published 0.0025 m²."""

STATES = ("disarmed", "armed", "hold", "fault")
"""Names of the states of the bridge, in their order."""

MOST = 2**32 - 1
"""Largest count of a uint32."""

FIRST_TIME, LAST_TIME = -(2**31) * 10**9, 2**31 * 10**9 - 1
"""Range of builtin_interfaces/Time, whose seconds are an int32 [ns]."""

LEVELS = ("ok", "warn", "error", "stale")
"""Names of the levels of a diagnostic, in their order."""


class Messages:
    """Constructor of the messages of one vehicle; times are integers [ns]."""

    def __init__(self, vehicle: Vehicle, prefix: str = "") -> None:
        """Prepare the constants of the messages.

        Args:
            vehicle: Vehicle with its instruments and the order of its thrusters.
            prefix: Prefix of the vehicle's own frames, such as `robot_1/`, if several vehicles share /tf.
        """
        self._prefix = prefix
        self.types = types()
        self._of = self.types.types
        self.names, self.others = list(vehicle.thruster_names), list(vehicle.actuators)
        imu = vehicle.sensors.imu
        q_body_imu = np.array([0.0, 0.0, 0.0, 1.0]) if imu is None else np.array(imu.orientation)
        self._R_body_imu = quat_to_matrix(q_body_imu)
        # Right multiplication by a constant quaternion is a matrix, whose product takes a microsecond.
        self._to_body = quat_multiply(np.eye(4), quat_conjugate(q_body_imu)).T
        self._imu_variances = [np.diag(v).ravel() for v in IMU_VARIANCES]
        sensors = with_navigation(vehicle).sensors
        assert sensors.dvl is not None and sensors.compass is not None
        self._log_std, self._compass_std = sensors.dvl.noise_std, sensors.compass.noise_std
        thrusters = vehicle.thrusters.values()
        self._outputs = [t.motor_index for t in thrusters if t.motor_index is not None]
        signs = np.array([float(t.motor_sign or 1) for t in thrusters])
        self._rad_per_s = signs * (2.0 * math.pi / 60.0)
        self._vehicle = vehicle

    @cached_property
    def own(self) -> dict[str, Device]:
        """Devices of the vehicle's cameras, sonars and altimeters, by name."""
        return {name: device_of(self._vehicle, name) for name in self._vehicle.perception}

    def cdr(self, message: Any, kind: str) -> bytes:
        """Return the serialised message."""
        return bytes(self.types.serialize_cdr(message, kind))

    def imu(self, stamp: int, telemetry: Telemetry) -> Any:
        """Return attitude of the body, and rates and specific force in body axes."""
        attitude, rates, force = self._imu_variances
        return self._of["sensor_msgs/msg/Imu"](
            self.header(stamp, BASE),
            self.quaternion(self._to_body @ telemetry.quaternion),
            attitude,
            self.vector(self._R_body_imu @ telemetry.gyro),
            rates,
            self.vector(self._R_body_imu @ telemetry.accel),
            force,
        )

    def pressure(self, stamp: int, telemetry: Telemetry) -> Any:
        """Return the absolute pressure at the port."""
        return self._of["sensor_msgs/msg/FluidPressure"](
            self.header(stamp, BASE), telemetry.pressure, PRESSURE_VARIANCE
        )

    def filled(self, kind: str, stamp: int, frame: str, values: Mapping[str, Any]) -> Any:
        """Return a FinsSim message with the given fields; others are NaN, 0 or empty, depending on their type."""
        fields = {name: make(values.get(name, default)) for name, make, default in fields_of(kind)}
        return self._of[f"finssim_msgs/msg/{kind}"](header=self.header(stamp, frame), **fields)

    def telemetry(self, stamp: int, received: int, telemetry: Telemetry) -> Any:
        """Return the received telemetry."""
        values = {
            "received": self.time(received),
            "sequence": telemetry.sequence & 0xFFFF,
            "mcu_ms": telemetry.mcu_ms & 0xFFFFFFFF,
            "status_flags": telemetry.flags & 0xFFFFFFFF,
            "orientation": self.quaternion(telemetry.quaternion),
            "angular_velocity": self.vector(telemetry.gyro),
            "linear_acceleration": self.vector(telemetry.accel),
            "depth": telemetry.depth,
            "pressure": telemetry.pressure,
            "motor_rpm": telemetry.motor_rpm or (),
        }
        return self.filled("HardwareTelemetry", stamp, IMU, values)

    def aid(self, stamp: int, aid: NavigationAid) -> tuple[str, Any] | None:
        """Return the message of a navigation instrument, with the key of its topic; None if there is no such
        instrument.

        Unmeasured components have the variance `UNKNOWN`; rates and specific force of a compass are marked as missing.
        """
        x, y, z = aid.values
        std, turn = aid.std[0] or POSITION_STD, aid.std[1] or YAW_STD
        of, none = self._of, np.array([-1.0, *[0.0] * 8])
        if aid.kind == VELOCITY:
            twist = of["geometry_msgs/msg/Twist"](self.vector(aid.values), self.vector((0.0, 0.0, 0.0)))
            covariance = np.diag([*[max(aid.std[0], self._log_std) ** 2] * 3, *[UNKNOWN] * 3]).ravel()
            measured = of["geometry_msgs/msg/TwistWithCovariance"](twist, covariance)
            kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
            return "dvl", of[kind](self.header(stamp, LOG), measured)
        if aid.kind == HEADING:
            level = np.diag([UNKNOWN, UNKNOWN, self._compass_std**2]).ravel()
            heading = self.quaternion(quat_from_yaw(x))
            rest = self.vector((0.0, 0.0, 0.0))
            message = of["sensor_msgs/msg/Imu"](
                self.header(stamp, BASE), heading, level, rest, none, rest, none
            )
            return "compass", message
        if aid.kind not in (POSITION, POSE):
            return None
        posed = aid.kind == POSE
        unknown = (UNKNOWN, UNKNOWN, UNKNOWN, turn**2) if posed else (std**2, UNKNOWN, UNKNOWN, UNKNOWN)
        pose = self.pose((x, y, 0.0 if posed else z), quat_from_yaw(z if posed else 0.0))
        covariance = np.diag([std**2, std**2, *unknown]).ravel()
        fix = of["geometry_msgs/msg/PoseWithCovariance"](pose, covariance)
        return "positioning", of["geometry_msgs/msg/PoseWithCovarianceStamped"](self.header(stamp, MAP), fix)

    def shafts(self, stamp: int, motor_rpm: Sequence[float]) -> Any | None:
        """Return measured shaft speeds by thruster, with the signs of positive thrust [rad/s]; None if not all are
        known."""
        if len(self._outputs) < len(self.names) or len(motor_rpm) <= max(self._outputs):
            return None
        speed, none = np.asarray(motor_rpm, float)[self._outputs] * self._rad_per_s, np.zeros(0)
        return self._of["sensor_msgs/msg/JointState"](self.header(stamp, BASE), self.names, none, speed, none)

    def actuators(self, stamp: int, values: npt.ArrayLike) -> Any:
        """Return values of the actuators besides thrusters, in the vehicle file's order [rad, m³ or m]."""
        none = np.zeros(0)
        return self._of["sensor_msgs/msg/JointState"](
            self.header(stamp, BASE), self.others, np.asarray(values, float), none, none
        )

    def odometry(self, stamp: int, reading: Reading) -> Any:
        """Return pose in the map and velocity in body axes, with covariances from the reading's standard deviations.

        Roll, pitch and rates, which have no standard deviation in a reading, have the variances of `imu`; unknown
        components have `UNKNOWN`.
        """
        variance = np.square(np.asarray(reading.std, float))
        R = quat_to_matrix(reading.quaternion)
        pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
        pose[DIAGONAL] = [*variance[:3], *IMU_VARIANCES[0][:2], variance[6]]
        twist[:3, :3] = R.T @ np.diag(variance[3:6]) @ R
        twist[3:, 3:] = np.diag(IMU_VARIANCES[1])
        of = self._of
        return of["nav_msgs/msg/Odometry"](
            self.header(stamp, MAP),
            self.frame(BASE),
            of["geometry_msgs/msg/PoseWithCovariance"](
                self.pose(reading.position, reading.quaternion), numbers_of(pose)
            ),
            of["geometry_msgs/msg/TwistWithCovariance"](
                of["geometry_msgs/msg/Twist"](self.vector(reading.nu[:3]), self.vector(reading.nu[3:])),
                numbers_of(twist),
            ),
        )

    def transform(self, stamp: int, reading: Reading) -> Any:
        """Return the transform from map to base_link, for viewers."""
        of = self._of
        pose = of["geometry_msgs/msg/Transform"](
            self.vector(reading.position), self.quaternion(reading.quaternion)
        )
        stamped = of["geometry_msgs/msg/TransformStamped"](self.header(stamp, MAP), self.frame(BASE), pose)
        return of["tf2_msgs/msg/TFMessage"]([stamped])

    def estimator(self, stamp: int, reading: Reading, health: Mapping[str, Any]) -> Any:
        """Return the estimator's status; values missing in `health` are NaN, 0 or empty."""
        std = np.asarray(reading.std, float)
        judged = {"position_std": std[:3], "velocity_std": std[3:6], "yaw_std": std[6]}
        status = {"ready": reading.ready, "mode": reading.mode, "reason": reading.reason}
        return self.filled("EstimatorStatus", stamp, MAP, {**health, **status, **judged})

    def goal(self, stamp: int, position: Any, yaw: float) -> Any:
        """Return a level pose in the map.

        Args:
            stamp: [ns]
            position: Map frame [m], (3,).
            yaw: About the map's z, left positive [rad].
        """
        pose = self.pose(position, quat_from_yaw(yaw))
        return self._of["geometry_msgs/msg/PoseStamped"](self.header(stamp, MAP), pose)

    def wrench(self, stamp: int, tau: Any) -> Any:
        """Return a requested wrench, body axes, (6,) [N, N m]."""
        wrench = self._of["geometry_msgs/msg/Wrench"](self.vector(tau[:3]), self.vector(tau[3:]))
        return self._of["geometry_msgs/msg/WrenchStamped"](self.header(stamp, BASE), wrench)

    def command(self, stamp: int, force: Any, source: str) -> Any:
        """Return requested thrusts, canonical order [N]."""
        values = {"source": source, "names": self.names, "force": force}
        return self.filled("ThrusterCommand", stamp, BASE, values)

    def thrusters(self, stamp: int, state: str, values: Mapping[str, Any]) -> Any:
        """Return the state of the bridge and its commands."""
        values_of_bridge = {"state": STATES.index(state), "names": self.names}
        return self.filled("ThrusterState", stamp, BASE, {**values, **values_of_bridge})

    def policy(self, stamp: int, pilot: str, values: Mapping[str, Any]) -> Any:
        """Return one decision of a controller."""
        return self.filled("PolicyInfo", stamp, BASE, {**values, "pilot": pilot})

    def echo(self, stamp: int, echo: CommandEcho) -> Any:
        """Return the motor controller's echo of a command."""
        return self.filled("CommandEcho", stamp, BASE, vars(echo))

    def picture(self, stamp: int, packed: bytes | None, frame: str = "camera") -> Any | None:
        """Return a picture in JPEG; None if it could not be encoded."""
        if packed is None:
            return None
        data = np.frombuffer(packed, np.uint8)
        return self._of["sensor_msgs/msg/CompressedImage"](self.header(stamp, frame), "jpeg", data)

    def image(self, stamp: int, image: npt.NDArray[np.uint8], frame: str = "camera_optical") -> Any:
        """Return a picture, gray or in red, green and blue."""
        rows, columns, *channels = image.shape
        return self._of["sensor_msgs/msg/Image"](
            header=self.header(stamp, frame), height=rows, width=columns, encoding="rgb8" if channels else "mono8",
            is_bigendian=0, step=image[0].size, data=image.ravel(),
        )  # fmt: skip

    def camera_info(self, stamp: int, lens: Lens, frame: str = "camera_optical") -> Any:
        """Return a camera's calibration."""
        K = [lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0]
        P = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
        full_region = self._of["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._of["sensor_msgs/msg/CameraInfo"](
            header=self.header(stamp, frame), height=lens.height, width=lens.width,
            distortion_model=LENS_MODELS[lens.model], d=floats(lens.distortion or (0.0,) * 5), k=floats(K),
            r=np.eye(3).ravel(), p=floats(P), binning_x=0, binning_y=0, roi=full_region,
        )  # fmt: skip

    def of_own(self, stamp: int, picture: Picture) -> dict[str, Callable[[], Any]]:
        """Return functions that create the messages of a reading of the vehicle's own sensors, by key of the topic;
        empty for an unknown sensor.

        Args:
            stamp: Time of the exposure [ns].
            picture: The reading.
        """
        name, device, image = picture.source, self.own.get(picture.source), picture.image
        if isinstance(device, CameraDevice) and image is not None and image.ndim == 3:
            optical, lens = f"{name}_optical", device.lens(image.shape[1])
            return {
                f"{name}/image": lambda: self.image(stamp, image, optical),
                f"{name}/picture": lambda: self.picture(stamp, jpeg(image[..., ::-1]), optical),
                f"{name}/camera_info": lambda: self.camera_info(stamp, lens, optical),
            }
        if isinstance(device, SonarDevice) and image is not None and image.ndim == 2:

            def fan() -> Any:
                echoes = np.nan_to_num(fan_picture(image, device.sector, FAN_ROWS)).astype(np.uint8)
                return self.picture(stamp, jpeg(echoes), f"{name}_link")

            return {f"{name}/sonar": lambda: self._sonar(stamp, device, picture), f"{name}/picture": fan}
        if isinstance(device, RangeDevice) and picture.ranges is not None:
            ranges = np.asarray(picture.ranges, float)
            if own_kind(device) == "beams" and len(ranges) == 4:
                return {f"{name}/beams": lambda: self._beams(stamp, device, name, ranges)}
            return {f"{name}/range": lambda: self._range(stamp, device, name, float(ranges.min()))}
        return {}

    def _sonar(self, stamp: int, device: SonarDevice, picture: Picture) -> Any:
        """Return a ping; the frame has z forward and x up, so beams to the left have negative y."""
        assert picture.image is not None
        of, (beams, bins) = self._of, picture.image.shape
        azimuth = device.sector * (0.5 - (np.arange(beams) + 0.5) / beams)
        about = of["marine_acoustic_msgs/msg/PingInfo"](
            frequency=device.frequency, sound_speed=0.0,
            tx_beamwidths=np.full(beams, device.vertical_beam_width, np.float32),
            rx_beamwidths=np.full(beams, device.beam_width, np.float32),
        )  # fmt: skip
        pixels = of["marine_acoustic_msgs/msg/SonarImageData"](
            is_bigendian=False, dtype=0, beam_count=beams, data=np.ascontiguousarray(picture.image.T).ravel()
        )
        return of["marine_acoustic_msgs/msg/ProjectedSonarImage"](
            header=self.header(stamp, f"{picture.source}_acoustic"), ping_info=about,
            beam_directions=[self.vector((0.0, -math.sin(a), math.cos(a))) for a in azimuth],
            ranges=np.float32((np.arange(bins) + 0.5) * device.range / bins), image=pixels,
        )  # fmt: skip

    def _range(self, stamp: int, device: RangeDevice, name: str, distance: float) -> Any:
        return self._of["sensor_msgs/msg/Range"](
            header=self.header(stamp, f"{name}_link"), radiation_type=0, field_of_view=device.beam_width,
            min_range=device.minimum_range, max_range=device.range, range=distance,
        )  # fmt: skip

    def _beams(self, stamp: int, device: RangeDevice, name: str, ranges: npt.NDArray[np.float64]) -> Any:
        """Return ranges of four beams; beam k is rotated from y (left) towards the DVL's x."""
        turn = 2.0 * math.pi * (np.arange(4) + 0.5) / 4.0
        c, s, reached = math.cos(device.beam_angle), math.sin(device.beam_angle), np.isfinite(ranges)
        unknown = np.full(4, -1.0, np.float32)
        return self._of["marine_acoustic_msgs/msg/Dvl"](
            header=self.header(stamp, f"{name}_acoustic"), velocity_mode=1, dvl_type=0,
            velocity=self.vector([math.nan] * 3), velocity_covar=np.full(9, -1.0),
            altitude=float(c * ranges[reached].mean()) if reached.any() else math.inf,
            course_gnd=math.nan, speed_gnd=math.nan, num_good_beams=int(reached.sum()), sound_speed=0.0,
            beam_ranges_valid=bool(reached.any()), beam_velocities_valid=False,
            beam_unit_vec=[self.vector((s * math.sin(a), -s * math.cos(a), c)) for a in turn], range=ranges,
            range_covar=np.float32(np.square(device.noise * np.where(reached, ranges, 0.0))),
            beam_quality=np.zeros(4, np.float32), beam_velocity=np.full(4, np.nan, np.float32),
            beam_velocity_covar=unknown,
        )  # fmt: skip

    def tags(self, picture: Picture) -> Any:
        """Return the corners of the tags that were sent with a picture [px], as JSON."""
        tags = [{"id": tag.tag_id, "corners": np.asarray(tag.corners).tolist()} for tag in picture.tags]
        return self.words({"sequence": picture.sequence, "tags": tags})

    def words(self, values: Mapping[str, Any]) -> Any:
        """Return values as JSON."""
        return self._of["std_msgs/msg/String"](json.dumps(values, default=str))

    def diagnostics(self, stamp: int, name: str, level: str, message: str, values: Mapping[str, Any]) -> Any:
        """Return one status of the vehicle; level is one of ok, warn, error, stale."""
        of = self._of
        pairs = [of["diagnostic_msgs/msg/KeyValue"](key, str(value)) for key, value in values.items()]
        status = of["diagnostic_msgs/msg/DiagnosticStatus"](
            level=LEVELS.index(level),
            name=name,
            message=message,
            hardware_id=self._vehicle.name,
            values=pairs,
        )
        return of["diagnostic_msgs/msg/DiagnosticArray"](self.header(stamp, ""), [status])

    def frame(self, name: str) -> str:
        """Return a frame's name with the vehicle's prefix."""
        return name if name in SHARED else self._prefix + name

    def header(self, stamp: int, frame: str) -> Any:
        """Return a header with stamp and frame."""
        return self._of["std_msgs/msg/Header"](self.time(stamp), self.frame(frame))

    def time(self, stamp: int) -> Any:
        """Return a time, limited to the range of the type, 1901 to 2038."""
        stamp = min(max(stamp, FIRST_TIME), LAST_TIME)
        return self._of["builtin_interfaces/msg/Time"](stamp // 1_000_000_000, stamp % 1_000_000_000)

    def vector(self, v: Any) -> Any:
        """Return a vector, (3,)."""
        return self._of["geometry_msgs/msg/Vector3"](float(v[0]), float(v[1]), float(v[2]))

    def quaternion(self, q: Any) -> Any:
        """Return a quaternion, xyzw."""
        return self._of["geometry_msgs/msg/Quaternion"](float(q[0]), float(q[1]), float(q[2]), float(q[3]))

    def pose(self, position: Any, q: Any) -> Any:
        """Return a pose."""
        point = self._of["geometry_msgs/msg/Point"](
            float(position[0]), float(position[1]), float(position[2])
        )
        return self._of["geometry_msgs/msg/Pose"](point, self.quaternion(q))


def count(number: Any) -> int:
    """Return a count limited to a uint32, `MOST`: a clock that steps forward causes any number of missed turns."""
    return min(int(number), MOST)


@cache
def fields_of(kind: str) -> list[tuple[str, Callable[[Any], Any], Any]]:
    """Return the fields of a FinsSim message after its header: name, constructor of the value, and default value."""
    numbers = {"float64": (float, math.nan), "string": (str, ""), "bool": (bool, False)}
    fields: list[tuple[str, Callable[[Any], Any], Any]] = []
    for name, (_, detail) in types().fielddefs[f"finssim_msgs/msg/{kind}"][1][1:]:
        element, length = detail if isinstance(detail, tuple) else (detail, 0)
        if isinstance(element, tuple):  # a sequence or an array
            listed = list if element[1][0] == "string" else floats
            fields.append((name, listed, (math.nan,) * length))
        elif isinstance(detail, tuple):
            fields.append((name, *numbers.get(element, (count, 0))))
        else:  # a message, which is given as such
            fields.append((name, lambda value: value, None))
    return fields


def floats(values: Any) -> npt.NDArray[np.float64]:
    """Return a copy of numbers, of any unit, in the form that rosbags requires."""
    return np.array(values, dtype=np.float64).ravel()


def numbers_of(covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a covariance (6, 6) row by row, (36,): unknown variances are large and uncorrelated, since filters reject
    NaN.

    The units are kept.
    """
    unknown = ~np.isfinite(covariance.sum(axis=0))
    covariance[unknown], covariance[:, unknown] = 0.0, 0.0
    covariance[unknown, unknown] = UNKNOWN
    return covariance.ravel()
