"""Eliminating what belongs to one segment changes nothing but the size of the system."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from finssim.calibration.simulation.bordered import CUT, bounded_step, collect, eliminate, huber, scatter
from finssim.calibration.simulation.gauss_newton import Linear, Point, solve


class Decays:
    """y = a exp(-b t) + c_g + noise: b is shared, c_g is of a trial, a is of a segment."""

    def __init__(self, seed=0, noise=0.01, outliers=0, segments=6, low=0.0):
        rng = np.random.default_rng(seed)
        self.t = np.linspace(0.0, 2.0, 40)
        self.groups = np.repeat(np.arange(segments // 2), 2)
        self.edges = np.arange(segments + 1) * len(self.t)
        self.truth = Point(
            np.array([1.3]), rng.normal(size=(segments // 2, 1)), rng.uniform(1, 2, (segments, 1))
        )
        self.low, self.high = np.array([low]), np.array([10.0])
        self.prior_std = np.full((segments, 1), 100.0)
        self.prior_mean, self.prior_precision = np.zeros(1), np.zeros(1)
        self.judged = 1
        self.size = noise
        clean = self.predicted(Point(*(part[None] for part in self.truth)))[:, 0]
        self.value = clean + noise * rng.normal(size=len(clean))
        self.value[rng.choice(len(clean), outliers, replace=False)] += 5.0

    def predicted(self, points):
        theta, phi, z = points
        decay = np.exp(-theta[:, None, :] * self.t)  # (C, 1, n)
        y = z * decay + phi[:, self.groups]
        return y.reshape(len(theta), -1).T

    def residuals(self, points):
        return self.value[:, None] - self.predicted(points)

    def linearise(self, point):
        residual = self.residuals(Point(*(part[None] for part in point)))[:, 0]
        decay = np.exp(-point.theta[0] * self.t)
        theta = (-self.t * decay * point.z).ravel()
        own = np.tile(decay, len(self.groups))[:, None]
        return Linear(residual, np.stack([theta, np.ones_like(theta)], axis=-1), own)

    def noise(self, residual):
        return np.full(len(residual), self.size)

    def grain(self, theta):
        return np.zeros(len(theta))


def dense(problem, point, std):
    """Normal matrix and right-hand side of all unknowns at once, by an explicit Jacobian."""
    linear = problem.linearise(point)
    P, (G, b), (S, q) = 1, point.phi.shape, point.z.shape
    J = np.zeros((len(linear.residual), P + G * b + S * q))
    for s in range(S):
        rows = slice(problem.edges[s], problem.edges[s + 1])
        J[rows, :P] = linear.shared[rows, :P]
        at = P + problem.groups[s] * b
        J[rows, at : at + b] = linear.shared[rows, P:]
        at = P + G * b + s * q
        J[rows, at : at + q] = linear.own[rows]
    weight = huber(linear.residual / std)[1] / std**2
    A, g = (J.T * weight) @ J, (J.T * weight) @ linear.residual
    prior = np.concatenate([np.zeros(P + G * b), 1.0 / problem.prior_std.ravel() ** 2])
    return A + np.diag(prior), g - prior * np.concatenate([np.zeros(P + G * b), point.z.ravel()])


@pytest.mark.parametrize("seed", range(3))
def test_the_schur_complement_gives_the_step_of_the_whole_system(seed):
    """Shared unknowns move as if all were solved for together, and so do their covariances."""
    problem = Decays(seed, outliers=3)
    rng = np.random.default_rng(seed)
    point = Point(np.array([0.8]), rng.normal(size=(3, 1)), rng.uniform(1, 2, (6, 1)))
    std = problem.noise(problem.value)
    blocks = collect(problem.linearise(point), std, problem.edges, point.z, problem.prior_std)
    normal, right, _ = eliminate(blocks)
    A, g = scatter(normal, right, problem.groups, (1, 3, 1))
    whole, side = dense(problem, point, std)
    np.testing.assert_allclose(np.linalg.solve(A, g), np.linalg.solve(whole, side)[:4], rtol=1e-8)
    np.testing.assert_allclose(np.linalg.inv(A), np.linalg.inv(whole)[:4, :4], rtol=1e-8)


def test_a_fit_finds_what_the_data_were_made_with():
    """Rate, offsets and amplitudes come back to a few standard errors of the noise."""
    problem = Decays()
    start = Point(np.array([4.0]), np.zeros((3, 1)), np.zeros((6, 1)))
    solution = solve(problem, start)
    assert solution.converged
    assert solution.point.theta[0] == pytest.approx(1.3, abs=0.02)
    np.testing.assert_allclose(solution.point.z, problem.truth.z, atol=0.05)
    np.testing.assert_allclose(solution.point.phi, problem.truth.phi, atol=0.05)


def test_outliers_hardly_move_a_fit():
    """Every twelfth sample off by 500 standard deviations shifts the rate by less than a tenth."""
    problem = Decays(outliers=20)
    solution = solve(problem, Point(np.array([1.0]), np.zeros((3, 1)), np.ones((6, 1))))
    assert solution.point.theta[0] == pytest.approx(1.3, abs=0.1)


def test_a_fit_stops_at_a_bound():
    """Where the best rate lies outside the box, the edge is the answer and the rest fits as it can."""
    problem = Decays(low=2.0)
    solution = solve(problem, Point(np.array([4.0]), np.zeros((3, 1)), np.zeros((6, 1))))
    assert solution.point.theta[0] == 2.0 and solution.converged


def test_ctrl_c_keeps_the_best_so_far():
    """An interrupt in the third iteration returns the second's point, better than the start."""

    def interrupt(iteration, rms):
        if iteration == 3:
            raise KeyboardInterrupt

    problem = Decays()
    start = Point(np.array([9.0]), np.zeros((3, 1)), np.zeros((6, 1)))
    solution = solve(problem, start, report=interrupt)
    assert solution.interrupted and not solution.converged
    before, after = (np.abs(problem.linearise(p).residual).sum() for p in (start, solution.point))
    assert after < before


@given(seed=st.integers(0, 10_000))
def test_a_bounded_step_satisfies_the_conditions_of_karush_kuhn_and_tucker(seed):
    """Inside the box, stationary where free, pushed against the bounds where not."""
    rng = np.random.default_rng(seed)
    n = rng.integers(1, 6)
    root = rng.normal(size=(n, n))
    A, g = root @ root.T + 0.1 * np.eye(n), 3.0 * rng.normal(size=n)
    low, high = -rng.uniform(0.0, 1.0, n), rng.uniform(0.0, 1.0, n)
    d = bounded_step(A, g, low, high)
    slope = g - A @ d
    assert ((d >= low) & (d <= high)).all()
    free = (d > low + 1e-9) & (d < high - 1e-9)
    np.testing.assert_allclose(slope[free], 0.0, atol=1e-7 * np.abs(g).max() + 1e-9)
    tiny = 1e-7 * np.abs(g).max()
    assert (slope[d <= low + 1e-9] <= tiny).all() and (slope[d >= high - 1e-9] >= -tiny).all()


@given(x=st.floats(-50.0, 50.0))
def test_hubers_loss_is_continuous_and_its_weight_its_slope(x):
    """ρ' = w x everywhere, quadratic inside the cut."""
    h = 1e-5
    (above, below), weight = (huber(np.array([x + h, x - h]))[0], huber(np.array([x]))[1])
    assert (above - below) / (2 * h) == pytest.approx(float(weight[0]) * x, abs=1e-3)
    if abs(x) < CUT:
        assert huber(np.array([x]))[0][0] == pytest.approx(0.5 * x * x)
