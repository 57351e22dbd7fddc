"""Trials without thrust: frequency and damping of a swing, drag of a coast, speed of a rise, and assumptions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler
from finssim.identification.rollout import released, streams
from finssim.identification.simulation_error import fit_by_simulation, prepare
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import Header, Trial
from finssim.vehicles import AXES, load_vehicle

HINSDALE = Path(__file__).parents[1] / "data" / "hinsdale"

HEAVY = load_vehicle("bluerov2_heavy")

NEUTRAL = HEAVY.replace({"body.displaced_volume": HEAVY.weight / (HEAVY.water.density * HEAVY.water.gravity)})
"""Vehicle that keeps its depth while it swings: in a sinking one, added mass contributes to the righting moment."""

ROV = load_vehicle("bluerov2")

SHAPES = {"linear": (0.25, 0.0), "quadratic": (0.0, 0.7), "both": (0.1, 0.5)}
"""d1/m [1/s] and d2/m [1/m, 1/rad] of coasts."""


def decay(w2, c1, c2, *, seed, angle=0.15, release=3.0, duration=20.0, axis="roll", trim=0.03, drift=0.0):
    """Return a trial at 50 Hz of a vehicle that is held at an angle and released.

    phi_dot_dot + c1 phi_dot + c2 |phi_dot| phi_dot + w2 (sin phi - trim) = 0, with noise; the trim moves by `drift`
    [1/s] from the release on.
    """
    rng, rate, fine = np.random.default_rng(seed), 50.0, 20
    t = np.arange(0.0, duration, 1.0 / rate)
    phi, p, x, v = np.full(len(t), angle), np.zeros(len(t)), angle, 0.0
    for i in range(int(release * rate), len(t)):
        phi[i], p[i] = x, v
        for _ in range(fine):
            rest = trim + drift * (t[i] - release)
            v -= (c1 * v + c2 * abs(v) * v + w2 * (np.sin(x) - rest)) / rate / fine
            x += v / rate / fine
    phi = phi + 0.003 * rng.normal(size=len(t))
    zero = np.zeros(len(t))
    q = quat_from_euler(*((phi, zero, zero) if axis == "roll" else (zero, phi, zero)))
    gyro = {"p" if axis == "roll" else "q": p + 0.004 * rng.normal(size=len(t))}
    channels = dict(zip(("qx", "qy", "qz", "qw"), q.T, strict=True)) | gyro
    return Trial(name=f"decay{seed}_{w2}", t=t, channels=channels, header=Header(passive=True))


def rise(speed, z, noise=0.003, seed=0):
    """Return a trial at 20 Hz with measured depth, for a height z [m] that follows from a speed [m/s]."""
    t = 0.05 * np.arange(len(speed))
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1])) * 0.05])
    z = z + way + noise * np.random.default_rng(seed).normal(size=len(t))
    return Trial(name="rise", t=t, channels={"depth": -z}, header=Header(passive=True))


def speed_and_way(t, v0, c1, c2):
    """Return v of v_dot = -c1 v - c2 |v| v, and its integral."""
    c1, c2, a0 = c1 + 1e-12, c2 + 1e-12, abs(v0)
    fallen = -np.expm1(-c1 * t)
    v = a0 * (1.0 - fallen) / (1.0 + c2 * a0 / c1 * fallen)
    return np.sign(v0) * v, np.sign(v0) * np.log1p(c2 * a0 / c1 * fallen) / c2


def coasts(rng, c1, c2, *, count=6, noise=0.004, column="yaw", rate=30.0, seconds=15.0):
    """Return trials with a heading, a rate, or a velocity of a vehicle that stays level and on course."""
    out = []
    for k in range(count):
        t = np.arange(0.0, seconds, 1.0 / rate)
        v, s = speed_and_way(t, rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.8), c1, c2)
        y = (rng.uniform(-3.0, 3.0) + s) if column == "yaw" else v
        channels = {column: y + noise * rng.standard_normal(len(t))}
        if column in "uv":
            still = {"u", "v", "w", "p", "q", "r", "roll", "pitch"} - {column}
            channels |= {name: np.zeros(len(t)) for name in still}
        out.append(Trial(name=f"coast_{k}", t=t, channels=channels, header=Header(passive=True)))
    return out


# -- swings ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "w2", "c1", "c2"), [("roll", 4.0, 0.4, 0.0), ("pitch", 6.0, 0.0, 3.0)])
def test_a_swing_gives_frequency_and_damping(axis, w2, c1, c2):
    """The ratios to the inertia and the right kind of damping are recovered, and the release is found."""
    trial = decay(w2, c1, c2, seed=1, axis=axis)
    begin = released(streams(trial, NEUTRAL), [axis]).drive.spans[0, 0]
    assert (
        3.0 <= begin < 3.0 + 0.5 * np.pi / np.sqrt(w2)
    )  # the rate is largest a quarter period after the release
    fit = fit_by_simulation([trial], NEUTRAL)
    assert fit.settings["axes"] == [axis]
    found = fit.estimates
    assert found[f"{axis}.natural_frequency"].estimate == pytest.approx(np.sqrt(w2), rel=0.01)
    kind, value, other = ("d1", c1, "d2") if c1 else ("d2", c2, "d1")
    assert found[f"{axis}.{kind}/m_eff"].estimate == pytest.approx(value, rel=0.03)
    assert found[f"{axis}.{other}/m_eff"].estimate < 0.02 * value
    assert found[f"{axis}.{other}/m_eff"].ci95[0] == 0.0
    assert fit.quality[axis]["r2"] > 0.95


@pytest.mark.slow
def test_intervals_of_a_swing_hold_the_truth():
    """In most of 10 noisy decays, the intervals of frequency and damping contain the truth."""
    hits = np.zeros(2)
    for seed in range(10):
        trial = decay(5.0, 0.5, 0.0, seed=seed, duration=12.0)
        found = fit_by_simulation([trial], NEUTRAL, damping="linear").estimates
        ends = [found[f"roll.{name}"].ci95 for name in ("natural_frequency", "d1/m_eff")]
        hits += [low <= value <= high for (low, high), value in zip(ends, (np.sqrt(5.0), 0.5), strict=True)]
    assert (hits >= 7).all()  # 9.5 expected; 1 case in 900 has fewer


@pytest.mark.slow
def test_an_equilibrium_that_moves_is_followed():
    """A drifting trim, as with a moving arm, does not bias the damping."""
    fit = fit_by_simulation([decay(4.0, 0.4, 0.0, seed=2, drift=0.02, duration=16.0)], NEUTRAL)
    assert fit.estimates["roll.d1/m_eff"].estimate == pytest.approx(0.4, rel=0.05)
    assert fit.estimates["roll.natural_frequency"].estimate == pytest.approx(2.0, rel=0.02)


@pytest.mark.slow
def test_absolute_values_name_what_was_assumed():
    """Either the stiffness or the inertia is assumed known, which is stated; both agree in the ratio."""
    trials = [decay(4.0, 0.4, 0.0, seed=s) for s in range(2)]
    k = HEAVY.buoyancy * HEAVY.body.center_of_buoyancy[2]
    stiff = fit_by_simulation(trials, NEUTRAL, axes=["roll"]).estimates
    assert stiff["roll.m_eff"].estimate == pytest.approx(k / 4.0, rel=0.03)
    assert "file's k" in stiff["roll.m_eff"].note
    assert stiff["roll.d1"].estimate == pytest.approx(0.4 * k / 4.0, rel=0.06)
    assert stiff["roll.damping_ratio"].estimate == pytest.approx(0.4 / (2.0 * 2.0), rel=0.06)
    heavy = fit_by_simulation(trials, NEUTRAL, axes=["roll"], known={"roll": 0.4}).estimates
    assert "given inertia" in heavy["roll.k"].note
    assert heavy["roll.k"].estimate / heavy["roll.m_eff"].estimate == pytest.approx(4.0, rel=0.03)


@pytest.mark.slow
def test_releases_that_disagree_widen_the_interval():
    """Four equal decays give a narrow interval; if frequencies differ by a fifth, it contains all of them."""
    same, apart = (
        fit_by_simulation(
            [decay(w2, 0.4, 0.0, seed=seed) for seed, w2 in enumerate((4.0, 4.0, other, other))],
            NEUTRAL,
            axes=["roll"],
            damping="linear",
        ).estimates["roll.natural_frequency"]
        for other in (4.0, 5.8)
    )
    assert np.diff(same.ci95)[0] < 0.03
    assert apart.ci95[0] < 2.02 and apart.ci95[1] > 2.38


def test_a_vehicle_at_rest_does_not_swing():
    """Noise alone is refused with the reason, and so is a trial without any measurement."""
    quiet = decay(4.0, 0.4, 0.0, seed=3, angle=0.03, trim=0.03)
    with pytest.raises(CalibrationError, match="does not ring down"):
        fit_by_simulation([quiet], HEAVY, axes=["roll"])
    with pytest.raises(CalibrationError, match="was not measured"):
        fit_by_simulation([replace(quiet, channels={})], HEAVY, axes=["roll"])


# -- rises ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("quadratic", [False, True])
def test_a_rise_gives_terminal_speed_and_excess(quadratic):
    """From rest: the speed at which drag equals the excess, and the excess over the mass from the acceleration."""
    e, top = 0.08, 0.2
    speed, w = np.zeros(400), 0.0
    for i in range(40, 400):
        speed[i] = w
        for _ in range(20):
            w += (e * (1.0 - (w / top) ** 2 if quadratic else 1.0 - w / top)) * 0.0025
    fit = fit_by_simulation([rise(speed, -6.0)], HEAVY)
    found = fit.estimates
    assert found["heave.terminal_speed"].estimate == pytest.approx(top, rel=0.01)
    assert found[f"heave.{'d1' if quadratic else 'd2'}"].ci95[0] == 0.0
    m = float(np.diag(HEAVY.mass_matrix())[2])
    # At one speed the other shape keeps a tenth of the probability, and biases the excess.
    assert found["buoyancy_excess"].estimate == pytest.approx(e * m, rel=0.1)
    assert found["buoyancy_excess"].ci95[0] < e * m < found["buoyancy_excess"].ci95[1]
    assert "from the acceleration" in found["buoyancy_excess"].note


@pytest.mark.slow
def test_a_file_that_sinks_where_the_vehicle_rises_is_reported():
    """A rise contradicts a file heavier than water, even if the excess is too uncertain to be written."""
    t = np.arange(0.0, 20.0, 0.05)
    speed = 0.2 * (1.0 - np.exp(-np.maximum(t - 2.0, 0.0) / 2.5))
    sinks = HEAVY.replace({"body.displaced_volume": 0.995 * HEAVY.weight / 9810.0})
    fit = fit_by_simulation([rise(speed, -6.0, noise=0.01, seed=1)], sinks, axes=["heave"])
    assert [one.subject for one in fit.findings if one.code == "buoyancy_contradicted"] == ["heave"]
    assert "body.displaced_volume" not in fit.changes


# -- coasts ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("column", "shape"), [("yaw", "quadratic"), ("r", "both"), ("u", "linear"), ("v", "quadratic")]
)
def test_a_coast_gives_drag_over_inertia(column, shape):
    """The data are a heading alone, a gyro, or a velocity; the file's inertia scales the drag."""
    c1, c2 = SHAPES[shape]
    axis = {"yaw": "yaw", "r": "yaw", "u": "surge", "v": "sway"}[column]
    fit = fit_by_simulation(coasts(np.random.default_rng(1), c1, c2, column=column), ROV)
    for name, value in (("d1", c1), ("d2", c2)):
        found = fit.estimates[f"{axis}.{name}/m_eff"]
        assert found.estimate == pytest.approx(value, rel=0.05, abs=1e-4), found
        assert found.ci95[0] <= value <= found.ci95[1] or abs(found.estimate - value) < 0.02 * max(value, 0.1)
    i = AXES.index(axis)
    changed = ROV.replace(fit.changes).hydrodynamics["calibrated"]
    assert changed.quadratic_damping[i, i] == pytest.approx(fit.estimates[f"{axis}.d2"].estimate)
    ratio = fit.estimates[f"{axis}.d2/m_eff"].estimate
    assert fit.estimates[f"{axis}.d2"].estimate == pytest.approx(ROV.mass_matrix()[i, i] * ratio, rel=0.02)
    assert not any(path.rpartition(".")[2] != str(i) for path in fit.changes)  # nothing of the other axes


