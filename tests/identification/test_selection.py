"""The damping that an axis' trials support is chosen, and what was left out keeps an honest interval."""

import numpy as np
import pytest

from finssim.identification.programme import programmes
from finssim.identification.simulation_error import fit_by_simulation
from finssim.identification.synthetic import NoiseProfile, record, trials_of
from finssim.trials.findings import CalibrationError
from finssim.vehicles import AXES, load_vehicle
from identification.known_trials import NOISE, trials, truth

SET = "hydrodynamics.calibrated"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "axis", "absent"),
    [("finsrov", "surge", "d2"), ("bluerov2_heavy", "sway", "d1"), ("bluerov2_heavy", "heave", None)],
)
def test_only_absent_damping_is_left_out(name, axis, absent):
    """A damping of zero is left out in most of 3 draws; then it is 0 with an interval that holds 0, and a note; it is
    written as zero beside the one that stays."""
    count, i = {"d1": 0, "d2": 0}, AXES.index(axis)
    paths = {"d1": f"{SET}.linear_damping.{i}.{i}", "d2": f"{SET}.quadratic_damping.{i}.{i}"}
    for seed in range(3):
        vehicle, some = trials(name, axis, seed=seed)
        fit = fit_by_simulation(some, vehicle)
        for term in count:
            estimate = fit.estimates[f"{axis}.{term}"]
            if "not distinguishable from zero" in estimate.note:
                count[term] += 1
                assert estimate.ci95[0] <= estimate.estimate == 0.0 <= estimate.ci95[1]
                assert not estimate.identifiable
                assert (
                    fit.changes[paths[term]]
                    == 0.0
                    < min(fit.changes[p] for t, p in paths.items() if t != term)
                )
    for term in count:
        assert count[term] > 1 if term == absent else count[term] == 0


@pytest.mark.slow
def test_the_interval_of_the_kept_term_allows_for_the_one_left_out():
    """Nobody knows that the term left out is zero: the kept one's interval is at least as wide as with both."""
    vehicle, some = trials("finsrov", "surge", noise=NoiseProfile(velocity_std=0.05))
    both, auto = (
        fit_by_simulation(some, vehicle, damping=kind).estimates["surge.d1"].ci95 for kind in ("both", "auto")
    )
    assert auto[0] <= both[0] + 1e-9 and auto[1] >= both[1] - 1e-9


@pytest.mark.slow
def test_asking_for_one_kind_gives_it():
    """`linear` and `quadratic` fit that term alone; the other is not reported and is zero in the vehicle file."""
    vehicle, some = trials("finsrov", "surge")
    some = some[::2]
    for damping, kept, other in (("linear", "d1", "d2"), ("quadratic", "d2", "d1")):
        fit = fit_by_simulation(some, vehicle, damping=damping)
        assert f"surge.{kept}" in fit.estimates and f"surge.{other}" not in fit.estimates
        family = {"d1": "linear", "d2": "quadratic"}[other]
        assert fit.changes[f"hydrodynamics.calibrated.{family}_damping.0.0"] == 0.0


def test_unknown_damping_is_refused():
    """With the available words."""
    vehicle, some = trials("bluerov2", "surge")
    with pytest.raises(CalibrationError, match="available: auto, linear, quadratic, both"):
        fit_by_simulation(some, vehicle, damping="cubic")


@pytest.mark.slow
def test_slow_speeds_do_not_make_a_quadratic_term():
    """Steps of 1 N: at 2 cm/s the quadratic damping of heave cannot show; it is not called identifiable."""
    vehicle = load_vehicle("finsrov").replace(
        {"thrusters.*.dead_rpm_plus": 1.0, "thrusters.*.dead_rpm_minus": -1.0}
    )
    slow = programmes(["heave"], vehicle, levels=[1.0, 2.0], coast=5.0)
    some = trials_of(record(slow, vehicle, seed=0), slow, vehicle, noise=NOISE, seed=0)
    estimate = fit_by_simulation(some, vehicle, axes=["heave"]).estimates["heave.d2"]
    assert not estimate.identifiable
    assert estimate.ci95[0] <= truth(vehicle)["heave.d2"] <= estimate.ci95[1]
    assert np.diff(estimate.ci95)[0] > 100.0
