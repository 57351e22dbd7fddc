"""Eliminating the unknowns of single segments changes only the size of the system."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from finssim.core.least_squares import Block, arrow_reduced, block_of, eliminated, huber_loss
from finssim.identification.shooting import (
    Linearization,
    Point,
    blocks_of,
    curvatures_of,
    solve,
    step_of,
    weights_of,
)


class Decays:
    """Problem y = a exp(-b t) + c_g + noise: b and the c_g of each trial are shared unknowns, a belongs to a
    segment."""

    def __init__(self, seed=0, noise=0.01, outliers=0, segments=6, low=0.0):
        rng = np.random.default_rng(seed)
        self.t = np.linspace(0.0, 2.0, 40)
        self.groups = np.repeat(np.arange(segments // 2), 2)
        self.edges = np.arange(segments + 1) * len(self.t)
        G = segments // 2
        self.truth = Point(np.append(1.3, rng.normal(size=G)), rng.uniform(1, 2, (segments, 1)))
        self.low, self.high = np.append(low, np.full(G, -np.inf)), np.append(10.0, np.full(G, np.inf))
        self.prior_std, self.farthest = np.full((segments, 1), 100.0), np.full(1, np.inf)
        self.judged = 1
        self.size = noise
        clean = self.predicted(Point(*(part[None] for part in self.truth)))[:, 0]
        self.value = clean + noise * rng.normal(size=len(clean))
        self.value[rng.choice(len(clean), outliers, replace=False)] += 5.0

    def prior(self, theta):
        return np.zeros_like(theta), np.zeros((theta.shape[-1], theta.shape[-1]))

    def predicted(self, points):
        theta, z = points
        decay = np.exp(-theta[:, :1, None] * self.t)  # (C, 1, n)
        y = z * decay + theta[:, 1:, None][:, self.groups]
        return y.reshape(len(theta), -1).T

    def residuals(self, points):
        return self.value[:, None] - self.predicted(points)

    def linearise(self, point, *, one_sided=False):
        residual = self.residuals(Point(*(part[None] for part in point)))[:, 0]
        decay = np.exp(-point.theta[0] * self.t)
        theta = (-self.t * decay * point.z).reshape(-1, 1)
        offset = np.repeat(self.groups, len(self.t))[:, None] == np.unique(self.groups)
        own = np.tile(decay, len(self.groups))[:, None]
        return Linearization(residual, np.concatenate([theta, offset], axis=1), own)

    def noise(self, residual):
        return np.full(len(residual), self.size)

    def grain(self, theta):
        return np.zeros(len(theta))


def dense(problem, point, std):
    """Return normal matrix and right-hand side of all unknowns at once, by an explicit Jacobian."""
    linear = problem.linearise(point)
    P, (S, q) = len(point.theta), point.z.shape
    J = np.zeros((len(linear.residual), P + S * q))
    J[:, :P] = linear.shared
    for s in range(S):
        rows = slice(problem.edges[s], problem.edges[s + 1])
        J[rows, P + s * q : P + (s + 1) * q] = linear.own[rows]
    A = (J.T * curvatures_of(linear.residual, std)) @ J
    g = (J.T * weights_of(linear.residual, std)) @ linear.residual
    prior = np.concatenate([np.zeros(P), 1.0 / problem.prior_std.ravel() ** 2])
    return A + np.diag(prior), g - prior * np.concatenate([np.zeros(P), point.z.ravel()])


@pytest.mark.parametrize("seed", range(3))
def test_the_schur_complement_gives_the_step_of_the_whole_system(seed):
    """Steps and covariances of shared unknowns equal those of a joint solution."""
    problem = Decays(seed, outliers=3)
    rng = np.random.default_rng(seed)
    point = Point(np.append(0.8, rng.normal(size=3)), rng.uniform(1, 2, (6, 1)))
    std = problem.noise(problem.value)
    blocks = blocks_of(problem, problem.linearise(point), std, point)
    theta, z, error = step_of(problem, arrow_reduced(blocks, 0.0), point, 0.0)
    whole, side = dense(problem, point, std)
    expected = np.linalg.solve(whole, side)
    np.testing.assert_allclose(theta, expected[:4], rtol=1e-6)
    np.testing.assert_allclose(z.ravel(), expected[4:], rtol=1e-6)
    np.testing.assert_allclose(error, np.sqrt(np.diag(np.linalg.inv(whole))[:4]), rtol=1e-6)


def start(rate):
    """Return a point with a decay rate alone."""
    return Point(np.array([rate, 0.0, 0.0, 0.0]), np.zeros((6, 1)))


def test_a_fit_finds_what_the_data_were_made_with():
    """Rate, offsets and amplitudes are recovered to a few standard errors of the noise."""
    problem = Decays()
    solution = solve(problem, start(4.0))
    assert solution.converged
    np.testing.assert_allclose(solution.point.z, problem.truth.z, atol=0.05)
    np.testing.assert_allclose(solution.point.theta, problem.truth.theta, atol=0.05)


def test_outliers_hardly_move_a_fit():
    """Every twelfth sample off by 500 standard deviations shifts the rate by less than a tenth."""
    problem = Decays(outliers=20)
    solution = solve(problem, start(1.0))
    assert solution.point.theta[0] == pytest.approx(1.3, abs=0.1)


def test_a_residual_of_five_standard_deviations_weighs_half():
    """Huber's weight is 1 up to 2.5 standard deviations and 2.5 / size beyond, divided by the variance."""
    std = np.array([0.1, 0.1, 3.0, 3.0])
    weight = weights_of(np.array([2.4, 5.0, -2.4, -25.0]) * std, std)
    np.testing.assert_allclose(weight * std**2, [1.0, 0.5, 1.0, 0.1])