@pytest.mark.slow
def test_the_shape_of_drag_is_right_and_its_interval_holds_the_truth():
    """The true shape, linear or quadratic, is most probable in at least 10 of 12 draws, and the interval of the ratio
    contains the truth in at least 9.

    11.6 and 11.4 are expected; 1 case in 200 and 1 in 50 have fewer.
    """
    rng = np.random.default_rng(5)
    right = held = 0
    for k in range(12):
        c1, c2 = SHAPES[("linear", "quadratic")[k % 2]]
        c1, c2 = c1 * rng.uniform(0.5, 2.0), c2 * rng.uniform(0.5, 2.0)
        fit = fit_by_simulation(coasts(rng, c1, c2, noise=0.02, rate=10.0, count=4), ROV)
        name, value, shape = ("d1", c1, "linear") if c1 > 0.0 else ("d2", c2, "quadratic")
        found, weights = fit.estimates, fit.settings["drag"]["yaw"]
        right += max(weights, key=weights.get) == shape
        low, high = found[f"yaw.{name}/m_eff"].ci95
        held += low <= value <= high
    assert right >= 10 and held >= 9


@pytest.mark.slow
def test_five_spins_that_agree_are_written_with_one_scatter():
    """For five spins at 20 Hz or 1 Hz, each with another pull, the file gets the drag; the interval of its ratio is
    below a third of it and contains the truth."""
    for rate in (20.0, 1.0):
        rng = np.random.default_rng(3)
        trials = coasts(rng, 0.1, 0.65, count=5, column="r", noise=0.01, rate=rate)
        fit = fit_by_simulation(trials, ROV, known={"yaw": 0.3})
        found = fit.estimates["yaw.d2/m_eff"]
        assert found.ci95[0] <= 0.65 <= found.ci95[1]
        assert np.diff(found.ci95)[0] < (0.3 if rate > 1.0 else 0.6) * found.estimate
        written = fit.changes["hydrodynamics.calibrated.quadratic_damping.5.5"]
        assert written == pytest.approx(0.3 * found.estimate)


