"""Synthetic trials obey the equations of motion row by row, and have the requested noise."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import quat_rotate
from finssim.identification.programme import programmes
from finssim.identification.synthetic import (
    NOISE_PROFILES,
    NoiseProfile,
    record,
    simulate_programme,
    trials_of,
)
from finssim.sim import Water
from finssim.trials.findings import CalibrationError
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
SURGE = programmes("surge", FINSROV, levels=[12.0])
M = 12.11 + 15.0346985  # m + M_A of surge, finsrov.yaml
D1 = 39.073593


@pytest.mark.parametrize("rate", [50.0, 5.0])
def test_momentum_between_rows_is_the_impulse_of_the_inputs(rate):
    """m Δu = ∫ (tau - d1 u) dt from row to row: states and inputs are both at t_k."""
    trial = simulate_programme(SURGE, FINSROV, noise="none", spread=0.0, rate=rate)[0]
    u, tau, x = (trial.channels[c] for c in ("u", "tau_x", "x"))
    heading = trial.channels["qz"][0], trial.channels["qw"][0]
    assert heading == pytest.approx((0.0, 1.0), abs=1e-6)
    missing = M * np.diff(u) + D1 * np.diff(x) - 0.5 * (tau[1:] + tau[:-1]) / rate
    # The trapezoidal rule errs by dt³ tau''/12 where motors start.
    scale = 12.0 / rate
    assert np.abs(missing).max() < 0.12 * scale
    assert abs(missing.sum()) < 2e-3 * scale


def test_accelerometer_reads_the_acceleration_of_its_place_and_gravity():
    """f = R^T (a_point + g up), with the point's acceleration differenced from its own path."""
    vehicle = FINSROV.replace({"sensors.imu.position": [0.2, 0.1, -0.05]})
    plan = programmes("all", vehicle, kind="multisine", duration=30.0)
    trial = simulate_programme(plan, vehicle, noise="none", rate=200.0)[0]
    q = np.stack([trial.channels[f"q{c}"] for c in "xyzw"], axis=-1)
    v = np.stack([trial.channels[c] for c in "uvw"], axis=-1)
    omega = np.stack([trial.channels[c] for c in "pqr"], axis=-1)
    r = np.array([0.2, 0.1, -0.05])
    velocity_w = quat_rotate(q, v + np.cross(omega, r))
    acceleration_w = (velocity_w[2:] - velocity_w[:-2]) * 100.0
    f = np.stack([trial.channels[f"a{c}"] for c in "xyz"], axis=-1)
    felt = quat_rotate(q, f)[1:-1] - [0.0, 0.0, 9.81]
    moving = np.abs(acceleration_w).max()
    assert np.median(np.abs(felt - acceleration_w)) < 0.02 * moving


@pytest.mark.slow
def test_equal_seeds_give_equal_trials():
    """Trials of equal seeds are bit-identical; other seeds give other motion and noise."""
    digest = [t.sha256 for t in simulate_programme(SURGE, FINSROV, seed=4)]
    assert digest == [t.sha256 for t in simulate_programme(SURGE, FINSROV, seed=4)]
    assert not set(digest) & {t.sha256 for t in simulate_programme(SURGE, FINSROV, seed=5)}
    assert len(set(digest)) == len(SURGE)


def test_noise_can_be_drawn_again_over_one_motion():
    """Two seeds for one recording differ by noise alone, of the profile's size."""
    recording = record(SURGE, FINSROV, seed=1)
    truth, a, b = (
        trials_of(recording, SURGE, FINSROV, noise=noise, seed=seed)[0]
        for noise, seed in (("none", 0), ("sensors", 1), ("sensors", 2))
    )
    assert (a.channels["rpm_H_LF"] == b.channels["rpm_H_LF"]).all()
    for column, std in (("u", 0.01), ("x", 0.01)):
        errors = np.concatenate([x.channels[column] - truth.channels[column] for x in (a, b)])
        assert errors.std() == pytest.approx(std, rel=0.1)  # 1400 samples: 2 % standard error


