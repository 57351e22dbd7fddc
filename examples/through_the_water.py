"""Locate a moving vehicle through rippling water: pictures, detections, poses and fusion, with the error of each.

    python examples/through_the_water.py

An overhead camera observes FinsROV on an ellipse, 0.45 m deep. Its tags are rendered through the water, detected in
each picture, located by refraction with a pressure sensor and an IMU of ordinary quality, and fused. Needs the extra
"vision".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from finssim.core import (
    Camera,
    Interface,
    Lens,
    matrix_to_quat,
    quat_from_euler,
    quat_multiply,
    quat_to_matrix,
    start_warp,
    wrap_angle,
)
from finssim.localization import (
    METHODS,
    Constraints,
    DepthSample,
    Estimator,
    ImuSample,
    Pool,
    RegionTracker,
    VisionSample,
    bitmap,
    detector,
    site_of,
    tag_corners_b,
)
from finssim.sim import overhead_camera
from finssim.vehicles import load_vehicle

DURATION, PERIOD = 8.0, 24.0
"""Duration of the run and of one round of the ellipse [s]."""
Z, TURN = -0.45, 2.0 * math.pi / PERIOD


def motion(t: float) -> tuple[NDArray[np.float64], float, float, float]:
    """Return position (z = 0 on the surface) [m] and roll, pitch, yaw [rad] on an ellipse, nose forward,
    rocking slightly."""
    x, y = 0.9 * math.cos(TURN * t), 0.5 * math.sin(TURN * t)
    yaw = math.atan2(0.5 * math.cos(TURN * t), -0.9 * math.sin(TURN * t))
    return np.array([x, y, Z]), 0.05 * math.sin(3.0 * t), 0.04 * math.cos(2.3 * t), yaw


def main() -> None:
    """Run the example."""
    start_warp()
    random = np.random.default_rng(1)
    vehicle = load_vehicle("finsrov")
    tags_b = tag_corners_b(vehicle.tags)
    lens = Lens(
        1280, 720, 540.93, 540.93, 682.23, 348.61, "plumb_bob", (0.0294, -0.0598, 0.0009, 0.0018, 0.0126)
    )
    pool = Pool(Camera(lens, [0.0, 0.0, 1.2], [1.0, 0.0, 0.0, 0.0]), Interface.water(0.0))
    scene = overhead_camera.Scene(
        camera=pool.camera,
        interface=pool.interface,
        basin=overhead_camera.TiledBasin(lower=(-2.0, -1.0, -1.0), upper=(2.0, 1.0, 0.1)),
        ripples=overhead_camera.Ripples(rms_slope=0.01, seed=2),
    )
    overhead = overhead_camera.OverheadCamera(scene)
    tracker = RegionTracker(detector(vehicle.tags.family), tags_b)
    estimator = Estimator(site=site_of(pool, vehicle))

    def tag(number: int, position: NDArray[np.float64], q: NDArray[np.float64]) -> overhead_camera.TagInScene:
        mount = vehicle.tags.mounts[number]
        at = position + quat_to_matrix(q) @ mount.position
        pose = overhead_camera.ObjectPose(
            position=tuple(at.tolist()), orientation=tuple(quat_multiply(q, mount.orientation).tolist())
        )
        return overhead_camera.TagInScene(
            bitmap=bitmap(vehicle.tags.family, number), edge=vehicle.tags.edge, pose=pose, margin=0.014
        )

    errors: dict[str, list[tuple[float, float]]] = {"fixes": [], "fused": []}
    port = np.asarray(vehicle.sensors.depth.position)
    step = 0.01
    for k in range(round(DURATION / step)):
        t = k * step
        position, roll, pitch, yaw = motion(t)
        q = quat_from_euler(roll, pitch, yaw)
        R, after = quat_to_matrix(q), quat_to_matrix(quat_from_euler(*motion(t + step)[1:]))
        q_step = matrix_to_quat(R.T @ after)
        rate = 2.0 * q_step[:3] / step + random.normal(0.0, 0.01, 3)
        tilt = (roll + random.normal(0.0, 0.009), pitch + random.normal(0.0, 0.009))  # 0.5 degrees
        estimator.add(ImuSample(t, tuple(rate.tolist()), tilt=tilt))
        depth = -float((position + R @ port)[2]) + random.normal(0.0, 0.01)
        if k % 5 == 0:
            estimator.add(DepthSample(t, depth))
        if k % 10 == 0:  # ten pictures a second
            drawn = [tag(number, position, q) for number in tags_b]
            seen = tracker.detect(overhead.render(tags=drawn, time=t, seed=k, region="tags"), t)
            height = -depth - float((R @ port)[2])
            known = Constraints(z_b=height, z_std=0.01, roll=tilt[0], pitch=tilt[1], port=tuple(port))
            found = METHODS["refractive"](seen, pool, tags_b, known, 0.8)
            if found.ok:
                covariance = tuple(tuple(row) for row in found.covariance.tolist())
                estimator.add(VisionSample(t, (found.x, found.y), found.yaw, covariance))
                errors["fixes"].append(off(found.x, found.y, found.yaw, position, yaw))
            if t > 1.0:
                now = estimator.estimate(t)
                errors["fused"].append(off(now.x[0], now.x[1], now.yaw, position, yaw))
    for name, values in errors.items():
        distance, turn = np.sqrt(np.mean(np.square(values), axis=0))
        print(
            f"{name}: {len(values)} times, {100.0 * distance:.2f} cm and {math.degrees(turn):.2f} degrees rms"
        )
    print(f"fixes of the filter: {estimator.counts['vision']}")


def off(x: float, y: float, heading: float, position: NDArray[np.float64], yaw: float) -> tuple[float, float]:
    """Return the horizontal distance [m] and the yaw error [rad] from the truth."""
    return math.hypot(x - position[0], y - position[1]), float(wrap_angle(heading - yaw))


if __name__ == "__main__":
    main()
