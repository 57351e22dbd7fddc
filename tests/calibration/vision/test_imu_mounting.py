"""How an IMU sits in the body comes back from turns that something else saw, and what no motion tells is said."""

from pathlib import Path

import numpy as np
import pytest

from calibration.vision.moving_vehicle import motion
from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision import sensor_mounts
from finssim.calibration.vision.sensor_mounts import (
    Attitude,
    Gyro,
    fit_imu_mounting,
    rotation_between,
    turn_pairs,
)
from finssim.geometry.rotations import (
    quat_conjugate,
    quat_from_rotvec,
    quat_inverse_rotate,
    quat_multiply,
    quat_to_rotvec,
)

HINSDALE = Path(__file__).resolve().parents[2] / "data" / "hinsdale"
MOUNTS = {
    "published flip": np.array([0.0, 0.0, 1.0, 0.0]),
    "as the body": np.array([0.0, 0.0, 0.0, 1.0]),
    "on its side": np.array([0.5, 0.5, -0.5, 0.5]),
    "a little off": np.array([0.02, -0.01, 0.03, 0.0]) + np.array([0.0, 0.0, 0.0, np.sqrt(1 - 14e-4)]),
}
BIAS = np.array([0.01, -0.006, 0.004])


def measured(mount, rng, *, tilt=0.2, noise_deg=0.5, late=0.0, seconds=60.0):
    """Attitude of 10 Hz with noise, and a gyro of 100 Hz in its own axes whose clock is late."""
    at = motion(tilt=tilt).at
    t = np.arange(0.0, seconds, 0.1)
    wobble = quat_from_rotvec(np.radians(noise_deg) * rng.standard_normal((len(t), 3)))
    attitude = Attitude(t=t, quaternion=quat_multiply(at(t).quaternion, wobble))
    fine = np.arange(0.0, seconds, 0.01)
    before, after = at(fine - 0.002).quaternion, at(fine + 0.002).quaternion
    rate = quat_to_rotvec(quat_multiply(quat_conjugate(before), after)) / 0.004
    sensed = quat_inverse_rotate(mount, rate) + BIAS + 0.002 * rng.standard_normal(rate.shape)
    return attitude, Gyro(t=fine - late, rate=sensed)


def degrees_between(a, b):
    return np.degrees(np.linalg.norm(quat_to_rotvec(quat_multiply(a, quat_conjugate(b)))))


@pytest.mark.slow
@pytest.mark.parametrize("name", MOUNTS)
def test_orientation_bias_and_clock_come_back(name):
    """From an attitude that is good to half a degree, whatever the mount, without a first guess."""
    fit = fit_imu_mounting(*measured(MOUNTS[name], np.random.default_rng(2), late=0.12))
    assert degrees_between(fit.orientation, MOUNTS[name]) < 0.4
    np.testing.assert_allclose(fit.gyro_bias, BIAS, atol=2e-3)
    assert fit.time_offset == pytest.approx(0.12, abs=0.01)
    assert all(fit.estimates[f"imu.turn_{axis}"].identifiable for axis in "xyz") and not fit.findings


@pytest.mark.slow
def test_intervals_hold_the_truth():
    """Three angles, over eight recordings; at least 80 % where 95 % are meant."""
    mount, inside = MOUNTS["published flip"], []
    for seed in range(8):
        fit = fit_imu_mounting(*measured(mount, np.random.default_rng(seed), seconds=40.0), start=mount)
        ends = np.array([fit.estimates[f"imu.turn_{axis}"].ci95 for axis in "xyz"])
        inside.append((ends[:, 0] < 0.0) & (ends[:, 1] > 0.0))
    assert np.mean(inside) >= 0.8


@pytest.mark.slow
def test_turning_about_one_axis_leaves_the_turn_about_it_to_the_file():
    """A vehicle that only yaws: how far the IMU is turned about z shows nowhere, its tilt does."""
    start = quat_from_rotvec(np.array([0.0, 0.0, 0.4]))
    true = quat_multiply(quat_from_rotvec(np.array([0.05, -0.03, 0.0])), start)
    attitude, gyro = measured(true, np.random.default_rng(0), tilt=0.0, noise_deg=0.05)
    fit = fit_imu_mounting(attitude, gyro, start=start)
    assert [fit.estimates[f"imu.turn_{a}"].identifiable for a in "xyz"] == [True, True, False]
    assert [one.values["axes"] for one in fit.findings if one.code == "imu_turn_unknown"] == [("z",)]
    assert degrees_between(fit.orientation, true) < 1.0


