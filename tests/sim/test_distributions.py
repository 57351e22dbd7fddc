"""Every distribution agrees with its closed form, and invalid ones are refused in one sentence."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from finssim.sim.distributions import Distribution
from finssim.sim.randomize import widened
from finssim.sim.ranges_file import Ranges, RangesError, load_ranges
from reference.draws import column, draw

WORLDS = 20_000

CONTINUOUS = {
    "uniform": ([0.5, 2.0], stats.uniform(0.5, 1.5)),
    "named uniform": ({"uniform": [0.5, 2.0]}, stats.uniform(0.5, 1.5)),
    "log-uniform": ({"log_uniform": [0.5, 2.0]}, stats.loguniform(0.5, 2.0)),
    "normal": ({"normal": [1.2, 0.2]}, stats.truncnorm(-4.0, 4.0, 1.2, 0.2)),
    "cut normal": ({"normal": [1.2, 0.5], "within": [1.0, 2.0]}, stats.truncnorm(-0.4, 1.6, 1.2, 0.5)),
}


@pytest.mark.parametrize("case", CONTINUOUS)
def test_draws_follow_the_distribution(case):
    """Mean and standard deviation to their errors, and Kolmogorov-Smirnov's statistic below its 0.1 % limit."""
    drawn, reference = CONTINUOUS[case]
    x = column(draw({"slew": drawn}, worlds=WORLDS)[1], "slew")
    assert x.mean() == pytest.approx(reference.mean(), abs=4.0 * reference.std() / np.sqrt(WORLDS))
    assert x.std() == pytest.approx(reference.std(), rel=0.03)
    assert stats.kstest(x, reference.cdf).statistic < 1.95 / np.sqrt(WORLDS)
    low, high = reference.support()
    assert x.min() >= low - 1e-6 and x.max() <= high + 1e-6


def test_choices_come_as_often_as_their_weights_say():
    x = column(draw({"slew": {"choice": [0.5, 1.0, 3.0], "weights": [1, 2, 5]}}, worlds=WORLDS)[1], "slew")
    for value, share in ((0.5, 0.125), (1.0, 0.25), (3.0, 0.625)):
        assert np.mean(x == np.float32(value)) == pytest.approx(share, abs=0.015)


def test_with_a_probability_the_number_of_the_file_stays_otherwise():
    x = column(draw({"slew": {"uniform": [0.2, 0.6], "probability": 0.3}}, worlds=WORLDS)[1], "slew")
    assert np.mean(x != 1.0) == pytest.approx(0.3, abs=0.015)
    assert x[x != 1.0].max() <= 0.6


def test_entries_are_independent_of_each_other():
    """Two entries, two vehicles and two episodes are uncorrelated."""
    parts = {"slew": [0.5, 1.5], "mass": [0.5, 1.5], "inertia": [0.5, 1.5]}
    _, draws = draw(parts, worlds=WORLDS, vehicles=["finsrov", "finsrov"])
    everything = [column(draws, name, v) for name in parts for v in range(2)]
    R = np.corrcoef(everything)
    assert abs(R - np.eye(len(R))).max() < 4.5 / np.sqrt(WORLDS)


WIDTHS = {
    "uniform": (Distribution(uniform=(0.5, 2.0)), 1.0, [0.75, 1.5, 0.0, 0.0], 1.0),
    "of which the nominal is outside": (Distribution(uniform=(2.0, 4.0)), 1.0, [2.0, 3.0, 0.0, 0.0], 1.0),
    "log-uniform": (Distribution(log_uniform=(0.25, 4.0)), 1.0, [0.5, 2.0, 0.0, 0.0], 1.0),
    "normal": (Distribution(normal=(1.2, 0.1), within=(0.8, 1.6)), 1.0, [0.9, 1.3, 1.1, 0.05], 1.0),
    "choice": (Distribution(choice=(0.0, 0.5)), 1.0, [0.0, 0.5, 0.0, 0.0], 0.5),
    "probability": (Distribution(uniform=(0.0, 0.3), probability=0.2), 1.0, [0.0, 0.3, 0.0, 0.0], 0.1),
}


@pytest.mark.parametrize("case", WIDTHS)
def test_half_the_width_lies_half_way_from_the_nominal_number(case):
    distribution, nominal, ends, probability = WIDTHS[case]
    found, p = widened(distribution, nominal, 0.5)
    np.testing.assert_allclose(found, ends, rtol=1e-12)
    assert p == probability
    full, whole = widened(distribution, nominal, 1.0)
    np.testing.assert_allclose(full[:2], distribution.bounds(), rtol=1e-12)
    assert whole == distribution.probability


