"""Aggregates over seeds: closed forms, and intervals that hold the truth as often as they say."""

import math

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from finssim.experiments.statistics import interquartile_mean, probability_of_improvement, with_bootstrap


@pytest.mark.parametrize(
    "scores, expected",
    [
        ([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], 3.5),  # the middle four
        ([1.0, 2.0, 3.0, 4.0, 10.0], (0.75 * 2.0 + 3.0 + 0.75 * 4.0) / 2.5),  # 1.25 off each end
        ([5.0], 5.0),
        ([1.0, 2.0, 3.0, math.inf], 2.5),  # one in four failed
        ([1.0, 2.0, math.inf, math.inf], math.inf),
    ],
)
def test_the_middle_half(scores, expected):
    shuffled = np.random.default_rng(0).permutation(scores)
    assert interquartile_mean(shuffled) == pytest.approx(expected)


def test_rows_and_columns_are_one_set():
    scores = np.random.default_rng(1).normal(size=(6, 4))
    assert interquartile_mean(scores) == interquartile_mean(scores.T)


@pytest.mark.parametrize("less", [True, False])
def test_probability_is_that_of_mann_and_whitney(less):
    """Column by column, ties included."""
    rng = np.random.default_rng(2)
    a, b = rng.integers(0, 5, (7, 3)).astype(float), rng.integers(1, 6, (5, 3)).astype(float)
    wins = [mannwhitneyu(a[:, k], b[:, k]).statistic / 35.0 for k in range(3)]
    expected = np.mean(wins) if not less else 1.0 - np.mean(wins)
    assert probability_of_improvement(a, b, less) == pytest.approx(expected)


@pytest.mark.slow
def test_intervals_hold_the_truth():
    """Of a symmetric distribution it is the middle: 12 runs, 200 draws; 95 % less what twelve cost."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(200):
        low, high = with_bootstrap([rng.normal(1.0, 0.3, (12, 3))], interquartile_mean, 300)["ci95"]
        held += low <= 1.0 <= high
    assert 0.85 * 200 <= held <= 200


def test_what_never_varies_has_no_width():
    same = with_bootstrap([np.full((4, 2), 3.0)], interquartile_mean)
    assert same == {"value": 3.0, "ci95": [3.0, 3.0], "count": 4}


def test_a_failure_is_no_number_in_json():
    failed = with_bootstrap([np.full((3, 2), math.inf)], interquartile_mean)
    assert failed == {"value": None, "ci95": [None, None], "count": 3}
