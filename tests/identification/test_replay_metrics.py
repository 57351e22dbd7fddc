"""A replay's scores follow their definitions on signals whose scores have a closed form."""

from __future__ import annotations

import numpy as np
import pytest

from finssim.identification.replay_metrics import (
    Pair,
    aggregate,
    error_ahead,
    excited_axes,
    find_phases,
    nrmse,
    onset,
    response_span,
    score,
    span,
)

RATE, HOLD, COAST, LEVEL, DAMPING, MASS = 50.0, 9.0, 4.0, 12.0, 40.0, 27.0


def step_response(t, level=LEVEL, damping=DAMPING, mass=MASS):
    """Return the surge of m u' = tau - d u under `level` from 1 s to 10 s, from rest."""
    lag, terminal = mass / damping, level / damping
    rise = terminal * (1.0 - np.exp(-(t - 1.0) / lag))
    at_end = terminal * (1.0 - np.exp(-HOLD / lag))
    return np.where(t < 1.0, 0.0, np.where(t < 1.0 + HOLD, rise, at_end * np.exp(-(t - 1.0 - HOLD) / lag)))


def make_pair(simulated, *, t=None, noise=0.0, named=None, axes=("surge",), in_sample=False, name="a"):
    """Return a surge step with the given simulated surge (or a function of time)."""
    t = np.arange(round((1.0 + HOLD + COAST) * RATE) + 1) / RATE if t is None else t
    tau = np.zeros((len(t), 6))
    tau[:, 0] = np.where((t >= 1.0) & (t < 1.0 + HOLD), LEVEL, 0.0)
    u = step_response(t) + noise * np.random.default_rng(1).standard_normal(len(t))
    values = simulated(t) if callable(simulated) else simulated
    return Pair(
        name=name,
        sha256="0" * 64,
        t=t,
        rate=RATE,
        axes=axes,
        phase=find_phases(t, tau, axes, named),
        tau=tau,
        measured={"u": u},
        noise={"u": noise},
        simulated={"calibrated": {"u": values}},
        in_sample=in_sample,
    )


@pytest.mark.parametrize("offset", [0.01, -0.2, 3.0])
def test_a_shifted_signal_has_the_shift_over_the_span(offset):
    x = np.linspace(0.0, 1.0, 1001)
    assert nrmse(x, x + offset, span(x)).value == pytest.approx(abs(offset) / 0.9)


@pytest.mark.parametrize("gain", [0.0, 0.5, 1.0, 2.0])
def test_a_scaled_sine_has_the_closed_form(gain):
    """|1 - g| A/√2 over the span 2 A sin(0.45 π) of a sine of amplitude A: a tenth of a period is above P95."""
    x = 0.3 * np.sin(2.0 * np.pi * np.arange(10000) / 10000)
    expected = abs(1.0 - gain) / np.sqrt(2.0) / (2.0 * np.sin(0.45 * np.pi))
    assert nrmse(x, gain * x, span(x)).value == pytest.approx(expected, abs=1e-4)


def test_the_mean_as_prediction_of_a_uniform_ramp():
    """A uniform distribution has a deviation of 1/√12 of its range and a P5-P95 span of 0.9 of it."""
    x = np.linspace(-2.0, 3.0, 20001)
    assert nrmse(x, np.full_like(x, x.mean()), span(x)).value == pytest.approx(
        1 / np.sqrt(12) / 0.9, rel=1e-3
    )


def test_missing_samples_are_left_out():
    x = np.linspace(0.0, 1.0, 100)
    gap = np.where(np.arange(100) % 3 == 0, np.nan, x)
    assert nrmse(gap, x + 0.1, span(x)).value == pytest.approx(0.1 / 0.9)


def test_a_perfect_replay_scores_zero():
    assert score(make_pair(step_response), "calibrated", "u").value == 0.0


def test_scores_cover_excitation_and_coast_only():
    """An error before the excitation does not count."""
    pair = make_pair(lambda t: np.where(t < 1.0, 5.0, step_response(t)))
    assert score(pair, "calibrated", "u").value == 0.0
    assert score(pair, "calibrated", "u", "baseline").value > 10.0
    assert score(pair, "calibrated", "u", "rest").why == "the trial has no rest"


def test_degenerate_responses_are_told_in_words():
    still = make_pair(step_response)
    still.measured["u"] = np.zeros(len(still.t))
    still.measured["v"] = np.full(len(still.t), np.nan)
    assert score(still, "calibrated", "u") == (
        None,
        "the measured response does not vary: its P5 to P95 span is zero",
    )
    assert response_span(still, "v").why == response_span(still, "w").why == "not measured"
    still.measured["u"] = 0.0005 * np.sin(still.t)  # a vehicle at rest on the bench, measured well
    assert "at rest" in score(still, "calibrated", "u").why
    still.measured["u"] = 0.004 * np.random.default_rng(0).standard_normal(len(still.t))
    still.noise["u"] = 0.01
    assert "noise" in score(still, "calibrated", "u").why
    still.measured["u"][:-5] = np.nan
    assert "too short" in score(still, "calibrated", "u").why


def test_the_noise_of_the_measurement_is_a_floor():
    """A perfect model of a measurement with noise s scores s over the span."""
    pair = make_pair(step_response, noise=0.01)
    expected = 0.01 / span(pair.measured["u"][pair.scored()])
    assert score(pair, "calibrated", "u").value == pytest.approx(expected, rel=0.05)


