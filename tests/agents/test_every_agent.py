"""Requirements on every agent: controllers and baselines of every task, and one from outside the package."""

import json

import numpy as np
import pytest

from finssim.agents.agent import TASKS_OF_PIDS, agent_for
from finssim.agents.catalogue import baselines_of
from finssim.agents.controllers import CONTROLLERS, COSTLY
from finssim.control.guidance import Goal, Known
from finssim.tasks import TASKS, task_named
from finssim.tasks.observer import fitted_task
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")


class Homing:
    """External agent that thrusts towards the goal, a third less in every decision."""

    name, action, wrench_scale, period = "homing", "wrench6", 1.0, 0.1

    def reset(self, n):
        return np.ones(n)

    def act(self, memory, reading, goal):
        towards = np.zeros((len(memory), 6), np.float32)
        towards[:, :3] = memory[:, None] * (np.asarray(goal.position) - reading.position)
        return np.clip(towards, -1.0, 1.0), memory * 2.0 / 3.0

    def describe(self):
        return {"name": self.name, "kind": "homing", "action": self.action, "period_s": self.period}


PAIRS = [(task, name) for task in TASKS_OF_PIDS for name in CONTROLLERS if name not in COSTLY]
PAIRS += [pytest.param("t1", name, marks=pytest.mark.slow) for name in COSTLY]
PAIRS += [(task, name) for task in TASKS.usable() for name in baselines_of(task) if (task, name) not in PAIRS]
PAIRS += [("t1", "homing")]
EVERY = pytest.mark.parametrize(("task", "name"), PAIRS)


@pytest.fixture
def agent(task, name):
    if name == "homing":
        return Homing()
    return agent_for(name, FINSROV, task_named(task))


def inputs(task, n, seed=0):
    """Return readings and goals of n worlds, with a row for each agent, within the range of a task's observations."""
    rng, the_task = np.random.default_rng(seed), fitted_task(task, FINSROV)
    rows = n * len(the_task.agents)
    turn = rng.normal(size=(rows, 4))
    pictures = {
        picture.name: rng.integers(0, 256, (rows, *picture.shape(FINSROV)), dtype=np.uint8)
        for picture in the_task.pictures
        if picture.shape(FINSROV)
    }
    reading = Known(
        rng.uniform(-1.0, 1.0, (rows, the_task.observation_size)).astype(np.float32),
        rng.uniform(-1.0, 1.0, (rows, 3)),
        turn / np.linalg.norm(turn, axis=1, keepdims=True),
        rng.uniform(-0.5, 0.5, (rows, 6)),
        pictures or None,
    )
    return (
        reading,
        Goal(rng.uniform(-1.0, 1.0, (rows, 3)), reading.quaternion[::-1].copy()),
        len(the_task.agents),
    )


def chosen(reading, goal, rows):
    """Return some of the rows."""
    pictures = reading.pictures and {name: picture[rows] for name, picture in reading.pictures.items()}
    parts = (reading.observation, reading.position, reading.quaternion, reading.nu)
    return Known(*(part[rows] for part in parts), pictures), Goal(goal.position[rows], goal.quaternion[rows])


def played(agent, frames, rows):
    """Return the actions in all frames, from the beginning."""
    memory, actions = agent.reset(rows), []
    for reading, goal in frames:
        action, memory = agent.act(memory, reading, goal)
        actions.append(np.array(action))
    return np.array(actions)


@EVERY
def test_its_actions_are_parts_of_its_limits(agent, task):
    """Actions are finite for any input, with a row for each agent; the agent describes itself in plain data.

    Actions are in [-1, 1], except wrenches of controllers, which are limited axis by axis when executed.
    """
    reading, goal, agents = inputs(task, 6)
    actions = played(agent, [(reading, goal)] * 3, 6)
    assert actions.shape[1] in (6, 6 * agents) and np.isfinite(actions).all()
    assert getattr(agent, "kind", "") == "pid" or np.abs(actions).max() <= 1.0
    assert agent.period > 0.0 and json.loads(json.dumps(agent.describe()))["name"] == agent.name


@EVERY
def test_it_begins_anew_after_a_reset(agent, task):
    """Equal inputs from the beginning give bit-identical actions: only the memory keeps state."""
    frames = [inputs(task, 4, seed)[:2] for seed in range(3)]
    np.testing.assert_array_equal(played(agent, frames, 4), played(agent, frames, 4))


@EVERY
def test_a_world_does_not_know_of_the_others(agent, task):
    """The last two of five worlds get the same actions alone as among the five."""
    frames = [inputs(task, 5, seed)[:2] for seed in range(3)]
    agents = inputs(task, 5)[2]
    rows = slice(3 * agents, 5 * agents)
    few = played(agent, [chosen(*frame, rows) for frame in frames], 2)
    many = played(agent, frames, 5)
    last = many[:, -few.shape[1] :]
    np.testing.assert_allclose(few, last, rtol=0, atol=1e-6)
