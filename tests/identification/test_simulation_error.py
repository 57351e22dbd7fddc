"""Fits of simulated trials recover the true parameters, and report those that are not identifiable."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import quat_conjugate, quat_rotate
from finssim.identification.excitation import compared, excites
from finssim.identification.programme import programmes
from finssim.identification.rollout import segments, streams
from finssim.identification.simulation_error import fit_by_simulation
from finssim.identification.stages import FitProgress, Stages
from finssim.identification.synthetic import simulate_programme
from finssim.sim.plant_arrays import twist_shift
from finssim.trials.findings import CalibrationError
from finssim.vehicles import AXES, Provenance, load_vehicle
from identification import known_trials
from identification.test_weak_form import with_bursts

SET = "hydrodynamics.calibrated"


def truth(vehicle, axis):
    """Return m_eff, d1 and d2 of an axis at the set's reference point."""
    chosen, i = vehicle.hydrodynamics["calibrated"], AXES.index(axis)
    back = np.linalg.inv(twist_shift(chosen.reference_point))
    M = back.T @ vehicle.rigid_body_mass_matrix() @ back + chosen.added_mass
    return {"m_eff": M[i, i], "d1": chosen.linear_damping[i, i], "d2": chosen.quadratic_damping[i, i]}


def wrong(vehicle):
    """Return the same vehicle with coefficients that are off by factors of two."""
    chosen = vehicle.hydrodynamics["calibrated"]
    return vehicle.replace(
        {
            f"{SET}.added_mass": 0.5 * np.diag(np.diag(chosen.added_mass)),
            f"{SET}.linear_damping": 2.0 * np.diag(np.diag(chosen.linear_damping)) + 0.1 * np.eye(6),
            f"{SET}.quadratic_damping": 0.5 * np.diag(np.diag(chosen.quadratic_damping)) + 0.1 * np.eye(6),
        }
    )


def without(some, *columns):
    """Return trials that lack these columns."""
    return [replace(t, channels={n: c for n, c in t.channels.items() if n not in columns}) for t in some]


def trials_of(vehicle, axes, *, count=3, **options):
    """Return trials of every second step of a programme: three levels, alternately ahead and astern."""
    return simulate_programme(programmes(axes, vehicle)[::2][:count], vehicle, **{"seed": 3, **options})


def check(fit, vehicle, axes, within):
    """Check identifiable values to a tolerance, and that intervals widened by half their width contain the truth."""
    for axis in axes:
        for name, value in truth(vehicle, axis).items():
            found = fit.estimates[f"{axis}.{name}"]
            if found.identifiable:
                assert found.estimate == pytest.approx(value, rel=within), found
            low, high = found.ci95
            slack = 0.5 * (high - low) + 0.01 * value
            assert low - slack <= value <= high + slack, found


