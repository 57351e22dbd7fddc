"""Levenberg-Marquardt finds minima from distant starts, returns only valid states and reports its course."""

import math

import numpy as np
import pytest

from finssim.core.least_squares import STEADIEST, descend


def problem(residual, jacobian, possible=lambda x: True):
    """Return cost and linearisation of a sum of squares of a vector of parameters."""

    def linearise(x):
        r, J = residual(x), jacobian(x)
        N = J.T @ J

        def stepped(damping):
            step = -np.linalg.solve(N + damping * np.diag(np.diagonal(N)), J.T @ r)
            return x + step, float(-2.0 * step @ (J.T @ r) - step @ N @ step)

        return stepped

    return lambda x: float(residual(x) @ residual(x)) if possible(x) else math.inf, linearise


def valley(x):
    """Return Rosenbrock's residuals, whose minimum is (1, 1), at the end of a curved valley."""
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def valley_slopes(x):
    return np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])


@pytest.mark.parametrize("start", [(-1.2, 1.0), (3.0, -4.0), (0.0, 0.0)])
def test_the_end_of_a_curved_valley_is_found(start):
    """Rosenbrock's minimum is found from three starts, and no step raises the cost."""
    cost, linearise = problem(valley, valley_slopes)
    costs = []

    def watched(x):
        costs.append(cost(x))
        return costs[-1]

    end = descend(np.array(start), watched, linearise, steps=60, tolerance=1e-20)
    np.testing.assert_allclose(end.state, 1.0, atol=1e-8)
    assert end.converged and end.steps == len(costs) - 1 and end.cost == min(costs)


def test_a_linear_problem_takes_a_step_and_its_confirmation():
    """With little damping, the first step of a straight-line fit reaches the closed form; the next predicts no gain."""
    t = np.linspace(0.0, 1.0, 20)
    A, y = np.column_stack([t, np.ones(20)]), np.sin(t)
    cost, linearise = problem(lambda x: A @ x - y, lambda x: A)
    end = descend(np.zeros(2), cost, linearise, steps=20, relative_tolerance=1e-12, damping=1e-9)
    np.testing.assert_allclose(end.state, np.linalg.lstsq(A, y, rcond=None)[0], atol=1e-8)
    assert end.steps == 2 and end.converged


def test_an_impossible_state_is_never_returned():
    """Where the cost is infinite beyond x = 0.5, the search ends before it, and not as converged."""
    cost, linearise = problem(valley, valley_slopes, possible=lambda x: x[0] <= 0.5)
    end = descend(np.array([-1.2, 1.0]), cost, linearise, steps=400, tolerance=1e-30)
    assert end.state[0] <= 0.5 and math.isfinite(end.cost) and end.cost >= 0.25


def test_a_search_without_any_step_gives_up():
    """If no step succeeds, damping reaches its limit in about nine steps, since its growth factor doubles."""
    end = descend(3.0, lambda x: 1.0, lambda x: lambda damping: (None, 1.0), steps=1000)
    assert end.state == 3.0 and not end.converged
    assert end.steps == next(n for n in range(100) if 1e-3 * 2.0 ** (n * (n + 1) / 2) >= STEADIEST)
