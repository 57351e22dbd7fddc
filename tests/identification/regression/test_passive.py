"""Trials without thrust: frequency and damping of a ring-down, speed and buoyancy of a rise, and what was assumed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler
from finssim.identification.regression.passive import free_motion, passive
from finssim.identification.regression.regress import regress
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import Header, Trial
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
    best = free_motion([decay(w2, c1, c2, seed=1, axis=axis)], axis, VEHICLE)[0]
    # The rate is largest a quarter period after the release.
    assert 3.0 <= best.releases[0].begin < 3.0 + 0.5 * np.pi / np.sqrt(w2)
    assert best.terms == (c1 > 0.0, c2 > 0.0)
    np.testing.assert_allclose(best.theta, (w2, 0.0, c1, c2), rtol=0.03)
    assert best.r2 > 0.95


@pytest.mark.slow
def test_intervals_of_a_ring_down_cover():
    """95 % intervals of w2 and c1 hold the truth in most of 20 noisy decays."""
    hits = np.zeros(2)
    for seed in range(20):
        trial = decay(5.0, 0.5, 0.0, seed=seed, duration=12.0)
        one = free_motion([trial], "roll", VEHICLE, terms=(True, False))[0]
        ends = [one.interval(lambda ratios, i=i: ratios[i])[1:] for i in (0, 2)]
        hits += [low <= truth <= high for (low, high), truth in zip(ends, (5.0, 0.5), strict=True)]
    assert (hits >= 16).all()  # 19 expected


def test_a_moving_equilibrium_is_followed():
    """A trim that drifts, as under a moving arm, does not bend the damping."""
    best = free_motion([decay(4.0, 0.4, 0.0, seed=2, drift=0.02, duration=16.0)], "roll", VEHICLE)[0]
    assert best.releases[0].pieces
    assert best.theta[2] == pytest.approx(0.4, rel=0.1)


def test_a_trial_at_rest_is_refused_with_the_reason():
    """Noise alone does not ring down."""
    quiet = decay(4.0, 0.4, 0.0, seed=3, angle=0.03, trim=0.03)
    with pytest.raises(CalibrationError, match="does not ring down"):
        free_motion([quiet], "roll", VEHICLE)
    with pytest.raises(CalibrationError, match="was not measured"):
        free_motion([replace(quiet, channels={})], "roll", VEHICLE)


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
    heavy = passive(trials, VEHICLE, axes=["roll"], known={"roll": 0.4}).estimates
    assert "given inertia" in heavy["roll.k"].note
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
    rise = Trial(name="rise", t=t, channels={"depth": -noisy}, header=Header(passive=True))
    best = free_motion([rise], "heave", VEHICLE)[0]
    assert best.terms == (not quadratic, quadratic)
    shown = passive([rise], VEHICLE, axes=["heave"]).estimates
    assert shown["heave.terminal_speed"].estimate == pytest.approx(top, rel=0.02)
    assert best.theta[1] == pytest.approx(e, rel=0.05)
    _, low, high = best.interval(lambda ratios: ratios[1])
    assert low < e < high


def test_a_file_that_sinks_where_the_vehicle_rises_is_said():
    """A rise contradicts a file heavier than water, even where the excess is known too badly to be written."""
    t = np.arange(0.0, 20.0, 0.05)
    w = 0.2 * (1.0 - np.exp(-np.maximum(t - 2.0, 0.0) / 2.5))
    z = -3.0 + np.cumsum(w) * 0.05 + 0.01 * np.random.default_rng(1).normal(size=len(t))
    rise = Trial(name="rise", t=t, channels={"depth": -z}, header=Header(passive=True))
    sinks = VEHICLE.replace({"body.displaced_volume": 0.995 * VEHICLE.weight / 9810.0})
    said = [
        one for one in passive([rise], sinks, axes=["heave"]).findings if one.code == "buoyancy_contradicted"
    ]
    assert [one.subject for one in said] == ["heave"]


@pytest.mark.slow
def test_releases_that_disagree_widen_the_interval():
    """Equal decays give a narrow interval; two whose frequencies differ by a fifth give one that holds both."""
    (same, apart) = (
        passive([decay(4.0, 0.4, 0.0, seed=0), decay(w2, 0.4, 0.0, seed=1)], VEHICLE, axes=["roll"])
        for w2 in (4.0, 5.8)
    )
    low, high = same.estimates["roll.natural_frequency"].ci95
    assert high - low < 0.02
    low, high = apart.estimates["roll.natural_frequency"].ci95
    assert low < 2.02 and high > 2.38


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
        best = free_motion([trial], axis, VEHICLE)[0]
        assert 1.0 < best.releases[0].begin < 3.5
        assert 2.0 * np.pi / np.sqrt(best.theta[0]) == pytest.approx(3.1, abs=0.25)
        assert 0.03 < best.theta[2] / (2.0 * np.sqrt(best.theta[0])) < 0.25
        assert best.r2 > 0.85


def test_real_trial_without_release_is_refused():
    """The arm stays still and nobody lets go: no decay, not a made-up one."""
    with pytest.raises(CalibrationError, match="does not ring down"):
        free_motion([hinsdale("baseline2")], "roll", VEHICLE)
