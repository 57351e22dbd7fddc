"""State estimation node: fuses fixes, IMU samples and depth to one state, sixty times a second."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from finssim.extensions.ros2.nodes.conversions import aid_of, telemetry_of
from finssim.extensions.ros2.nodes.frames import FixFrame, Frames
from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.extensions.ros2.topics import TOPICS
from finssim.localization.fusion.estimator import Health
from finssim.localization.overhead_camera import load_pool
from finssim.robot.goals import place_of
from finssim.robot.perception import Perception
from finssim.robot.runtime import USED


class StateEstimation(RobotNode):
    """Node that publishes Odometry, tf and EstimatorStatus with equal stamps; no Odometry while the position
    is unknown."""

    def __init__(self) -> None:
        super().__init__("state_estimation")
        file = self.parameter("pool_file", "pool.yaml")
        pool = None if file == "none" else load_pool(self.await_file(file))
        mode = self.parameter("mode", "error-state" if self.vehicle.sensors.imu else "constant-velocity")
        start = self.parameter("let_in", "")
        self.perception = Perception(self.vehicle, pool, mode=mode, let_in=place_of(start) if start else None)
        self.sends("odometry", "estimator", "diagnostics", "event")
        self.frames = Frames(self, pool)
        self.hears("telemetry", self._on_telemetry)
        if pool is not None:
            self.fixes = FixFrame(pool, self.perception.estimator)
            self.hears("fix", self._on_fix)
        for key in ("positioning", "dvl", "compass"):
            self.hears(key, partial(self._on_aid, key))
        self.create_timer(1.0 / self.parameter("rate", 60.0), self._estimate)
        self.create_timer(1.0, self._publish_diagnostics)

    def _on_telemetry(self, message: Any) -> None:
        times = self.seconds(message.received), self.seconds(message.header.stamp)
        self.perception.telemetry(times[0], telemetry_of(message), times[1])

    def _on_fix(self, message: Any) -> None:
        time = self.seconds(message.header.stamp)
        self.perception.estimator.add(self.fixes.from_map(message, time, self.now()))

    def _on_aid(self, key: str, message: Any) -> None:
        now = self.now()
        frame = self.make.frame(TOPICS[key].frame)
        aid = aid_of(key, message, now - self.seconds(message.header.stamp), frame)
        if isinstance(aid, str):
            self.perception.estimator.refuse("aid", aid)
        else:
            self.perception.aid(now, aid)

    def _estimate(self) -> None:
        now = self.now()
        reading, stamp = self.perception.reading(now), self.ns(now)
        if np.isfinite(reading.position).all():
            self.send("odometry", self.make.odometry(stamp, reading))
            self.frames.publish(stamp, reading)
        self.send("estimator", self.make.estimator(stamp, reading, health_values(self.perception.health())))

    def _publish_diagnostics(self) -> None:
        reading, health = self.perception.reading(self.now()), self.perception.health()
        counts = {
            f"{s}: {word}": n
            for s, counts_by_word in health.counts.items()
            for word, n in counts_by_word.items()
        }
        ages = {"age of vision [s]": health.age_vision, "of inertial data [s]": health.age_imu}
        ages |= {"of depth [s]": health.age_depth, "standard deviation [m]": max(reading.std[:3])}
        level = "ok" if reading.ready else "warn"
        self.diagnose("localization", level, reading.reason or reading.mode, {**ages, **counts})


def health_values(health: Health) -> dict[str, Any]:
    """Return the fields of EstimatorStatus other than those of a reading."""
    vision = health.counts.get("vision", {})
    used = sum(n for word, n in vision.items() if word in USED)
    return {
        "vision_age": health.age_vision,
        "imu_age": health.age_imu,
        "depth_age": health.age_depth,
        "fixes_accepted": used,
        "fixes_rejected": sum(vision.values()) - used,
        "reject_reason": health.reject_reason,
        "mahalanobis": health.mahalanobis.get("vision", math.nan),
    }
