"""Streams of a vehicle with exactly known motion: smooth paths, and samples of its sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from finssim.core.rotations import (
    quat_conjugate,
    quat_from_euler,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
    quat_to_rotvec,
)
from finssim.localization.fusion.fuse_settings import Site
from finssim.localization.fusion.streams import DepthSample, ImuSample, VisionSample

GRAVITY = 9.81
SITE = Site(up=(0.0, 0.0, 1.0), offset=-1.0, depth_port=(0.0, 0.0, -0.115), imu=(0.05, 0.0, 0.02))
"""Pool with its origin on the floor and one metre of water."""


def position(t):
    """Return the position of the body origin, pool frame [m], (..., 3)."""
    t = np.asarray(t, float)
    return np.stack(
        [
            0.8 * np.sin(0.35 * t) + 0.1 * np.sin(1.1 * t),
            0.5 * np.sin(0.47 * t + 1.0),
            0.5 + 0.2 * np.sin(0.3 * t),
        ],
        axis=-1,
    )


def attitude(t):
    """Return q_pb, (..., 4); the heading crosses the half turn."""
    t = np.asarray(t, float)
    return quat_from_euler(0.06 * np.sin(1.3 * t), 0.05 * np.sin(1.1 * t + 0.5), yaw(t))


def yaw(t):
    """Return the heading [rad], (...), not wrapped."""
    return 2.8 + 0.9 * np.sin(0.4 * np.asarray(t, float))


def slope(f, t, h=1e-4):
    """Return the time derivative of a smooth function."""
    return (f(t + h) - f(t - h)) / (2.0 * h)


def body_rates(t, h=1e-4):
    """Return the angular rate, body frame [rad/s], (..., 3)."""
    return quat_to_rotvec(quat_multiply(quat_conjugate(attitude(t - h)), attitude(t + h))) / (2.0 * h)


def specific_force(t, lever, h=1e-2):
    """Return the specific force at a body point, body frame [m/s²], (..., 3)."""

    def point(s):
        return position(s) + quat_rotate(attitude(s), np.asarray(lever, float))

    a = (point(t + h) - 2.0 * point(t) + point(t - h)) / h**2
    return quat_rotate(quat_conjugate(attitude(t)), a + np.array([0.0, 0.0, GRAVITY]))


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the samples."""

    xy: float = 0.01
    yaw: float = 0.02
    depth: float = 0.01
    gyro: float = 0.003
    accel: float = 0.05
    gyro_bias: tuple[float, float, float] = (0.004, -0.003, 0.006)
    accel_bias: tuple[float, float, float] = (0.03, -0.02, 0.02)


QUIET = Noise(0.0, 0.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def streams(
    duration, *, seed=0, noise=Noise(), tilt=True, latency=0.06, site=SITE, rates=(100.0, 20.0, 30.0)
):
    """Return samples of IMU, depth sensor and camera, in the order of their arrival."""
    rng = np.random.default_rng(seed)
    imu_rate, depth_rate, vision_rate = rates
    samples = []
    t = np.arange(0.0, duration, 1.0 / imu_rate)
    omega = body_rates(t) + noise.gyro_bias + noise.gyro * rng.standard_normal((len(t), 3))
    force = specific_force(t, site.imu) + noise.accel_bias + noise.accel * rng.standard_normal((len(t), 3))
    roll, pitch = 0.06 * np.sin(1.3 * t), 0.05 * np.sin(1.1 * t + 0.5)
    for k, s in enumerate(t):
        angles = (float(roll[k]), float(pitch[k])) if tilt else None
        samples.append(ImuSample(float(s), tuple(omega[k]), tuple(force[k]), angles, float(s) + 0.002))
    for s in np.arange(0.003, duration, 1.0 / depth_rate):
        port = position(s) + quat_to_matrix(attitude(s)) @ np.array(site.depth_port)
        depth = -(np.array(site.up) @ port + site.offset) + noise.depth * rng.standard_normal()
        samples.append(DepthSample(float(s), float(depth), float(s) + 0.01))
    variance = max(noise.xy, 1e-3) ** 2, max(noise.xy, 1e-3) ** 2, max(noise.yaw, 1e-3) ** 2
    R = tuple(tuple(row) for row in np.diag(variance))
    for s in np.arange(0.011, duration, 1.0 / vision_rate):
        xy = position(s)[:2] + noise.xy * rng.standard_normal(2)
        psi = yaw(s) + noise.yaw * rng.standard_normal()
        samples.append(VisionSample(float(s), tuple(xy), float(psi), R, float(s) + latency))
    return sorted(samples, key=lambda sample: sample.arrival)


def without_vision(samples, start, end):
    """Return the samples without the fixes of a time interval."""
    return [s for s in samples if s.stream != "vision" or not start <= s.time < end]


def with_outliers(samples, share, rng):
    """Return the samples with some fixes moved by 0.5 to 1 m."""
    out = []
    for s in samples:
        if s.stream == "vision" and rng.random() < share:
            angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.0)
            s = replace(
                s, position=(s.position[0] + far * np.cos(angle), s.position[1] + far * np.sin(angle))
            )
        out.append(s)
    return out


def with_flips(samples, share, rng):
    """Return the samples with some yaws turned by a half or a quarter turn."""
    turns = (np.pi, np.pi / 2, -np.pi / 2)
    return [
        replace(s, yaw=s.yaw + turns[rng.integers(3)]) if s.stream == "vision" and rng.random() < share else s
        for s in samples
    ]


def shuffled(samples, longest, share, rng):
    """Return samples delayed by up to `longest` seconds, some of them duplicated, in the order of their arrival."""
    late = [replace(s, arrival=s.time + rng.uniform(0.0, longest)) for s in samples]
    late += [replace(s, arrival=s.time + longest) for s in late if rng.random() < share]
    return sorted(late, key=lambda s: s.arrival)


def run(estimator, samples, times):
    """Feed samples as they arrive, and return the estimates at the times."""
    estimates, k = [], 0
    for t in times:
        while k < len(samples) and samples[k].arrival <= t + 1e-9:
            estimator.add(samples[k])
            k += 1
        estimates.append(estimator.estimate(float(t)))
    return estimates