def test_the_onset_is_where_the_input_reaches_a_tenth():
    pair = make_pair(step_response)
    pair.tau[:, 0] = np.clip(pair.t - 1.0, 0.0, 5.0)
    assert pair.t[onset(pair, "surge")] == pytest.approx(1.5)
    assert onset(pair, "sway") is None


def test_phases_are_those_of_the_log_or_follow_from_the_input():
    pair = make_pair(step_response)
    changes = np.flatnonzero(pair.phase[1:] != pair.phase[:-1]) + 1
    assert list(pair.phase[[0, *changes]]) == ["baseline", "excitation", "coast"]
    np.testing.assert_allclose(pair.t[changes], [1.0, 1.0 + HOLD])
    named = np.where(pair.t < 5.0, "excitation", "rest")
    assert list(find_phases(pair.t, pair.tau, ("surge",), named)) == list(named)
    assert set(find_phases(pair.t, 0.0 * pair.tau, ("surge",))) == {"coast"}


def test_excited_axes_come_from_the_header_or_the_input():
    limits = np.array([20.0, 20.0, 28.0, 3.0, 3.0, 7.0])
    tau = np.zeros((50, 6))
    assert excited_axes(tau, limits) == ()
    tau[:, 5], tau[:, 0] = 2.0, 0.3
    assert excited_axes(tau, limits) == ("yaw",)
    tau[:, 0] = 6.0
    assert excited_axes(tau, limits) == ("surge", "yaw")
    assert excited_axes(tau, limits, ("yaw", "heave")) == ("heave", "yaw")
    tau[:] = 0.0
    tau[:, 1] = 5.0
    assert excited_axes(tau, np.array([20.0, 0.0, 20.0, 0.0, 0.0, 5.0])) == ("sway",)


def test_the_heights_of_a_vehicle_file_do_not_choose_the_axes():
    """For a push 5 cm above the reference, or at it, pitch counts if it swings, and alone if nothing else is driven."""
    limits, tau = np.array([20.0, 20.0, 28.0, 3.0, 3.0, 7.0]), np.zeros((50, 6))
    tau[:, 0] = 20.0
    for height in (0.0, 0.05):
        tau[:, 4] = height * tau[:, 0]
        assert excited_axes(tau, limits) == ("surge",)
        assert excited_axes(tau, limits, swinging=("pitch",)) == ("surge", "pitch")
    tau[:, 0] = 0.0
    assert excited_axes(tau, limits) == ("pitch",)


def test_the_aggregate_weights_axes_equally_whatever_their_trials():
    rows = [{"surge": 0.1}] * 6 + [{"sway": 0.3}] * 2 + [{"heave": None}]
    found = aggregate(rows)
    assert found.value == pytest.approx(0.2) and found.trials == 8
    assert found.by_axis == {"surge": pytest.approx(0.1), "sway": pytest.approx(0.3)}
    assert found.ci95 == (pytest.approx(0.2), pytest.approx(0.2))


def test_one_wild_trial_does_not_move_the_median():
    rows = [{"yaw": x} for x in (0.1, 0.1, 0.1, 0.1, 5.0)]
    assert aggregate(rows).value == pytest.approx(0.1)


def test_the_interval_of_a_median_is_the_textbook_one():
    """For many trials of one axis it is ±1.96 times the standard error 1.253 s/√n of a normal sample's median."""
    x = np.random.default_rng(3).normal(0.3, 0.05, 400)
    low, high = aggregate([{"surge": value} for value in x]).ci95
    assert high - low == pytest.approx(2.0 * 1.96 * 1.253 * 0.05 / 20.0, rel=0.35)
    assert low < np.median(x) < high


def test_the_bootstrap_is_reproducible_and_its_seed_counts():
    rows = [{"surge": x, "yaw": 2.0 * x} for x in np.random.default_rng(0).uniform(0.1, 0.5, 60)]
    first, again, other = (aggregate(rows, seed=seed) for seed in (1, 1, 2))
    assert first == again and first.ci95 != other.ci95


def test_no_interval_from_a_single_trial_of_an_axis():
    found = aggregate([{"surge": 0.1}, {"surge": 0.2}, {"yaw": 0.3}])
    assert found.ci95 is None and "yaw" in found.why and found.value == pytest.approx(0.225)
    assert aggregate([{"surge": None}]) == (None, None, {}, 0, "no trial has a score")


def test_the_error_ahead_of_a_drift_grows_in_proportion():
    """With x = v t measured from each start and half of it predicted, the error is half that of persistence."""
    ahead = np.arange(0, 151) / RATE
    starts = np.zeros(7)
    measured = np.outer(ahead, np.linspace(0.1, 0.7, 7))
    found = error_ahead(starts, ahead, measured, 0.5 * measured, 2.0, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found.rmse[1:] / found.rmse[0], [2.0, 3.0])
    np.testing.assert_allclose(found.skill, 0.5)
    np.testing.assert_allclose(found.nrmse, found.rmse / 2.0)
    assert list(found.count) == [7, 7, 7]


def test_persistence_and_the_model_are_compared_on_the_same_predictions():
    ahead = np.arange(0, 101) / RATE
    measured = np.outer(ahead, np.ones(4))
    simulated = measured.copy()
    measured[50, 0] = simulated[50, 1] = np.nan
    found = error_ahead(np.zeros(4), ahead, measured, simulated, 1.0, [1.0, 2.0])
    assert list(found.count) == [2, 4]
    np.testing.assert_allclose(found.persistence, [1.0, 2.0])