CASES = {
    "finsrov, sensors at 50 Hz": ("finsrov", ("surge", "yaw"), 4, {}, 0.05),
    "finsrov, wrench and velocity at 5 Hz": (
        "finsrov",
        ("surge", "sway", "yaw"),
        2,
        {"rate": 5.0, "columns": ("u", "v", "w", "p", "q", "r"), "inputs": ("wrench",)},
        0.10,
    ),
    "bluerov2, commanded thrusters": ("bluerov2", ("sway", "yaw"), 2, {"inputs": ("command",)}, 0.08),
    "bluerov2_heavy, sensors at 50 Hz": ("bluerov2_heavy", ("surge", "heave", "pitch"), 3, {}, 0.05),
    "bluerov2_heavy, gyro and attitude": (
        "bluerov2_heavy",
        ("roll",),
        4,
        {"columns": ("p", "q", "r", "qx", "qy", "qz", "qw")},
        0.10,
    ),
}
"""Vehicle, axes, stride of their programmes, options of the simulation, and tolerance: with seven seeds of the
noise, all errors were smaller."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_numbers_come_back(name):
    """Parameters are recovered from coefficients off by factors of two, for every kind of input and sensor."""
    vehicle, axes, every, options, within = CASES[name]
    vehicle = load_vehicle(vehicle)
    some = simulate_programme(programmes(axes, vehicle)[::every], vehicle, seed=3, **options)
    fit = fit_by_simulation(some, wrong(vehicle))
    assert fit.settings["axes"] == list(axes)
    check(fit, vehicle, axes, within)
    identified = [e for e in fit.estimates.values() if e.name.endswith("m_eff") and e.identifiable]
    assert len(identified) == len(axes)


@pytest.mark.slow
def test_a_calibrated_vehicle_holds_the_numbers():
    """The changes give the wrong vehicle the added mass and damping force of the true one."""
    vehicle = load_vehicle("finsrov")
    fit = fit_by_simulation(trials_of(vehicle, "yaw"), wrong(vehicle))
    found, true = (v.hydrodynamics["calibrated"] for v in (wrong(vehicle).replace(fit.changes), vehicle))
    assert found.added_mass[5, 5] == pytest.approx(true.added_mass[5, 5], rel=0.05)
    force = [s.linear_damping[5, 5] * 1.5 + s.quadratic_damping[5, 5] * 1.5**2 for s in (found, true)]
    assert force[0] == pytest.approx(force[1], rel=0.03)
    assert fit.trials.keys() == {t.name for t in trials_of(vehicle, "yaw")}
    assert fit.quality["yaw"]["nrmse"] < 0.05 and len(fit.curves) == 1


def spiked(trial, column, value):
    """Return the trial with one in a hundred samples of a column replaced."""
    y = trial.channels[column].copy()
    y[50::100] = value
    return replace(trial, channels={**trial.channels, column: y})


@pytest.mark.slow
def test_rare_spikes_leave_a_right_fit_and_do_not_hide_a_wrong_one():
    """R² and NRMSE exclude spikes; a velocity that ignores its inputs stays unexplained."""
    vehicle = load_vehicle("finsrov")
    some = trials_of(vehicle, "yaw", count=2, rate=20.0, columns=("u", "v", "r"), inputs=("wrench",))
    fit = fit_by_simulation([spiked(t, "r", 10.0) for t in some], vehicle)
    figures = fit.quality["yaw"]
    assert figures["rejected"] > 0 and figures["r2"] > 0.99
    assert max(figures[name] for name in ("nrmse", "held_out", "file")) < 0.05
    assert fit.changes and fit.estimates["yaw.m_eff"].identifiable
    other = [replace(t, channels={**t.channels, "r": np.sin(6.0 * t.t)}) for t in some]
    wrong_fit = fit_by_simulation([spiked(t, "r", 10.0) for t in other], vehicle, axes=("yaw",))
    assert "axis_refused" in {one.code for one in wrong_fit.findings}


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
    """At 0.02 rad/s, d2 of FinsROV's yaw is not distinguishable from zero or other values, and keeps its origin."""
    vehicle = load_vehicle("finsrov")
    trials = simulate_programme(programmes("yaw", vehicle, levels={"yaw": (0.005,)}), vehicle, seed=3)
    fit = fit_by_simulation(trials, vehicle)
    d1, d2 = (fit.estimates[f"yaw.{name}"] for name in ("d1", "d2"))
    assert d2.estimate == truth(vehicle, "yaw")["d2"] and "not distinguishable from zero" in d2.note
    path = f"{SET}.quadratic_damping.5"
    assert fit.vehicle.origin_of(path) == vehicle.origin_of(path)
    assert fit.changes[f"{SET}.linear_damping.5.5"] == pytest.approx(d1.estimate)
    assert d1.ci95[0] < truth(vehicle, "yaw")["d1"] < d1.ci95[1]


@pytest.mark.slow
def test_a_small_swing_is_fitted_and_integrals_are_not_compared():
    """Roll of a stiff vehicle under sway is fitted although it is not driven; positions add no information to
    velocities."""
    file = load_vehicle("bluerov2_heavy")
    stiff = file.replace({"body.center_of_buoyancy": [0.0, 0.0, 0.04]})
    plan = programmes("sway", stiff, levels={"sway": (23.0,)})[:1]
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
def test_pushes_that_tilt_a_vehicle_drive_it_up_and_down_too():
    """Surge steps that pitch a vehicle by up to 25° move heave; taken as measured, heave biased surge drag by 20 %."""
    vehicle = load_vehicle("bluerov2_heavy")
    some = simulate_programme(programmes("surge", vehicle), vehicle, seed=2, inputs=("force",))
    bare = [replace(t, header=t.header.model_copy(update={"axis": ()})) for t in some]
    fit = fit_by_simulation(bare, wrong(vehicle))
    assert set(fit.quality) == {"surge", "heave", "roll", "pitch"}
    for name, value in truth(vehicle, "surge").items():
        low, high = fit.estimates[f"surge.{name}"].ci95
        assert low < value < high, name