@pytest.mark.slow
def test_jumps_of_the_attitude_have_no_weight():
    """A tracker that loses the body for moments, and finds it upside down, changes nothing."""
    attitude, gyro = measured(MOUNTS["published flip"], np.random.default_rng(1))
    broken = attitude.quaternion.copy()
    broken[200:215] = quat_multiply(broken[200:215], np.array([1.0, 0.0, 0.0, 0.0]))
    fit = fit_imu_mounting(Attitude(t=attitude.t, quaternion=broken), gyro)
    assert degrees_between(fit.orientation, MOUNTS["published flip"]) < 0.5
    assert fit.rejected >= 5


def test_a_gap_of_the_gyro_is_not_turned_across():
    attitude, gyro = measured(MOUNTS["as the body"], np.random.default_rng(1), noise_deg=0.01)
    keep = (gyro.t < 20.0) | (gyro.t > 23.0)
    pairs = turn_pairs(attitude, 0.5)
    turns = pairs.sensor(Gyro(t=gyro.t[keep], rate=gyro.rate[keep]), 0.0)
    across = (pairs.end > 20.05) & (pairs.start < 22.95)
    apart = (pairs.end < 19.95) | (pairs.start > 23.05) & (pairs.end < 59.0)
    assert np.isnan(turns[across]).all() and np.isfinite(turns[apart]).all()


@pytest.mark.slow
def test_streams_of_different_recordings_are_refused():
    attitude, _ = measured(MOUNTS["as the body"], np.random.default_rng(1))
    still = Gyro(
        t=np.arange(0.0, 60.0, 0.01), rate=1e-3 * np.random.default_rng(0).standard_normal((6000, 3))
    )
    with pytest.raises(CalibrationError, match="do not turn together"):
        fit_imu_mounting(attitude, still)
    with pytest.raises(CalibrationError, match="at least 20"):
        fit_imu_mounting(Attitude(t=attitude.t[:8], quaternion=attitude.quaternion[:8]), still)


def test_a_direction_without_information_stays_as_it_was():
    """Kabsch's rotation of parallel vectors is any; ours is the one nearest to the start."""
    up = np.tile([0.0, 0.0, 1.0], (5, 1))
    start = quat_from_rotvec(np.array([0.0, 0.0, 1.1]))
    assert degrees_between(rotation_between(up, up, np.ones(5), start), start) < 0.01


def load(name):
    """A trial of a real BlueROV2: motion capture and gyro."""
    mocap = np.genfromtxt(HINSDALE / f"{name}_mocap.csv", delimiter=",", names=True)
    imu = np.genfromtxt(HINSDALE / f"{name}_imu.csv", delimiter=",", names=True)
    t, first = np.unique(mocap["time_secs"], return_index=True)
    q = np.stack([mocap[f"{axis}_ori"] for axis in "xyzw"], axis=-1)[first]
    at, once = np.unique(imu["time_secs"], return_index=True)
    rate = np.stack([imu[f"{axis}_angvel"] for axis in "xyz"], axis=-1)[once]
    return Attitude(t=t, quaternion=q / np.linalg.norm(q, axis=1, keepdims=True)), Gyro(t=at, rate=rate)


def residual_of_turns(mounting, attitude, gyro, time_offset):
    """Disagreement of gyro and attitude on a recording, but for its own bias, robust rms [rad]."""
    body, sensor = sensor_mounts._both(turn_pairs(attitude, sensor_mounts.WINDOW), gyro, time_offset)
    residual = quat_inverse_rotate(mounting.orientation, body) - sensor
    residual -= np.median(residual, axis=0)
    size = np.linalg.norm(residual, axis=1)
    usual = size < 4.0 * np.median(size)
    return np.sqrt(np.mean(size[usual] ** 2))


def test_a_real_vehicle_says_the_same_in_two_trials():
    """Motion capture against gyro: fitted to one trial, the other's residual is what its own fit reaches."""
    trials = {name: load(name) for name in ("traj005-1", "traj_alt_009-0")}
    fits = {name: fit_imu_mounting(*trial) for name, trial in trials.items()}
    for one, other in (("traj005-1", "traj_alt_009-0"), ("traj_alt_009-0", "traj005-1")):
        offset = fits[other].time_offset
        own, held_out = (residual_of_turns(fits[name], *trials[other], offset) for name in (other, one))
        assert np.degrees(held_out) < 0.45
        assert held_out < 1.1 * own
    first, second = (fits[name].estimates for name in trials)
    for axis in "xyz":
        a, b = first[f"imu.turn_{axis}"], second[f"imu.turn_{axis}"]
        assert max(a.ci95[0], b.ci95[0]) < min(a.ci95[1], b.ci95[1])
    assert all(abs(fit.time_offset) < 0.04 for fit in fits.values())


def test_a_real_vehicle_that_hardly_turns_is_refused():
    """`baseline2`: 1 degree in half a second at most, and a flip of the motion capture."""
    with pytest.raises(CalibrationError, match="do not turn together"):
        fit_imu_mounting(*load("baseline2"))