@pytest.mark.slow
def test_a_damping_that_was_asked_for_is_what_a_coast_gives():
    """With quadratic damping alone, no linear term is estimated, and the file's is written as zero."""
    trials = coasts(np.random.default_rng(1), 0.0, 0.7, column="r", noise=0.01, count=5)
    file = ROV.replace({"hydrodynamics.calibrated.linear_damping.5.5": 0.05})
    fit = fit_by_simulation(trials, file, damping="quadratic")
    assert "yaw.d1/m_eff" not in fit.estimates
    assert fit.changes["hydrodynamics.calibrated.linear_damping.5.5"] == 0.0
    assert fit.estimates["yaw.d2/m_eff"].estimate == pytest.approx(0.7, rel=0.05)


def test_one_coast_is_enough_and_a_push_ends_it():
    """A single trial gets its interval from blocks; samples after another push do not count."""
    (one,) = coasts(np.random.default_rng(2), 0.0, 0.7, count=1, column="r", noise=0.01)
    again = one.channels["r"].copy()
    again[300:] += np.sign(again[0]) * 0.4
    pushed = Trial(name="pushed", t=one.t, channels={"r": again}, header=one.header)
    for trial in (one, pushed):
        found = fit_by_simulation([trial], ROV).estimates["yaw.d2/m_eff"]
        assert found.estimate == pytest.approx(0.7, rel=0.1)
        assert found.ci95[0] < 0.7 < found.ci95[1]


