"""Intervals cover at their nominal rate, whatever errors the trials share; trade-offs are named."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.identification.uncertainty import (
    Evidence,
    correlated_samples,
    correlation,
    degeneracy,
    intervals,
    pooled_covariance,
    trial_covariance,
)
from finssim.trials.findings import CalibrationError

TRUTH = np.array([3.0, -1.0, 0.5])


def fitted(rng, trials, *, shared=0.0, unequal=False, samples=20):
    """Return estimate and evidence of least squares on trials whose errors share an offset and a slope within
    each trial."""
    X, y = [], []
    for g in range(trials):
        x = np.column_stack([np.ones(samples), rng.normal(size=(samples, 2)) + [rng.normal(), 0.0]])
        x = x * (1 + 2 * (g % 3)) if unequal else x
        noise = rng.normal(size=samples) + shared * (rng.normal() + x[:, 1] * rng.normal())
        X.append(x)
        y.append(x @ TRUTH + noise)
    theta = np.linalg.lstsq(np.concatenate(X), np.concatenate(y), rcond=None)[0]
    r = [b - a @ theta for a, b in zip(X, y, strict=True)]
    variance = np.mean(np.concatenate(r) ** 2)
    return theta, Evidence(
        names=("a", "b", "c"),
        normal=np.array([a.T @ a for a in X]) / variance,
        score=np.array([a.T @ b for a, b in zip(X, r, strict=True)]) / variance,
    )


@pytest.mark.slow
@pytest.mark.parametrize("trials", [3, 4, 6, 10, 30])
@pytest.mark.parametrize("shared", [0.0, 0.5])
@pytest.mark.parametrize("unequal", [False, True])
def test_intervals_cover_the_truth(trials, shared, unequal):
    """95 % intervals contain the truth in at least 90 % of 400 fits, and from 6 trials on are not far too wide either.

    Trials may be few, of unequal weight, and differ as a whole.
    """
    rng = np.random.default_rng(trials)
    hits = np.zeros(3)
    for _ in range(400):
        theta, evidence = fitted(rng, trials, shared=shared, unequal=unequal)
        ends = intervals(theta, trial_covariance(evidence))
        hits += (ends[:, 0] <= TRUTH) & (TRUTH <= ends[:, 1])
    assert (hits >= 0.88 * 400).all()  # 0.90 minus 1.3 standard errors of the count
    assert (hits <= 0.9975 * 400).all() or trials < 6


@pytest.mark.slow
def test_pooled_intervals_of_five_trials_cover_the_truth_and_are_shorter():
    """With one factor from all trials and parameters, 92 to 99 % of 400 fits contain the truth."""
    rng = np.random.default_rng(4)
    hits, length = np.zeros(3), np.zeros((2, 400, 3))
    for k in range(400):
        theta, evidence = fitted(rng, 5)
        pair = [intervals(theta, f(evidence)) for f in (pooled_covariance, trial_covariance)]
        hits += (pair[0][:, 0] <= TRUTH) & (TRUTH <= pair[0][:, 1])
        length[:, k] = np.diff(pair, axis=-1)[..., 0]
    assert 0.92 <= hits.sum() / 1200.0 <= 0.99
    assert np.median(length[0]) < 0.75 * np.median(length[1])


def test_local_covariance_is_too_narrow_when_trials_differ_and_trials_are_not():
    """Errors shared within a trial do not enter the local covariance, but the disagreement of the trials shows them."""
    rng = np.random.default_rng(0)
    errors, local, trials = [], [], []
    for _ in range(300):
        theta, evidence = fitted(rng, 20, shared=1.0)
        covariance = trial_covariance(evidence)
        errors.append(theta - TRUTH)
        local.append(np.diagonal(covariance.local))
        trials.append(np.diagonal(covariance.trials))
    truth = np.var(errors, axis=0)[:2]
    assert (np.mean(local, axis=0)[:2] < 0.4 * truth).all()
    assert np.mean(trials, axis=0)[:2] == pytest.approx(truth, rel=0.25)


def test_the_sandwich_agrees_with_trials_drawn_anew():
    """The formula agrees with 2000 draws of 60 trials with replacement."""
    _, evidence = fitted(np.random.default_rng(1), 60, shared=0.5)
    times = np.random.default_rng(3).multinomial(60, np.full(60, 1.0 / 60), size=2000).astype(float)
    normal = np.einsum("rg,gij->rij", times, evidence.normal)
    steps = np.linalg.solve(normal, (times @ evidence.score)[..., None])[..., 0]
    assert steps.std(axis=0) == pytest.approx(trial_covariance(evidence).std, rel=0.2)


@pytest.mark.parametrize("std", [0.01, 0.1, 1.0])
def test_intervals_with_a_prior_hold_truths_drawn_from_it(std):
    """For estimates pulled towards a prior's mean, 95 % intervals contain the truth and follow the narrower source."""
    rng, hits, width = np.random.default_rng(4), [], []
    for _ in range(300):
        theta, evidence = fitted(rng, 8)
        inverse = np.diag([0.0, std**-2, 0.0])
        N = evidence.normal.sum(axis=0)
        mean = TRUTH + [0.0, std * rng.normal(), 0.0]
        pulled = np.linalg.solve(N + inverse, N @ theta + inverse @ mean)
        covariance = trial_covariance(
            replace(
                evidence,
                score=evidence.score - evidence.normal @ (pulled - theta),
                prior=inverse,
            )
        )
        low, high = intervals(pulled, covariance)[1]
        hits.append(low <= TRUTH[1] <= high)
        width.append(0.5 * (high - low))
    assert 0.92 <= np.mean(hits)
    assert np.median(width) < 1.1 * 1.96 * std


