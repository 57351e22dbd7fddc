"""A vehicle that circles in a pool by a closed form, with its sensor readings and the image positions of its
tags."""

import math

import numpy as np

from finssim.core.optics import Camera, Interface, Lens, project
from finssim.core.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_euler,
    quat_from_yaw,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
)
from finssim.localization.detection.families import tag_corners_b
from finssim.localization.overhead_camera import Pool
from finssim.robot.messages import Picture, TagCorners, Telemetry
from finssim.vehicles import load_vehicle

LENS = Lens(1280, 720, 540.93, 540.93, 682.23, 348.61, "plumb_bob", (0.0294, -0.0598, 0.0009, 0.0018, 0.0126))


def overhead(latency=0.05, **frames):
    """Return a camera 1.2 m above level water at z = 0 of the pool frame."""
    return Pool(Camera(LENS, [0.0, 0.0, 1.2], [1.0, 0.0, 0.0, 0.0]), Interface.water(0.0), latency, **frames)


class Rounds:
    """Position, attitude and velocity in world axes as functions of time; telemetry and corners with seeded noise."""

    def __init__(self, pool, vehicle=None, *, seed=0, noise=1.0, speed=0.15, mcu_yaw=1.0, drift=0.01):
        self.pool, self.vehicle = pool, vehicle or load_vehicle("finsrov")
        self.random = np.random.default_rng(seed)
        self.noise, self.speed, self.mcu_yaw, self.drift = noise, speed, mcu_yaw, drift
        self.tags_b = tag_corners_b(self.vehicle.tags)
        self.q_bs = np.asarray(self.vehicle.sensors.imu.orientation)
        self.port = np.asarray(self.vehicle.sensors.depth.position)

    def position(self, t):
        """Return the position of the body origin, world frame [m], (3,)."""
        a = self.speed * t
        return np.array([0.6 * math.cos(a), 0.4 * math.sin(a), -0.45 + 0.05 * math.sin(2.0 * a)])

    def quaternion(self, t):
        """Return the attitude, body to world, xyzw, (4,)."""
        return quat_from_euler(0.05 * math.sin(3.0 * t), 0.04 * math.cos(2.3 * t), 2.0 * self.speed * t + 0.3)

    def nu(self, t, step=1e-4):
        """Return velocity and angular velocity of the body origin, body frame, by central differences, (6,)."""
        v = (self.position(t + step) - self.position(t - step)) / (2.0 * step)
        turn = quat_multiply(quat_conjugate(self.quaternion(t - step)), self.quaternion(t + step))
        return np.concatenate(
            [quat_inverse_rotate(self.quaternion(t), v), turn[:3] / step * np.sign(turn[3])]
        )

    def telemetry(self, t, sequence):
        """Return the motor controller's message at t; its heading has an offset and drifts. Sensors have no
        latency."""
        q, noise = self.quaternion(t), self.noise
        omega = self.nu(t)[3:] + noise * self.random.normal(0.0, 0.002, 3)
        force = quat_inverse_rotate(q, [0.0, 0.0, 9.81]) + noise * self.random.normal(0.0, 0.02, 3)
        own = quat_multiply(quat_from_yaw(self.mcu_yaw + self.drift * t), q)
        depth = -float((self.position(t) + quat_rotate(q, self.port))[2]) + noise * self.random.normal(
            0.0, 0.005
        )
        q_sb = quat_conjugate(self.q_bs)
        return Telemetry(
            sequence=sequence % 2**16,
            mcu_ms=round(1000.0 * t) % 2**32,
            quaternion=tuple(quat_multiply(own, self.q_bs).tolist()),
            gyro=tuple(quat_rotate(q_sb, omega).tolist()),
            accel=tuple(quat_rotate(q_sb, force).tolist()),
            depth=depth,
            pressure=101325.0 + 1027.0 * 9.81 * depth,
            flags=0,
            motor_rpm=(0.0,) * 8,
        )

    def picture(self, exposed, sequence):
        """Return the tags at the time of an exposure, as a picture that arrives `Pool.latency` later."""
        T = self.pool.T_pw
        R = T[:3, :3] @ quat_to_matrix(self.quaternion(exposed))
        origin = T[:3, :3] @ self.position(exposed) + T[:3, 3]
        tags = []
        for tag, corners_b in self.tags_b.items():
            pixels = project(self.pool.camera, self.pool.interface, origin + corners_b @ R.T).pixels
            tags.append(TagCorners(tag, pixels + self.noise * self.random.normal(0.0, 0.2, (4, 2))))
        return Picture(exposed + self.pool.latency, sequence, tags=tuple(tags))


def yaw_between(a, b):
    """Return the rotation about the vertical from attitude a to b [rad]."""
    x, y, z, w = quat_multiply(b, quat_conjugate(a))
    return 2.0 * math.atan2(z, w) if w >= 0.0 else 2.0 * math.atan2(-z, -w)


def without_latency(vehicle):
    """Return the vehicle with sensors without latency."""
    sensors = vehicle.sensors
    sensors = sensors.model_copy(
        update={
            "imu": sensors.imu.model_copy(update={"latency": 0.0}),
            "depth": sensors.depth.model_copy(update={"latency": 0.0}),
        }
    )
    return vehicle.model_copy(update={"sensors": sensors})


__all__ = ["Rounds", "matrix_to_quat", "overhead", "without_latency", "yaw_between"]
