"""Virtual pool: plant, instruments and firmware on one clock, and frames in transit to and from a robot."""

from __future__ import annotations

import heapq
import json
import logging
import random
import struct
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.core.budget import read_bytes
from finssim.core.yaml_file import json_value
from finssim.pool.firmware import Firmware, FirmwareSample, PoolSensors
from finssim.pool.plant import RPM, Plant
from finssim.pool.plant_spec import PlantSpec, PlantSpecError
from finssim.pool.positioning import Positioning
from finssim.robot.links.frames import TELEMETRY, crc16_modbus, encode_telemetry, forms
from finssim.robot.messages import Delivery, Picture, Telemetry
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from finssim.pool.ardusub import ArduSub
    from finssim.sim import Dock

__all__ = [
    "VehicleObserver",
    "FaultError",
    "Faults",
    "PoolClockError",
    "PoseAt",
    "Truth",
    "TruthError",
    "TruthWriter",
    "VirtualPool",
    "read_truth",
]


# Truth file: the true states in the pool, written continuously, only for later scoring.


Array = NDArray[np.float64]

FORMAT = "finssim-truth-1"

FLUSH = 50
"""Number of records after which the file is flushed: at most half a second at 100 Hz is lost."""

log = logging.getLogger(__name__)


class TruthError(ValueError):
    """A file that is not a truth file."""


class Truth(NamedTuple):
    """Records of a truth file, by time."""

    header: dict[str, Any]
    """Vehicle, its digest, plant, severity, seed, and names of the thrusters and of other actuators, if any."""
    time: Array
    """[s], (k,)"""
    position: Array
    """Body origin, world frame [m], (k, 3)."""
    quaternion: Array
    """Body to world, xyzw, (k, 4)."""
    nu: Array
    """Twist, body frame [m/s, rad/s], (k, 6)."""
    shaft_rpm: Array
    """Shaft speeds, canonical order [rpm], (k, n)."""
    thrust: Array
    """Delivered thrust, canonical order [N], (k, n)."""
    voltage: Array
    """Voltage of the battery [V], (k,)."""
    current: Array
    """Velocity of the water at the body, world frame [m/s], (k, 3)."""
    actuators: Array
    """Values of the actuators other than thrusters, in the header's order [rad, m³ or m], (k, m)."""


