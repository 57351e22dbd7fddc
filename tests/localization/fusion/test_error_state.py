"""The error-state filter: its Jacobians, exact motions, and consistent covariances."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from finssim.core.rotations import (
    quat_conjugate,
    quat_from_euler,
    quat_from_rotvec,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
    quat_to_rotvec,
    wrap_angle,
)
from finssim.localization.fusion.error_state import (
    ErrorStateNoise,
    InertialState,
    depth_model,
    heading_model,
    limits,
    position_model,
    predict,
    turned,
    velocity_model,
    yaw_model,
)
from finssim.localization.fusion.kalman import Innovation, bounded
from finssim.localization.fusion.position_filter import restarted

RUNS = 200
NOISE = ErrorStateNoise(gyro=2e-3, accel=0.02, gyro_walk=2e-4, accel_walk=2e-3)
SILENT = ErrorStateNoise(0.0, 0.0, 0.0, 0.0)
GRAVITY = np.array([0.0, 0.0, -9.81])
STD = np.array([0.02] * 3 + [0.05] * 3 + [0.02] * 3 + [0.01] * 3 + [0.05] * 3)
LEVER = np.array([0.1, -0.05, 0.2])


def some_state(seed=0, batch=()):
    rng = np.random.default_rng(seed)
    position, velocity = rng.standard_normal((*batch, 3)), rng.standard_normal((*batch, 3))
    return InertialState(
        np.concatenate([position, velocity], axis=-1),
        np.broadcast_to(np.diag(STD**2), (*batch, 15, 15)),
        quat_from_euler(*np.broadcast_arrays(0.2, -0.3, np.full(batch, 1.1))),
        0.1 * rng.standard_normal((*batch, 3)),
        0.3 * rng.standard_normal((*batch, 3)),
    )


def moved(state, d):
    """Return the state after adding an error."""
    return InertialState(
        state.x + d[..., 0:6],
        state.P,
        quat_multiply(quat_from_rotvec(d[..., 6:9]), state.q),
        state.gyro_bias + d[..., 9:12],
        state.accel_bias + d[..., 12:15],
    )


def error(true, found):
    """Return the error that leads from the estimated state to the true one, (..., 15)."""
    turn = quat_to_rotvec(quat_multiply(true.q, quat_conjugate(found.q)))
    parts = (true.x - found.x, turn)
    return np.concatenate([*parts, true.gyro_bias - found.gyro_bias, true.accel_bias - found.accel_bias], -1)


def jacobian(f, m, h=1e-6):
    """Return central differences of f, which takes an error state."""
    return np.stack([(f(h * e) - f(-h * e)) / (2 * h) for e in np.eye(15)], axis=-1).reshape(m, 15)


def test_propagation_carries_errors_as_its_covariance_says():
    """P after one step equals F P F' with F from finite differences of the nominal motion."""
    state, omega, force, dt = some_state(), np.array([0.3, -0.5, 0.8]), np.array([0.5, -1.0, 9.0]), 0.01
    after = predict(state, omega, force, dt, SILENT, GRAVITY)
    F = jacobian(lambda d: error(predict(moved(state, d), omega, force, dt, SILENT, GRAVITY), after), 15)
    expected = F @ state.P @ F.T
    # F is first order in the rotation of one step, omega dt = 0.01.
    np.testing.assert_allclose(after.P, expected, atol=0.01 * dt * np.abs(expected).max())


@pytest.mark.parametrize(
    ("model", "m"),
    [
        (lambda s: position_model(s, LEVER), 3),
        (lambda s: depth_model(s, LEVER, np.array([0.0, 0.6, 0.8]), -1.0), 1),
        (yaw_model, 1),
    ],
    ids=["position", "depth", "yaw"],
)
def test_measurement_jacobians_are_derivatives(model, m):
    """Jacobians equal central differences of each measurement over all fifteen errors."""
    state = some_state(1)
    numeric = jacobian(lambda d: model(moved(state, d))[0] - model(state)[0], m)
    np.testing.assert_allclose(model(state)[1], numeric, atol=1e-8)


