"""The significance of a relation between two signals is valid for noise that is correlated in time."""

import numpy as np
import pytest
from scipy.signal import lfilter

from finssim.trials.significance import relation


def coloured(rng, n, lag):
    """Return noise of unit size with a correlation time of `lag` samples."""
    return lfilter([np.sqrt(2.0 / lag)], [1.0, 1.0 / lag - 1.0], rng.standard_normal(n + 20 * lag))[
        20 * lag :
    ]


@pytest.mark.parametrize("lag", [1, 5, 25])
def test_unrelated_noise_gives_the_stated_chance(lag):
    """Of 400 pairs of 500 samples, 20 are below 5 % on one side, 40 on both; hardly any is certain."""
    rng = np.random.default_rng(lag)
    found = [relation(coloured(rng, 500, lag), coloured(rng, 500, lag)) for _ in range(400)]
    assert 15 <= sum(one.chance < 0.05 for one in found) <= 75
    assert sum(one.sure for one in found) <= 1


def test_a_signal_and_its_negative_are_told_apart_beside_noise():
    """The slope is -1 in noise of half the signal's size, with a constant that is not part of the relation."""
    rng = np.random.default_rng(0)
    t = np.arange(500) / 25.0
    x = np.sin(0.7 * t)
    found = relation(x + 3.0, -x + 0.5 * coloured(rng, 500, 5) - 1.0, nuisances=np.ones((500, 1)))
    assert found.sure and found.slope == pytest.approx(-1.0, abs=0.2) and found.correlation < -0.7


def test_gaps_and_empty_signals_say_nothing_of_themselves():
    """Unknown samples do not count; a signal without samples has no relation."""
    x = np.sin(np.arange(300.0))
    y = np.where(np.arange(300) % 7 == 0, np.nan, 2.0 * x)
    assert relation(x, y).slope == pytest.approx(2.0) and relation(x, y).sure
    assert not relation(x, np.full(300, np.nan)).sure and not relation(x, np.zeros(300)).sure
