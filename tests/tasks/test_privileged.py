"""Privileged observations are the drawn deviations from nominal, scaled to about one."""

from __future__ import annotations

import numpy as np
import pytest

from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import Ranges, available
from finssim.tasks import Environment, EnvironmentSetupError, StationKeeping, make

PARTS = {
    "mass": (0.9, 1.3),
    "center_of_gravity": {"z": [-0.02, 0.01]},
    "thrust": {"each": [0.8, 1.1]},
    "current": (0.0, 0.2),
    "sensors": {"delay": [0.0, 0.4]},
}


def environment(worlds=50, **more) -> Environment:
    ranges = Ranges.model_validate({"name": "test", **PARTS})
    return Environment(
        StationKeeping(time_limit=0.5),
        worlds=worlds,
        randomization=Randomization(ranges),
        privileged=True,
        **more,
    )


def test_names_are_those_of_what_varies():
    """Current is given by its components; directions are omitted."""
    each = [f"thrust.each.{k}" for k in range(8)]
    expected = ["mass", "center_of_gravity.z", *each, "sensors.delay", "current.x", "current.y"]
    env = environment()
    assert env.privileged_names == expected
    assert env.arrays.privileged.shape == (50, len(expected))


def test_each_is_the_difference_from_nominal_over_the_farthest_end():
    env = environment()
    found = dict(zip(env.privileged_names, env.arrays.privileged.numpy().T, strict=True))
    plant, water, vehicle = env.simulator.plant, env.simulator.water, env.simulator.vehicles[0]
    mass = plant.mass.numpy()[:, 0] / vehicle.body.mass
    np.testing.assert_allclose(found["mass"], (mass - 1.0) / 0.3, atol=1e-5)
    z = plant.r_g.numpy()[:, 0, 2] - vehicle.body.center_of_gravity[2]
    np.testing.assert_allclose(found["center_of_gravity.z"], z / 0.02, atol=1e-5)
    gain = plant.gain.numpy()[:, 0]
    np.testing.assert_allclose(found["thrust.each.3"], (gain[:, 3] - 1.0) / 0.2, atol=1e-5)
    np.testing.assert_allclose(found["current.x"], water.current.numpy()[:, 0] / 0.2, atol=1e-5)
    np.testing.assert_allclose(found["current.y"], water.current.numpy()[:, 1] / 0.2, atol=1e-5)
    np.testing.assert_allclose(found["sensors.delay"], env._seen.delay.numpy()[:, 0] / 0.4, atol=1e-5)


@pytest.mark.parametrize("name", [n for n in available() if n != "no_thruster_dynamics"])
def test_they_are_of_about_unit_scale_for_every_set(name):
    """They lie within [-1, 1] and use most of it."""
    env = make("t1", worlds=1000, randomize=name, privileged=True)
    x = env.arrays.privileged.numpy()
    assert abs(x).max() <= 1.0 + 1e-5
    assert (abs(x).max(axis=0) > 0.8).all()


def test_those_of_the_episode_that_ended_are_kept():
    """They are needed for the value of the episode's last observation."""
    env = environment()
    before = env.arrays.privileged.numpy().copy()
    for _ in range(5):
        step = env.step(np.zeros((50, 6)))
    assert step.truncated.all()
    np.testing.assert_array_equal(env.arrays.final_privileged.numpy(), before)
    assert (env.arrays.privileged.numpy() != before).mean() > 0.95


def test_without_randomisation_there_are_none():
    with pytest.raises(
        EnvironmentSetupError, match="privileged numbers are what is drawn: give randomization"
    ):
        Environment(StationKeeping(), privileged=True)
    env = Environment(StationKeeping())
    assert env.privileged_names == [] and env.arrays.privileged.shape == (1, 0)


def test_they_change_nothing_of_the_run():
    """They only observe."""
    ranges = Ranges.model_validate({"name": "test", **PARTS})
    plain = Environment(StationKeeping(time_limit=0.5), worlds=50, randomization=Randomization(ranges))
    told = environment()
    for _ in range(12):
        a, b = (env.step(np.full((50, 6), 0.3)).observation for env in (plain, told))
    np.testing.assert_array_equal(a, b)
