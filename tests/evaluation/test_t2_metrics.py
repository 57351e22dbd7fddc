"""Measures of tracking, on runs with known errors."""

import math
from dataclasses import replace

import numpy as np
import pytest

from finssim.control.trajectories import TRAJECTORIES
from finssim.core.rotations import quat_from_euler
from finssim.evaluation.metrics import MEASURES, measure_tracking, projected_times, summarize_tracking

ELLIPSE, EIGHT = TRAJECTORIES["ellipse"], TRAJECTORIES["lemniscate"]


def times(trajectory, rate=20.0):
    return np.arange(0.0, trajectory.duration + 1e-9, 1.0 / rate)


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_a_perfect_run_has_no_error_and_is_complete(name):
    """Cross-track errors are those of a reference sampled at 50 Hz: half the distance between samples."""
    trajectory = TRAJECTORIES[name]
    t = times(trajectory)
    m = measure_tracking(t, trajectory.at(t).position, trajectory)
    assert max(m[key] for key in ("horizontal_rmse_m", "vertical_rmse_m", "p95_m")) == 0.0
    assert m["cross_track_p95_m"] <= 0.5 * 0.11 / 50.0
    assert m["complete"] and m["valid"] == 1.0


def test_a_constant_shift_is_its_own_error():
    """Horizontal 0.03 and 0.04 give 0.05 m; with 0.12 below, the distance is 0.13 m."""
    t = times(ELLIPSE)
    m = measure_tracking(t, ELLIPSE.at(t).position + [0.03, 0.04, -0.12], ELLIPSE)
    errors = [m[key] for key in ("horizontal_rmse_m", "vertical_rmse_m", "p95_m")]
    np.testing.assert_allclose(errors, [0.05, 0.12, 0.13], rtol=1e-9)


def test_being_late_is_an_error_in_time_and_none_across_the_way():
    """One second late on the ellipse, the error is v · 1 s in time and zero across the path; the end is not reached."""
    t = times(ELLIPSE)
    m = measure_tracking(t, ELLIPSE.at(t - 1.0).position, ELLIPSE)
    speed = np.linalg.norm(ELLIPSE.at(t).velocity, axis=-1)
    assert m["horizontal_rmse_m"] == pytest.approx(math.sqrt(np.mean(speed**2)), rel=0.02)
    assert m["cross_track_p95_m"] < 0.002
    assert 0.98 < m["completion"] < 1.0
    short = measure_tracking(t, ELLIPSE.at(t).position + [0.0, -0.02, 0.0], ELLIPSE)
    assert short["complete"]  # two centimetres short of the end, where the reference is slow


def test_projections_never_go_back_nor_take_the_other_branch_of_a_crossing():
    """The eight's middle is passed twice: the projection stays near the sample's own time, and is monotone."""
    t = times(EIGHT)
    rng = np.random.default_rng(0)
    found = projected_times(t, EIGHT.at(t).position + rng.normal(0.0, 0.03, (len(t), 3)), EIGHT)
    assert np.all(np.diff(found) >= 0.0)
    assert np.all(np.abs(found - t) <= 2.0 + 1e-9)
    assert abs(found[len(t) // 2] - 15.0) <= 2.0


def test_stopping_half_way_is_not_complete():
    t = times(EIGHT)
    m = measure_tracking(t, EIGHT.at(np.minimum(t, 10.0)).position, EIGHT)
    assert not m["complete"] and m["completion"] == pytest.approx(1.0 / 3.0, abs=0.05)


def test_only_the_duration_counts():
    """Samples before the start and after the end change nothing."""
    t = np.arange(-5.0, EIGHT.duration + 5.0, 0.05)
    place = EIGHT.at(t).position
    place[(t < 0.0) | (t > EIGHT.duration)] += 9.0
    assert measure_tracking(t, place, EIGHT)["p95_m"] == 0.0


def test_efforts_follow_their_formulas():
    """Two thrusters of ±4 N: one is steady at 4 N, the other switches between ±1 N at 20 Hz."""
    t = times(EIGHT)
    thrust = np.column_stack([np.full(len(t), 4.0), np.where(np.arange(len(t)) % 2, 1.0, -1.0)])
    limits = (np.full(2, -4.0), np.full(2, 4.0))
    m = measure_tracking(t, EIGHT.at(t).position, EIGHT, thrust=thrust, limits=limits)
    assert m["energy"] == pytest.approx((4.0**1.5 + 1.0) * 30.0)
    assert m["smoothness_per_s"] == pytest.approx(math.sqrt(0.5) * (2.0 / 4.0) * 20.0)
    assert m["saturation"] == pytest.approx(0.5)


def test_the_tilt_is_the_largest_angle_to_the_vertical():
    t = times(EIGHT)
    roll = np.where(np.arange(len(t)) == 100, 0.3, 0.0)
    q = quat_from_euler(roll, np.zeros(len(t)), np.ones(len(t)))
    m = measure_tracking(t, EIGHT.at(t).position, EIGHT, quaternion=q)
    assert m["max_tilt_deg"] == pytest.approx(math.degrees(0.3))


def test_a_run_that_broke_has_no_errors_and_counts_all_the_same():
    t = times(EIGHT)
    place = EIGHT.at(t).position
    place[len(t) // 2 :] = np.nan
    broken, whole = measure_tracking(t, place, EIGHT), measure_tracking(t, EIGHT.at(t).position, EIGHT)
    assert broken["p95_m"] is None and not broken["complete"]
    row = summarize_tracking([broken, whole])
    assert (row["trials"], row["valid"], row["complete"]) == (2, 1, 1)
    assert row["p95_m"] == 0.0 and set(MEASURES) <= row.keys()


def test_what_is_no_series_is_refused():
    with pytest.raises(ValueError, match="do not increase"):
        measure_tracking([0.0, 0.0], np.zeros((2, 3)), EIGHT)
    with pytest.raises(ValueError, match="expected"):
        measure_tracking([0.0, 1.0], np.zeros((3, 3)), replace(EIGHT, name="x"))


def test_a_constant_offset_at_a_corner_that_the_way_rests_at_is_no_end_of_it():
    """Dead reckoning 5 cm off along the whole broken line is measured to its end, with an error of at most 5 cm."""
    guide = TRAJECTORIES["broken"]
    t = np.arange(0.0, guide.duration + 0.05, 0.1)
    measures = measure_tracking(t, guide.at(t).position + np.array([-0.045, 0.02, 0.0]), guide)
    assert measures["complete"] and measures["completion"] > 0.99
    assert measures["cross_track_p95_m"] < 0.05
