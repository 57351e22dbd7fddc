"""Averages of linear and quadratic drag, compared with closed forms."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from finssim.identification.drag_shape import WHITE, _average


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
