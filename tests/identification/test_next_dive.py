"""The next dive is designed from the fit's information: its forecast is right, and it beats a repeated dive."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.identification.hydrodynamics import fit_hydrodynamics
from finssim.identification.programme import alternating, programmes
from finssim.identification.synthetic import simulate_programme
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("bluerov2_heavy")


def dived(plan, seed, name=""):
    """Return the trials of a plan, at 20 Hz."""
    return [replace(t, name=t.name + name) for t in simulate_programme(plan, VEHICLE, seed=seed, rate=20.0)]


@pytest.mark.slow
def test_a_designed_second_dive_halves_what_a_repeated_one_leaves():
    """For dives of equal length, the median interval width is at most 0.6 of that after repeating the first dive."""
    plan = programmes("surge,yaw", VEHICLE, levels={"surge": (18.0,), "yaw": (5.0,)})
    first = dived(plan, 1)
    fit = fit_hydrodynamics(first, VEHICLE, design=True)
    dive = fit.next_dive
    assert {leg.axis for leg in dive.legs} == {"surge", "yaw"}
    assert sum(t.duration for t in first) <= dive.duration < 1.3 * sum(t.duration for t in first)
    assert "record next: surge at" in str(dive) and dive.widest in str(dive)
    legs = [alternating(leg, n + 1) for leg in dive.legs for n in range(leg.times)]
    after, again = (
        fit_hydrodynamics([*first, *second], VEHICLE).intervals
        for second in (dived(legs, 2), dived(plan, 2, "_again"))
    )
    names = [f"{axis}.{name}" for axis in ("surge", "yaw") for name in ("m_eff", "d1", "d2")]
    assert np.median([np.diff(after[n]) / np.diff(again[n]) for n in names]) < 0.6
    # The forecast assumes independent errors; trials of one dive differ a little more.
    width = np.diff(after[dive.widest])[0] / np.diff(fit.intervals[dive.widest])[0]
    assert width < 2.0 * dive.factor


def test_a_fit_without_thrust_designs_nothing():
    """A fit without thrust designs no dive, since the effect of steps cannot be predicted."""
    from identification.test_free_motion import ROV, coasts

    trials = coasts(np.random.default_rng(1), 0.1, 0.5, count=2, column="r", noise=0.01)
    assert fit_hydrodynamics(trials, ROV, design=True).next_dive is None


@pytest.mark.slow
def test_trials_that_measured_different_columns_get_a_dive_too():
    """One trial with depth and one with speed, whose columns are not compared, still give a dive in heave."""
    plan = programmes("heave", VEHICLE, levels={"heave": (18.0,)}, coast=3.0)[:2]
    some = [
        simulate_programme([one], VEHICLE, seed=1, rate=20.0, columns=[own])[0]
        for one, own in zip(plan, ("depth", "w"), strict=True)
    ]
    dive = fit_hydrodynamics(some, VEHICLE, design=True).next_dive
    assert {leg.axis for leg in dive.legs} == {"heave"}