@pytest.mark.slow
def test_an_axis_that_a_trial_does_not_excite_moves_as_it_was_seen_to():
    """A surge trial that drifts sideways compares surge alone; sway that is only noise is simulated and compared."""
    vehicle = load_vehicle("finsrov")
    surge, sway = (trials_of(vehicle, axis, count=1)[0] for axis in ("surge", "sway"))
    assert surge.header.axis == ("surge",)

    def cut(*some):
        prepared = [streams(t, vehicle) for t in some]
        stages = Stages(prepared, vehicle, ("surge", "sway"), (), {}, None, FitProgress(None))
        stages.cut(5.0)
        return [next(s for s in stages.segments if s.trial == t.name) for t in some]

    v = surge.channels["v"]
    drifting = replace(surge, channels=surge.channels | {"v": v + 0.2 * np.sin(np.arange(len(v)) / 50.0)})
    for trial, shown in ((drifting, {"u"}), (surge, {"u", "v"})):
        first, second = cut(trial, sway)
        assert set(first.measured) & {"u", "v"} == shown
        assert np.isfinite(first.held[:, 1]).all() == (shown == {"u"})
        assert not np.isfinite(first.held[:, 0]).any() and "v" in second.measured
    (alone,) = cut(drifting)
    assert {"u", "v"} <= set(alone.measured), "no trial excites sway: this one has to show it"


@pytest.mark.slow
def test_a_tether_that_pulls_in_one_direction_does_not_bend_the_drag():
    """The vehicle turns under a pull of 1.8 N; without a separate pull in each segment, mass and drag are wrong."""
    vehicle, force = load_vehicle("bluerov2_heavy"), np.array([1.5, -1.0, 0.0])

    def pull(simulator):
        q = simulator.numpy("quaternion")[:, 0]
        body = quat_rotate(quat_conjugate(q), np.broadcast_to(force, (len(q), 3)))
        simulator.command.disturbance.numpy()[:, 0, :3] = body

    some = simulate_programme(
        programmes(["surge", "yaw"], vehicle), vehicle, seed=2, each_step=pull, noise=known_trials.NOISE,
        rate=5.0, inputs=("command",),
    )  # fmt: skip
    found, true = fit_by_simulation(some, vehicle).estimates, known_trials.truth(vehicle)
    for name, size in (("surge.m_eff", 0.05), ("surge.d1", 0.15), ("surge.d2", 0.1), ("yaw.m_eff", 0.01)):
        assert found[name].estimate == pytest.approx(true[name], rel=size)
        assert found[name].ci95[0] < true[name] < found[name].ci95[1]


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
    """A second without measurements and a hundred outliers do not change the result."""
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
    """With a single trial, blocks within it replace trials, which is reported."""
    vehicle = load_vehicle("finsrov")
    fit = fit_by_simulation(trials_of(vehicle, "yaw", count=1), wrong(vehicle))
    (found,) = [one for one in fit.findings if one.code == "block_intervals"]
    assert found.values == {"axes": ("yaw",), "trials": 1} and "of yaw (1)" in str(found)
    assert np.isfinite(fit.estimates["yaw.m_eff"].ci95).all()


@pytest.mark.slow
def test_intervals_hold_the_truth():
    """Over 8 noise draws of three trials, 95 % intervals of mass and damping contain the truth in at least 6."""
    names = ("surge.m_eff", "surge.d1", "surge.d2")
    hits = np.zeros(3)
    for seed in range(8):
        vehicle, some = known_trials.trials("bluerov2_heavy", "surge", seed=seed)
        found, expected = fit_by_simulation(some[::2], vehicle).estimates, known_trials.truth(vehicle)
        hits += [found[n].ci95[0] <= expected[n] <= found[n].ci95[1] for n in names]
    assert (hits >= 6).all()  # 7.6 expected; 1 case in 170 has fewer


@pytest.mark.slow
def test_a_velocity_later_than_the_gyro_costs_no_mass():
    """u is logged 120 ms later than the gyro: the lag of that stream is found, and the mass is within 5 %."""
    vehicle, some = known_trials.trials("bluerov2_heavy", "surge")
    late = []
    for t in some[::2]:
        shifted = {n: np.interp(t.t - 0.12, t.t, c) if n in "uvw" else c for n, c in t.channels.items()}
        late.append(replace(t, channels=shifted))
    fit = fit_by_simulation(without(late, "x", "y", "z", "depth", "ax", "ay", "az"), vehicle)
    mass, expected = fit.estimates["surge.m_eff"], known_trials.truth(vehicle)["surge.m_eff"]
    assert mass.estimate == pytest.approx(expected, rel=0.05) and mass.ci95[0] < expected < mass.ci95[1]
    (lag,) = (one.values["lag"] for one in fit.findings if one.code == "motion_late")
    assert lag == pytest.approx(0.12, abs=0.02)


