"""Yaw: its rate from body rates, the shortest direction, bias estimation, and consistent variances."""

import numpy as np
import pytest
from scipy.stats import chi2

from finssim.core.rotations import quat_to_euler, wrap_angle
from finssim.localization.fusion.attitude import (
    YawNoise,
    YawState,
    capped,
    predict,
    restarted,
    yaw_rate,
)
from localization.fusion.known_streams import attitude, body_rates, yaw

RUNS = 200
NOISE = YawNoise(rate=3e-3, bias_walk=5e-4)


def start(batch=(), variance=0.01, bias_std=0.02):
    zero = np.zeros(batch)
    return YawState(zero, zero, zero + variance, zero, zero + bias_std**2)


def compared(state, seen, variance):
    """Return the innovation of a measured yaw."""
    residual = np.atleast_1d(wrap_angle(seen - state.yaw)[..., None])
    return state.innovation(residual, np.array([[1.0, 0.0]]), np.array([[variance]]))


def test_yaw_rate_is_the_derivative_of_yaw_on_a_tilting_path():
    """psi_dot = (q sin φ + r cos φ)/cos θ agrees with the derivative of a path that rolls, pitches and turns."""
    t = np.linspace(0.0, 20.0, 401)
    roll, pitch, _ = quat_to_euler(attitude(t))
    omega = body_rates(t)
    h = 1e-4
    rates = [yaw_rate(*numbers) for numbers in zip(omega[:, 1], omega[:, 2], roll, pitch, strict=True)]
    np.testing.assert_allclose(rates, (yaw(t + h) - yaw(t - h)) / (2 * h), atol=2e-7)
    assert (
        np.abs(omega[:, 2] - 0.36 * np.cos(0.4 * t)).max() > 1e-3
    )  # the body's r alone is not the rate of yaw


def test_a_left_turn_raises_yaw():
    """Level and turning left (r > 0), yaw grows; rolled by 90 degrees, nose-down pitching makes it grow."""
    assert yaw_rate(0.0, 0.2, 0.0, 0.0) == pytest.approx(0.2)
    assert yaw_rate(0.2, 0.0, np.pi / 2, 0.0) == pytest.approx(0.2)


@pytest.mark.parametrize("true", [0.0, 3.1, -3.1, np.pi, 100.0])
def test_correction_goes_the_short_way_round(true):
    """From just across the half turn the correction is small, and yaw stays in [-pi, pi)."""
    state = restarted(start(), true, 0.01, 0.0)
    after = state.corrected(compared(state, true + 0.1 - 6 * np.pi, 0.01))
    assert wrap_angle(after.yaw - true) == pytest.approx(0.05)
    assert -np.pi <= after.yaw < np.pi


def test_the_bias_is_found():
    """A gyro bias of 0.02 rad/s is found to 0.001 rad/s after 20 s of a camera at 10 Hz."""
    rng = np.random.default_rng(0)
    state, noise = start(), YawNoise(rate=1e-3, bias_walk=1e-5)
    for k in range(1, 2001):
        state = predict(state, 0.3 + 0.02 + 0.01 * rng.standard_normal(), 0.01, noise)
        if k % 10 == 0:
            seen = 0.3 * 0.01 * k + 0.01 * rng.standard_normal()
            state = state.corrected(compared(state, seen, 1e-4))
    assert float(state.bias) == pytest.approx(0.02, abs=0.001)
    assert np.sqrt(state.P[1, 1]) < 0.002


def test_without_a_bias_the_gain_is_the_published_one():
    """For q = 0.02 /s and R = 0.05, the gain is P/(P + R) of one scalar."""
    noise, R = YawNoise(rate=np.sqrt(0.02), bias_walk=0.0), 0.05
    P = 10.0
    state = start(variance=P, bias_std=0.0)
    for _ in range(3):
        state = predict(state, 0.1, 0.02, noise)
        P = P + 0.02 * 0.02
        found = compared(state, 0.5, R)
        after = state.corrected(found)
        assert float((after.yaw - state.yaw) / found.residual[0]) == pytest.approx(P / (P + 0.05))
        state, P = after, P - P**2 / (P + 0.05)
        assert state.P[0, 0] == pytest.approx(P)


def test_errors_and_innovations_are_as_large_as_the_filter_says():
    """NEES (2) and NIS (1) of 200 runs, gyro 100 Hz and camera 30 Hz, lie in their 95 % bands 95 % of the time."""
    rng = np.random.default_rng(4)
    rate, variance = 300, 4e-4
    truth, bias = 0.1 * rng.standard_normal(RUNS), 0.02 * rng.standard_normal(RUNS)
    state, dt, nees, nis = start((RUNS,)), 0.01, [], []
    for k in range(1, 3000):
        if k % (rate // 100) == 0:
            turning = 0.4 * np.cos(0.3 * k / rate) * np.ones(RUNS)
            # Within a step the bias walks and the rate is noisy: exact sampling of the assumptions of `predict`.
            w, b = rng.standard_normal((2, RUNS))
            walk = NOISE.bias_walk * np.sqrt(dt) * w
            inside = NOISE.bias_walk * np.sqrt(dt**3 / 3.0) * (np.sqrt(0.75) * w + 0.5 * b)
            shown = turning + bias + (inside + NOISE.rate * np.sqrt(dt) * rng.standard_normal(RUNS)) / dt
            truth, bias = truth + turning * dt, bias + walk
            state = predict(state, shown, dt, NOISE)
        if k % (rate // 30) == 0 and k % (rate // 100) == 0:
            found = compared(state, truth + np.sqrt(variance) * rng.standard_normal(RUNS), variance)
            state = state.corrected(found)
            nis.append(found.mahalanobis)
            e = np.stack([wrap_angle(state.yaw - truth), state.bias - bias], -1)
            nees.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(state.P), e))
    for rows, dimension in ((np.array(nees), 2), (np.array(nis), 1)):
        low, high = chi2.ppf([0.025, 0.975], RUNS * dimension) / RUNS
        mean = rows.mean(axis=1)
        assert np.mean((mean > low) & (mean < high)) == pytest.approx(0.95, abs=0.05)


def test_doubt_of_yaw_is_capped():
    """A gyro that is silent for a day leaves a finite, positive covariance."""
    state = capped(predict(start(), 0.0, 86400.0, YawNoise(rate=0.3)), 10.0)
    assert state.P[0, 0] == pytest.approx(10.0)
    assert np.linalg.eigvalsh(state.P)[0] > -1e-9
