"""Averages of linear and quadratic drag, compared with closed forms."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm, t

from finssim.identification.drag_shape import WHITE, _average, drag_shape


@pytest.mark.parametrize(("size", "top"), [(2.0, 3.0), (0.5, 4.0)])
def test_the_prior_of_linear_drag_equals_quadratic_drag_at_the_top_speed(size, top):
    """With data as weak as the prior, the mean of d1 is that of a truncated normal, by the probability of its term.

    The prior of d1 is a half-normal of scale size * top; zero lies midway between two points of the grid.
    """
    std = size * top
    mean = 0.5 * (WHITE[1] - WHITE[0]) * std
    value, _, probability, _ = _average(
        np.array([mean, size]), np.diag([std**2, (0.1 * size) ** 2]), size, top
    )
    both = norm(0.5 * mean, math.sqrt(0.5) * std)  # product of the likelihood and the untruncated prior
    truncated = both.mean() + both.var() * both.pdf(0.0) / both.sf(0.0)
    assert value[0] == pytest.approx((probability["both"] + probability["linear"]) * truncated, rel=0.01)


def test_an_uncertain_thrust_widens_the_intervals_of_both_terms():
    """With thrust of standard deviation s, both terms vary by their sensitivities g on top of their own spread:
    half widths add in squares, and the averages stay."""
    A, x = np.array([[0.04, -0.03], [-0.03, 0.09]]), np.array([4.0, 6.0, 1.0])
    s, g = 0.05, np.array([5.0, 8.0])

    def shape(g):
        C = np.zeros((3, 3))
        C[:2, :2], C[2, 2] = A + s**2 * np.outer(g, g), s**2
        C[:2, 2] = C[2, :2] = s**2 * g
        parameters = SimpleNamespace(
            names=["surge.d1", "surge.d2", "thrust_scale"], likely=True, expected=x.copy()
        )
        covariance = SimpleNamespace(local=C, trials=C, alone=np.zeros(3, bool), dof=np.full(3, 5.0))
        problem = SimpleNamespace(parameters=parameters, low=np.zeros(3))
        stage = SimpleNamespace(x=x, problem=problem, found=SimpleNamespace(covariance=covariance, free=x))
        return drag_shape(stage, "surge", 8.0, [0.5, 1.5])

    known, uncertain = shape(np.zeros(2)), shape(g)
    np.testing.assert_allclose(uncertain.value, known.value, rtol=1e-9)
    for value, (low, high), (lower, higher), change in zip(
        known.value, known.ends, uncertain.ends, t.ppf(0.975, 5.0) * s * g, strict=True
    ):
        assert higher - value == pytest.approx(math.hypot(high - value, change), rel=1e-3)
        assert value - lower == pytest.approx(math.hypot(value - low, change), rel=1e-3)
