"""Ideal sensors obey mechanics."""

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler, quat_inverse_rotate, quat_multiply
from finssim.extensions.ros2.worlds.sim import IdealSensors
from finssim.robot.reading import Reading
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("finsrov")
MOUNT = np.array(VEHICLE.sensors.imu.orientation)
TURN = np.asarray(quat_from_euler(0.2, -0.1, 1.0))


def reading(nu, time=0.0):
    """Return the reading of a tilted vehicle."""
    return Reading(time, np.array([0.0, 0.0, -0.8]), TURN, np.array(nu, float), True)


def test_at_rest_the_specific_force_is_upwards():
    """f = R_sw g z, |f| = g; the gyro reads zero."""
    sample = IdealSensors(VEHICLE).sample(reading(np.zeros(6)), 0.01)
    up = quat_inverse_rotate(quat_multiply(TURN, MOUNT), (0.0, 0.0, VEHICLE.water.gravity))
    assert sample.accel == pytest.approx(tuple(up)) and sample.gyro == pytest.approx((0.0,) * 3)


def test_a_change_of_velocity_is_felt():
    """f - g = Δv / Δt in sensor axes; rates are those of the body, turned by the mount."""
    sensors = IdealSensors(VEHICLE)
    rest = sensors.sample(reading(np.zeros(6)), 0.01)
    moved = sensors.sample(reading([0.05, 0.0, 0.0, 0.1, 0.2, 0.3]), 0.01)
    felt = np.array(moved.accel) - np.array(rest.accel)
    assert felt == pytest.approx(quat_inverse_rotate(MOUNT, (5.0, 0.0, 0.0)))
    assert moved.gyro == pytest.approx(tuple(quat_inverse_rotate(MOUNT, (0.1, 0.2, 0.3))))
    sensors.reset()
    assert sensors.sample(reading(np.zeros(6)), 0.01).accel == pytest.approx(rest.accel)


def test_pressure_is_that_of_the_water_above_the_port():
    """Pressure is p = p0 + rho g d."""
    sample = IdealSensors(VEHICLE).sample(reading(np.zeros(6)), 0.01)
    water = VEHICLE.water
    assert sample.pressure - 101_325.0 == pytest.approx(water.density * water.gravity * sample.depth)
    assert sample.depth == pytest.approx(0.8, abs=0.3)