def test_each_trial_is_announced_before_it_is_prepared():
    """A user sees progress within a moment."""
    names = []
    prepare(coasts(np.random.default_rng(1), 0.1, 0.5, count=2, column="r"), ROV, ["yaw"], names.append)
    assert names == ["coast_0", "coast_1"]


def test_what_does_not_coast_is_refused():
    """A vehicle at rest, and one that keeps turning, show no drag."""
    t = np.arange(0.0, 10.0, 0.05)
    for y in (0.001 * np.sin(t), np.full(len(t), 1.0)):
        trial = Trial(name="still", t=t, channels={"r": y}, header=Header(passive=True))
        with pytest.raises(CalibrationError, match="does not coast"):
            fit_by_simulation([trial], ROV)


# -- recordings of a real vehicle -----------------------------------------------------------------------------------


def hinsdale(name):
    """Return a real trial: pose of motion capture and IMU on one time base."""
    tables = [
        np.genfromtxt(HINSDALE / f"{name}_{part}.csv", delimiter=",", skip_header=1)
        for part in ("mocap", "imu")
    ]
    t = np.unique(np.concatenate([table[:, 0] for table in tables]))
    channels = {}
    columns = (("x", "y", "z", "qx", "qy", "qz", "qw"), ("", "", "", "", "p", "q", "r"))
    for table, names in zip(tables, columns, strict=True):
        for j, column in enumerate(names):
            if column:
                channels[column] = np.full(len(t), np.nan)
                channels[column][np.searchsorted(t, table[:, 0])] = table[:, j + 1]
    return Trial(name=name, t=t, channels=channels, header=Header(passive=True))


