"""Intervals cover at their nominal rate, and pairs cancel the effects that both rows share."""

import numpy as np
import pytest

from finssim.evaluation.statistics import paired_difference, with_interval


def test_the_value_is_the_statistic_of_all_values():
    """Clusters affect the interval, not the value."""
    values = {"a": [1.0, 2.0], "b": [9.0]}
    assert with_interval(values)["value"] == pytest.approx(4.0)
    assert with_interval(values, np.median)["value"] == pytest.approx(2.0)
    assert with_interval({"a": []}) is None


def test_shared_errors_widen_the_interval():
    """Eight trials that share their plant contain little more information than one."""
    random = np.random.default_rng(1)
    clustered = {k: list(np.full(8, shared)) for k, shared in enumerate(random.normal(0.0, 1.0, 9))}
    alone = {k: [x] for k, x in enumerate(random.normal(0.0, 1.0, 72))}
    wide, narrow = (np.ptp(with_interval(values)["ci95"]) for values in (clustered, alone))
    assert wide > 1.8 * narrow


@pytest.mark.slow
def test_an_interval_holds_the_mean_about_as_often_as_it_says():
    """With nine clusters, a percentile bootstrap covers somewhat less than 95 %, never less than 80 %."""
    random = np.random.default_rng(2)
    inside = 0
    for _ in range(60):
        drawn = {k: list(x + random.normal(0.0, 0.3, 8)) for k, x in enumerate(random.normal(0.0, 1.0, 9))}
        low, high = with_interval(drawn, np.mean)["ci95"]
        inside += low <= 0.0 <= high
    assert inside >= 48


def test_pairs_cancel_what_a_plant_does_to_both():
    """A difference of 0.01 is significant although plants differ by 1."""
    random = np.random.default_rng(3)
    plants = random.normal(0.0, 1.0, 9)
    pairs = [(p, s, t) for p in range(9) for s in (1,) for t in ("P01", "P02")]
    ours = {pair: plants[pair[0]] + random.normal(0.0, 0.002) for pair in pairs}
    theirs = {pair: plants[pair[0]] + 0.01 + random.normal(0.0, 0.002) for pair in pairs}
    d = paired_difference(ours, theirs)
    assert d["ci95"][0] > 0.0 and d["value"] == pytest.approx(0.01, abs=0.002) and d["count"] == len(pairs)


def test_trials_without_a_partner_are_left_out():
    """A pair needs both."""
    d = paired_difference({(1, 1, "P01"): 1.0}, {(1, 1, "P01"): 2.0, (2, 1, "P01"): 50.0})
    assert (d["value"], d["count"]) == (1.0, 1)
    assert paired_difference({(1, 1, "P01"): 1.0}, {}) is None
