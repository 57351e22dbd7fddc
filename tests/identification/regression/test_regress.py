"""Regression axis by axis gives back what trials were simulated with, and says what it cannot know."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.identification.regression.axis_fit import Run, cut, fit_axis, joined, simulate_axis
from finssim.identification.regression.plant_terms import matrices
from finssim.identification.regression.regress import axis_data, prepare, regress
from finssim.identification.synthetic import NoiseProfile
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import Header
from finssim.vehicles import AXES
from identification.known_trials import trials, truth

TILTING = (("surge", (41.0, 82.0, 123.0)), ("sway", (31.0, 62.0, 93.0)))
"""Steps far beyond the speed at which bluerov2 stays level [N]."""


def without(some, *columns):
    """Trials that lack these columns."""
    return [replace(t, channels={n: c for n, c in t.channels.items() if n not in columns}) for t in some]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "axes"),
    [
        ("finsrov", ("surge", "sway", "yaw")),
        ("bluerov2", ("heave", "roll", "yaw")),
        ("bluerov2_heavy", ("surge", "sway", "heave", "pitch", "yaw")),
    ],
)
def test_identifiable_parameters_come_back(name, axes):
    """Published steps, realistic noise, 50 Hz: what is called identifiable is within 5 %, or within 1.5 intervals."""
    vehicle, some = trials(name, *axes)
    fit = regress(some, vehicle)
    expected = truth(vehicle)
    told = {n: e for n, e in fit.estimates.items() if e.identifiable and n in expected}
    assert {f"{axis}.m_eff" for axis in axes} <= told.keys()
    for parameter, estimate in told.items():
        half = 0.5 * (estimate.ci95[1] - estimate.ci95[0])
        error = abs(estimate.estimate - expected[parameter])
        assert error <= max(0.05 * abs(expected[parameter]), 1.5 * half), parameter
        assert error <= 0.15 * abs(expected[parameter]), parameter
    changed = vehicle.replace(fit.changes)
    i = AXES.index(axes[0])
    assert (
        changed.hydrodynamic_set("calibrated").added_mass[i, i]
        == fit.estimates[f"{axes[0]}.added_mass"].estimate
    )
    assert set(fit.trials) == {t.name for t in some}


@pytest.mark.slow
def test_intervals_cover_the_truth():
    """Over 12 noise draws of six trials, 95 % intervals of mass and damping hold the truth in at least 9."""
    names = ("surge.m_eff", "surge.d1", "surge.d2")
    hits = np.zeros(3)
    for seed in range(12):
        vehicle, some = trials("bluerov2_heavy", "surge", seed=seed)
        fit, expected = regress(some, vehicle), truth(vehicle)
        hits += [fit.estimates[n].ci95[0] <= expected[n] <= fit.estimates[n].ci95[1] for n in names]
    assert (hits >= 9).all()  # 11.4 expected; 1 in 460 has fewer


@pytest.mark.slow
def test_instruments_remove_the_bias_of_noisy_velocities():
    """With 5 cm/s of noise least squares loses a tenth of the mass; with simulated velocities it comes back."""
    plain, instrumental = [], []
    for seed in range(5):
        vehicle, some = trials("finsrov", "heave", seed=seed, noise=NoiseProfile(velocity_std=0.05))
        prepared, _ = prepare(some, vehicle)
        data, _ = axis_data(2, prepared, [matrices(vehicle)] * len(prepared))
        terms = np.array([True, True, True, True, False, False, False])
        X, y = (np.concatenate([getattr(rows, name) for rows in data.rows]) for name in "Xy")
        plain.append(np.linalg.lstsq(X[:, :4], y, rcond=None)[0][0])
        instrumental.append(fit_axis(data, terms).free[0])
    true = truth(vehicle)["heave.m_eff"]
    assert np.mean(plain) < 0.9 * true
    assert np.mean(instrumental) == pytest.approx(true, rel=0.06)


@pytest.mark.parametrize(("model", "seconds"), [((12.0, 3.0, 20.0, 0.0), 90.0), ((0.6, 0.4, 0.8, 2.0), 45.0)])
def test_cut_and_decimated_simulation_is_the_one_in_one_run(model, seconds):
    """At 100 Hz in blocks of 20 s and steps of 40 ms from noisy states: within 1 % of one run at every sample."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, seconds, 0.01)
    push = model[0] * np.convolve(
        np.repeat(rng.normal(size=len(t) // 100 + 1), 100)[: len(t)], np.ones(5) / 5, "same"
    )
    whole = Run(0.5 * (push[1:] + push[:-1]), 0.01, 0.3, 0.0)
    (nu,), (s,) = simulate_axis(np.array(model), [whole])
    scale = np.std(nu)
    noisy = nu + 0.05 * scale * rng.normal(size=len(nu))
    pieces = cut(100.0, [(0, len(t))], noisy, s)
    runs = [piece.run(push) for piece in pieces]
    assert max(len(run.push) for run in runs) <= 25.0 * 22.0 + 1
    again = joined(simulate_axis(np.array(model), runs)[0], pieces, len(t))
    settled = t > 3.0
    assert np.std((again - nu)[settled]) < 0.01 * scale


def test_late_motion_is_told_from_inertia():
    """Velocities logged 60 ms late: the mass does not take the blame, and the lag is reported."""
    vehicle, some = trials("bluerov2_heavy", "surge")
    late = []
    for t in some:
        shifted = {n: np.interp(t.t - 0.06, t.t, c) if n in "uvwpqr" else c for n, c in t.channels.items()}
        late.append(replace(t, channels=shifted))
    fit = regress(late, vehicle)
    assert fit.estimates["surge.m_eff"].estimate == pytest.approx(truth(vehicle)["surge.m_eff"], rel=0.03)
    assert fit.quality["surge"]["delay"] == pytest.approx(0.06, abs=0.01)
    assert "motion_late" in {one.code for one in fit.findings}


@pytest.mark.slow
def test_a_velocity_later_than_the_gyro_costs_no_mass():
    """u is logged 120 ms late, the gyro is not: mass within 5 %, and its note tells of the lag."""
    vehicle, some = trials("bluerov2_heavy", "surge")
    late = []
    for t in some:
        shifted = {n: np.interp(t.t - 0.12, t.t, c) if n in "uvw" else c for n, c in t.channels.items()}
        late.append(replace(t, channels=shifted))
    late = without(late, "x", "y", "z", "depth", "ax", "ay", "az")
    fit = regress(late, vehicle)
    assert fit.quality["surge"]["delay"] == pytest.approx(0.12, abs=0.02)
    assert fit.estimates["surge.m_eff"].estimate == pytest.approx(truth(vehicle)["surge.m_eff"], rel=0.05)
    low, high = fit.estimates["surge.m_eff"].ci95
    assert low < truth(vehicle)["surge.m_eff"] < high
    assert "lags the file's motors" in fit.estimates["surge.m_eff"].note


@pytest.mark.slow
def test_all_axes_moving_at_once():
    """A multi-sine on all axes: Coriolis terms and couplings of the file are taken off by the measured motion."""
    vehicle, some = trials("bluerov2_heavy", *AXES, kind="multisine")
    fit, expected = regress(some, vehicle), truth(vehicle)
    for parameter in ("surge.m_eff", "sway.m_eff", "heave.m_eff", "yaw.m_eff"):
        assert fit.estimates[parameter].estimate == pytest.approx(expected[parameter], rel=0.1), parameter


def test_five_hertz_with_wrench_and_velocity_only():
    """No attitude, no IMU, 5 Hz: mass and damping within 10 %."""
    columns = ("u", "v", "w", "p", "q", "r")
    vehicle, some = trials("finsrov", "surge", "yaw", rate=5.0, columns=columns, inputs=("wrench",))
    fit, expected = regress(some, vehicle), truth(vehicle)
    for parameter in ("surge.m_eff", "surge.d1", "yaw.m_eff", "yaw.d1", "yaw.d2"):
        assert fit.estimates[parameter].estimate == pytest.approx(expected[parameter], rel=0.1), parameter


def test_gyro_without_velocity_gives_the_rates_axes():
    """Only rates and attitude are logged: yaw and roll are fitted, surge is left alone with the reason."""
    vehicle, some = trials("bluerov2_heavy", "surge", "roll", "yaw")
    fit = regress(without(some, "u", "v", "w", "x", "y", "z", "depth"), vehicle)
    assert {n.partition(".")[0] for n in fit.estimates} == {"roll", "yaw"}
    assert any(one.code == "axis_unmeasured" and one.values["axis"] == "surge" for one in fit.findings)
    assert not any("added_mass.0" in path for path in fit.changes)


def test_roll_without_attitude_is_left_out_with_the_reason():
    """The restoring moment needs the angle."""
    vehicle, some = trials("bluerov2_heavy", "roll", "yaw")
    fit = regress(without(some, "qx", "qy", "qz", "qw"), vehicle)
    assert "roll.m_eff" not in fit.estimates
    assert any(one.code == "attitude_needed" and one.values["axis"] == "roll" for one in fit.findings)


def test_outliers_and_a_gap_do_little():
    """One sample in a hundred is nonsense and a second is missing: the estimates stay, and the samples are counted."""
    vehicle, some = trials("bluerov2_heavy", "surge")
    rng = np.random.default_rng(0)
    bad = []
    for t in some:
        u = t.channels["u"].copy()
        hit = rng.choice(len(u), len(u) // 100, replace=False)
        u[hit] += rng.choice([-2.0, 2.0], len(hit))
        u[200:250] = np.nan
        bad.append(replace(t, channels=t.channels | {"u": u}))
    fit, expected = regress(bad, vehicle), truth(vehicle)
    assert fit.estimates["surge.m_eff"].estimate == pytest.approx(expected["surge.m_eff"], rel=0.04)
    assert fit.estimates["surge.d2"].estimate == pytest.approx(expected["surge.d2"], rel=0.04)
    assert fit.quality["surge"]["rejected"] >= 20


@pytest.mark.slow
def test_bursts_of_a_wrong_wrench_lose_their_weight():
    """Two quarters of a second with three times the largest wrench in each trial: 5 %; least squares misses by 30 %."""
    vehicle, some = trials("bluerov2_heavy", "surge")
    bad = []
    for j, t in enumerate(without(some, *(n for n in some[0].channels if n.startswith("rpm")))):
        tau = t.channels["tau_x"].copy()
        most = 3.0 * np.nanmax(np.abs(tau))
        for k, at in enumerate((0.35, 0.6)):
            begin = int(at * len(tau))
            tau[begin : begin + 12] += most * (-1) ** (j + k + 1)
        bad.append(replace(t, channels=t.channels | {"tau_x": tau}))
    fit, expected = regress(bad, vehicle), truth(vehicle)
    for name in ("surge.m_eff", "surge.d2"):
        assert fit.estimates[name].estimate == pytest.approx(expected[name], rel=0.05)


@pytest.mark.slow
def test_dive_and_coast_gives_the_buoyancy():
    """The coast after a dive shows the excess by itself; where it goes in the file reproduces it."""
    vehicle, some = trials("bluerov2", "heave")
    fit = regress(some, vehicle)
    excess = fit.estimates["buoyancy_excess"]
    assert excess.identifiable
    assert excess.estimate == pytest.approx(truth(vehicle)["buoyancy_excess"], rel=0.05)
    changed = vehicle.replace({"body.displaced_volume": fit.changes["body.displaced_volume"]})
    assert changed.buoyancy - changed.weight == pytest.approx(excess.estimate, rel=1e-6)


def test_a_file_too_heavy_is_said():
    """An effective mass below the file's rigid mass: no negative added mass is written."""
    vehicle, some = trials("bluerov2_heavy", "surge", inputs=("wrench",))
    heavy = vehicle.replace({"body.mass": 25.0, "body.displaced_volume": 0.0249})
    fit = regress(some, heavy)
    assert not fit.estimates["surge.added_mass"].identifiable
    assert not any("added_mass" in path for path in fit.changes)
    assert any(
        one.code == "inertia_too_small" and one.values["rigid"] == pytest.approx(25.0) for one in fit.findings
    )


@pytest.mark.slow
def test_a_motion_that_the_wrench_does_not_explain_writes_nothing():
    """The velocity is another vehicle's: R² is low, and nothing of the axis is identifiable or written."""
    vehicle, some = trials("bluerov2_heavy", "heave", "yaw")
    rng = np.random.default_rng(3)
    foreign = []
    for t in some:
        wander = np.convolve(rng.normal(size=len(t.t) + 100), np.hanning(101) / 20.0, "valid")
        foreign.append(replace(t, channels=t.channels | {"w": wander}))
    foreign = without(foreign, "x", "y", "z", "depth", "ax", "ay", "az")
    fit = regress(foreign, vehicle)
    assert fit.quality["heave"]["r2"] < 0.2
    of_heave = [e for n, e in fit.estimates.items() if n.startswith(("heave.", "buoyancy"))]
    assert len(of_heave) >= 5
    for estimate in of_heave:
        assert not estimate.identifiable
        assert "explains nothing" in estimate.note or "finds no inertia" in estimate.note
    assert not any(".2.2" in path or path.startswith("body.") for path in fit.changes)
    assert any(path.endswith("added_mass.5.5") for path in fit.changes)  # yaw is as good as ever


@pytest.mark.slow
def test_tilted_samples_are_left_out_unless_the_other_axes_are_fitted():
    """Surge steps pitch bluerov2 to 80°: with a wrong file, surge alone is not believed."""
    vehicle, some = trials("bluerov2", "surge", "sway", "heave", "yaw", levels=TILTING)
    added = 0.5 * vehicle.hydrodynamics["calibrated"].added_mass
    wrong = vehicle.replace({"hydrodynamics.calibrated.added_mass": added.tolist()})
    alone = regress(some, wrong, axes=["surge", "yaw"])
    assert any((one.code, one.subject) == ("tilted_left_out", "surge") for one in alone.findings)
    assert not alone.estimates["surge.m_eff"].identifiable
    assert not any(".0.0" in path for path in alone.changes)
    assert alone.estimates["yaw.m_eff"].identifiable
    together, expected = regress(some, wrong), truth(vehicle)
    assert together.estimates["surge.m_eff"].estimate == pytest.approx(expected["surge.m_eff"], rel=0.03)


@pytest.mark.slow
def test_a_vehicle_that_turns_over_needs_trials_of_sway_too():
    """bluerov2 turned over by surge steps also sways: from surge and heave alone, nothing of surge is believed."""
    vehicle, some = trials("bluerov2", "surge", "heave", levels=TILTING)
    added = 0.5 * vehicle.hydrodynamics["calibrated"].added_mass
    wrong = vehicle.replace({"hydrodynamics.calibrated.added_mass": added.tolist()})
    fit, expected = regress(some, wrong), truth(vehicle)
    of_surge = [e for name, e in fit.estimates.items() if name.startswith("surge.")]
    assert of_surge
    for estimate in of_surge:
        assert not estimate.identifiable
        assert "fit surge, sway and heave together" in estimate.note
    assert not any(".0.0" in path for path in fit.changes)
    assert fit.estimates["heave.m_eff"].identifiable
    assert fit.estimates["heave.m_eff"].estimate == pytest.approx(expected["heave.m_eff"], rel=0.03)


@pytest.mark.slow
def test_damping_is_written_as_a_pair_or_not_at_all():
    """A dropped term is written as zero beside the one that stays; an axis whose drag is unknown keeps both."""
    vehicle, some = trials("bluerov2_heavy", "sway", "roll")
    changes = regress(some, vehicle).changes
    for i in range(6):
        pair = [
            f"hydrodynamics.calibrated.{kind}_damping.{i}.{i}" in changes for kind in ("linear", "quadratic")
        ]
        assert pair[0] == pair[1]
    assert changes["hydrodynamics.calibrated.linear_damping.1.1"] == 0.0
    assert changes["hydrodynamics.calibrated.quadratic_damping.1.1"] > 0.0


def test_few_trials_are_said():
    """With two trials intervals come from blocks, which is said, and still hold the truth."""
    vehicle, some = trials("bluerov2_heavy", "surge")
    fit, expected = regress(some[-2:], vehicle), truth(vehicle)
    assert "block_intervals" in {one.code for one in fit.findings}
    low, high = fit.estimates["surge.m_eff"].ci95
    assert low - 0.2 < expected["surge.m_eff"] < high + 0.2


def test_refusals_say_what_to_do():
    """Held-out trials, unknown axes, no trials and no excitation."""
    vehicle, some = trials("bluerov2_heavy", "surge")
    held = replace(some[0], header=Header(**(some[0].header.model_dump() | {"role": "held-out"})))
    with pytest.raises(CalibrationError, match="held out"):
        regress([held, *some[1:]], vehicle)
    with pytest.raises(CalibrationError, match="unknown axis 'forward'"):
        regress(some, vehicle, axes=["forward"])
    with pytest.raises(CalibrationError, match="no trials"):
        regress([], vehicle)
    with pytest.raises(CalibrationError, match="no trial excites it"):
        regress(some, vehicle, axes=["sway"])
    with pytest.raises(CalibrationError, match="two trials are called"):
        regress([some[0], some[0]], vehicle)
