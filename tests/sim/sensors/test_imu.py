"""The IMU: its equation against differentiated motion, its noise against the Allan variance it should have."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy import stats
from scipy.spatial.transform import Rotation

from finssim.physics.types import vec6
from finssim.sim.sensors import SensorSuite
from finssim.sim.sensors.imu import angular_rate, specific_force
from finssim.vehicles import catalogue, load_vehicle

WITH_IMU = [name for name in catalogue() if load_vehicle(name).sensors.imu is not None]
EPS = float(np.finfo(np.float32).eps)
CONFIDENCE = 4.5  # standard errors; fewer than one honest test in 10⁵ exceeds them


@pytest.mark.parametrize("name", WITH_IMU)
def test_at_rest_it_reads_gravity_upwards(name: str, rest: Any, ideal: Any) -> None:
    """Level and at rest, R_bs f = (0, 0, +g): the mount pushes up against the weight."""
    vehicle = load_vehicle(name)
    suite = SensorSuite(vehicle, worlds=1, control_step=0.1)
    ideal(suite.imu)
    suite.reset(rest(1))
    f_b = Rotation.from_quat(vehicle.sensors.imu.orientation).apply(suite.imu.accel.numpy()[0, 0])
    np.testing.assert_allclose(f_b, [0.0, 0.0, vehicle.water.gravity], atol=8 * EPS * 9.81)
    np.testing.assert_allclose(suite.imu.gyro.numpy(), 0.0)


def test_a_sensor_off_the_axis_of_a_spin_feels_the_centripetal_acceleration() -> None:
    """Spinning at ω about z, a sensor at radius r on x reads -ω² r along x."""
    f = specific_force(
        vec6(0, 0, 0, 0, 0, 2), vec6(), wp.quat_identity(), wp.vec3(0.3, 0.0, 0.1), wp.quat_identity(), 9.81
    )
    np.testing.assert_allclose(f, [-(2.0**2) * 0.3, 0.0, 9.81], rtol=4 * EPS)


def test_coasting_straight_while_turning_feels_only_gravity() -> None:
    """A body that turns while its origin keeps its world velocity has v_dot = -ω × v, and no acceleration."""
    v, omega = np.array([0.7, -0.2, 0.1]), np.array([0.1, 0.4, -0.6])
    nu, nu_dot = vec6(*v, *omega), vec6(*-np.cross(omega, v), 0, 0, 0)
    f = specific_force(nu, nu_dot, wp.quat_identity(), wp.vec3(), wp.quat_identity(), 9.81)
    np.testing.assert_allclose(f, [0.0, 0.0, 9.81], atol=16 * EPS)


def test_it_reads_the_second_derivative_of_its_own_path() -> None:
    """f = R_wsᵀ (d²p_s/dt² - g) and ω_s from R_ws itself, differentiated along a path given in closed form."""
    r, R_bs = np.array([0.2, -0.1, 0.15]), Rotation.from_rotvec([0.4, -0.9, 0.3])
    g = np.array([0.0, 0.0, -9.81])

    def pose(t: float) -> tuple[np.ndarray, Rotation]:
        x = np.array([np.sin(0.9 * t), 0.5 * np.cos(1.3 * t), -1.0 + 0.2 * np.sin(1.7 * t)])
        return x, Rotation.from_euler("ZYX", [0.8 * t, 0.4 * np.sin(t), 0.5 * np.cos(1.1 * t)])

    def nu(t: float) -> np.ndarray:
        (x0, R0), (x1, R1), R = pose(t - h), pose(t + h), pose(t)[1]
        return np.concatenate([R.inv().apply(x1 - x0), (R0.inv() * R1).as_rotvec()]) / (2 * h)

    def point(t: float) -> np.ndarray:
        x, R = pose(t)
        return x + R.apply(r)

    h = 1e-4  # truncation h² ~ 1e-8 and rounding 1e-16 / h² ~ 1e-8: both below float32
    for t in (0.3, 1.1, 2.7):
        R_wb = pose(t)[1]
        nu_dot = (nu(t + h) - nu(t - h)) / (2 * h)
        q_wb, q_bs = wp.quat(*R_wb.as_quat()), wp.quat(*R_bs.as_quat())
        f = specific_force(vec6(*nu(t)), vec6(*nu_dot), q_wb, wp.vec3(*r), q_bs, 9.81)
        p_ddot = (point(t + h) - 2 * point(t) + point(t - h)) / h**2
        np.testing.assert_allclose(f, (R_wb * R_bs).inv().apply(p_ddot - g), atol=2e-5)
        R_ws0, R_ws1 = pose(t - h)[1] * R_bs, pose(t + h)[1] * R_bs
        expected = (R_ws0.inv() * R_ws1).as_rotvec() / (2 * h)
        np.testing.assert_allclose(angular_rate(vec6(*nu(t)), q_bs), expected, atol=1e-6)


def record(suite: SensorSuite, state: Any, steps: int) -> dict[str, np.ndarray]:
    """Gyro and accelerometer over time: each (steps, W, 3)."""
    suite.reset(state)
    launch = suite.launches(state)[0]
    views = {name: getattr(suite.imu, name).numpy() for name in ("gyro", "accel")}
    log = {name: np.empty((steps, suite.worlds, 3)) for name in views}
    for k in range(steps):
        state.advance()
        launch.launch()
        for name, view in views.items():
            log[name][k] = view[:, 0]
    return log


def allan_variances(x: np.ndarray, m: int) -> np.ndarray:
    """Allan variance of every world and axis for clusters of m samples: half the mean square of differences."""
    clusters = x[: len(x) // m * m].reshape(-1, m, *x.shape[1:]).mean(axis=1)
    return 0.5 * np.mean(np.diff(clusters, axis=0) ** 2, axis=0).ravel()


def expected_variance(N: float, K: float, m: int, T: float) -> float:
    """Of white noise N and a walk K sampled every T: N²/τ + K² T (2 m² + 1) / (6 m), the latter K² τ/3 for large m."""
    return N**2 / (m * T) + K**2 * T * (2 * m**2 + 1) / (6 * m)


def assert_mean(samples: np.ndarray, expected: float) -> None:
    """The mean of independent samples is the expected one within their own standard error."""
    error = np.std(samples, ddof=1) / np.sqrt(len(samples))
    assert abs(np.mean(samples) - expected) < CONFIDENCE * error, (np.mean(samples), expected, error)


@pytest.mark.parametrize("name", WITH_IMU)
def test_allan_deviation_at_one_second_is_the_noise_density_of_the_file(name: str, rest: Any) -> None:
    """At rest, σ(τ = 1 s) = N up to the small part that the bias walk has by then."""
    imu = load_vehicle(name).sensors.imu
    T, m = 1.0 / imu.rate, round(imu.rate)
    suite = SensorSuite(load_vehicle(name), worlds=64, control_step=T, seed=11)
    suite.imu.set(gyro_quantisation=0.0, accel_quantisation=0.0, dropout=0.0)
    log = record(suite, rest(64), 20 * m)
    for what, N, K in (
        ("gyro", imu.gyro_noise_density, imu.gyro_bias_walk),
        ("accel", imu.accel_noise_density, imu.accel_bias_walk),
    ):
        assert_mean(allan_variances(log[what], m), expected_variance(N, K, m, T))


def test_allan_deviation_falls_as_white_noise_and_rises_as_the_bias_walk(rest: Any, vehicle: Any) -> None:
    """Slope -1/2 with N/√τ at short times, +1/2 with K √(τ/3) at long ones, and the sum of both between."""
    N, K, T = 2e-3, 4e-3, 0.01  # the two cross at √3 N/K = 0.87 s
    suite = SensorSuite(vehicle, worlds=64, control_step=T, seed=12)
    suite.imu.set(gyro_noise=N / np.sqrt(T), gyro_bias_walk=K, gyro_bias_initial=1.0, gyro_quantisation=0.0)
    gyro = record(suite, rest(64), 8000)["gyro"]
    deviation = {}
    for m in (1, 3, 10, 30, 100, 300, 800, 1600):
        variances = allan_variances(gyro, m)
        assert_mean(variances, expected_variance(N, K, m, T))
        deviation[m] = np.sqrt(np.mean(variances))

    def slope(m_0: int, m_1: int) -> float:
        return np.log(deviation[m_1] / deviation[m_0]) / np.log(m_1 / m_0)

    assert slope(1, 10) == pytest.approx(-0.5, abs=0.03)  # the walk bends it by 0.007 there
    # Of 192 records with 4 differences each, one standard error is 0.03.
    assert slope(800, 1600) == pytest.approx(0.5, abs=0.08)


def test_quantisation_error_is_uniform_within_half_a_count(rest: Any, vehicle: Any, ideal: Any) -> None:
    """For an input spread over many counts the error is uniform in ±q/2: its variance is q²/12."""
    q, worlds = 0.02, 20_000
    suite = SensorSuite(vehicle, worlds=worlds, control_step=0.1)
    ideal(suite.imu).set(gyro_quantisation=q)
    rates = np.random.default_rng(1).uniform(-2.0, 2.0, (worlds, 1, 6)).astype(np.float32)
    suite.reset(rest(worlds).put(velocity=rates))
    exact = Rotation.from_quat(vehicle.sensors.imu.orientation).inv().apply(rates[:, 0, 3:])
    error = (suite.imu.gyro.numpy()[:, 0] - exact).ravel()
    assert np.abs(error).max() <= 0.5 * q + 4 * EPS
    assert stats.kstest(error, stats.uniform(-q / 2, q).cdf).pvalue > 1e-4
    # The variance of the square of a uniform error is q⁴/180.
    assert np.mean(error**2) == pytest.approx(q**2 / 12, abs=CONFIDENCE * q**2 / np.sqrt(180 * error.size))


def test_readings_stop_at_the_range(rest: Any, vehicle: Any, ideal: Any) -> None:
    """Beyond its range a converter shows the end of its range, and inside it the value."""
    suite = SensorSuite(vehicle, worlds=3, control_step=0.1)
    ideal(suite.imu).set(orientation=[0, 0, 0, 1], gyro_range=1.5, accel_range=5.0)
    state = rest(3)
    state.velocity.numpy()[:, 0, 3] = [1.0, 4.0, -4.0]
    suite.reset(state)
    np.testing.assert_allclose(suite.imu.gyro.numpy()[:, 0, 0], [1.0, 1.5, -1.5])
    np.testing.assert_allclose(suite.imu.accel.numpy()[:, 0, 2], 5.0)


def test_a_range_may_stand_in_the_file(vehicle: Any) -> None:
    """A file that gives a range limits the reading; one that gives none does not."""

    suite = SensorSuite(vehicle, worlds=1, control_step=0.1)
    assert np.isinf(suite.imu.parameters.numpy()["gyro_range"]).all()
    suite = SensorSuite(vehicle.replace({"sensors.imu.gyro_range": 8.7}), worlds=1, control_step=0.1)
    np.testing.assert_allclose(suite.imu.parameters.numpy()["gyro_range"], 8.7, rtol=EPS)
