"""The position filter has a consistent covariance, and its steps follow its motion model."""

import numpy as np
import pytest
from scipy.stats import chi2

from finssim.localization.fusion.position_filter import (
    MotionModel,
    PositionState,
    capped,
    frozen,
    predict,
    process_noise,
    restarted,
    transition,
)

RUNS = 200
MOTION = MotionModel(density=(0.05, 0.05, 0.02))
SLOWING = MotionModel(density=(0.12, 0.12, 0.12), decay=(0.7, 0.7, 0.0))
VISION, DEPTH = np.eye(6)[:2], np.eye(6)[2:3]


def start(batch=()):
    return PositionState(
        np.zeros((*batch, 6)), np.broadcast_to(np.diag([0.01] * 3 + [0.09] * 3), (*batch, 6, 6))
    )


def compared(state, H, z, R):
    """Return the innovation of a measurement z = H x + noise."""
    return state.innovation(z - state.x @ H.T, H, R)


@pytest.mark.parametrize("motion", [MOTION, SLOWING], ids=["constant", "slowing"])
def test_two_steps_are_one_of_both_lengths(motion):
    """The model is in continuous time: any division of a step gives the same mean and covariance."""
    state = PositionState(np.arange(6.0), start().P)
    once = predict(state, 0.7, motion)
    parts = predict(predict(predict(state, 0.1, motion), 0.35, motion), 0.25, motion)
    np.testing.assert_allclose(parts.x, once.x, rtol=1e-12)
    np.testing.assert_allclose(parts.P, once.P, rtol=1e-11, atol=1e-15)


def test_process_noise_is_the_integral_of_white_acceleration():
    """Q = q [dt³/3 dt²/2; dt²/2 dt] is compared with the covariance of many finely integrated paths."""
    q, dt, n = 0.05, 0.5, 500
    rng = np.random.default_rng(1)
    steps = rng.standard_normal((20000, n)) * np.sqrt(q * dt / n)
    v = np.cumsum(steps, axis=1)
    p = v.sum(axis=1) * dt / n
    Q = process_noise(dt, MotionModel(density=(q, q, q)))
    measured = np.cov(np.stack([p, v[:, -1]]))
    np.testing.assert_allclose(measured, Q[np.ix_([0, 3], [0, 3])], rtol=0.05)


@pytest.mark.parametrize("dt", [1e-9, 1e-5, 1e-3, 0.1, 10.0])
def test_slow_decay_ends_in_none(dt):
    """As the decay goes to zero, step and noise become those of constant velocity."""
    nearly = MotionModel(density=MOTION.density, decay=(1e-7,) * 3)
    np.testing.assert_allclose(process_noise(dt, nearly), process_noise(dt, MOTION), rtol=1e-4)
    np.testing.assert_allclose(transition(dt, nearly), transition(dt, MOTION), rtol=1e-5)


def test_update_is_the_least_squares_answer():
    """Kalman's update equals the information form, with a full 2 x 2 covariance of x and y."""
    rng = np.random.default_rng(2)
    A = rng.standard_normal((6, 6))
    state = PositionState(rng.standard_normal(6), A @ A.T)
    R, z = np.array([[0.04, 0.018], [0.018, 0.01]]), np.array([0.3, -0.2])
    after = state.corrected(compared(state, VISION, z, R))
    information = np.linalg.inv(state.P) + VISION.T @ np.linalg.inv(R) @ VISION
    np.testing.assert_allclose(after.P, np.linalg.inv(information), rtol=1e-9, atol=1e-12)
    expected = after.P @ (np.linalg.solve(state.P, state.x) + VISION.T @ np.linalg.solve(R, z))
    np.testing.assert_allclose(after.x, expected, rtol=1e-8)


def test_covariance_stays_symmetric_and_positive_with_a_measurement_nearly_exact():
    """Joseph's form survives a thousand measurements of a nanometre after a prior of ten metres."""
    state = PositionState(np.zeros(6), np.eye(6) * 100.0)
    R = np.eye(2) * 1e-18
    for _ in range(1000):
        state = predict(state, 0.01, MOTION)
        state = state.corrected(compared(state, VISION, np.zeros(2), R))
    assert np.array_equal(state.P, state.P.T)
    assert np.linalg.eigvalsh(state.P)[0] > -1e-15