def test_one_trial_leaves_the_local_answer():
    """One trial has no disagreement, so the local covariance is used."""
    theta, evidence = fitted(np.random.default_rng(2), 1, samples=200)
    covariance = trial_covariance(evidence)
    assert covariance.alone.all()
    half = np.diff(intervals(theta, covariance), axis=1)[:, 0] / 2
    assert half == pytest.approx(1.96 * np.sqrt(np.diagonal(np.linalg.inv(evidence.normal[0]))), rel=1e-3)


def test_what_only_one_trial_shows_is_not_called_certain():
    """The score of a trial that alone informs a parameter is zero; its interval comes from the residuals instead."""
    rng = np.random.default_rng(3)
    X = [np.column_stack([rng.normal(size=50), np.zeros(50)]) for _ in range(6)]
    X[0][:, 1] = rng.normal(size=50)
    y = [x @ [1.0, 2.0] + rng.normal(size=50) for x in X]
    theta = np.linalg.lstsq(np.concatenate(X), np.concatenate(y), rcond=None)[0]
    r = [b - a @ theta for a, b in zip(X, y, strict=True)]
    covariance = trial_covariance(
        Evidence(
            names=("a", "b"),
            normal=np.array([a.T @ a for a in X]),
            score=np.array([a.T @ b for a, b in zip(X, r, strict=True)]),
        )
    )
    assert covariance.alone.tolist() == [False, True]
    assert covariance.std[1] > 0.9 / np.sqrt(50)


def test_unknown_directions_have_infinite_intervals():
    """Of two regressors that are always equal, neither is known; the third is."""
    rng = np.random.default_rng(4)
    x = [np.column_stack([a := rng.normal(size=30), a, rng.normal(size=30)]) for _ in range(5)]
    evidence = Evidence(
        names=("a", "b", "c"),
        normal=np.array([a.T @ a for a in x]),
        score=rng.normal(size=(5, 3)) * [1, 1, 1],
    )
    half = np.diff(intervals(np.zeros(3), trial_covariance(evidence)), axis=1)[:, 0]
    assert np.isinf(half[:2]).all() and np.isfinite(half[2])


def test_correlated_samples_of_an_autoregression():
    """In an AR(1) series with coefficient φ, (1 + φ)/(1 - φ) samples count as one independent sample."""
    from scipy.signal import lfilter

    noise = np.random.default_rng(5).normal(size=40000)
    assert correlated_samples(noise) == pytest.approx(1.0, abs=0.1)
    series = lfilter([1.0], [1.0, -0.8], noise)
    assert correlated_samples(series) == pytest.approx(9.0, rel=0.15)
    assert correlated_samples(series, [10000, 20000]) == pytest.approx(9.0, rel=0.15)


def test_thrust_scale_against_mass_is_named():
    """The ratios are known to 1 % and each value to 40 %: the finding names all of them."""
    theta = np.array([1.0, 25.0, 40.0, 0.3])
    relative = 0.4**2 * np.ones((4, 4)) + 0.01**2 * np.eye(4)
    relative[3, :3] = relative[:3, 3] = 0.0
    names = ("thrust_scale", "surge.m_eff", "surge.d1", "yaw.d1")
    found, findings = degeneracy(names, relative * np.outer(theta, theta), theta)
    assert found.matrix[0, 1] == pytest.approx(1.0, abs=1e-3)
    assert [one.code for one in findings] == ["thrust_traded"]
    assert findings[0].values == {"parameters": ("surge.m_eff", "surge.d1")}


def test_well_known_parameters_need_no_warning():
    """A strong correlation is harmless where every parameter is known to 1 %."""
    theta = np.array([25.0, 40.0])
    covariance = np.array([[1.0, 0.999], [0.999, 1.0]]) * np.outer(0.01 * theta, 0.01 * theta)
    assert degeneracy(("surge.d1", "surge.d2"), covariance, theta)[1] == []
    _, (traded,) = degeneracy(("surge.d1", "surge.d2"), 1600 * covariance, theta)
    assert traded.code == "damping_traded" and set(traded.values["parameters"]) == {"surge.d1", "surge.d2"}


def test_infinite_variance_is_said():
    """A parameter without information is named and does not affect the correlations of the others."""
    covariance = np.array([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, np.inf]])
    found, findings = degeneracy(("a", "b", "sway.d1"), covariance)
    assert findings[0].values == {"parameters": ("sway.d1",)}
    assert found.matrix[0, 1] == pytest.approx(0.5)
    assert np.isfinite(correlation(("a", "b", "c"), covariance).matrix).all()


def test_numbers_that_overflow_are_refused():
    """Overflowing numbers, as from inputs of millions of revolutions a minute, are refused."""
    evidence = Evidence(names=("c",), normal=np.full((2, 1, 1), np.nan), score=np.zeros((2, 1)))
    with pytest.raises(CalibrationError, match="numbers that overflow: check the units"):
        trial_covariance(evidence)


def test_a_parameter_that_is_hardly_known_overflows_nothing():
    """The square of a hardly known parameter's variance overflows, but the degrees of freedom of the others stay."""
    noise = np.random.default_rng(0).standard_normal((5, 2))
    for tiny in (1e-9, 1e-200):
        scale = np.array([1.0, tiny])
        evidence = Evidence(
            names=("a", "b"),
            normal=np.array([(1.0 + 0.1 * g) * np.diag(scale) for g in range(5)]),
            score=noise * np.sqrt(scale),
        )
        with np.errstate(all="raise", under="ignore"):
            found = trial_covariance(evidence)
        assert found.dof == pytest.approx([3.9085, 3.9085], rel=1e-4)
