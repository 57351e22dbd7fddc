"""Repeated samples in a log are distinguished from a vehicle at rest and from coarse numbers."""

import numpy as np
import pytest

from finssim.trials.trial import Trial
from finssim.trials.trial_files import load_trial, new_samples, write_trial

T = np.arange(1000) * 0.02


@pytest.mark.parametrize("rate", [5.0, 10.0, 12.5, 18.0, 25.0])
def test_a_slow_stream_in_a_fast_table_keeps_its_own_samples(rate):
    """The first row of every run is the sample, also if the rates do not divide."""
    ticks = np.floor(T * rate + 1e-9)
    values = np.stack([np.sin(ticks / rate), np.cos(ticks / rate)], axis=-1)
    new = new_samples(values)
    np.testing.assert_array_equal(new, np.concatenate([[True], np.diff(ticks) > 0]))


def test_a_vehicle_at_rest_repeats_nothing():
    """Long runs of one value among samples that all differ are rest, or a simulation."""
    rest = np.where((T > 4.0) & (T < 12.0), np.sin(T), 0.0)[:, None]
    assert new_samples(rest).all() and new_samples(np.zeros((1000, 3))).all()


def test_coarse_numbers_are_no_repeats():
    """Tested with a pressure sensor of 2 mm resolution in a slow dive, with noise of the same size."""
    rng = np.random.default_rng(0)
    for size in (0.0005, 0.002):
        depth = np.round((0.05 * T + size * rng.normal(size=1000)) / 0.002) * 0.002
        assert new_samples(depth[:, None]).all()


def test_rest_in_a_repeated_stream_makes_no_gap():
    """While the vehicle is at rest, the slow stream is assumed to continue at its own rate."""
    ticks = np.floor(T * 10.0 + 1e-9) / 10.0
    values = np.where(ticks < 5.0, 0.0, np.sin(ticks))[:, None]
    assert np.diff(T[new_samples(values)]).max() < 0.11


def test_repeats_are_emptied_when_a_trial_is_read_and_the_rest_is_left(tmp_path):
    """Velocity is at 10 Hz and gyro at 50 Hz in one table; a held command is kept, and reading again changes
    nothing."""
    ticks = np.floor(T * 10.0 + 1e-9) / 10.0
    channels = {"u": np.sin(ticks), "v": np.cos(ticks), "r": np.sin(T), "tau_x": np.floor(ticks)}
    write_trial(Trial(name="made", t=T, channels=channels), tmp_path / "made")
    trial = load_trial(tmp_path / "made")
    assert np.isfinite(trial.channels["u"]).sum() == 200 and np.isfinite(trial.channels["v"]).sum() == 200
    assert np.isfinite(trial.channels["r"]).all() and np.isfinite(trial.channels["tau_x"]).all()
    assert trial.findings[0].values == {"group": "velocity", "rows": pytest.approx(5.0, abs=0.05)}
    write_trial(trial, tmp_path / "again")
    assert load_trial(tmp_path / "again").sha256 == trial.sha256
