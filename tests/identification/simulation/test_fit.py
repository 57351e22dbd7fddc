"""Trials of the simulator give back the numbers that they were simulated with, and say what they cannot tell."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.identification.programme import programmes
from finssim.identification.simulation.fit import compared, excites, fit_by_simulation
from finssim.identification.simulation.rollout import segments, streams
from finssim.identification.synthetic import simulate_programme
from finssim.sim.plant_arrays import twist_shift
from finssim.trials.findings import CalibrationError
from finssim.vehicles import AXES, load_vehicle

SET = "hydrodynamics.calibrated"


def truth(vehicle, axis):
    """m_eff, d1 and d2 of an axis at the set's reference point."""
    chosen, i = vehicle.hydrodynamics["calibrated"], AXES.index(axis)
    back = np.linalg.inv(twist_shift(chosen.reference_point))
    M = back.T @ vehicle.rigid_body_mass_matrix() @ back + chosen.added_mass
    return {"m_eff": M[i, i], "d1": chosen.linear_damping[i, i], "d2": chosen.quadratic_damping[i, i]}


def wrong(vehicle):
    """The same vehicle with coefficients that are off by factors of two."""
    chosen = vehicle.hydrodynamics["calibrated"]
    return vehicle.replace(
        {
            f"{SET}.added_mass": 0.5 * np.diag(np.diag(chosen.added_mass)),
            f"{SET}.linear_damping": 2.0 * np.diag(np.diag(chosen.linear_damping)) + 0.1 * np.eye(6),
            f"{SET}.quadratic_damping": 0.5 * np.diag(np.diag(chosen.quadratic_damping)) + 0.1 * np.eye(6),
        }
    )


def trials_of(vehicle, axes, *, count=None, **options):
    return simulate_programme(programmes(axes, vehicle)[:count], vehicle, **{"seed": 3, **options})


def check(fit, vehicle, axes, within):
    """Every identifiable number within a part of the truth, and the truth inside its interval widened by as much."""
    for axis in axes:
        for name, value in truth(vehicle, axis).items():
            found = fit.estimates[f"{axis}.{name}"]
            if found.identifiable:
                assert found.estimate == pytest.approx(value, rel=within), found
            low, high = found.ci95
            slack = 0.5 * (high - low) + 0.01 * value
            assert low - slack <= value <= high + slack, found