@pytest.mark.slow
def test_all_axes_moving_at_once():
    """For a multi-sine on all axes, the simulation includes Coriolis terms and couplings."""
    vehicle, some = known_trials.trials("bluerov2_heavy", *AXES, kind="multisine")
    found, expected = fit_by_simulation(some, vehicle).estimates, known_trials.truth(vehicle)
    for axis in AXES:
        assert found[f"{axis}.m_eff"].estimate == pytest.approx(expected[f"{axis}.m_eff"], rel=0.03), axis


@pytest.mark.slow
def test_a_gyro_without_velocity_gives_the_axes_of_rotation():
    """With only rates and attitude logged, yaw and roll are fitted, and surge is reported as unmeasured."""
    vehicle, some = known_trials.trials("bluerov2_heavy", "surge", "roll", "yaw")
    some = [next(t for t in some if t.name.startswith(axis)) for axis in ("surge", "roll", "yaw")]
    fit = fit_by_simulation(without(some, "u", "v", "w", "x", "y", "z", "depth"), vehicle)
    assert {n.partition(".")[0] for n in fit.estimates if "." in n} == {"roll", "yaw"}
    assert ("axis_undetermined", "surge") in {(one.code, one.subject) for one in fit.findings}


@pytest.mark.slow
def test_roll_without_attitude_rests_on_its_swing():
    """Without any angle, the gyro alone shows how fast roll swings back: stiffness and mass are in their intervals."""
    vehicle, some = known_trials.trials("bluerov2_heavy", "roll")
    found = fit_by_simulation(without(some[::2], "qx", "qy", "qz", "qw"), vehicle).estimates
    for name in ("roll.m_eff", "roll.k"):
        low, high = found[name].ci95
        assert low <= known_trials.truth(vehicle)[name] <= high and high - low < 0.3 * found[name].estimate


@pytest.mark.slow
def test_bursts_of_a_wrong_wrench_make_the_intervals_wide():
    """Each trial has two quarters of a second with three times the largest wrench: reported, nothing is
    identifiable."""
    vehicle, some = known_trials.trials("bluerov2_heavy", "surge")
    bad = [with_bursts(t, j)[0] for j, t in enumerate(some)]
    fit, expected = fit_by_simulation(bad, vehicle), known_trials.truth(vehicle)
    assert len([one for one in fit.findings if one.code == "jolt"]) >= 6
    for name in ("surge.m_eff", "surge.d1", "surge.d2"):
        low, high = fit.estimates[name].ci95
        assert low <= expected[name] <= high and not fit.estimates[name].identifiable


@pytest.mark.slow
def test_axes_that_hardly_move_do_not_shake_the_others():
    """With small pulses on roll and pitch, and noise as velocities, both are recovered, and surge is unchanged."""
    vehicle, some = known_trials.trials("finsrov", "roll", "pitch")
    centre = {"body.center_of_gravity": vehicle.body.center_of_gravity.tolist()}
    file = wrong(vehicle).replace(centre, Provenance("measured", "weighed"))
    fit, expected = fit_by_simulation(some[::2], file), known_trials.truth(vehicle)
    for name in ("roll.m_eff", "roll.k", "pitch.m_eff", "pitch.d1"):
        assert fit.estimates[name].estimate == pytest.approx(expected[name], rel=0.05), name
        low, high = fit.estimates[name].ci95
        assert low <= expected[name] <= high
    assert not any(path.startswith(SET) and path.rsplit(".", 2)[1] in "0125" for path in fit.changes)


@pytest.mark.slow
def test_dive_and_coast_gives_the_buoyancy():
    """The coast after a dive determines the excess alone, and the displaced volume in the file reproduces it."""
    vehicle, some = known_trials.trials("bluerov2", "heave")
    fit = fit_by_simulation(some, vehicle)
    excess = fit.estimates["buoyancy_excess"]
    assert excess.identifiable
    assert excess.estimate == pytest.approx(known_trials.truth(vehicle)["buoyancy_excess"], rel=0.05)
    changed = vehicle.replace({"body.displaced_volume": fit.changes["body.displaced_volume"]})
    assert changed.buoyancy - changed.weight == pytest.approx(excess.estimate, rel=1e-6)


@pytest.mark.slow
def test_a_file_that_is_too_heavy_is_reported():
    """For an effective mass below the file's rigid mass, no negative added mass is written."""
    vehicle, some = known_trials.trials("bluerov2_heavy", "surge", inputs=("wrench",))
    heavy = vehicle.replace({"body.mass": 25.0, "body.displaced_volume": 0.0249})
    fit = fit_by_simulation(some[::2], heavy)
    assert not fit.estimates["surge.added_mass"].identifiable
    assert not any("added_mass.0" in path for path in fit.changes)
    (said,) = (one for one in fit.findings if one.code == "inertia_too_small")
    assert said.values["rigid"] == pytest.approx(25.0)


