"""Robust weights of the regression: what they cost on clean noise, and what outliers still weigh."""

import numpy as np
import pytest

from finssim.identification.regression.axis_fit import robust_weights


@pytest.mark.parametrize("std", [0.02, 30.0])
def test_huber_weights_are_95_percent_efficient_on_gaussian_noise(std):
    """E[psi']² / E[psi²] of an M-estimator with psi = w r (Huber 1964) is 0.950 at 1.345 standard deviations."""
    residual = np.random.default_rng(0).normal(0.0, std, 200_000)
    weight = robust_weights(residual)
    slope = np.mean(weight == 1.0)  # psi' is 1 up to the cut and 0 beyond
    efficiency = slope**2 / np.mean((weight * residual / std) ** 2)
    assert efficiency == pytest.approx(0.950, abs=0.005)


def test_rows_beyond_eight_standard_deviations_weigh_nothing():
    """Of residuals of unit deviation, one of 7.5 has 1.345/7.5, one of 8.5 nothing."""
    residual = np.append(np.random.default_rng(1).standard_normal(100_000), [7.5, -8.5])
    weight = robust_weights(residual)
    assert weight[-2] == pytest.approx(1.345 / 7.5, rel=0.02) and weight[-1] == 0.0