REFUSED = {
    "none": ("slew: {}", "slew: gives no distribution, expected one of uniform, log_uniform, normal, choice"),
    "two": ("slew: {uniform: [0, 1], normal: [1, 1]}", "slew: gives uniform and normal, expected one of"),
    "a word": ("slew: fast", "slew: is 'fast', expected two numbers [low, high] or a distribution such as {normal"),
    "one number": ("slew: 1.0", "slew: is 1.0, expected two numbers [low, high] or a distribution"),
    "three numbers": ("slew: [1, 2, 3]", "slew: is [1, 2, 3], expected two numbers"),
    "unknown kind": ("slew: {unifrom: [0, 1]}", "slew: unknown entry 'unifrom'; did you mean 'uniform'?"),
    "reversed": ("slew: {uniform: [2, 1]}", "slew: uniform: is [2.0, 1.0], expected [low, high] with low <= high"),
    "log of zero": ("slew: {log_uniform: [0, 1]}", "slew: log_uniform: is [0.0, 1.0], expected numbers above 0"),
    "no spread": ("slew: {normal: [1, -0.1]}", "slew: normal: standard deviation is -0.1, expected 0 or more"),
    "mean outside": ("slew: {normal: [3, 0.1], within: [0, 2]}", "slew: normal: mean 3.0 lies outside of within"),
    "within alone": ("slew: {uniform: [0, 1], within: [0, 2]}", "slew: within belongs to a normal distribution"),
    "weights alone": ("slew: {uniform: [0, 1], weights: [1]}", "slew: weights belong to choices"),
    "weights of nothing": ("slew: {choice: [1, 2], weights: [0, 0]}", "slew: weights are [0.0, 0.0], expected 0"),
    "infinite": ("slew: {uniform: [0, .inf]}", "slew: expected finite numbers"),
    "probability": ("slew: {uniform: [0, 1], probability: 2}", "slew: probability: Input should be less than"),
    "normal below zero": ("mass: {normal: [1, 0.3]}", "mass: reaches from -0.2 to 2.2, expected numbers above 0"),
    "dropout of one": ("sensors: {dropout: [0, 1]}", "sensors.dropout: is [0.0, 1.0], expected numbers from 0 to"),
    "sensor": ("sensors: {positon_std: [0, 1]}", "sensors: unknown entry 'positon_std'; did you mean 'position_std'?"),
    "thruster": ("thrust: {every: [0, 1]}", "thrust: unknown entry 'every'; available: all, each, failure"),
    "center": ("center_of_gravity: {X: [0, 1]}", "center_of_gravity: unknown entry 'X'; available: x, y, z"),
    "too late": ("added_delay: [0, 3]", "added_delay: reaches 3 s, expected at most 2 s"),
    "nothing alike": ("qqqq: [0, 1]", "unknown entry 'qqqq'; available: name, source, mass"),
    "schedule": ("curriculum: {over: [0.6, 0.2]}", "curriculum: over is [0.6, 0.2], expected [low, high]"),
    "judge": ("curriculum: {narrow_at: 0.9}", "curriculum: narrow_at is 0.9, expected at most widen_at, 0.8"),
    "success": ("curriculum: {success: {}}", "curriculum.success: expected either held [s] or episode_return"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_drawn_is_refused(case, tmp_path):
    text, sentence = REFUSED[case]
    path = tmp_path / "ranges.yaml"
    path.write_text(text + "\n", encoding="utf-8")
    with pytest.raises(RangesError) as caught:
        load_ranges(path)
    assert str(caught.value).startswith(f"{path}: {sentence}")
    assert "\n" not in str(caught.value)


def test_ranges_are_read_back_from_what_they_are_saved_as():
    """They are saved as in a policy's description."""
    ranges = Ranges.model_validate(
        {
            "name": "all",
            "mass": {"normal": [1.0, 0.1]},
            "center_of_gravity": {"z": [-0.01, 0.01]},
            "time_constant": {"all": [0.5, 1.0], "each": {"choice": [1.0, 1.2]}},
            "thrust": {"failure": {"uniform": [0.0, 0.3], "probability": 0.1}},
            "waves": {"count": [0, 2], "amplitude": {"log_uniform": [0.01, 0.03]}, "wavelength": [3.0, 8.0]},
            "correlated": [{"entries": ["mass", "center_of_gravity.z"], "correlation": [[1, 0.5], [0.5, 1]]}],
            "curriculum": {"success": {"held": 3.0}},
        }
    )
    assert Ranges.model_validate(ranges.model_dump(mode="json")) == ranges


def test_a_plant_file_gets_the_same_check_of_its_correlations():
    with pytest.raises(ValidationError, match="'slew' is not drawn"):
        Ranges.model_validate(
            {
                "name": "x",
                "mass": [0.9, 1.1],
                "correlated": [{"entries": ["mass", "slew"], "correlation": [[1, 0.5], [0.5, 1]]}],
            }
        )