class TruthWriter:
    """Writer of a truth file: records of fixed length after one line of JSON, so that a truncated file is readable.

    A full disk ends the file with a warning, but not the pool: the vehicle must not stop because of a log.
    """

    def __init__(self, path: str | Path, thrusters: Sequence[str], header: dict[str, Any]) -> None:
        """Create the file.

        Args:
            path: Path of the file; an existing file is replaced.
            thrusters: Names in canonical order.
            header: Additional entries of the header.
        """
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file: BinaryIO | None = self.path.open("wb")
        self._count = 0
        line = json.dumps({"format": FORMAT, "thrusters": list(thrusters), **header})
        self._file.write(line.encode() + b"\n")
        self._file.flush()

    def write(self, time: float, values: Iterable[NDArray[np.float32]]) -> None:
        """Append one record.

        Args:
            time: [s]
            values: Position, quaternion, nu, shaft rpm, thrust, voltage, current and values of other actuators, in this
                order; float32.
        """
        if self._file is None:
            return
        try:
            self._file.write(struct.pack("<d", time) + b"".join([v.tobytes() for v in values]))
            self._count += 1
            if self._count % FLUSH == 0:
                self._file.flush()
        except OSError as error:
            log.warning("%s: the truth ends at %.2f s: %s", self.path, time, error.strerror or error)
            self._file = None

    def close(self) -> None:
        """Write the remaining records and close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None


def read_truth(path: str | Path) -> Truth:
    """Return the records of a truth file, up to its last complete one.

    Raises:
        TruthError: The file does not exist or is not a truth file.
    """
    data = read_bytes(Path(path), TruthError, limit=1 << 30)
    try:
        header = json_value(data[: data.index(b"\n")], TruthError, str(path))
        if header["format"] != FORMAT:
            raise KeyError
    except (ValueError, KeyError, TypeError):
        raise TruthError(f"{path}: is not a truth file: give one that 'finssim pool --truth' wrote") from None
    n = len(header["thrusters"])
    fields = {
        "position": 3,
        "quaternion": 4,
        "nu": 6,
        "shaft_rpm": n,
        "thrust": n,
        "voltage": 1,
        "current": 3,
        "actuators": len(header.get("actuators", ())),
    }
    layout = np.dtype([("time", "<f8"), *((name, "<f4", (size,)) for name, size in fields.items())])
    body = data[data.index(b"\n") + 1 :]
    table = np.frombuffer(body, dtype=layout, count=len(body) // layout.itemsize)
    time = table["time"].astype(float)
    if not (np.isfinite(time).all() and (np.diff(time) > 0.0).all()):
        raise TruthError(f"{path}: is damaged: its times do not increase: give the file as the pool wrote it")
    columns = {name: table[name].astype(float) for name in fields}
    columns["voltage"] = columns["voltage"][:, 0]
    return Truth(header=header, time=time, **columns)


# Faults of link and instruments that experiments switch on, to test the robustness of a robot.


REORDERED = 0.025
"""Additional delay of a frame that is overtaken [s]: it arrives after the next two at 100 Hz."""

PROBABILITIES = ("drop", "drop_commands", "corrupt", "reorder", "duplicate")
NUMBERS = {f.name: f.values for f in TELEMETRY.payload if f.code == "f"}
"""Telemetry fields that can be NaN, and their number of values (0: one per motor output)."""
SPOILABLE = {*NUMBERS, *(f"{name}.{i}" for name, values in NUMBERS.items() for i in range(values or 8))}


class FaultError(ValueError):
    """An invalid fault: a probability out of range, or a field that no frame has."""


@dataclass
class AutopilotFaults:
    """Active faults of an `ArduSub` and of devices connected to it."""

    dvl_silent: bool = False
    """True if the Doppler log sends nothing to any client."""
    north: float = 0.0
    """Error of its north, east positive, as by a disturbed compass [rad]."""
    no_heartbeat: bool = False
    """True if only its HEARTBEAT is lost."""
    no_ground_heartbeat: bool = False
    """True if the HEARTBEAT of the ground station does not reach it."""
    position_lag: float = 0.0
    """Delay of the position that it reports as its present one [s]."""
    leak: bool = False
    """True if its leak sensor detects water."""
    battery_voltage: float = 0.0
    """Reading of its battery monitor [V]; the true voltage if 0."""


@dataclass
class Faults:
    """Active faults; every field may be changed at any time, and all random numbers follow from the seed."""

    seed: int = 0
    drop: float = 0.0
    """Probability that a frame from the vehicle is lost."""
    drop_commands: float = 0.0
    """Probability that a frame to the vehicle is lost."""
    corrupt: float = 0.0
    """Probability that one to eight bits of a frame are inverted."""
    reorder: float = 0.0
    """Probability that a frame is overtaken by later ones."""
    duplicate: float = 0.0
    """Probability that a frame arrives twice."""
    freeze_sensors: bool = False
    """True if instruments are frozen; sequence numbers and clock continue."""
    nan_field: str = ""
    """Telemetry field that is sent as NaN, such as `depth`, or one element of it, such as `gyro.2`; none if empty."""
    freeze_depth: bool = False
    """True if the pressure gauge is frozen."""
    autopilot: AutopilotFaults = field(default_factory=AutopilotFaults)
    _frozen: Telemetry | None = None
    _frozen_depth: tuple[float, float] | None = None

    def __setattr__(self, name: str, value: object) -> None:
        if name in PROBABILITIES and not (isinstance(value, int | float) and 0.0 <= value <= 1.0):
            raise FaultError(f"{name} is {value!r}, expected a probability from 0 to 1")
        if name == "nan_field" and value and str(value) not in SPOILABLE:
            raise FaultError(
                f"telemetry has no number '{value}': give one of {', '.join(NUMBERS)}, or an element as in gyro.2"
            )
        super().__setattr__(name, value)

    def __post_init__(self) -> None:
        self._random = random.Random(f"faults {self.seed}")

    def lost(self, commands: bool = False) -> bool:
        """Return whether the next frame is lost."""
        return self._happens(self.drop_commands if commands else self.drop)

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and self._random.random() < probability

    def reading(self, sample: FirmwareSample) -> FirmwareSample:
        """Return the readings of the instruments, with a frozen pressure gauge if this fault is active."""
        if not self.freeze_depth:
            self._frozen_depth = None
            return sample
        depth, pressure = self._frozen_depth = self._frozen_depth or (sample.depth, sample.pressure)
        return sample._replace(depth=depth, pressure=pressure)

    def encode(self, telemetry: Telemetry) -> bytes:
        """Return the frame of a snapshot, with frozen instruments and invalid fields as set."""
        if not self.freeze_sensors:
            self._frozen = None
        else:
            held = self._frozen = self._frozen or telemetry
            telemetry = replace(
                telemetry,
                quaternion=held.quaternion,
                gyro=held.gyro,
                accel=held.accel,
                depth=held.depth,
                pressure=held.pressure,
                motor_rpm=held.motor_rpm,
                actuators=held.actuators,
            )
        frame = encode_telemetry(telemetry)
        return (
            frame if not self.nan_field else _with_nan(frame, self.nan_field, len(telemetry.motor_rpm or ()))
        )

    def arrivals(self, time: float, frame: bytes) -> list[tuple[float, bytes]]:
        """Return the actual arrivals [s] of a frame due at a time [s]: it may be lost, doubled, late or corrupted."""
        if frame[:1] == b"{":  # a line of a Doppler log over TCP, which neither loses nor corrupts data
            return [(time, frame)]
        if self.lost():
            return []
        if self._happens(self.corrupt):
            spoiled = bytearray(frame)
            for bit in self._random.sample(range(8 * len(frame)), self._random.randint(1, 8)):
                spoiled[bit // 8] ^= 1 << (bit % 8)
            frame = bytes(spoiled)
        if self._happens(self.reorder):
            time += REORDERED
        copies = 2 if self._happens(self.duplicate) else 1
        return [(time, frame)] * copies


def _with_nan(frame: bytes, name: str, outputs: int) -> bytes:
    """Return the frame with one field, or one element of it, NaN and a correct CRC: no checksum detects a
    controller's NaN."""
    field, _, element = name.partition(".")
    body = bytearray(frame[len(TELEMETRY.magic) : -2])
    at = 0
    for entry in forms(TELEMETRY, outputs)[0].fields:
        size, values = struct.calcsize("<" + entry.code), entry.values or outputs
        if entry.name == field:
            for i in [int(element)] if element else range(values):
                struct.pack_into("<f", body, at + i * size, float("nan"))
        at += size * values
    return TELEMETRY.magic + bytes(body) + struct.pack("<H", crc16_modbus(bytes(body)))