def aided_state(random):
    return InertialState(
        random.standard_normal(6), np.eye(20), quat_from_euler(0.2, -0.1, 1.0),
        0.01 * random.standard_normal(3), np.zeros(3), np.array([0.02, 0.01, 0.1, -0.2, 0.05]),
    )  # fmt: skip


@pytest.mark.parametrize("model", ["velocity", "heading"])
def test_jacobians_of_doppler_log_and_compass_are_derivatives(model):
    """Jacobians equal central differences through `correct`, which moves the error into the state."""
    random = np.random.default_rng(3)
    s, omega, lever = aided_state(random), random.standard_normal(3), np.array([0.1, -0.2, 0.3])

    def value(x):
        return velocity_model(x, omega, lever) if model == "velocity" else heading_model(x)

    H = value(s).H
    for k in range(20):
        ends = []
        for sign in (1.0, -1.0):
            gain = np.eye(20)[:, k : k + 1]
            found = Innovation(np.array([sign * 1e-6]), np.zeros((1, 20)), np.eye(1), np.zeros(()), gain)
            moved = s.corrected(found)
            ends.append(value(moved)[0])
        np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, H[:, k], atol=2e-6)


def test_a_doppler_log_reads_what_a_turning_vehicle_moves_at():
    """At rest but turning, a log ahead of the IMU reads ω x l, with scale and offset added."""
    q, none = quat_from_euler(0.0, 0.0, 0.7), np.zeros(3)
    turning = InertialState(np.zeros(6), np.eye(20), q, none, none, np.zeros(5))
    read = velocity_model(turning, np.array([0.0, 0.0, 0.5]), np.array([0.4, 0.0, 0.0])).value
    np.testing.assert_allclose(read, [0.0, 0.2, 0.0], atol=1e-12)
    north, extra = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.1, 0.0, 0.0, 0.3])
    moving = InertialState(np.append(none, north), np.eye(20), q, none, none, extra)
    expected = 1.1 * quat_to_matrix(q).T @ north + [0.0, 0.0, 0.3]
    np.testing.assert_allclose(velocity_model(moving, none, none)[0], expected)


def test_a_constant_push_in_a_turn_is_followed_to_second_order():
    """Circling at constant speed, the position after one turn returns, within the error of the midpoint rule."""
    speed, rate, dt = 0.5, 1.0, 0.01
    n = round(2 * np.pi / rate / dt)
    dt = 2 * np.pi / rate / n
    still = replace(some_state(), x=np.array([0, 0, 0, speed, 0, 0]), q=np.array([0.0, 0, 0, 1]))
    state = replace(still, gyro_bias=np.zeros(3), accel_bias=np.zeros(3))
    force = np.array([0.0, speed * rate, 9.81])  # towards the centre, on the left
    for _ in range(n):
        state = predict(state, np.array([0.0, 0.0, rate]), force, dt, SILENT, GRAVITY)
    np.testing.assert_allclose(state.x[:3], 0.0, atol=speed * rate * dt)
    np.testing.assert_allclose(state.x[3:], [speed, 0.0, 0.0], atol=speed * dt**2)


def test_at_rest_with_the_right_biases_nothing_moves():
    """Level or tilted, an accelerometer that reads gravity and its bias leaves the vehicle at rest."""
    state = replace(some_state(2), x=some_state(2).x * [1, 1, 1, 0, 0, 0])
    force = quat_rotate(quat_conjugate(state.q), -GRAVITY) + state.accel_bias
    after = state
    for _ in range(500):
        after = predict(after, state.gyro_bias, force, 0.01, SILENT, GRAVITY)
    np.testing.assert_allclose(after.x[:3], state.x[:3], atol=1e-9)