def test_the_vehicles_own_sensors_measure():
    """Depth is sampled at the sensor's 20 Hz with its quantisation; the gyroscope has a bias that is constant
    in a trial."""
    trial = simulate_programme(SURGE, FINSROV, noise="sensors", seed=2)[0]
    t, depth = trial.series("depth")
    assert len(t) == pytest.approx(20.0 * trial.duration, abs=2)
    np.testing.assert_allclose(depth / 0.002, np.round(depth / 0.002), atol=0.02)  # float32 at 20 m
    truth = simulate_programme(SURGE, FINSROV, noise="none", seed=2)[0]
    bias = trial.channels["p"] - truth.channels["p"]
    halves = bias[: len(bias) // 2].mean(), bias[len(bias) // 2 :].mean()
    assert halves[0] == pytest.approx(
        halves[1], abs=4e-4
    )  # white part 2.5 mrad/s over 350 samples: 0.13 mrad/s
    assert abs(halves[0]) < 5 * 5e-3


def test_a_row_has_the_newest_sample_and_the_commands_from_then_on():
    """An ideal gyro reads the true rate of the row, and the thrusts add up to the requested wrench."""
    names = ("gyro_noise_density", "gyro_bias_walk", "gyro_bias_initial", "gyro_quantisation", "latency")
    vehicle = FINSROV.replace({f"sensors.imu.{name}": 0.0 for name in names})
    plan = programmes("yaw", vehicle, levels=[1.0])[:1]
    recording = record(plan, vehicle)
    noise = NoiseProfile(own_sensors=True)
    (trial,) = trials_of(recording, plan, vehicle, noise=noise, inputs=("command",))
    every = round(0.02 / recording.step)
    true = recording.velocity[::every, 0, 5][: len(trial.t)]
    np.testing.assert_allclose(trial.channels["r"], true, atol=1e-5)
    thrusts = np.stack([trial.channels[f"command_{name}"] for name in vehicle.thruster_names], axis=-1)
    asked = np.repeat(plan[0].tau_desired[:, 5], round(50.0 / plan[0].rate))
    given = thrusts @ vehicle.thruster_matrix()[5]
    np.testing.assert_allclose(given[: len(asked)], asked, atol=0.02)


def test_published_noise_takes_velocity_from_noisy_positions():
    """A local parabola of 1 s over 5 cm of noise at 50 Hz leaves std² = 12 σ² / (N T²) of velocity error."""
    recording = record(SURGE, FINSROV, seed=1)
    noise = replace(NOISE_PROFILES["published"], yaw_std=0.0, attitude_std=0.0)
    measured = trials_of(recording, SURGE, FINSROV, noise=noise, seed=3)
    truth = trials_of(recording, SURGE, FINSROV, noise="none")
    errors = [m.channels["v"] - t.channels["v"] for m, t in zip(measured, truth, strict=True)]
    expected = 0.05 * np.sqrt(12.0 / 51.0) / 1.0
    assert np.concatenate([e[50:-50] for e in errors]).std() == pytest.approx(expected, rel=0.2)


def test_a_plant_may_differ_from_the_file():
    """A weaker propeller slows the vehicle with unchanged telemetry; a current carries it away."""
    nominal = simulate_programme(SURGE, FINSROV, noise="none", spread=0.0)[0]
    weak = simulate_programme(SURGE, FINSROV, noise="none", spread=0.0, plant={"gain": np.full(8, 0.8)})[0]
    np.testing.assert_allclose(weak.channels["tau_x"], nominal.channels["tau_x"], atol=1e-6)
    end = nominal.phase == "excitation"
    assert weak.channels["u"][end][-1] == pytest.approx(0.8 * nominal.channels["u"][end][-1], rel=1e-3)
    adrift = simulate_programme(
        SURGE, FINSROV, noise="none", spread=0.0, water=Water(current=(0.0, 0.1, 0.0))
    )[0]
    # It also turns a little: a current from the side and forward motion give a Munk moment.
    assert np.diff(adrift.channels["y"])[-1] * 50.0 == pytest.approx(0.1, rel=0.05)
    assert adrift.header.water.current == (0.0, 0.1, 0.0)


def test_worlds_may_have_plants_of_their_own():
    """A value given for each world acts in that world."""
    gain = np.stack([np.full(8, 1.0), np.full(8, 0.5)])
    plus, minus = simulate_programme(SURGE, FINSROV, noise="none", spread=0.0, plant={"gain": gain})
    assert minus.channels["u"][500] == pytest.approx(-0.5 * plus.channels["u"][500], rel=1e-3)


def test_a_log_may_hold_few_columns_slowly():
    """A log with 5 Hz of wrench and velocity alone has pulse widths that the file converts back to the
    requested thrust."""
    trial = simulate_programme(SURGE, FINSROV, rate=5.0, columns=("u", "r"), inputs=("wrench",))[0]
    assert set(trial.channels) == {"tau_x", "tau_y", "tau_z", "tau_k", "tau_m", "tau_n", "u", "r"}
    assert np.diff(trial.t) == pytest.approx(0.2)
    assert len(trial.phase) == len(trial.t) == 70
    six = load_vehicle("bluerov2")
    plan = programmes("surge", six, levels=[0.5, 20.0])
    weak, *_, strong = simulate_programme(plan, six, noise="none", spread=0.0, inputs=("pwm", "command"))
    assert strong.header.inputs == "commanded"
    for name, thruster in six.thrusters.items():
        thrust = thruster.thrust(thruster.shaft_speed(strong.channels[f"pwm_{name}"]))
        np.testing.assert_allclose(thrust, strong.channels[f"command_{name}"], atol=1e-5)
        # Within the dead band nothing turns, although 0.2 N were requested.
        assert not weak.channels[f"command_{name}"].any()
    assert abs(weak.channels["u"]).max() < 1e-3 < abs(strong.channels["u"]).max()


@pytest.mark.slow
def test_a_dive_ends_when_the_ascent_is_steady():
    """A buoyant vehicle's coast stops 2 s after it rises faster than 1 cm/s; a trimmed one coasts for 30 s."""
    plan = [p for p in programmes("heave", FINSROV, levels=[9.0]) if "dive" in p.name]
    trimmed = simulate_programme(plan, FINSROV)[0]
    buoyant = simulate_programme(plan, FINSROV.replace({"body.displaced_volume": 0.0122}))[0]
    assert trimmed.duration == pytest.approx(42.0, abs=0.1)
    assert 13.0 < buoyant.duration < 20.0
    assert buoyant.phase[-1] == "coast"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"rate": 30.0}, "expected 200 Hz over an integer"),
        ({"columns": ("speed",)}, "no column 'speed'"),
        ({"inputs": ("current",)}, "unknown input 'current'"),
        ({"inputs": ("pwm",)}, "no 'esc'"),
        ({"noise": "loud"}, "available: none, sensors, published"),
        ({"plant": {"drag": 1.0}}, "no field 'drag'"),
        ({"plant": {"gain": np.ones(3)}}, r"plant.gain has shape \(3,\)"),
    ],
)
def test_what_cannot_be_is_refused(arguments, sentence):
    """Bad arguments are named together with the valid ones."""
    with pytest.raises(ValueError, match=sentence):
        simulate_programme(SURGE[:1], FINSROV, **arguments)


def test_noise_must_be_finite_and_positive():
    """A negative standard deviation is refused."""
    with pytest.raises(CalibrationError, match="velocity_std is -1"):
        NoiseProfile(velocity_std=-1.0)
