"""The DVL: velocity of its own point, relative to floor or water, while the beams return."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from scipy import stats
from scipy.spatial.transform import Rotation

from finssim.physics.types import vec6
from finssim.sim.sensors import SensorSuite
from finssim.sim.sensors.dvl import sensed_velocity


def test_it_reads_the_derivative_of_its_own_path() -> None:
    """v_s = R_wsᵀ d(p + R_wb r)/dt, differentiated along a path given in closed form."""
    r, R_bs, h, t = np.array([0.3, -0.2, -0.4]), Rotation.from_rotvec([0.1, 0.7, -0.5]), 1e-5, 0.8

    def pose(t: float) -> tuple[np.ndarray, Rotation]:
        return np.array([t**2, np.sin(t), -t]), Rotation.from_euler("ZYX", [t, 0.3 * t, np.cos(t)])

    (x0, R0), (x1, R1), R_wb = pose(t - h), pose(t + h), pose(t)[1]
    nu = vec6(*R_wb.inv().apply(x1 - x0) / (2 * h), *(R0.inv() * R1).as_rotvec() / (2 * h))
    p_dot = (x1 + R1.apply(r) - x0 - R0.apply(r)) / (2 * h)
    q_wb, q_bs = wp.quat(*R_wb.as_quat()), wp.quat(*R_bs.as_quat())
    v = sensed_velocity(nu, q_wb, wp.vec3(), wp.vec3(*r), q_bs)
    np.testing.assert_allclose(v, (R_wb * R_bs).inv().apply(p_dot), atol=2e-6)


def test_drifting_with_the_water_is_rest_through_the_water() -> None:
    """A vehicle carried along by a current reads zero on water track and the current on bottom track."""
    R_wb, current = Rotation.from_euler("ZYX", [0.9, 0.2, -0.1]), np.array([0.3, -0.1, 0.05])
    nu, q = vec6(*R_wb.inv().apply(current), 0, 0, 0), wp.quat(*R_wb.as_quat())
    here = wp.vec3(0.1, 0.0, 0.0)
    through_water = sensed_velocity(nu, q, wp.vec3(*current), here, wp.quat_identity())
    np.testing.assert_allclose(through_water, 0.0, atol=1e-7)
    over_floor = sensed_velocity(nu, q, wp.vec3(), here, wp.quat_identity())
    np.testing.assert_allclose(R_wb.apply(over_floor), current, atol=1e-7)


def test_going_ahead_it_reads_the_speed_along_the_nose(vehicle: Any, rest: Any, ideal: Any) -> None:
    """R_bs v_s = (u, 0, 0) for pure surge, wherever and however the DVL is mounted."""
    suite = SensorSuite(vehicle, worlds=1, control_step=0.1)
    ideal(suite.dvl)
    suite.reset(rest(1).put(velocity=[0.4, 0, 0, 0, 0, 0]))
    v_s = suite.dvl.velocity.numpy()[0, 0]
    np.testing.assert_allclose(
        v_s, [0.4 * np.sqrt(0.5), -0.4 * np.sqrt(0.5), 0.0], atol=1e-7
    )  # turned 45° left


def test_the_suite_tracks_the_water_when_it_is_told_its_velocity(vehicle: Any, rest: Any, ideal: Any) -> None:
    """Given the water's velocity, a vehicle at rest in a current sees the water come towards it."""
    suite = SensorSuite(vehicle, worlds=1, control_step=0.2)
    ideal(suite.dvl).set(orientation=[0, 0, 0, 1])
    current = wp.array([[[0.2, 0.0, 0.0]]], dtype=wp.vec3)
    suite.reset(rest(1), water_velocity=current)
    np.testing.assert_allclose(suite.dvl.velocity.numpy()[0, 0], [-0.2, 0.0, 0.0], atol=1e-7)


def test_error_is_scale_plus_bias_plus_noise(vehicle: Any, rest: Any, ideal: Any) -> None:
    """Over many worlds the variance along a speed u is (scale u)² + turn-on² + noise²; across it there is no scale."""
    worlds, u = 5000, 1.5
    suite = SensorSuite(vehicle, worlds=worlds, control_step=0.2, seed=3)
    ideal(suite.dvl).set(orientation=[0, 0, 0, 1], scale_error=0.01, bias_initial=0.006, noise_std=0.008)
    suite.reset(rest(worlds).put(velocity=[u, 0, 0, 0, 0, 0]))
    error = suite.dvl.velocity.numpy()[:, 0] - [u, 0.0, 0.0]
    for axis, std in enumerate([np.sqrt((0.01 * u) ** 2 + 0.01**2), 0.01, 0.01]):
        assert stats.kstest(error[:, axis], stats.norm(0.0, std).cdf).pvalue > 1e-4


def test_without_an_echo_the_last_reading_stays(vehicle: Any, rest: Any, ideal: Any) -> None:
    """Too high above the floor, too low or leaning too far, the reading is old; back within reach it is fresh."""
    suite = SensorSuite(vehicle, worlds=1, control_step=0.2, floor_depth=50.0)
    ideal(suite.dvl).set(position=[0, 0, 0], tilt_cosine=np.cos(0.5), altitude_min=0.5, altitude_max=30.0)
    state = rest(1).put(position=[0.0, 0.0, -40.0])
    suite.reset(state)
    level = [0.0, 0.0, 0.0, 1.0]

    def leaning(angle: float) -> np.ndarray:
        return Rotation.from_rotvec([angle, 0.0, 0.0]).as_quat()

    cases = [
        (-21.0, level, True),
        (-19.0, level, False),
        (-49.4, level, True),
        (-49.6, level, False),
        (-40.0, leaning(0.49), True),
        (-40.0, leaning(0.51), False),
        (-40.0, leaning(np.pi), False),
    ]
    for z, q, fresh in cases:
        state.advance()
        suite.update(state.put(position=[0.0, 0.0, z], quaternion=q))
        assert suite.dvl.fresh.numpy()[0, 0] == fresh, (z, q)


def test_without_lock_on_a_described_bottom_there_is_no_sample(vehicle: Any, rest: Any, ideal: Any) -> None:
    """`lock`, which the beams of a `finssim.extensions.perception.DopplerBatch` write, holds and frees the reading."""
    suite = SensorSuite(vehicle, worlds=1, control_step=0.2)
    ideal(suite.dvl)
    state = rest(1)
    suite.reset(state)
    for lock in (1, 0, 1):
        suite.dvl.lock.fill_(lock)
        state.advance()
        suite.update(state)
        assert suite.dvl.fresh.numpy()[0, 0] == bool(lock)