@pytest.mark.slow
def test_errors_and_innovations_are_as_large_as_the_filter_says():
    """NEES (15) of 200 runs and NIS of fixes, yaws and depths lie in their 95 % bands about 95 % of the time."""
    rng, dt, variance = np.random.default_rng(7), 0.01, {"xy": 1e-4, "yaw": 4e-4, "depth": 2.5e-5}
    found = some_state(3, (RUNS,))
    found = replace(found, x=found.x * [1, 1, 1, 0, 0, 0])
    true = moved(found, STD * rng.standard_normal((RUNS, 15)))
    nees, nis = [], {name: [] for name in variance}
    for k in range(1, 1000):
        t = k * dt
        turning = np.array([0.1 * np.sin(t), 0.1 * np.cos(1.3 * t), 0.4 * np.cos(0.3 * t)])
        wanted = np.array([0.2 * np.sin(0.7 * t), 0.2 * np.cos(0.5 * t), 0.1 * np.sin(0.9 * t)])
        middle = quat_multiply(true.q, quat_from_rotvec(0.5 * dt * turning))
        force = quat_rotate(quat_conjugate(middle), wanted - GRAVITY)
        walk = np.sqrt(dt) * rng.standard_normal((RUNS, 4, 3))
        shown = turning + true.gyro_bias + NOISE.gyro * walk[:, 0] / dt
        felt = force + true.accel_bias + NOISE.accel * walk[:, 1] / dt
        true = predict(true, turning + true.gyro_bias, force + true.accel_bias, dt, SILENT, GRAVITY)
        true = replace(
            true,
            gyro_bias=true.gyro_bias + NOISE.gyro_walk * walk[:, 2],
            accel_bias=true.accel_bias + NOISE.accel_walk * walk[:, 3],
        )
        found = predict(found, shown, felt, dt, NOISE, GRAVITY)
        due = (["xy", "yaw"] if k % 3 == 0 else []) + (["depth"] if k % 5 == 0 else [])
        for name in due:
            found = measured(found, true, name, variance[name], rng, nis)
        if due and k % 15 == 0:
            e = error(true, found)
            nees.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.P), e))
    for rows, dimension, slack in (
        (nees, 15, 0.08),
        (nis["xy"], 2, 0.05),
        (nis["yaw"], 1, 0.05),
        (nis["depth"], 1, 0.05),
    ):
        low, high = chi2.ppf([0.025, 0.975], RUNS * dimension) / RUNS
        mean = np.array(rows).mean(axis=1)
        assert np.mean((mean > low) & (mean < high)) == pytest.approx(0.95, abs=slack)


def measured(found, true, name, variance, rng, nis):
    """Return the filter after one measurement of each run."""
    model = {
        "xy": lambda s: (position_model(s, LEVER).value[..., :2], position_model(s, LEVER).H[..., :2, :]),
        "yaw": yaw_model,
        "depth": lambda s: depth_model(s, LEVER, np.array([0.0, 0.0, 1.0]), 0.0),
    }[name]
    expected, H = model(found)[:2]
    z = model(true)[0] + np.sqrt(variance) * rng.standard_normal(expected.shape)
    residual = wrap_angle(z - expected) if name == "yaw" else z - expected
    R = variance * np.eye(H.shape[-2])
    compared = found.innovation(residual, H, R)
    nis[name].append(compared.mahalanobis)
    return found.corrected(compared)


def test_restarts_and_caps_keep_the_covariance_positive():
    """Restarted axes and headings have the variance of their measurement; caps bound variances, and none is
    negative."""
    state = predict(some_state(), np.zeros(3), np.array([0, 0, 9.81]), 1.0, NOISE, GRAVITY)
    after = turned(restarted(state, [0, 1], np.array([3.0, 4.0]), np.eye(2) * 0.01, 0.3), 0.5, 0.02)
    np.testing.assert_array_equal(after.x[:2], [3.0, 4.0])
    assert after.P[8, 8] == 0.02
    assert float(wrap_angle(yaw_model(after)[0] - yaw_model(state)[0])[0]) == pytest.approx(0.5)
    capped = bounded(after.P * 1e6, limits(100.0, 15))
    d = np.diagonal(capped)
    assert np.all(d[:3] <= 100.0 * (1 + 1e-12)) and np.all(d[6:8] <= 0.25 * (1 + 1e-12))
    for P in (after.P, capped):
        assert np.linalg.eigvalsh(P)[0] > -1e-9