PoseAt = Callable[[float], tuple[Array, Array]]
"""Time [s] -> position (3,) and quaternion xyzw (4,) of the body in the world frame."""

REMEMBERED = 1.0
"""Duration of the past that `pose_at` covers: longer than any exposure plus latency [s]."""


class PoolClockError(ValueError):
    """A request to advance the pool to a past time."""


class VehicleObserver(Protocol):
    """External observer of the vehicle, such as a camera."""

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> Sequence[Picture]:
        """Return the pictures that arrive in (t0, t1]; exposures may lie up to `REMEMBERED` seconds in the past."""


class VirtualPool:
    """Vehicle and pool. Only frames and pictures leave it; a robot may only call `exchange`.

    Attributes:
        plant: True state; for the truth file, the viewer and tests.
        firmware: Program of the motor controller, or of the autopilot.
        faults: Active faults of link and instruments.
        time: Time up to which the pool has been simulated [s].
    """

    def __init__(
        self,
        vehicle: Vehicle,
        spec: PlantSpec,
        *,
        camera: VehicleObserver | None = None,
        positioning: Positioning | None = None,
        start: tuple[ArrayLike, ArrayLike] = ((0.0, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0)),
        seed: int = 0,
        truth: str | Path | None = None,
        truth_period: float = 0.01,
        firmware: Literal["mcu", "ardusub"] = "mcu",
        world: Any = None,
        dock: Dock | None = None,
    ) -> None:
        """Put the vehicle into the pool, at rest, with its motor controller running.

        Args:
            vehicle: Its file.
            spec: The plant.
            camera: Overhead camera; None for no camera.
            positioning: Motion capture or acoustic positioning, with fixes on the robot's link; None for neither.
            start: Position, world frame [m], and quaternion, body to world, xyzw.
            seed: Seed of instruments, speed measurements and link.
            truth: Truth file to write; None for no file.
            truth_period: Period of its records [s], rounded to whole physics steps.
            firmware: mcu: a motor controller that receives shaft speeds; ardusub: an autopilot that receives axes over
                MAVLink and drives the motors only by pulses.
            world: Single instance of a world whose objects the hull can touch; its basin replaces that of `spec`.
            dock: Funnel in the water, at `plant.simulator.funnel`.

        Raises:
            PlantSpecError: The plant is for another vehicle.
            ControlError: There is no autopilot for this vehicle.
        """
        imu = vehicle.sensors.imu
        period = 1.0 / imu.rate if imu is not None else 0.01
        self.vehicle, self.spec, self.camera, self.positioning = vehicle, spec, camera, positioning
        self.firmware = self._firmware(firmware)
        self.plant = Plant(
            vehicle, spec, seed=seed, period=period, start=start, speed_loop=firmware == "mcu", world=world,
            dock=dock,
        )  # fmt: skip
        self.sensors = PoolSensors(self.plant, seed)
        self.faults = Faults(seed)
        self.time = 0.0
        self._newest = 0.0
        self._imu_latency = imu.latency if imu is not None else 0.0
        # Python's own generator: a single number costs a tenth of NumPy's.
        self._random = random.Random(f"pool {seed}")
        self._order = count()
        self._down: list[tuple[float, int, bytes]] = []
        self._up: list[tuple[float, int, bytes]] = []
        self._poses: deque[tuple[float, Array, Array]] = deque(maxlen=round(REMEMBERED / self.plant.step) + 1)
        self._remember()
        self._truth_steps = max(1, round(truth_period / self.plant.step))
        self._truth = None if truth is None else self._open_truth(truth, seed)

    def _firmware(self, name: str) -> Firmware | ArduSub:
        if name == "mcu":
            return Firmware(self.vehicle, self.spec)
        if self.vehicle.actuators:
            raise PlantSpecError(
                f"firmware {name} moves only thrusters, but {self.vehicle.name} has "
                f"{', '.join(self.vehicle.actuators)}: use firmware mcu"
            )
        try:
            from finssim.pool.ardusub import ArduSub
        except ImportError:
            raise PlantSpecError(
                "firmware ardusub needs pymavlink, which is not installed: pip install 'finssim[hardware]'"
            ) from None
        return ArduSub(self.vehicle, self.spec)

    def exchange(self, until: float, sent: Sequence[bytes] = ()) -> Delivery:
        """Advance the pool, with the frames that the robot sends now.

        Args:
            until: Robot's clock [s].
            sent: Datagrams for the motor controller, sent at the time of the last exchange.

        Returns:
            Everything that has reached the robot by `until`.

        Raises:
            PoolClockError: `until` lies in the past.
        """
        if not until >= self.time:
            raise PoolClockError(f"exchange until {until} s is in the past: the pool is at {self.time} s")
        for data in sent:
            if not self.faults.lost(commands=True):
                self._send(self._down, self.time + self._random.uniform(*self.spec.firmware.downlink), data)
        while self.plant.time + self.plant.step <= until + 1e-9:
            self._advance()
        frames = []
        while self._up and self._up[0][0] <= until:
            arrival, _, data = heapq.heappop(self._up)
            frames.append((arrival, data))
        before, self.time = self.time, until
        if self.positioning is not None:
            frames += self.positioning.advance(before, until, self.pose_at)
            frames.sort(key=lambda frame: frame[0])
        pictures = self.camera.advance(before, until, self.pose_at) if self.camera is not None else ()
        return Delivery(until, tuple(frames), tuple(pictures))

    def pose_at(self, time: float) -> tuple[Array, Array]:
        """Return the pose of the vehicle at a time in the last second, interpolated; the nearest pose outside this
        range.

        Args:
            time: Robot's clock [s].

        Returns:
            Body origin, world frame [m], (3,), and quaternion, body to world, xyzw, (4,).
        """
        poses = self._poses
        i = bisect_right(poses, time, key=lambda pose: pose[0])
        if i == 0 or i == len(poses):
            return poses[i - 1 if i else 0][1:]
        (t0, x0, q0), (t1, x1, q1) = poses[i - 1], poses[i]
        s = (time - t0) / (t1 - t0)
        q = (1.0 - s) * q0 + s * (q1 if q0 @ q1 >= 0.0 else -q1)
        return (1.0 - s) * x0 + s * x1, q / np.linalg.norm(q)

    def reboot(self) -> None:
        """Restart the motor controller, as after a voltage drop."""
        self.firmware.reboot(self.plant.time)

    def close(self) -> None:
        """Finish the truth file."""
        if self._truth is not None:
            self._truth.close()

    def _advance(self) -> None:
        """Run one physics step: first the firmware, then motors and body, then instruments if they are due."""
        plant, firmware = self.plant, self.firmware
        now = plant.time
        while self._down and self._down[0][0] <= now:
            arrival, _, data = heapq.heappop(self._down)
            for echo in firmware.receive(arrival, data):
                self._transmit(now, echo)
        firmware.watch(now)
        plant.target[:] = firmware.target
        if self.vehicle.actuators and isinstance(firmware, Firmware):
            plant.set_points(firmware.setpoints)
        plant.advance()
        if self.camera is not None or self.positioning is not None:
            self._remember()
        if plant.steps % plant.steps_per_period == 0:
            sample = self.faults.reading(self.sensors.sample())
            leaves = plant.time + self._imu_latency
            aids = self.sensors.aids(self._imu_latency)
            for frame in firmware.frames(leaves, sample, aids, plant, self.faults):
                self._transmit(leaves, frame)
        if self._truth is not None and plant.steps % self._truth_steps == 0:
            self._write_truth(self._truth)

    def _transmit(self, leaves: float, frame: bytes) -> None:
        arrival = leaves + self._random.uniform(*self.spec.firmware.uplink)
        if self.firmware.ordered:
            arrival = self._newest = max(arrival, self._newest)
        for time, data in self.faults.arrivals(arrival, frame):
            self._send(self._up, time, data)

    def _send(self, way: list[tuple[float, int, bytes]], arrival: float, data: bytes) -> None:
        heapq.heappush(way, (arrival, next(self._order), data))

    def _remember(self) -> None:
        plant = self.plant
        self._poses.append((plant.time, plant.position.astype(float), plant.quaternion.astype(float)))

    def _open_truth(self, path: str | Path, seed: int) -> TruthWriter:
        header = {
            "vehicle": self.vehicle.name,
            "vehicle_sha256": self.vehicle.sha256,
            "plant": self.spec.title,
            "severity": self.spec.severity,
            "plant_seed": self.spec.seed,
            "seed": seed,
        }
        header |= {"actuators": list(self.vehicle.actuators)} if self.vehicle.actuators else {}
        writer = TruthWriter(path, self.vehicle.thruster_names, header)
        self._write_truth(writer)
        return writer

    def _write_truth(self, writer: TruthWriter) -> None:
        p = self.plant
        rpm = p.shaft_speed / np.float32(RPM)
        writer.write(
            p.time,
            (p.position, p.quaternion, p.nu, rpm, p.thrust, p.electric[:1], p.water_velocity, p.values),
        )
