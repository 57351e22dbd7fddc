"""Sim node: any vehicle of the engine as a ROS 2 robot, with the bridge and topics of a real one, and /clock."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType

from finssim.core.rotations import (
    quat_conjugate,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
)
from finssim.extensions.ros2.nodes.conversions import ros_type
from finssim.extensions.ros2.nodes.frames import Frames
from finssim.extensions.ros2.nodes.hardware_bridge import BridgeTopics
from finssim.extensions.ros2.nodes.robot_node import STEP, RobotNode
from finssim.extensions.ros2.topics import SERVICES
from finssim.extensions.ros2.worlds.clock import Barrier, SharedClock
from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.goals import station_of
from finssim.robot.messages import Telemetry
from finssim.robot.reading import Reading
from finssim.sim import Simulator
from finssim.sim.sensors.depth import ATMOSPHERE
from finssim.vehicles import Vehicle

__all__ = ["Sim"]

SUBSTEPS = 3
MOST_BEHIND = 5
"""Largest number of steps made up for at a time; on a slower computer, simulated time is slower."""
POLL = 0.001
"""Time between two checks whether a step in lock-step may begin [s]."""


IDENTITY = (0.0, 0.0, 0.0, 1.0)


class IdealSensors:
    """Inertial unit and pressure port at their mounts, without noise; velocities at the IMU are those of the
    origin."""

    def __init__(self, vehicle: Vehicle) -> None:
        imu, depth = vehicle.sensors.imu, vehicle.sensors.depth
        self._q_bs = np.array(imu.orientation if imu is not None else IDENTITY)
        self._port = np.array(depth.position if depth is not None else (0.0, 0.0, 0.0))
        self._water = vehicle.water
        self.reset()

    def reset(self) -> None:
        """Restart, after the vehicle was placed elsewhere."""
        self._velocity: np.ndarray | None = None
        self._count = 0

    def sample(self, reading: Reading, step: float) -> Telemetry:
        """Return the measurements after a step [s]; the specific force is the mean over the step."""
        q, gravity = reading.quaternion, self._water.gravity
        velocity = np.asarray(quat_rotate(q, reading.nu[:3]))
        before, self._velocity = self._velocity, velocity
        force = np.array([0.0, 0.0, gravity])
        if before is not None:
            force = force + (velocity - before) / step
        R_sw = quat_to_matrix(quat_multiply(q, self._q_bs)).T
        R_sb = quat_to_matrix(quat_conjugate(self._q_bs))
        depth = -float(reading.position[2] + np.asarray(quat_rotate(q, self._port))[2])
        self._count += 1
        return Telemetry(
            sequence=self._count & 0xFFFF,
            mcu_ms=round(1e3 * reading.time) & 0xFFFFFFFF,
            quaternion=tuple(np.asarray(quat_multiply(q, self._q_bs), float).tolist()),
            gyro=tuple((R_sb @ reading.nu[3:]).tolist()),
            accel=tuple((R_sw @ force).tolist()),
            depth=depth,
            pressure=ATMOSPHERE + self._water.density * gravity * depth,
            flags=0,
            motor_rpm=None,
        )


class Sim(RobotNode):
    """Simulator node. Its time begins at 0, or follows /clock if another node already publishes it. It
    publishes the true state."""

    def __init__(self) -> None:
        super().__init__("sim")
        self.base, self.time = 0, 0.0
        self.sends("odometry", "estimator", "imu", "pressure", "event", "diagnostics")
        self.sends(*["actuators"] * bool(self.vehicle.actuators))
        hydrodynamics, seed = self.parameter("hydrodynamics", "calibrated"), self.parameter("seed", 1)
        self.sim = Simulator(
            self.vehicle, hydrodynamics=hydrodynamics, control_step=STEP, substeps=SUBSTEPS, seed=seed
        )
        self.start = station_of(self.parameter("start", "0,0,-0.5,0"))
        self.sensors = IdealSensors(self.vehicle)
        limits = BridgeSettings.of(self.vehicle, telemetry_timeout=math.inf)
        self.bridge = Bridge(self.vehicle, limits)
        self.topics = BridgeTopics(self, self.bridge, readings=False)
        service = SERVICES["reset"]
        self.create_service(ros_type(service.type), self.below(service.name), self._on_reset)
        self._reset()
        self.frames = Frames(self)
        self._factor, self._steady = (
            self.parameter("real_time_factor", 1.0),
            Clock(clock_type=ClockType.STEADY_TIME),
        )
        self.clock = SharedClock(self, self._follow, self._lead)
        nodes = self.parameter("waits_for", "")
        self._barrier = Barrier(self, nodes.split(), self._publish_time) if self.lockstep else None
        period = STEP / self._factor if self._factor > 0.0 else POLL if self.lockstep else 0.0
        self.create_timer(period, self._turn, clock=self._steady)

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self.time

    def _lead(self) -> None:
        """Count steps from now on."""
        self._began, self._made = self._steady.now().nanoseconds, 0

    def _follow(self, now: float) -> None:
        """Step up to a time of another publisher's clock [s], by at most a few steps; the others are skipped."""
        if now < self.time - MOST_BEHIND * STEP:  # that clock restarted
            self.time = now
        due = int((now - self.time) / STEP + 0.01)
        steps = min(due, MOST_BEHIND)
        self.time += (due - steps) * STEP
        for _ in range(steps):
            self._step()

    def _turn(self) -> None:
        """Do the steps that are due, at most a few."""
        if not self.clock.ours:
            return
        passed = (self._steady.now().nanoseconds - self._began) * 1e-9 * self._factor / STEP
        due = int(passed) - self._made if self._factor > 0.0 else 1
        self._made += due
        if self._barrier is not None:  # the time that the nodes need is not simulated time
            due = min(due, 0 if self._barrier.missing(self.time) else 1)
        for _ in range(min(due, MOST_BEHIND)):
            self._step()

    def _publish_time(self) -> None:
        if self.clock.ours:
            self.send("clock", self.make.clock(self.ns(self.time)))

    def _step(self) -> None:
        self.bridge.reading(self.time, self._reading())
        command = self.bridge.tick(self.time)
        self.sim.set_actuators([*self.bridge.force, *self.bridge.setpoints])
        self.sim.step()
        self.time += STEP
        self._publish(command.normalised)

    def _publish(self, normalised: Any) -> None:
        stamp, reading, make = self.ns(self.time), self._reading(), self.make
        self._publish_time()
        self.send("odometry", make.odometry(stamp, reading))
        self.frames.publish(stamp, reading)
        self.send("estimator", make.estimator(stamp, reading, {}))
        sample = self.sensors.sample(reading, STEP)
        self.send("imu", make.imu(stamp, sample))
        self.send("pressure", make.pressure(stamp, sample))
        if self.vehicle.actuators:
            channels = self.sim.numpy("thrust")[0, 0, : len(self.vehicle.channel_names)]
            self.send("actuators", make.actuators(stamp, channels[len(self.vehicle.thrusters) :]))
        self.topics.publish(self.time, normalised=normalised)

    def _reading(self) -> Reading:
        position, q, nu = (
            np.array(self.sim.numpy(name)[0, 0], float) for name in ("position", "quaternion", "velocity")
        )
        valid = bool(np.isfinite([*position, *q, *nu]).all())
        reason = "" if valid else "the simulation diverged: reset it"
        return Reading(self.time, position, q / np.linalg.norm(q), nu, valid, "fresh", reason, np.zeros(7))

    def _reset(self) -> None:
        self.sim.place(self.start.position, quat_from_yaw(self.start.yaw))
        self.sensors.reset()

    def _on_reset(self, request: Any, response: Any) -> Any:
        """Return to the start, disarmed; time continues."""
        self.bridge.disarm(self.time)
        self._reset()
        response.success, response.message = True, f"at {self.start.position}"
        return response
