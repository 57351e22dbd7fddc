"""Claims about every task and every vehicle of the catalogue beyond those of `check_task`."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.tasks import TASKS, EnvironmentSetupError, make, numeric_tasks
from finssim.tasks.fitting import driven_axes
from finssim.vehicles import catalogue, load_vehicle
from finssim.vehicles.capability import coefficients_of
from reference.examples import example

NUMERIC = numeric_tasks()

OWN = example("own_task").KeepDepth
NAMES = [*NUMERIC, OWN().name]
"""Tasks of the package, and one from outside."""
PAIRS = [
    (name, vehicle)
    for name in NAMES
    for vehicle in catalogue()
    if vehicle in ("finsrov", "bluerov2", "torpedo") or name == "path"
]
PAIRS.remove((OWN().name, "torpedo"))  # whose kernel with the walls of a pool no other task has
"""Every task with a vehicle that is pushed every way, one that cannot pitch and one with fins, and every vehicle in
open water: the others repeat the kernels of these, or compile theirs for one case."""
SHORT = 1.0
"""Length of an episode [s], so that several end in a test."""


def environment(name, vehicle="finsrov", worlds=4, **options):
    model = coefficients_of(load_vehicle(vehicle))
    return make(
        replace((TASKS.get(name) or OWN)(), time_limit=SHORT),
        worlds=worlds,
        vehicle=vehicle,
        hydrodynamics=model,
        **options,
    )


def actions(env, steps, seed=0):
    """Return actions; those of the first worlds do not depend on the number of worlds."""
    agents = () if env.agents == 1 else (env.agents,)
    shape = (env.worlds, steps, *agents, env.action_size)
    return np.random.default_rng(seed).uniform(-1.5, 1.5, shape).astype(np.float32).swapaxes(0, 1)


def played(env, steps=25, given=None):
    """Return copies of observations, rewards and ends of every step."""
    out = []
    for action in actions(env, steps) if given is None else given:
        step = env.step(action)
        out.append(
            (step.observation.copy(), step.reward.copy(), step.terminated.copy(), step.truncated.copy())
        )
    return [np.array(column) for column in zip(*out, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_number_of_worlds_changes_nothing(name):
    """The first of many worlds, on two threads, equal those of few, bit for bit."""
    few, many = environment(name, worlds=3, seed=5), environment(name, worlds=130, threads=2, seed=5)
    given = actions(many, 25)
    for a, b in zip(played(few, given=given[:, :3]), played(many, given=given), strict=True):
        np.testing.assert_array_equal(a, b[:, :3])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "vehicle"), PAIRS)
def test_observations_stay_bounded_whatever_the_vehicle(name, vehicle):
    """At full random thrust numbers are finite and of order one, rewards finite, episodes end, success is 0 or 1.

    A task may refuse, in a sentence, a vehicle that cannot push along every axis, or that its autopilot cannot steer.
    """
    try:
        env = environment(name, vehicle)
    except EnvironmentSetupError as refusal:
        body = load_vehicle(vehicle)
        leaning = "pitch" in getattr(TASKS.get(name), "needs", ()) and "pitch" not in body.controlled_axes
        pushed = "does not control" in str(refusal) and (len(driven_axes(body)) < 3 or leaning)
        steered = (
            "do not control surge, pitch and yaw" in str(refusal) and "pitch" not in body.controlled_axes
        )
        glides = not body.thrusters and "no thruster drives it ahead" in str(refusal)
        assert pushed or steered or glides
        return
    observation, reward, terminated, truncated = played(env)
    assert np.isfinite(observation).all() and np.abs(observation).max() < 12.0
    assert np.isfinite(reward).all()
    assert (terminated | truncated).any(axis=0).all() and not (terminated & truncated).any()
    assert set(env.task.metrics(env.arrays)["success"].tolist()) <= {0.0, 1.0}


@pytest.mark.parametrize("name", NAMES)
def test_a_reset_starts_over_and_leaves_the_others_alone(name):
    """The same seed repeats everything, another does not; with a mask, only the masked worlds are reset."""
    env = environment(name, seed=1)
    first = env.reset(seed=1).copy()
    played(env, 5)
    assert not np.array_equal(env.reset(seed=2), first)
    np.testing.assert_array_equal(env.reset(seed=1), first)
    played(env, 5)
    before = env.arrays.observation.numpy().copy()
    after = env.reset(mask=[True, False, True, False]).reshape(4, -1)
    np.testing.assert_array_equal(after[[1, 3]], before[[1, 3]])
    assert np.all(np.any(after[[0, 2]] != before[[0, 2]], axis=1))


@pytest.mark.parametrize("name", NAMES)
def test_episodes_differ_from_each_other_and_between_worlds(name):
    """Every start is drawn anew."""
    env = environment(name, worlds=8)
    starts = np.concatenate([env.reset().reshape(8, -1).copy() for _ in range(4)])
    assert len({row.tobytes() for row in starts}) == 32
