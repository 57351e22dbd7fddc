"""Roll and pitch from gyro and accelerometer: signs, convergence, bias, and accelerations other than gravity."""

import numpy as np
import pytest

from finssim.core.rotations import quat_conjugate, quat_from_euler, quat_rotate, quat_to_euler
from finssim.localization.fusion.attitude import (
    Tilt,
    TiltGains,
    follow,
    height_above_origin,
    in_body_axes,
    roll_pitch,
    tilt_from,
    up_of,
)
from finssim.vehicles import load_vehicle
from localization.fusion.known_streams import GRAVITY, attitude, body_rates, specific_force

GAINS = TiltGains()


def at_rest(roll, pitch):
    """Return an accelerometer's reading at rest, body axes."""
    return quat_rotate(quat_conjugate(quat_from_euler(roll, pitch, 0.7)), [0.0, 0.0, GRAVITY])


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.4, 0.0), (0.0, 0.3), (-1.0, 0.5), (2.5, -1.2)])
def test_gravity_tells_roll_and_pitch(roll, pitch):
    """At rest the accelerometer gives the angles of the attitude, whatever the heading."""
    found = roll_pitch(tilt_from(at_rest(roll, pitch)).up)
    assert found == pytest.approx((roll, pitch))
    np.testing.assert_allclose(up_of(roll, pitch) * GRAVITY, at_rest(roll, pitch), atol=1e-12)


def test_a_point_ahead_sinks_with_the_nose():
    """The height of a point of the body is its component along "up"; nose down, a point ahead is below the origin."""
    rng = np.random.default_rng(1)
    for roll, pitch, *point in rng.uniform(-1.5, 1.5, (20, 5)):
        assert height_above_origin(point, roll, pitch) == pytest.approx(up_of(roll, pitch) @ point)
    assert height_above_origin((1.0, 0.0, 0.0), 0.0, 0.2) == pytest.approx(-np.sin(0.2))


def test_nose_down_is_positive_and_lifts_the_force_off_the_nose():
    """Nose down by 0.2 rad, the body's x axis points down and its reading is negative: -g sin 0.2."""
    accel = np.array([-GRAVITY * np.sin(0.2), 0.0, GRAVITY * np.cos(0.2)])
    assert float(roll_pitch(tilt_from(accel).up)[1]) == pytest.approx(0.2)


def test_the_gyro_alone_follows_a_tilting_path():
    """Without an accelerometer the angles follow those of an exact gyro."""
    dt, t = 0.01, np.arange(0.0, 10.0, 0.01)
    tilt = Tilt(up_of(*quat_to_euler(attitude(0.0))[:2]), np.zeros(3))
    for s in t:
        tilt = follow(tilt, body_rates(s + 0.5 * dt), np.full(3, np.nan), dt, GAINS)
    np.testing.assert_allclose(roll_pitch(tilt.up), quat_to_euler(attitude(10.0))[:2], atol=1e-5)


@pytest.mark.slow
def test_a_wrong_start_and_a_bias_die_away():
    """Starting 0.3 rad off and with a gyro bias of 0.01 rad/s, the angles of a moving vehicle are found to 0.02 rad."""
    rng, dt = np.random.default_rng(0), 0.02
    tilt = Tilt(up_of(0.3, -0.2), np.zeros(3))
    errors = []
    for s in np.arange(0.0, 120.0, dt):
        omega = body_rates(s + 0.5 * dt) + np.array([0.01, -0.01, 0.02])
        force = specific_force(s + dt, (0, 0, 0)) + 0.1 * rng.standard_normal(3)
        tilt = follow(tilt, omega, force, dt, GAINS)
        errors.append(np.array(roll_pitch(tilt.up)) - np.array(quat_to_euler(attitude(s + dt))[:2]))
    settled = np.array(errors[len(errors) // 2 :])
    assert np.sqrt(np.mean(settled**2, axis=0)).max() < 0.02
    np.testing.assert_allclose(tilt.bias[:2], [0.01, -0.01], atol=0.004)


def test_a_hard_push_is_not_taken_for_gravity():
    """Two seconds of 5 m/s² sideways tilt the estimate by less than a degree; taken as gravity, by 27 degrees."""
    tilt = tilt_from(np.array([0.0, 0.0, GRAVITY]))
    for _ in range(200):
        tilt = follow(tilt, np.zeros(3), np.array([0.0, 5.0, GRAVITY]), 0.01, GAINS)
    assert abs(float(roll_pitch(tilt.up)[0])) < np.radians(1.5)


def test_the_mounting_of_the_vehicle_file_is_respected():
    """FinsROV's IMU has x backwards and y to the right: half a turn about z."""
    orientation = load_vehicle("finsrov").sensors.imu.orientation
    np.testing.assert_allclose(in_body_axes([1.0, 2.0, 3.0], orientation), [-1.0, -2.0, 3.0], atol=1e-12)


def test_a_batch_is_its_runs():
    """A leading axis changes no number."""
    rng = np.random.default_rng(1)
    up = tilt_from(rng.standard_normal((4, 3)))
    omega, force = rng.standard_normal((4, 3)), rng.standard_normal((4, 3)) + [0, 0, GRAVITY]
    together = follow(up, omega, force, 0.01, GAINS)
    for i in range(4):
        one = follow(Tilt(up.up[i], up.bias[i]), omega[i], force[i], 0.01, GAINS)
        np.testing.assert_allclose(together.up[i], one.up, rtol=1e-13)