@pytest.mark.slow
def test_a_motion_that_the_wrench_does_not_explain_writes_nothing():
    """Heave has another vehicle's velocity: none of its parameters is identifiable or written; yaw is unaffected."""
    vehicle, some = known_trials.trials("bluerov2_heavy", "heave", "yaw")
    rng = np.random.default_rng(3)
    foreign = []
    for t in some[::2]:
        wander = np.convolve(rng.normal(size=len(t.t) + 100), np.hanning(101) / 20.0, "valid")
        foreign.append(replace(t, channels=t.channels | {"w": wander}))
    fit = fit_by_simulation(without(foreign, "x", "y", "z", "depth", "ax", "ay", "az"), vehicle)
    of_heave = [e for n, e in fit.estimates.items() if n.startswith(("heave.", "buoyancy"))]
    assert len(of_heave) == 5 and not any(estimate.identifiable for estimate in of_heave)
    assert not any(".2.2" in path or path.startswith("body.") for path in fit.changes)
    yaw = fit.estimates["yaw.m_eff"]
    assert yaw.identifiable and yaw.estimate == pytest.approx(
        known_trials.truth(vehicle)["yaw.m_eff"], rel=0.02
    )


@pytest.mark.slow
@pytest.mark.parametrize("axes", [("surge", "yaw"), ("surge", "heave")])
def test_a_vehicle_that_turns_over_is_simulated_as_it_turned(axes):
    """Surge steps pitch bluerov2 to 80°: from a wrong file, surge and the other axis are recovered all the same."""
    levels = (("surge", (41.0, 82.0, 123.0)), ("sway", (31.0, 62.0, 93.0)))
    vehicle, some = known_trials.trials("bluerov2", *axes, levels=levels)
    added = 0.5 * vehicle.hydrodynamics["calibrated"].added_mass
    found = fit_by_simulation(some[::2], vehicle.replace({f"{SET}.added_mass": added.tolist()})).estimates
    for axis in axes:
        expected = known_trials.truth(vehicle)[f"{axis}.m_eff"]
        assert found[f"{axis}.m_eff"].estimate == pytest.approx(expected, rel=0.02), axis


@pytest.mark.slow
def test_an_interrupt_returns_the_best_until_then():
    """Ctrl-C while fitting returns estimates, marked as those of an interrupted fit."""
    vehicle = load_vehicle("finsrov")

    def interrupt(part, words):
        if words.startswith("fit"):
            raise KeyboardInterrupt

    fit = fit_by_simulation(trials_of(vehicle, "yaw", count=4), wrong(vehicle), progress=interrupt)
    assert fit.interrupted and fit.findings[0].code == "interrupted"
    assert fit.estimates["yaw.m_eff"].estimate == pytest.approx(truth(vehicle, "yaw")["m_eff"], rel=0.3)


@pytest.mark.slow
def test_equal_seeds_give_equal_fits():
    """The result does not depend on threads, time or chance."""
    vehicle = load_vehicle("finsrov")
    trials = trials_of(vehicle, "yaw", count=1)
    a, b = (fit_by_simulation(trials, wrong(vehicle)) for _ in range(2))
    assert a.estimates == b.estimates


def test_what_cannot_be_fitted_is_refused():
    """Refused: held-out trials, unknown words, and trials without a measurement of an axis."""
    vehicle = load_vehicle("finsrov")
    trials = trials_of(vehicle, "yaw", count=2)
    held = [replace(t, header=t.header.model_copy(update={"role": "held-out"})) for t in trials]
    for given, options, words in (
        (held, {}, "held out"),
        ([], {}, "no trials"),
        (trials, {"axes": ["up"]}, "unknown axis 'up'"),
        (trials, {"estimate": ["colour"]}, "cannot estimate 'colour'"),
        (trials, {"damping": "cubic"}, "unknown damping"),
        ([trials[0], trials[0]], {}, "expected unique names"),
    ):
        with pytest.raises(CalibrationError, match=words):
            fit_by_simulation(given, vehicle, **options)
    blind = [
        replace(t, channels={k: v for k, v in t.channels.items() if k in ("r", "tau_n")}) for t in trials
    ]
    with pytest.raises(CalibrationError, match="no measurement that determines surge"):
        fit_by_simulation(blind, vehicle, axes=["surge"])