@pytest.mark.parametrize("cut", [2.5, np.inf])
def test_slopes_and_curvatures_are_those_of_the_loss(cut):
    """Slopes and curvatures equal differences of half Huber's loss of r / std, away from its kink."""
    std, r, h = np.full(6, 0.2), 0.2 * np.array([-30.0, -2.6, -2.4, 0.0, 1.0, 9.0]), 1e-4

    def half_loss(r):
        return 0.5 * huber_loss(np.abs(r / std), cut)

    slope = (half_loss(r + h) - half_loss(r - h)) / (2.0 * h)
    bend = (half_loss(r + h) - 2.0 * half_loss(r) + half_loss(r - h)) / h**2
    np.testing.assert_allclose(weights_of(r, std, cut) * r, slope, atol=1e-6)
    kept = np.where(np.abs(r) <= cut * std, 0.0, 0.1 * weights_of(r, std, cut))
    np.testing.assert_allclose(curvatures_of(r, std, cut), bend + kept, atol=1e-4)


def test_a_fit_among_many_outliers_takes_steps_of_newtons_kind():
    """With a fifth of the samples off to one side it takes 9 iterations from a third of the rate; with Huber's full
    weights as curvatures it took 16."""
    problem = Decays()
    problem.value[::5] += 0.05 * np.sign(problem.t[::5].mean() - np.tile(problem.t, 6)[::5])
    solution = solve(problem, start(0.4))
    assert solution.converged and solution.iterations <= 12


def test_an_unknown_that_is_held_does_not_stiffen_the_others():
    """Next to an unknown with a prior of 1e-9, a start that is off by 1 is corrected in one step."""
    rows = np.array([[1.0, 0.0], [1.0, 1e-3], [1.0, -1e-3]])
    block = block_of(np.zeros((3, 1)), rows, np.ones(3))
    held = block._replace(aa=np.eye(1), bb=block.bb + np.diag([1e-4, 1e18]))
    inner = eliminated(held, 0.0)[2]
    np.testing.assert_allclose(inner[:, -1], [1.0, 0.0], atol=1e-4)


def test_a_segment_that_overshoots_does_not_stop_the_others():
    """One reading ends in a plateau, as where the time of a change has reached the next sample: a full step of that
    segment's amplitude gives the largest error, and the rest converges all the same."""
    problem, straight = Decays(), Decays.predicted

    def predicted(points):
        y = straight(problem, points).T.reshape(len(points.theta), 6, -1)
        y[:, 0] = np.tanh(4.0 * (y[:, 0] - 2.2))
        return y.reshape(len(points.theta), -1).T

    problem.predicted = predicted
    problem.value = predicted(Point(*(part[None] for part in problem.truth)))[:, 0]

    def linearise(point, *, one_sided=False):
        linear = Decays.linearise(problem, point)
        n = len(problem.t)
        slope = 4.0 * (1.0 - predicted(Point(*(part[None] for part in point)))[:n, 0] ** 2)[:, None]
        linear.shared[:n] *= slope
        linear.own[:n] *= slope
        return linear

    problem.linearise = linearise
    solution = solve(problem, Point(np.array([1.0, 0.0, 0.0, 0.0]), np.full((6, 1), 1.2)))
    np.testing.assert_allclose(solution.point.theta, problem.truth.theta, atol=0.02)


def test_a_fit_stops_at_a_bound():
    """If the best rate lies outside the box, the result is at the edge and the rest fits as well as possible."""
    problem = Decays(low=2.0)
    solution = solve(problem, start(4.0))
    assert solution.point.theta[0] == 2.0 and solution.converged


def test_ctrl_c_keeps_the_best_so_far():
    """An interrupt in the third iteration returns the second's point, better than the start."""

    def interrupt(iteration, rms):
        if iteration == 3:
            raise KeyboardInterrupt

    problem = Decays()
    first = start(9.0)
    solution = solve(problem, first, report=interrupt)
    assert solution.interrupted and not solution.converged
    before, after = (np.abs(problem.linearise(p).residual).sum() for p in (first, solution.point))
    assert after < before


@given(seed=st.integers(0, 10_000))
def test_a_step_in_a_box_satisfies_the_conditions_of_karush_kuhn_and_tucker(seed):
    """Inside the box, the step is stationary in free directions and pushed against active bounds."""
    rng = np.random.default_rng(seed)
    n = rng.integers(1, 6)
    root = rng.normal(size=(n, n))
    A, g = root @ root.T + 0.1 * np.eye(n), 3.0 * rng.normal(size=n)
    problem = Decays()
    problem.low, problem.high = -rng.uniform(0.0, 1.0, n), rng.uniform(0.0, 1.0, n)
    block = Block(A, np.zeros((n, 1)), np.ones((1, 1)), g, np.zeros(1))
    d, _, _ = step_of(problem, arrow_reduced([block], 0.0), Point(np.zeros(n), np.zeros((1, 1))), 0.0)
    slope, tiny = g - A @ d, 1e-6 * np.abs(g).max()
    at_low, at_high = d <= problem.low + 1e-8, d >= problem.high - 1e-8
    assert ((d >= problem.low - 1e-8) & (d <= problem.high + 1e-8)).all()
    np.testing.assert_allclose(slope[~(at_low | at_high)], 0.0, atol=tiny + 1e-8)
    assert (slope[at_low] <= tiny).all() and (slope[at_high] >= -tiny).all()
