"""Trials without thrust: frequency and damping of a ring-down, speed and buoyancy of a rise, and what was assumed."""

from pathlib import Path

import numpy as np
import pytest

from finssim.calibration.errors import CalibrationError
from finssim.calibration.regression.free_decay import free_decay
from finssim.calibration.regression.passive import buoyant_rise, passive, pooled
from finssim.calibration.regression.regress import regress
from finssim.calibration.trials.header import Header
from finssim.calibration.trials.trial import Trial
from finssim.calibration.uncertainty import intervals
from finssim.geometry.rotations import quat_from_euler
from finssim.vehicles import load_vehicle

HINSDALE = Path(__file__).parents[2] / "data" / "hinsdale"

VEHICLE = load_vehicle("bluerov2_heavy")


def decay(
    w2, c1, c2, *, seed, angle=0.15, release=3.0, rate=50.0, duration=20.0, axis="roll", trim=0.03, drift=0.0
):
    """A trial held at an angle and let go: s_dot_dot + c1 s_dot + c2 |s_dot| s_dot + w2 (s - trim) = 0, with noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 1.0 / rate)
    s, p = np.full(len(t), angle), np.zeros(len(t))
    x, v, fine = angle, 0.0, 20
    for i in range(int(release * rate), len(t)):
        s[i], p[i] = x, v
        for _ in range(fine):
            here = trim + drift * (t[i] - release)
            v -= (c1 * v + c2 * abs(v) * v + w2 * (x - here)) / rate / fine
            x += v / rate / fine
    angle_of = np.arcsin(s) + 0.003 * rng.normal(size=len(t))
    zero = np.zeros(len(t))
    roll, pitch = (angle_of, zero) if axis == "roll" else (zero, angle_of)
    q = quat_from_euler(roll, pitch, zero)
    gyro = p + 0.004 * rng.normal(size=len(t))
    channels = dict(zip(("qx", "qy", "qz", "qw"), q.T, strict=True)) | {"p" if axis == "roll" else "q": gyro}
    return Trial(name=f"decay{seed}", t=t, channels=channels, header=Header(passive=True))


@pytest.mark.slow
@pytest.mark.parametrize("axis", ["roll", "pitch"])
@pytest.mark.parametrize(("w2", "c1", "c2"), [(4.0, 0.4, 0.0), (6.0, 0.0, 3.0)])
def test_ring_down_gives_frequency_and_damping(axis, w2, c1, c2):
    """Ratios of stiffness and of the right kind of damping to inertia come back, and the release is found."""
    found = free_decay(decay(w2, c1, c2, seed=1, axis=axis), axis)
    assert (
        3.0 <= found.begin < 3.0 + 0.5 * np.pi / np.sqrt(w2)
    )  # the rate is largest a quarter period after the release
    assert found.theta[0] == pytest.approx(w2, rel=0.02)
    assert found.theta[1] + found.theta[2] * found.swing == pytest.approx(c1 + c2 * found.swing, rel=0.12)
    assert found.r2 > 0.95


@pytest.mark.slow
def test_intervals_of_a_ring_down_cover():
    """95 % intervals of ln w2 and c1 hold the truth in most of 20 noisy decays."""
    hits = np.zeros(2)
    for seed in range(20):
        found = free_decay(decay(5.0, 0.5, 0.0, seed=seed, duration=12.0), "roll", terms=(True, False))
        ends = intervals(np.array([np.log(found.theta[0]), found.theta[1]]), found.covariance)
        hits += (ends[:, 0] <= [np.log(5.0), 0.5]) & (ends[:, 1] >= [np.log(5.0), 0.5])
    assert (hits >= 16).all()  # 19 expected


def test_a_moving_equilibrium_is_followed():
    """A trim that drifts, as under a moving arm, does not bend the damping."""
    found = free_decay(decay(4.0, 0.4, 0.0, seed=2, drift=0.02, duration=16.0), "roll")
    assert found.drift
    assert found.theta[1] == pytest.approx(0.4, rel=0.1)


def test_a_trial_at_rest_is_refused_with_the_reason():
    """Noise alone does not ring down."""
    quiet = decay(4.0, 0.4, 0.0, seed=3, angle=0.03, trim=0.03)
    with pytest.raises(CalibrationError, match="does not ring down"):
        free_decay(quiet, "roll")
    with pytest.raises(CalibrationError, match="nothing to see"):
        free_decay(Trial(name="empty", t=np.arange(10.0), channels={}), "roll")


@pytest.mark.slow
def test_absolute_values_name_what_was_assumed():
    """With the stiffness or with the inertia of the file as known: which is said, and both agree in ratio."""
    w2, c1 = 4.0, 0.4
    trials = [decay(w2, c1, 0.0, seed=s) for s in range(2)]
    body = VEHICLE.body
    k = VEHICLE.buoyancy * body.center_of_buoyancy[2] - VEHICLE.weight * body.center_of_gravity[2]
    stiff = passive(trials, VEHICLE, axes=["roll"]).estimates
    assert stiff["roll.m_eff"].estimate == pytest.approx(k / w2, rel=0.03)
    assert "file's k" in stiff["roll.m_eff"].note
    assert stiff["roll.d1"].estimate == pytest.approx(c1 * k / w2, rel=0.06)
    assert stiff["roll.damping_ratio"].estimate == pytest.approx(c1 / (2.0 * np.sqrt(w2)), rel=0.06)
    heavy = passive(trials, VEHICLE, axes=["roll"], assume="inertia").estimates
    assert "file's inertia" in heavy["roll.k"].note
    assert heavy["roll.k"].estimate / heavy["roll.m_eff"].estimate == pytest.approx(w2, rel=0.03)


@pytest.mark.slow
def test_regression_takes_up_passive_trials():
    """Given only trials without thrust, the hydrodynamics command's regression reports the decay."""
    fit = regress([decay(4.0, 0.4, 0.0, seed=s) for s in range(2)], VEHICLE)
    assert fit.estimates["roll.natural_frequency"].estimate == pytest.approx(2.0, rel=0.02)
    assert set(fit.trials) == {"decay0", "decay1"}


