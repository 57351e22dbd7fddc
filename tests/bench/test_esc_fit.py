"""The law of a speed controller from tables: recovered where it is exact, with valid intervals where it is not."""

import numpy as np
import pytest

from finssim.bench.curves import fit_esc
from finssim.trials.findings import CalibrationError
from finssim.vehicles import Esc, load_vehicle

RANGE = (1100.0, 1500.0, 1900.0)
TRUTHS = {
    "t200": load_vehicle("bluerov2").thrusters["T1"].esc,
    "asymmetric": Esc(
        pulse_neutral=1500.0, pulse_min=1100.0, pulse_max=1900.0, voltage=14.8, dead_minus=1450.0, dead_plus=1540.0,
        zero_minus=1490.0, zero_plus=1525.0, emf_minus=0.05, emf_plus=0.03, load_minus=2e-5, load_plus=9e-5,
    ),
}  # fmt: skip


def table(truth, volts, *, step=8.0, noise=0.0, seed=0):
    """Return pulses, speeds and voltages of a given law, every `step` µs."""
    pulse = np.tile(np.arange(1100.0, 1900.1, step), len(volts))
    voltage = np.repeat(volts, len(pulse) // len(volts))
    speed = truth.shaft_speed(pulse, voltage)
    error = noise * np.random.default_rng(seed).standard_normal(len(pulse))
    return pulse, speed + error * (speed != 0.0), voltage


@pytest.mark.parametrize("volts", [[14.8], [12.0, 14.8, 16.8]], ids=["one voltage", "three"])
@pytest.mark.parametrize("truth", TRUTHS.values(), ids=TRUTHS)
def test_an_exact_law_is_recovered(truth, volts):
    """Speeds are recovered to 0.1 %, and the dead band at every voltage to the step of the pulses."""
    fit = fit_esc(*table(truth, volts), pulse_range=RANGE, at=14.8)
    pulses = np.arange(1105.0, 1900.0, 10.0)
    for voltage in (12.0, 16.8):
        ours, theirs = fit.esc.shaft_speed(pulses, voltage), truth.shaft_speed(pulses, voltage)
        both = (ours != 0.0) & (theirs != 0.0)
        np.testing.assert_allclose(ours[both], theirs[both], rtol=1e-3)
        np.testing.assert_allclose(fit.esc.dead_band(voltage), truth.dead_band(voltage), atol=8.0)


@pytest.mark.slow
def test_intervals_cover_the_truth():
    """In 60 noisy tables, every parameter lies in its 95 % interval in at least 85 % of them."""
    truth = TRUTHS["asymmetric"]
    hits = {"emf_plus": 0, "load_plus": 0, "zero_plus": 0, "emf_minus": 0, "load_minus": 0, "zero_minus": 0}
    for seed in range(60):
        fit = fit_esc(*table(truth, [14.8], noise=2.0, seed=seed), pulse_range=RANGE)
        for name in hits:
            low, high = fit.intervals[name]
            hits[name] += low <= getattr(truth, name) <= high
    assert min(hits.values()) >= 0.85 * 60, hits


def test_a_table_without_standstill_does_not_know_the_dead_band():
    pulse, speed, voltage = table(TRUTHS["t200"], [16.0])
    turning = speed != 0.0
    fit = fit_esc(pulse[turning], speed[turning], voltage[turning], pulse_range=RANGE)
    assert {"dead_plus", "dead_minus"} <= set(fit.unsure)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p, s, v: (p, -s, v), "turns backwards at pulses below neutral"),
        (
            lambda p, s, v: (p[p > 1500], s[p > 1500], v[p > 1500]),
            "0 rows turn the shaft at pulses below neutral",
        ),
    ],
)
def test_tables_that_show_no_law_are_refused(change, said):
    with pytest.raises(CalibrationError, match=said):
        fit_esc(*change(*table(TRUTHS["t200"], [16.0])), pulse_range=RANGE)
