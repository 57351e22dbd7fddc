"""The virtual pool: plant, instruments and firmware on one clock, and the frames on their way to and from a robot."""

from __future__ import annotations

import heapq
import random
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.pool.faults import Faults
from finssim.pool.firmware import Firmware
from finssim.pool.motors import RPM
from finssim.pool.plant import Plant
from finssim.pool.plant_spec import PlantSpec
from finssim.pool.positioning import Positioning
from finssim.pool.sensors import PoolSensors
from finssim.pool.truth import TruthWriter
from finssim.robot.link.frames import encode_navigation
from finssim.robot.messages import Delivery, Picture
from finssim.vehicles import Vehicle

__all__ = ["Camera", "PoolClockError", "PoseAt", "VirtualPool"]

Array = NDArray[np.float64]
PoseAt = Callable[[float], tuple[Array, Array]]
"""Time [s] -> position (3,) and quaternion xyzw (4,) of the body in the world."""

REMEMBERED = 1.0
"""How far back `pose_at` reaches: longer than any exposure and its latency [s]."""


class PoolClockError(ValueError):
    """The pool was asked to go back in time."""


class Camera(Protocol):
    """What looks at the vehicle from outside."""

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> Sequence[Picture]:
        """Pictures that arrive after t0 and not after t1; exposures may lie up to `REMEMBERED` seconds back."""


class VirtualPool:
    """The vehicle and its room. Only frames and pictures leave it; `exchange` is all that a robot may call.

    Attributes:
        plant: The truth; for the truth file, the viewer's ghost and tests.
        firmware: The motor controller's program.
        faults: What is wrong with wire and instruments.
        time: Up to which everything has happened [s].
    """

    def __init__(
        self,
        vehicle: Vehicle,
        spec: PlantSpec,
        *,
        camera: Camera | None = None,
        positioning: Positioning | None = None,
        start: tuple[ArrayLike, ArrayLike] = ((0.0, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0)),
        seed: int = 0,
        truth: str | Path | None = None,
        truth_period: float = 0.01,
    ) -> None:
        """Put the vehicle into the pool, at rest, with its motor controller running.

        Args:
            vehicle: Its file.
            spec: The plant.
            camera: Overhead; none if None.
            positioning: Motion capture or acoustics, whose fixes come on the robot's wire; none if None.
            start: Position, world frame [m], and quaternion, body to world, xyzw.
            seed: Of instruments, speed measurements and the wire.
            truth: File that is written; none if None.
            truth_period: Between its records [s], taken to whole physics steps.

        Raises:
            PlantSpecError: The plant is not of this vehicle.
        """
        imu = vehicle.sensors.imu
        period = 1.0 / imu.rate if imu is not None else 0.01
        self.vehicle, self.spec, self.camera, self.positioning = vehicle, spec, camera, positioning
        self.plant = Plant(vehicle, spec, seed=seed, period=period, position=start[0], quaternion=start[1])
        self.sensors = PoolSensors(self.plant, seed)
        self.firmware = Firmware(vehicle, spec)
        self.faults = Faults(seed)
        self.time = 0.0
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

    def exchange(self, until: float, sent: Sequence[bytes] = ()) -> Delivery:
        """Let the world go on, with the frames that the robot sends now.

        Args:
            until: Robot's clock [s].
            sent: Datagrams for the motor controller, sent at the time of the last exchange.

        Returns:
            Everything that has reached the robot by `until`.

        Raises:
            PoolClockError: `until` lies in the past.
        """
        if not until >= self.time:
            raise PoolClockError(
                f"exchange until {until} s, but it is {self.time} s already: time goes forward"
            )
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
        """Where the vehicle is at a time of the last second, between physics steps; the nearest beyond them.

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
        """Restart the motor controller, as a brown-out does."""
        self.firmware.reboot(self.plant.time)

    def close(self) -> None:
        """Finish the truth file."""
        if self._truth is not None:
            self._truth.close()

    def _advance(self) -> None:
        """One physics step: firmware first, then motors and body, then instruments if they are due."""
        plant, firmware = self.plant, self.firmware
        now = plant.time
        while self._down and self._down[0][0] <= now:
            arrival, _, data = heapq.heappop(self._down)
            for echo in firmware.receive(arrival, data):
                self._transmit(now, echo)
        firmware.watch(now)
        plant.target[:] = firmware.target
        plant.advance()
        if self.camera is not None or self.positioning is not None:
            self._remember()
        if plant.steps % plant.steps_per_period == 0:
            sample = self.sensors.sample()
            leaves = plant.time + self._imu_latency
            telemetry = firmware.telemetry(leaves, sample, plant.measured_speed, plant.throttle)
            if telemetry is not None:
                self._transmit(leaves, self.faults.encode(telemetry))
                for aid in self.sensors.aids():
                    self._transmit(leaves, encode_navigation(replace(aid, age=aid.age + self._imu_latency)))
        if self._truth is not None and plant.steps % self._truth_steps == 0:
            self._write_truth(self._truth)

    def _transmit(self, leaves: float, frame: bytes) -> None:
        arrival = leaves + self._random.uniform(*self.spec.firmware.uplink)
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
        writer = TruthWriter(path, self.vehicle.thruster_names, header)
        self._write_truth(writer)
        return writer

    def _write_truth(self, writer: TruthWriter) -> None:
        p = self.plant
        rpm = p.shaft_speed / np.float32(RPM)
        writer.write(
            p.time, (p.position, p.quaternion, p.nu, rpm, p.thrust, p.electric[:1], p.water_velocity)
        )