@pytest.mark.slow
def test_a_real_release_is_found_and_fitted():
    """A BlueROV2 with an arm, released by hand, rolls and pitches with periods of about 3 s and light damping."""
    trial = hinsdale("traj005-1")
    assert 1.0 < released(streams(trial, HEAVY), ["roll", "pitch"]).drive.spans[0, 0] < 3.5
    fit = fit_by_simulation([trial], HEAVY, axes=["roll", "pitch"])
    for axis in ("roll", "pitch"):
        frequency = fit.estimates[f"{axis}.natural_frequency"]
        assert 2.0 * np.pi / frequency.estimate == pytest.approx(3.1, abs=0.25) and frequency.identifiable
        assert 0.03 < fit.estimates[f"{axis}.damping_ratio"].estimate < 0.25
        assert fit.quality[axis]["r2"] > 0.85


@pytest.mark.slow
def test_surge_and_sway_are_judged_by_a_coordinate_each():
    """Each has its own coordinate: motion capture gives no u and v, and x would be used for both."""
    fit = fit_by_simulation([hinsdale("traj005-1")], HEAVY, axes=["surge", "sway"])
    assert [curve.y_label for curve in fit.curves] == ["x [m]", "y [m]"]


@pytest.mark.slow
def test_real_releases_that_disagree_write_nothing():
    """The arm moved between the two: one pitch stiffness does not fit both, which is stated."""
    trials = [hinsdale(name) for name in ("traj005-1", "traj_alt_009-0")]
    fit = fit_by_simulation(trials, HEAVY, axes=["pitch"])
    assert [one.subject for one in fit.findings if one.code == "axis_refused"] == ["pitch"]
    assert not fit.changes and not any(e.identifiable for e in fit.estimates.values())


def test_a_real_trial_without_a_release_is_refused():
    """The arm stays still and the vehicle is not released: no decay is reported."""
    with pytest.raises(CalibrationError, match="does not ring down"):
        fit_by_simulation([hinsdale("baseline2")], HEAVY, axes=["roll"])
