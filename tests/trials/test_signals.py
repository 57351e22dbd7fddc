"""Measured or derived velocity, acceleration and attitude of the body origin, against a known motion."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import quat_from_rotvec, quat_inverse_rotate, quat_multiply, quat_to_euler
from finssim.trials.conversion import merged
from finssim.trials.motion import gyroscope_bias, holds_gravity, motion
from finssim.trials.trial import Header, Trial, TrialWater
from finssim.vehicles import load_vehicle
from identification.moving_body import MovingBody

VEHICLE = load_vehicle("bluerov2")
POINT = (0.3, -0.2, 0.15)
T = np.arange(1000) * 0.01


def trial(channels, t=T, **header):
    """Return a trial of these columns, with the thrusters off."""
    return Trial(name="made", t=t, channels=channels, header=Header(**({"passive": True} | header)))


def inner(m, margin=0.5):
    """Return the rows away from the ends, where derivatives are most accurate."""
    return (m.t > m.t[0] + margin) & (m.t < m.t[-1] - margin)


def assert_close(values, truth, rows, atol):
    """Assert that the given rows are finite and equal the truth up to atol."""
    assert np.isfinite(values[rows]).all()
    np.testing.assert_allclose(values[rows], truth[rows], atol=atol)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("turns", [False, True])
def test_what_is_measured_at_the_origin_is_the_motion(seed, turns):
    """This holds upside down too; what was not measured stays unknown."""
    body = MovingBody(seed, turns=turns)
    m = motion(trial(body.columns(T, "velocity", "rates", "quaternion")), VEHICLE)
    assert_close(m.nu, body.nu(m.t), inner(m), 1e-5)
    blind = motion(trial(body.columns(T, "velocity", "rates")), VEHICLE)
    assert np.isnan(blind.quaternion).all() and np.isnan(blind.position).all()


def test_acceleration_without_gravity_is_recognised():
    """Kinematic accelerations, as from optical systems, are distinguished from specific force by their size."""
    body = MovingBody(3)
    channels = body.columns(T, "velocity", "rates", "quaternion", "acceleration")
    f = np.stack([channels[name] for name in ("ax", "ay", "az")], axis=-1)
    kinematic = f + quat_inverse_rotate(body.quaternion(T), np.array([0.0, 0.0, -9.81]))
    for values, kind, gravity in (
        (f, "auto", True),
        (f, "specific_force", True),
        (kinematic, "auto", False),
        (kinematic, "kinematic", False),
    ):
        made = channels | dict(zip(("ax", "ay", "az"), values.T, strict=True))
        assert holds_gravity(trial(made, acceleration=kind), 9.81) == gravity


def test_a_velocity_measured_elsewhere_is_moved_to_the_origin():
    """v_O = v_P - ω × r_P, smoothed and as sampled."""
    body = MovingBody(4)
    channels = body.columns(T, "rates") | body.columns(T, "velocity", at=POINT)
    m = motion(trial(channels, velocity_at=POINT), VEHICLE)
    assert m.nu_source == ("measured",) * 6
    assert_close(m.nu, body.nu(m.t), inner(m), 1e-4)
    assert_close(m.raw, body.nu(m.t), inner(m), 1e-4)


def test_a_velocity_through_moving_water_becomes_one_over_ground():
    """This needs the current in the header; otherwise nu stays relative to the water."""
    body = MovingBody(5)
    current = np.array([0.3, -0.2, 0.0])
    channels = body.columns(T, "velocity", "rates", "quaternion")
    through_water = body.velocity(T) - quat_inverse_rotate(body.quaternion(T), current)
    channels |= dict(zip("uvw", through_water.T, strict=True))
    known = motion(trial(channels, velocity="water", water=TrialWater(current=tuple(current))), VEHICLE)
    assert_close(known.nu, body.nu(T), inner(known), 1e-4)
    unknown = motion(trial(channels, velocity="water"), VEHICLE)
    assert_close(unknown.nu[:, :3], through_water, inner(unknown), 1e-4)


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("form", ["quaternion", "euler"])
def test_rates_come_from_the_attitude_where_there_is_no_gyro(form, turns):
    """This holds also through a full roll, where Euler angles jump."""
    body = MovingBody(6, turns=turns)
    m = motion(trial(body.columns(T, form)), VEHICLE)
    assert m.nu_source == ("", "", "", *("derived from attitude",) * 3)
    assert_close(m.nu[:, 3:], body.omega(m.t), inner(m), 1e-3)
    same = np.abs(np.sum(m.quaternion * body.quaternion(m.t), axis=1))
    np.testing.assert_allclose(same[inner(m)], 1.0, atol=1e-6)


@pytest.mark.parametrize("height", ["position", "depth"])
def test_velocities_come_from_position_where_none_is_measured(height):
    """A marker away from the origin gives position, with the height from it or from a pressure sensor
    elsewhere."""
    body = MovingBody(7)
    port = (-0.1, 0.05, -0.2)
    channels = body.columns(T, "quaternion") | body.columns(T, "position", at=POINT)
    if height == "depth":
        del channels["z"]
        channels |= body.columns(T, "depth", at=port)
    m = motion(trial(channels, position_at=POINT, depth_at=port), VEHICLE)
    assert m.nu_source[:3] == ("derived from position",) * 2 + (f"derived from {height}",)
    assert_close(m.nu, body.nu(m.t), inner(m), 2e-3)
    assert_close(m.position, body.position(m.t), inner(m), 1e-4)


def test_heave_comes_from_depth_beside_a_measured_surge():
    """z_dot = up · v, solved for w."""
    body = MovingBody(8)
    channels = body.columns(T, "velocity", "quaternion", "depth")
    del channels["w"]
    m = motion(trial(channels), VEHICLE)
    assert m.nu_source[:3] == ("measured", "measured", "derived from depth")
    assert_close(m.nu, body.nu(m.t), inner(m), 2e-3)


def test_a_level_vehicle_needs_only_its_heading():
    """With an overhead camera x, y and yaw give surge, sway and yaw rate; roll, pitch and heave stay unknown."""
    body = MovingBody(9)
    body.sizes[2:5] = 0.0
    channels = body.columns(T, "position", "euler")
    m = motion(trial({name: channels[name] for name in ("x", "y", "yaw")}), VEHICLE)
    assert m.nu_source == ("derived from position",) * 2 + ("",) * 3 + ("derived from attitude",)
    assert_close(m.nu[:, [0, 1, 5]], body.nu(m.t)[:, [0, 1, 5]], inner(m), 2e-3)
    assert np.isnan(m.nu[:, 2:5]).all() and np.isnan(m.quaternion).all()
    assert m.findings[0].code in ("wrench_zero", "taken_level")


def test_what_nothing_tells_stays_unknown():
    """A gyro alone gives only rates, half a tilt gives no attitude, and a position without heading no
    velocity."""
    body = MovingBody(10)
    gyro = motion(trial(body.columns(T, "rates")), VEHICLE)
    assert gyro.nu_source == ("", "", "", "measured", "measured", "measured")
    assert np.isnan(gyro.nu[:, :3]).all() and gyro.valid[5:-5].all()
    half = motion(trial({"roll": body.columns(T, "euler")["roll"], "r": T * 0.0}), VEHICLE)
    assert np.isnan(half.quaternion).all()
    lost = motion(trial({name: body.columns(T, "position")[name] for name in "xy"} | {"r": T * 0.0}), VEHICLE)
    assert np.isnan(lost.nu[:, :3]).all()


def test_a_tilt_without_heading_is_a_tilt():
    """Roll and pitch come from an inertial sensor, with a heading of 0."""
    body = MovingBody(11)
    channels = body.columns(T, "velocity", "rates", "euler")
    del channels["yaw"]
    m = motion(trial(channels), VEHICLE)
    roll, pitch, _ = quat_to_euler(m.quaternion)
    np.testing.assert_allclose(roll[inner(m)], channels["roll"][inner(m)], atol=1e-5)
    np.testing.assert_allclose(pitch[inner(m)], channels["pitch"][inner(m)], atol=1e-5)


def test_streams_of_different_rates_and_jitter_come_onto_one_grid():
    """Velocity at 8 Hz, gyro at 100 Hz, depth at 20 Hz and attitude at 50 Hz, all with jitter."""
    body = MovingBody(12, fastest=1.5)
    rng = np.random.default_rng(0)
    streams = {}
    for rate, groups in ((8.0, ["velocity"]), (100.0, ["rates"]), (20.0, ["depth"]), (50.0, ["quaternion"])):
        n = int(10.0 * rate)
        t = (np.arange(n) + 0.3 * rng.uniform(-1.0, 1.0, n)) / rate + 0.01
        streams |= {name: (t, values) for name, values in body.columns(t, *groups).items()}
    t, channels = merged(streams)
    m = motion(trial(channels, t=t, depth_at=(0.0, 0.0, 0.0)), VEHICLE)
    assert m.rate == pytest.approx(100.0, rel=0.05)
    np.testing.assert_allclose(np.diff(m.t), 1.0 / m.rate)
    assert_close(m.nu, body.nu(m.t), inner(m), 5e-3)


def test_five_hertz_of_wrench_and_velocity():
    """The poorest usable log has six velocities and a wrench at 5 Hz."""
    body = MovingBody(13, fastest=1.5)
    t = np.arange(75) * 0.2
    channels = body.columns(t, "velocity", "rates") | {"tau_x": np.sin(t)}
    m = motion(trial(channels, t=t, passive=False, wrench_at="origin"), VEHICLE)
    assert m.rate == pytest.approx(5.0) and m.valid.all()
    assert_close(m.nu, body.nu(m.t), inner(m), 2e-3)
    np.testing.assert_allclose(m.tau[:, 0], np.sin(m.t), atol=1e-9)
    np.testing.assert_array_equal(m.tau[:, 1:], 0.0)


def test_a_gap_is_left_open_and_is_not_valid():
    """Velocity is unknown for two seconds, and as accurate as elsewhere on both sides."""
    body = MovingBody(14)
    channels = body.columns(T, "velocity", "rates")
    hole = (T > 4.0) & (T < 6.0)
    for name in "uvw":
        channels[name] = np.where(hole, np.nan, channels[name])
    m = motion(trial(channels), VEHICLE)
    assert np.isnan(m.nu[hole, :3]).all() and not m.valid[hole].any()
    assert_close(m.nu, body.nu(m.t), ~hole & inner(m), 1e-4)
    assert m.valid[~hole].all()


def test_noise_is_estimated_by_axis():
    """White noise of a different size on every axis is estimated to about a tenth."""
    body = MovingBody(15)
    rng = np.random.default_rng(0)
    sizes = np.array([0.01, 0.03, 0.002, 0.05, 0.005, 0.02])
    channels = body.columns(T, "velocity", "rates")
    noisy = {
        name: values + size * rng.normal(size=len(T))
        for size, (name, values) in zip(sizes, channels.items(), strict=True)
    }
    m = motion(trial(noisy), VEHICLE)
    np.testing.assert_allclose(m.noise_std, sizes, rtol=0.12)
    assert np.all(np.std((m.nu - body.nu(m.t))[inner(m)], axis=0) < 0.4 * sizes)


def test_phases_and_the_wrench_ride_along():
    """Phases hold from their row on; the wrench is about the body origin; rows outside the inputs are
    invalid."""
    body = MovingBody(16)
    channels = body.columns(T, "velocity") | {"tau_z": np.where(T < 8.0, 2.0, np.nan)}
    made = trial(channels, passive=False, wrench_at=(0.5, 0.0, 0.0))
    made = replace(made, phase=np.where(T < 3.0, "baseline", np.where(T < 7.0, "excitation", "")))
    m = motion(made, VEHICLE)
    assert [str(m.phase[np.argmin(abs(m.t - s))]) for s in (1.0, 2.98, 3.0, 6.9, 9.0)] == [
        "baseline", "baseline", "excitation", "excitation", "",
    ]  # fmt: skip
    np.testing.assert_allclose(m.tau[10], [0.0, 0.0, 2.0, 0.0, -1.0, 0.0])
    assert m.valid[m.t < 7.9].all() and not m.valid[m.t > 8.1].any()


@pytest.mark.parametrize("bias", [(0.0, 0.0, 0.0), (0.005, -0.003, 0.008)])
def test_the_bias_of_a_gyroscope_is_its_difference_from_the_attitude(bias):
    """It is right to 0.3 mrad/s with noise on both; 0 if noise explains the difference or no attitude was
    measured."""
    rng, t = np.random.default_rng(3), np.arange(3000) * 0.02
    body = MovingBody(4)
    columns = body.columns(t, "rates", "quaternion")
    for name, b in zip("pqr", bias, strict=True):
        columns[name] = columns[name] + b + 0.002 * rng.standard_normal(len(t))
    noisy = quat_multiply(
        np.column_stack([columns[f"q{c}"] for c in "xyzw"]),
        quat_from_rotvec(0.003 * rng.standard_normal((len(t), 3))),
    )
    columns |= {f"q{c}": noisy[:, i] for i, c in enumerate("xyzw")}
    found = gyroscope_bias(motion(trial(columns, t), VEHICLE))
    np.testing.assert_allclose(found, bias, atol=3e-4)
    rates = {name: columns[name] for name in "pqr"}
    assert not gyroscope_bias(motion(trial(rates, t), VEHICLE)).any()
