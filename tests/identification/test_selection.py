"""The damping of an axis is the average over the shapes that its trials support, with a valid interval."""

import numpy as np
import pytest

from finssim.identification.drag_shape import WIDER, _average, averaged
from finssim.identification.programme import programmes
from finssim.identification.simulation_error import fit_by_simulation, prepare
from finssim.identification.stages import FitProgress, Stages
from finssim.identification.synthetic import record, trials_of
from finssim.identification.vehicle_file import number_in
from finssim.trials.findings import CalibrationError
from finssim.vehicles import AXES, load_vehicle
from identification.known_trials import NOISE, trials, truth

SET = "hydrodynamics.calibrated"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "axis", "absent"),
    [("finsrov", "surge", "d2"), ("bluerov2_heavy", "sway", "d1"), ("bluerov2_heavy", "heave", None)],
)
def test_only_absent_damping_is_improbable(name, axis, absent):
    """The shape without a zero damping is the most probable one in most of 3 draws, and the interval of that damping
    contains zero; both dampings are written as estimated."""
    count, i = {"d1": 0, "d2": 0}, AXES.index(axis)
    paths = {"d1": f"{SET}.linear_damping.{i}.{i}", "d2": f"{SET}.quadratic_damping.{i}.{i}"}
    for seed in range(3):
        vehicle, some = trials(name, axis, seed=seed)
        fit = fit_by_simulation(some[::2], vehicle)
        weights = fit.settings["drag"][axis]
        (said,) = [one for one in fit.findings if one.code == "drag_averaged"]
        assert said.subject == axis and f"both {weights['both']:.2f}" in str(said)
        assert sum(weights.values()) == pytest.approx(1.0)
        for term, shape in (("d1", "quadratic"), ("d2", "linear")):
            estimate = fit.estimates[f"{axis}.{term}"]
            assert number_in(fit.vehicle, paths[term]) == pytest.approx(estimate.estimate)
            if weights[shape] > 0.5:
                count[term] += 1
                assert estimate.ci95[0] == 0.0 <= estimate.estimate <= estimate.ci95[1]
                assert not estimate.identifiable and "not distinguishable from zero" in estimate.note
    for term in count:
        assert count[term] > 1 if term == absent else count[term] == 0


@pytest.mark.slow
def test_intervals_reach_from_the_free_drag_to_the_averaged_one():
    """With another drag the other parameters move; their intervals keep their ends and extend by the shift."""
    vehicle, some = trials("bluerov2_heavy", "sway")
    fit = Stages(prepare(some[::3], vehicle)[0], vehicle, ("sway",), (), {}, None, FitProgress(None))
    free = fit.first({"sway": "both"}, {})
    shape = fit.shapes(free)["sway"]
    end = averaged(free, {"sway": shape._replace(value=1.2 * free.x[1:3])})
    way = end.x[0] - free.x[0]
    assert free.problem.names[:3] == ("sway.added_mass", "sway.d1", "sway.d2")
    assert abs(way) > 0.05 * free.x[0]
    expected = free.found.interval[0] + [min(way, 0.0), max(way, 0.0)]
    np.testing.assert_allclose(end.found.interval[0], expected)


def test_the_average_over_shapes_holds_what_the_data_cannot_exclude():
    """If only the force at one speed is known, all shapes contribute; where shapes are distinguishable, only
    one does."""
    top, size = 0.25, 80.0
    # A vehicle whose stronger trials give 13 and 87: 29.5 at 0.25 m/s, not 34.8.
    drag = np.array([25.0, 18.0])
    across, along = np.array([1.0, top]), np.array([top, -1.0])
    S = 1.5**2 * np.outer(across, across) + 14.0**2 * np.outer(along, along)
    value, ends, weights, _ = _average(drag, WIDER**2 * S, size, top)
    assert all(w > 0.02 for w in weights.values()) and sum(weights.values()) == pytest.approx(1.0)
    assert ends[0][0] <= 13.0 <= ends[0][1] and ends[1][0] <= 87.0 <= ends[1][1]
    assert (value >= 0.0).all() and value @ across == pytest.approx(drag @ across, rel=0.1)
    sure, ends, weights, spread = _average(np.array([13.0, 87.0]), np.diag([1.0, 4.0]), size, top)
    assert weights["both"] > 0.999 and sure == pytest.approx([13.0, 87.0], rel=0.02)
    assert spread == pytest.approx(top * np.hypot(1.0, 2.0 * top), rel=0.02)
    assert ends[0] == pytest.approx((11.04, 14.96), abs=0.2) and ends[1] == pytest.approx(
        (83.1, 90.9), abs=0.4
    )


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
    """The message lists the available words."""
    vehicle, some = trials("bluerov2", "surge")
    with pytest.raises(CalibrationError, match="available: auto, linear, quadratic, both"):
        fit_by_simulation(some, vehicle, damping="cubic")


@pytest.mark.slow
def test_slow_speeds_do_not_make_a_quadratic_term():
    """Steps of 1 N reach 2 cm/s, where the quadratic damping of heave has no effect: it is not called identifiable."""
    vehicle = load_vehicle("finsrov").replace(
        {"thrusters.*.dead_rpm_plus": 1.0, "thrusters.*.dead_rpm_minus": -1.0}
    )
    slow = programmes(["heave"], vehicle, levels=[1.0, 2.0], coast=5.0)
    some = trials_of(record(slow, vehicle, seed=0), slow, vehicle, noise=NOISE, seed=0)
    estimate = fit_by_simulation(some, vehicle, axes=["heave"]).estimates["heave.d2"]
    assert not estimate.identifiable
    assert estimate.ci95[0] <= truth(vehicle)["heave.d2"] <= estimate.ci95[1]
    assert np.diff(estimate.ci95)[0] > 100.0