def simulate(seed, duration=10.0, rate=120):
    """Simulate 200 vehicles with the model's motion, fixes at 30 Hz and depths at 20 Hz: NEES and NIS by time."""
    rng = np.random.default_rng(seed)
    L = np.linalg.cholesky(process_noise(1.0 / rate, MOTION))
    state = start((RUNS,))
    truth = state.x + rng.standard_normal((RUNS, 6)) @ np.sqrt(np.diag([0.01] * 3 + [0.09] * 3))
    R = {"vision": np.array([[4e-4, 1e-4], [1e-4, 1e-4]]), "depth": np.array([[2.5e-5]])}
    H = {"vision": VISION, "depth": DEPTH}
    nees, nis = [], {"vision": [], "depth": []}
    for k in range(1, int(duration * rate)):
        truth = truth @ transition(1.0 / rate, MOTION).T + rng.standard_normal((RUNS, 6)) @ L.T
        due = [name for name, every in (("depth", rate // 20), ("vision", rate // 30)) if k % every == 0]
        state = predict(state, 1.0 / rate, MOTION)
        for name in due:
            noise = rng.standard_normal((RUNS, len(H[name]))) @ np.linalg.cholesky(R[name]).T
            found = compared(state, H[name], truth @ H[name].T + noise, R[name])
            state = state.corrected(found)
            nis[name].append(found.mahalanobis)
        if due:
            e = state.x - truth
            nees.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(state.P), e))
    return np.array(nees), {name: np.array(rows) for name, rows in nis.items()}


def share_inside(rows, dimension):
    """Return the share of times at which the mean over the runs lies in its 95 % band."""
    low, high = chi2.ppf([0.025, 0.975], RUNS * dimension) / RUNS
    mean = rows.mean(axis=1)
    return float(np.mean((mean > low) & (mean < high)))


def test_errors_and_innovations_are_as_large_as_the_filter_says():
    """NEES (6) and NIS (2 and 1) of 200 runs lie in their 95 % bands about 95 % of the time."""
    nees, nis = simulate(seed=3)
    # Neighbouring times share their errors, so the share scatters more than with independent ones: +-4 %.
    assert share_inside(nees, 6) == pytest.approx(0.95, abs=0.04)
    for name, dimension in (("vision", 2), ("depth", 1)):
        assert share_inside(nis[name], dimension) == pytest.approx(0.95, abs=0.03)
        # Innovations are white, so the band of their grand mean is that of all numbers together.
        low, high = chi2.ppf([0.025, 0.975], nis[name].size * dimension) / nis[name].size
        assert low < nis[name].mean() < high


def test_a_batch_is_its_runs():
    """A leading axis changes no number."""
    rng = np.random.default_rng(5)
    batch = PositionState(rng.standard_normal((3, 6)), start((3,)).P)
    z, R = rng.standard_normal((3, 2)), np.eye(2) * 0.01
    together = batch.corrected(compared(batch, VISION, z, R))
    for i in range(3):
        one = PositionState(batch.x[i], batch.P[i])
        one = one.corrected(compared(one, VISION, z[i], R))
        np.testing.assert_allclose(together.x[i], one.x, rtol=1e-14)
        np.testing.assert_allclose(together.P[i], one.P, rtol=1e-13, atol=1e-18)


def test_restarting_an_axis_leaves_the_others():
    """The restarted axes have the measured position, at rest; the others keep state and covariance."""
    state = predict(PositionState(np.arange(6.0), start().P), 1.0, MOTION)
    after = restarted(state, [0, 1], np.array([7.0, 8.0]), np.eye(2) * 0.01, 0.3)
    np.testing.assert_array_equal(after.x, [7.0, 8.0, state.x[2], 0.0, 0.0, state.x[5]])
    np.testing.assert_array_equal(after.P[np.ix_([2, 5], [2, 5])], state.P[np.ix_([2, 5], [2, 5])])
    assert np.linalg.eigvalsh(after.P)[0] > 0.0


def test_stopping_turns_speed_into_doubt_and_a_cap_keeps_it_finite():
    """A stopped axis does not move; its variance is capped together with its covariances, and stays positive."""
    state = frozen(PositionState(np.array([0, 0, 0, 0.4, -0.2, 0.1]), start().P), [0, 1])
    np.testing.assert_array_equal(state.x[3:], [0.0, 0.0, 0.1])
    assert state.P[3, 3] == pytest.approx(0.09 + 0.16)
    later = capped(predict(state, 1e6, SLOWING), 100.0)
    assert np.all(np.diagonal(later.P)[:3] <= 100.0 * (1 + 1e-12))
    assert np.linalg.eigvalsh(later.P)[0] > -1e-9
