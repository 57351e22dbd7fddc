"""Measures of synthetic trials with known results in closed form."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from finssim.evaluation.metrics import measure_trial, resample, summarize

GOAL = np.array([1.0, -0.3, -0.5, math.pi])


def trial(offset, yaw_offset, period=0.1, duration=60.0):
    """Return samples every `period`, at GOAL + offset(t) and its yaw + yaw_offset(t), with yaw wrapped as by
    sensors."""
    t = np.arange(round(duration / period) + 1) * period
    position = GOAL[:3] + np.stack([np.broadcast_to(component, t.shape) for component in offset(t)], axis=-1)
    yaw = (GOAL[3] + yaw_offset(t) + math.pi) % (2 * math.pi) - math.pi
    return t, position, yaw


def nowhere(t):
    return (0.0 * t, 0.0, 0.0)


def test_constant_errors_are_their_own_rms():
    """For e = (0.03, 0.04, 0.12), e_p = 0.13 and e_y is the vertical part; 12 cm below is no success."""
    measures = measure_trial(*trial(lambda t: (0.03, 0.04, -0.12), lambda t: np.full_like(t, -0.05)), GOAL)
    assert measures["e_p_m"] == pytest.approx(0.13)
    assert measures["e_y_m"] == pytest.approx(0.12)
    assert measures["e_psi_deg"] == pytest.approx(math.degrees(0.05))
    assert not measures["success"]
    assert measures["t_s_s"] is measures["J_p_m"] is measures["J_psi_deg"] is None


def test_errors_before_the_window_do_not_count():
    """An error of 5 m until 39.9 s does not count if the vehicle is at the goal from 40 s on."""
    measures = measure_trial(*trial(lambda t: (np.where(t < 39.95, 5.0, 0.0), 0.0, 0.0), np.zeros_like), GOAL)
    assert measures["e_p_m"] == pytest.approx(0.0, abs=1e-12)
    assert measures["t_s_s"] == pytest.approx(40.0)


def test_an_oscillation_has_the_rms_of_a_sine():
    """For A sin over whole periods, RMS = A / sqrt(2), as error and as jitter, with a goal at the wrap of yaw."""
    A, B = 0.06, math.radians(8.0)
    offset = lambda t: (A * np.sin(2 * np.pi * 0.5 * t), 0.0, 0.02)  # noqa: E731
    measures = measure_trial(*trial(offset, lambda t: B * np.sin(2 * np.pi * 0.3 * t)), GOAL)
    late = 1.0 / 200  # the window has 201 points: one more than whole periods
    assert measures["e_p_m"] == pytest.approx(math.hypot(A / math.sqrt(2), 0.02), rel=late)
    assert measures["e_psi_deg"] == pytest.approx(8.0 / math.sqrt(2), rel=late)
    assert measures["success"] and measures["t_s_s"] == 0.0
    # The constant 2 cm do not count as jitter.
    assert measures["J_p_m"] == pytest.approx(A / math.sqrt(2), rel=2 * late)
    assert measures["J_psi_deg"] == pytest.approx(8.0 / math.sqrt(2), rel=2 * late)


def test_settling_time_of_an_exponential_approach():
    """1.2 m exp(-t/4) passes 0.10 m at 4 ln 12 = 9.94 s; the first grid point inside is 10.0 s."""
    measures = measure_trial(*trial(lambda t: (-1.2 * np.exp(-t / 4.0), 0.0, 0.0), np.zeros_like), GOAL)
    assert measures["t_s_s"] == pytest.approx(math.ceil(4.0 * math.log(12.0) * 10.0) / 10.0)


def test_success_needs_ten_seconds_without_a_break():
    """Outside for one instant every 9 s never succeeds; one segment of 10 s does, and t_s is its start."""
    never = measure_trial(*trial(nowhere, lambda t: np.where(np.round(t % 9.0, 6) == 0.0, 1.0, 0.0)), GOAL)
    assert not never["success"]
    once = measure_trial(*trial(nowhere, lambda t: np.where((t > 19.95) & (t < 30.05), 0.0, 0.2)), GOAL)
    assert once["success"] and once["t_s_s"] == pytest.approx(20.0)
    short = measure_trial(*trial(nowhere, lambda t: np.where((t > 19.95) & (t < 29.95), 0.0, 0.2)), GOAL)
    assert not short["success"]


@pytest.mark.parametrize("axis", range(3))
def test_each_axis_has_its_own_tolerance(axis):
    """0.09 m on all three axes succeeds although the distance is 0.156 m; 0.11 m on one does not."""
    every = measure_trial(*trial(lambda t: (0.09, -0.09, 0.09), np.zeros_like), GOAL)
    one = measure_trial(*trial(lambda t: np.eye(3)[axis] * 0.11, np.zeros_like), GOAL)
    assert every["success"] and not one["success"]


@given(st.floats(0.01, 0.2), st.floats(-0.05, 0.05), st.floats(0.0, 0.1))
def test_measures_do_not_depend_on_the_sampling_rate(period, drift, turn):
    """A straight line is interpolated exactly at any sampling rate, up to the gap limit."""
    line = lambda t: (drift * t / 60.0, 0.0, 0.0)  # noqa: E731
    coarse = measure_trial(*trial(line, lambda t: turn * t / 60.0, period, 62.0), GOAL)
    fine = measure_trial(*trial(line, lambda t: turn * t / 60.0, 0.1, 62.0), GOAL)
    assert coarse["success"] == fine["success"]
    for key in ("e_p_m", "e_psi_deg", "t_s_s", "J_p_m", "J_psi_deg"):
        assert coarse[key] == pytest.approx(fine[key], abs=1e-9)


def test_a_gap_in_the_samples_breaks_the_hold():
    """Samples are missing for 0.4 s in every 8 s: there is no hold of 10 s, but late errors are known."""
    t, position, yaw = trial(nowhere, np.zeros_like)
    kept = (t % 8.0 > 0.35) | (t % 8.0 < 0.05)
    measures = measure_trial(t[kept], position[kept], yaw[kept], GOAL)
    assert not measures["success"]
    assert measures["e_p_m"] == 0.0
    assert 0.9 < measures["valid"] < 1.0


def test_a_trial_that_ends_early_has_no_late_errors():
    """A trial that ends early may have held for 10 s before; without samples there is no measure at all."""
    measures = measure_trial(*trial(nowhere, np.zeros_like, duration=30.0), GOAL)
    assert measures["success"] and measures["e_p_m"] is None and measures["valid"] == 0.0
    empty = measure_trial(np.empty(0), np.empty((0, 3)), np.empty(0), GOAL)
    assert not empty["success"] and empty["e_p_m"] is None


def test_samples_that_are_not_finite_are_unknown():
    t, position, yaw = trial(nowhere, np.zeros_like)
    position[450:, 1] = np.nan
    measures = measure_trial(t, position, yaw, GOAL)
    assert measures["e_p_m"] is None and measures["valid"] == pytest.approx(50 / 201)
    assert measures["success"]


def test_yaw_is_interpolated_the_short_way_round():
    """From 179 to -179 deg the vehicle passes 180, not 0."""
    grid, _, yaw = resample([0.0, 0.2], np.zeros((2, 3)), np.radians([179.0, -179.0]))
    assert yaw[1] == pytest.approx(math.pi)
    assert np.isnan(yaw[3:]).all() and grid[-1] == 60.0


@pytest.mark.parametrize(
    ("t", "position", "yaw", "sentence"),
    [
        ([0.0, 0.1, 0.1], np.zeros((3, 3)), np.zeros(3), "do not increase"),
        ([0.0, 0.1], np.zeros((3, 3)), np.zeros(3), r"expected \(T,\), \(T, 3\), \(T,\)"),
    ],
)
def test_malformed_samples_are_refused(t, position, yaw, sentence):
    with pytest.raises(ValueError, match=sentence):
        measure_trial(t, position, yaw, GOAL)


def test_the_table_row_averages_errors_and_takes_the_median_settling_time():
    """Trials at 1, 2, 3 cm settle at 10, 12, 50 s; one fails at 24 cm and one ended after 5 s."""
    trials = []
    for error, settled in ((0.01, 10.0), (0.02, 12.0), (0.03, 50.0), (0.24, 0.0)):
        path = lambda t, e=error: (0.0, e, 0.0)  # noqa: E731
        turn = lambda t, s=settled: np.where(t < s - 0.05, 1.0, 0.0)  # noqa: E731
        trials.append(measure_trial(*trial(path, turn), GOAL) | {"setpoint": "P03"})
    trials.append(measure_trial(*trial(nowhere, np.zeros_like, duration=5.0), GOAL) | {"setpoint": "P04"})
    row = summarize(trials)
    assert (row["trials"], row["valid"], row["success"]) == (5, 4, 3)
    assert row["e_p_m"] == pytest.approx((0.01 + 0.02 + 0.03 + 0.24) / 4)
    assert row["t_s_s"] == pytest.approx(12.0)
    assert row["J_p_m"] == pytest.approx(0.0, abs=1e-12)
    assert json.loads(json.dumps(row, allow_nan=False)) == row


def test_a_controller_that_never_succeeds_has_no_settling_time():
    row = summarize([measure_trial(*trial(lambda t: (0.5, 0.0, 0.0), np.zeros_like), GOAL)] * 2)
    assert row["success"] == 0
    assert row["t_s_s"] is row["J_p_m"] is row["J_psi_deg"] is None
