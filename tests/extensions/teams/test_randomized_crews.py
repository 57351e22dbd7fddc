"""Randomisation of every task, and of worlds with several vehicles: each vehicle is drawn separately."""

from __future__ import annotations

import numpy as np
import pytest

from finssim.tasks import make, numeric_tasks

NUMERIC = numeric_tasks()


@pytest.mark.slow
@pytest.mark.parametrize("task", NUMERIC)
def test_every_task_runs_with_drawn_vehicles_and_privileged_numbers(task):
    """Each agent's numbers are those of its own vehicle; runs of equal seeds are equal."""
    found = []
    for _ in range(2):
        env = make(task, worlds=20, randomize="fossen_learn_to_swim", privileged=True, seed=5, threads=1)
        shape = (20, env.action_size) if env.agents == 1 else (20, env.agents, env.action_size)
        for _ in range(3):
            step = env.step(np.full(shape, 0.2, np.float32))
        assert np.isfinite(step.observation).all()
        found.append(step.observation.copy())
    np.testing.assert_array_equal(*found)
    told = env.arrays.privileged.numpy().reshape(20, env.agents, -1)
    assert told.shape[2] == len(env.privileged_names)
    plant, k = env.simulator.plant, env.privileged_names.index("mass")
    for a in range(env.agents):
        mass = plant.mass.numpy()[:, a] / env.simulator.vehicles[a].body.mass
        np.testing.assert_allclose(told[:, a, k], (mass - 1.0) / 0.02, atol=1e-4)
    if len(env.simulator.vehicles) > 1:
        mass = plant.mass.numpy() / [vehicle.body.mass for vehicle in env.simulator.vehicles]
        assert np.ptp(mass, axis=1).min() > 0.0


def test_the_vehicles_of_a_world_share_its_water():
    """They share nothing else: chaser and prey have their own thrusters."""
    env = make("pursuit", worlds=30, randomize="pool", seed=5)
    drawn = env.draws.numpy(["current", "thrust.all"])
    np.testing.assert_array_equal(drawn[:, 0, 0], drawn[:, 1, 0])
    assert (drawn[:, 0, 1] != drawn[:, 1, 1]).all()


@pytest.mark.slow
def test_no_vehicle_of_one_seed_is_another_of_the_next_seeds():
    """Trainings of seeds 1, 2, 3, ... share no vehicle at any index."""
    first, *others = (
        make("pursuit", worlds=4, randomize="fossen_learn_to_swim", seed=1 + k).draws.numpy()[0, v, 0]
        for k, v in [(0, 1), *((k, 0) for k in range(20))]
    )
    assert first not in others
