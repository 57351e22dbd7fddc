"""A compass reads the heading, wherever the vehicle leans, with its offset and noise."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from finssim.core.rotations import quat_from_euler
from finssim.physics.types import vec6
from finssim.sim.sensors import SensorSuite
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import with_navigation

WORLDS = 2000


def state(q):
    """Vehicles at rest, all turned alike."""
    full = lambda value, dtype: wp.full((WORLDS, 1), value=value, dtype=dtype, device="cpu")  # noqa: E731
    return SimpleNamespace(
        position=full(wp.vec3(0.0, 0.0, -3.0), wp.vec3), quaternion=full(wp.quat(*map(float, q)), wp.quat),
        velocity=full(vec6(), vec6), acceleration=full(vec6(), vec6),
        steps=wp.zeros(WORLDS, dtype=int, device="cpu"), episode=wp.zeros(WORLDS, dtype=int, device="cpu"),
    )  # fmt: skip


@pytest.mark.parametrize("yaw", [-2.5, 0.0, 1.2])
def test_the_heading_is_that_of_the_body_with_offset_and_noise(yaw):
    """Leaning by 20° changes nothing; over worlds the spread is that of offset and noise together."""
    vehicle = with_navigation(load_vehicle("bluerov2_heavy"))
    suite = SensorSuite(vehicle, worlds=WORLDS, control_step=0.05, seed=4)
    suite.reset(state(quat_from_euler(0.35, -0.2, yaw)))
    entry = vehicle.sensors.compass
    read = suite.compass.numpy()["heading"][:, 0] if hasattr(suite.compass, "numpy") else None
    error = np.array([math.remainder(float(x) - yaw, math.tau) for x in read])
    spread = math.hypot(entry.noise_std, entry.bias_initial)
    assert abs(error.mean()) < 5.0 * spread / math.sqrt(WORLDS)
    assert error.std() == pytest.approx(spread, rel=0.1)


def test_a_vehicle_without_one_has_none():
    """Nothing is launched for it."""
    assert SensorSuite(load_vehicle("finsrov"), worlds=1, control_step=0.05).compass is None
