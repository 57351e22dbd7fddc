"""Correlated draws reproduce the given covariance and keep their own distributions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from finssim.sim.ranges_file import RangesError, load_ranges
from reference.draws import column, draw

WORLDS = 20_000
NAMES = ["linear_damping.surge", "quadratic_damping.surge", "thrust.all"]
R = [[1.0, -0.9, 0.3], [-0.9, 1.0, -0.1], [0.3, -0.1, 1.0]]


def parts(surge, squared, thrust):
    return {
        "linear_damping": {"axes": {"surge": surge}},
        "quadratic_damping": {"axes": {"surge": squared}},
        "thrust": {"all": thrust},
        "correlated": [{"entries": NAMES, "correlation": R}],
    }


def test_normal_draws_have_the_given_covariance():
    """C = diag(std) R diag(std); an element's error is at most std_i std_j sqrt(2 / n)."""
    std = np.array([0.10, 0.15, 0.05])
    own = [{"normal": [1.0, s], "within": [1.0 - 5.0 * s, 1.0 + 5.0 * s]} for s in std]
    _, draws = draw(parts(*own), worlds=WORLDS)
    C = np.cov([column(draws, name) for name in NAMES])
    np.testing.assert_allclose(C / np.outer(std, std), R, atol=4.0 * np.sqrt(2.0 / WORLDS))


def test_other_distributions_stay_and_their_ranks_go_together():
    """Spearman's correlation of a Gaussian copula is 6/π asin(ρ/2)."""
    _, draws = draw(parts([0.5, 2.0], {"log_uniform": [0.5, 2.0]}, [0.9, 1.1]), worlds=WORLDS)
    x = [column(draws, name) for name in NAMES]
    spearman = stats.spearmanr(np.array(x).T).statistic
    np.testing.assert_allclose(spearman, 6.0 / np.pi * np.arcsin(0.5 * np.array(R)), atol=0.03)
    assert stats.kstest(x[0], stats.uniform(0.5, 1.5).cdf).statistic < 1.95 / np.sqrt(WORLDS)
    assert stats.kstest(x[1], stats.loguniform(0.5, 2.0).cdf).statistic < 1.95 / np.sqrt(WORLDS)


def test_a_singular_correlation_ties_entries_together():
    both = {"mass": [0.9, 1.1], "slew": [0.9, 1.1]}
    tied = [{"entries": ["mass", "slew"], "correlation": [[1, 1], [1, 1]]}]
    _, draws = draw({**both, "correlated": tied})
    np.testing.assert_allclose(column(draws, "mass"), column(draws, "slew"), rtol=1e-6)


def test_the_vehicles_of_a_world_are_drawn_on_their_own():
    own = [{"normal": [1.0, 0.1]}] * 3
    _, draws = draw(parts(*own), worlds=WORLDS, vehicles=["finsrov", "finsrov"])
    x = [column(draws, NAMES[0], v) for v in range(2)]
    assert abs(np.corrcoef(x)[0, 1]) < 4.0 / np.sqrt(WORLDS)


HEAD = "mass: [0.9, 1.1]\nslew: [0.9, 1.1]\ncurrent: [0, 0.1]\ncorrelated:\n"
REFUSED = {
    "- {entries: [mass, slow], correlation: [[1, 0], [0, 1]]}": "correlated: unknown entry 'slow'; did you mean 'slew'",
    "- {entries: [mass, delay], correlation: [[1, 0], [0, 1]]}": "correlated: 'delay' is not drawn: give it a range",
    "- {entries: [mass, current], correlation: [[1, 0], [0, 1]]}": "correlated: mass, current: some are drawn for a",
    "- {entries: [mass, slew], correlation: [[1, 0]]}": "correlated.0: correlation is not 2 by 2",
    "- {entries: [mass, slew], correlation: [[1, 0.5], [0, 1]]}": "correlated.0: correlation: expected a symmetric",
    "- {entries: [mass, slew], correlation: [[1, 2], [2, 1]]}": "correlated.0: correlation: expected a matrix without",
    "- {entries: [mass, mass], correlation: [[1, 0], [0, 1]]}": "correlated.0: entries: one is named twice",
    "- {entries: [mass, slew], correlation: [[1, 0], [0, 1]]}\n"
    "- {entries: [mass, slew], correlation: [[1, 0], [0, 1]]}": "correlated: 'mass' is in two groups",
}  # fmt: skip


@pytest.mark.parametrize("text", REFUSED)
def test_what_cannot_go_together_is_refused(text, tmp_path):
    path = tmp_path / "ranges.yaml"
    path.write_text(HEAD + text + "\n", encoding="utf-8")
    with pytest.raises(RangesError) as caught:
        load_ranges(path)
    assert str(caught.value).startswith(f"{path}: {REFUSED[text]}")