@pytest.mark.slow
@pytest.mark.parametrize("quadratic", [False, True])
def test_rise_gives_terminal_speed_and_excess(quadratic):
    """From rest: the speed where drag equals the excess, and the excess over the mass from the acceleration."""
    e, top = 0.08, 0.2
    t = np.arange(0.0, 20.0, 0.05)
    z, w, h = np.full(len(t), -3.0), 0.0, -3.0
    for i in range(40, len(t)):
        z[i] = h
        for _ in range(20):
            w += (e * (1.0 - (w / top) ** 2 if quadratic else 1.0 - w / top)) * 0.0025
            h += w * 0.0025
    noisy = z + 0.003 * np.random.default_rng(0).normal(size=len(t))
    found = buoyant_rise(Trial(name="rise", t=t, channels={"depth": -noisy}))
    assert found.quadratic == quadratic
    assert found.terminal_speed == pytest.approx(top, rel=0.03)
    assert found.excess_ratio == pytest.approx(e, rel=0.15)
    assert found.excess_ci95[0] < e < found.excess_ci95[1]


def test_a_file_that_sinks_where_the_vehicle_rises_is_said():
    """A rise contradicts a file heavier than water, even where the excess is known too badly to be written."""
    t = np.arange(0.0, 20.0, 0.05)
    w = 0.2 * (1.0 - np.exp(-np.maximum(t - 2.0, 0.0) / 2.5))
    z = -3.0 + np.cumsum(w) * 0.05 + 0.01 * np.random.default_rng(1).normal(size=len(t))
    rise = Trial(name="rise", t=t, channels={"depth": -z}, header=Header(passive=True))
    sinks = VEHICLE.replace({"body.displaced_volume": 0.995 * VEHICLE.weight / 9810.0})
    said = [one for one in passive([rise], sinks, axes=["heave"]).findings if one.code == "buoyancy_sign"]
    assert [one.subject for one in said] == ["heave"]


def test_pooling_trials_that_disagree_widens_the_interval():
    """Equal estimates pool to a narrower interval; estimates ten standard errors apart do not."""
    same = pooled(np.array([1.0, 1.0]), np.array([0.1, 0.1]), np.array([20.0, 20.0]))
    apart = pooled(np.array([0.5, 1.5]), np.array([0.1, 0.1]), np.array([20.0, 20.0]))
    assert same[2] - same[1] < 2 * 1.96 * 0.1
    assert apart[1] < 0.5 and apart[2] > 1.5


def hinsdale(name):
    """A real trial: mocap pose and IMU on one time base."""
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
def test_real_release_is_found_and_fitted():
    """A BlueROV2 with an arm, let go by hand: roll and pitch ring with periods of about 3 s, lightly damped."""
    trial = hinsdale("traj005-1")
    for axis in ("roll", "pitch"):
        found = free_decay(trial, axis)
        assert 1.0 < found.begin < 3.5
        assert 2.0 * np.pi / np.sqrt(found.theta[0]) == pytest.approx(3.1, abs=0.25)
        assert 0.03 < found.theta[1] / (2.0 * np.sqrt(found.theta[0])) < 0.25
        assert found.r2 > 0.85


def test_real_trial_without_release_is_refused():
    """The arm stays still and nobody lets go: no decay, not a made-up one."""
    with pytest.raises(CalibrationError, match="does not ring down"):
        free_decay(hinsdale("baseline2"), "roll")