CASES = {
    "finsrov, sensors at 50 Hz": ("finsrov", ("surge", "yaw"), {}, 0.05),
    "finsrov, wrench and velocity at 5 Hz": (
        "finsrov",
        ("surge", "sway", "yaw"),
        {"rate": 5.0, "columns": ("u", "v", "w", "p", "q", "r"), "inputs": ("wrench",)},
        0.10,
    ),
    "bluerov2, commanded thrusters": ("bluerov2", ("sway", "yaw"), {"inputs": ("command",)}, 0.08),
    "bluerov2_heavy, gyro and attitude": (
        "bluerov2_heavy",
        ("roll",),
        {"columns": ("p", "q", "r", "qx", "qy", "qz", "qw")},
        0.10,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_numbers_come_back(name):
    """From coefficients off by factors of two, whatever drives and measures the vehicle."""
    vehicle, axes, options, within = CASES[name]
    vehicle = load_vehicle(vehicle)
    fit = fit_by_simulation(trials_of(vehicle, axes, **options), wrong(vehicle))
    assert fit.settings["axes"] == list(axes)
    check(fit, vehicle, axes, within)
    identified = [e for e in fit.estimates.values() if e.name.endswith("m_eff") and e.identifiable]
    assert len(identified) == len(axes)


@pytest.mark.slow
def test_a_calibrated_vehicle_holds_the_numbers():
    """The changes turn the wrong vehicle into one whose added mass and damping force are the true one's."""
    vehicle = load_vehicle("finsrov")
    fit = fit_by_simulation(trials_of(vehicle, "yaw"), wrong(vehicle))
    found, true = (v.hydrodynamics["calibrated"] for v in (wrong(vehicle).replace(fit.changes), vehicle))
    assert found.added_mass[5, 5] == pytest.approx(true.added_mass[5, 5], rel=0.05)
    force = [s.linear_damping[5, 5] * 1.5 + s.quadratic_damping[5, 5] * 1.5**2 for s in (found, true)]
    assert force[0] == pytest.approx(force[1], rel=0.03)
    assert fit.trials.keys() == {t.name for t in trials_of(vehicle, "yaw")}
    assert fit.quality["yaw"]["nrmse"] < 0.05 and len(fit.curves) == 1


@pytest.mark.slow
def test_thrust_against_mass_is_said_and_not_picked():
    """Motion gives only ratios: with a free thrust scale no mass is identifiable, and a sentence says why."""
    vehicle = load_vehicle("finsrov")
    fit = fit_by_simulation(trials_of(vehicle, "yaw"), vehicle, estimate=("thrust_scale",))
    assert not fit.estimates["thrust_scale"].identifiable
    assert not fit.estimates["yaw.m_eff"].identifiable
    assert "thrust_traded" in {one.code for one in fit.findings}
    assert not any(path.startswith(f"{SET}.added_mass") for path in fit.changes)


@pytest.mark.slow
def test_damping_at_zero_rests_on_its_bound():
    """FinsROV's surge has no quadratic drag: the estimate is compatible with zero and not called determined."""
    vehicle = load_vehicle("finsrov")
    fit = fit_by_simulation(trials_of(vehicle, "surge"), wrong(vehicle))
    d2 = fit.estimates["surge.d2"]
    assert not d2.identifiable and d2.note
    assert d2.ci95[0] == 0.0 <= d2.estimate


@pytest.mark.slow
def test_damping_that_slow_motion_does_not_show_stays_the_files():
    """Of 0.02 rad/s: FinsROV's d2 of yaw can be told from nothing, so it is neither written nor set to zero."""
    vehicle = load_vehicle("finsrov")
    trials = simulate_programme(programmes("yaw", vehicle, levels={"yaw": (0.005,)}), vehicle, seed=3)
    fit = fit_by_simulation(trials, vehicle)
    d1, d2 = (fit.estimates[f"yaw.{name}"] for name in ("d1", "d2"))
    assert d2.estimate == truth(vehicle, "yaw")["d2"] and "nor from the file's" in d2.note
    assert f"{SET}.quadratic_damping.5.5" not in fit.changes
    assert fit.changes[f"{SET}.linear_damping.5.5"] == d1.estimate
    assert d1.ci95[0] < truth(vehicle, "yaw")["d1"] < d1.ci95[1]


@pytest.mark.slow
def test_a_small_swing_is_fitted_and_integrals_are_not_compared():
    """Roll of a stiff vehicle under sway is fitted though nothing drives it; places add nothing to velocities."""
    file = load_vehicle("bluerov2_heavy")
    stiff = file.replace({"body.center_of_buoyancy": [0.0, 0.0, 0.04]})
    plan = programmes("sway", stiff, levels={"sway": (25.0,)})[:1]
    (trial,) = simulate_programme(plan, stiff, seed=3)
    one = streams(replace(trial, header=trial.header.model_copy(update={"axis": ()})), file)
    assert np.ptp(one.motion.nu[:, 3]) < 0.25
    assert excites(one, file) == {"sway", "roll"}
    segment = segments(one, file, length=5.0, step=0.02)[0]
    assert {"u", "v", "w", "x", "y", "z", "depth"} < set(segment.measured)
    assert (
        {"v", "w"}
        <= set(compared(segment, one.motion, ("sway", "heave")).measured)
        <= {"v", "w", "p", "q", "r"}
    )
    blind = replace(segment, measured={c: m for c, m in segment.measured.items() if c != "w"})
    assert {"z", "depth"} <= set(compared(blind, one.motion, ("heave",)).measured)


@pytest.mark.slow
def test_a_late_stream_is_found_and_does_not_bias_the_mass():
    """Rates logged 80 ms late move the lag, not the inertia."""
    vehicle = load_vehicle("finsrov")
    late = []
    for trial in trials_of(vehicle, "yaw", inputs=("wrench",)):
        channels = dict(trial.channels)
        for column in ("p", "q", "r"):
            channels[column] = np.concatenate([np.full(4, channels[column][0]), channels[column][:-4]])
        late.append(replace(trial, channels=channels))
    fit = fit_by_simulation(late, wrong(vehicle))
    assert fit.estimates["yaw.m_eff"].estimate == pytest.approx(truth(vehicle, "yaw")["m_eff"], rel=0.03)
    assert ("motion_late", "rates") in {(one.code, one.subject) for one in fit.findings}


@pytest.mark.slow
def test_outliers_and_gaps_are_survived():
    """A second without measurements and a hundred wild samples leave the numbers where they were."""
    vehicle, rng = load_vehicle("finsrov"), np.random.default_rng(0)
    bad = []
    for trial in trials_of(vehicle, "surge"):
        u = trial.channels["u"].copy()
        u[200:250] = np.nan
        u[rng.choice(len(u), 15, replace=False)] += 3.0
        bad.append(replace(trial, channels={**trial.channels, "u": u}))
    check(fit_by_simulation(bad, wrong(vehicle)), vehicle, ("surge",), 0.05)


@pytest.mark.slow
def test_one_trial_says_what_its_intervals_rest_on():
    """With a single trial, blocks within it stand for trials, which is said."""
    vehicle = load_vehicle("finsrov")
    fit = fit_by_simulation(trials_of(vehicle, "yaw", count=1), wrong(vehicle))
    assert "block_intervals" in {one.code for one in fit.findings}
    assert np.isfinite(fit.estimates["yaw.m_eff"].ci95).all()


@pytest.mark.slow
def test_an_interrupt_returns_the_best_until_then():
    """Ctrl-C while fitting ends with estimates and the mark of an interrupted fit."""
    vehicle = load_vehicle("finsrov")

    def interrupt(part, words):
        if words.startswith("fit"):
            raise KeyboardInterrupt

    fit = fit_by_simulation(trials_of(vehicle, "yaw", count=4), wrong(vehicle), progress=interrupt)
    assert fit.interrupted and fit.findings[0].code == "interrupted"
    assert fit.estimates["yaw.m_eff"].estimate == pytest.approx(truth(vehicle, "yaw")["m_eff"], rel=0.3)


@pytest.mark.slow
def test_equal_seeds_give_equal_fits():
    """Nothing depends on threads, time or chance."""
    vehicle = load_vehicle("finsrov")
    trials = trials_of(vehicle, "yaw", count=2)
    a, b = (fit_by_simulation(trials, wrong(vehicle)) for _ in range(2))
    assert a.estimates == b.estimates


def test_what_cannot_be_fitted_is_refused():
    """Held-out trials, unknown words, and trials that measure nothing of an axis."""
    vehicle = load_vehicle("finsrov")
    trials = trials_of(vehicle, "yaw", count=2)
    held = [replace(t, header=t.header.model_copy(update={"role": "held-out"})) for t in trials]
    for given, options, words in (
        (held, {}, "held out"),
        ([], {}, "no trials"),
        (trials, {"axes": ["up"]}, "unknown axis 'up'"),
        (trials, {"estimate": ["colour"]}, "cannot estimate 'colour'"),
        (trials, {"damping": "cubic"}, "unknown damping"),
        ([trials[0], trials[0]], {}, "expected a name for each"),
    ):
        with pytest.raises(CalibrationError, match=words):
            fit_by_simulation(given, vehicle, **options)
    blind = [
        replace(t, channels={k: v for k, v in t.channels.items() if k in ("r", "tau_n")}) for t in trials
    ]
    with pytest.raises(CalibrationError, match="no measurement that determines surge"):
        fit_by_simulation(blind, vehicle, axes=["surge"])
