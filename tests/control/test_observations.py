"""A policy on the robot is fed what it was fed in training."""

from types import SimpleNamespace

import numpy as np
import pytest

from finssim.control.errors import ControlError
from finssim.control.guidance import Station
from finssim.control.observations import OBSERVERS, observer
from finssim.geometry.rotations import quat_yaw
from finssim.learning.description import observation_schema
from finssim.tasks import Environment, StationKeeping


def test_the_t1_observation_equals_the_training_kernels():
    """For states and goals drawn at random, the robot's numbers are the kernel's to 1e-6 (float32)."""
    env = Environment(StationKeeping(), worlds=128, seed=3)
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.step(rng.uniform(-1.0, 1.0, (128, 6)))
        a = env.arrays
        kernel, goal, turn = a.observation.numpy(), a.goal_position.numpy(), a.goal_quaternion.numpy()
        states = (a.position.numpy()[:, 0], a.quaternion.numpy()[:, 0], a.velocity.numpy()[:, 0])
        for w in range(env.worlds):
            measured = SimpleNamespace(position=states[0][w], quaternion=states[1][w], nu=states[2][w])
            station = Station(tuple(goal[w].tolist()), float(quat_yaw(turn[w])))
            np.testing.assert_allclose(
                OBSERVERS["t1"].observe(measured, station, 0.0), kernel[w], rtol=0.0, atol=1e-6
            )


def test_the_t1_schema_is_the_tasks():
    """A policy that fits the task in training fits it on the robot."""
    assert OBSERVERS["t1"].schema == observation_schema(StationKeeping())


def test_a_task_that_no_robot_observes_is_refused():
    """The sentence lists those that are."""
    with pytest.raises(ControlError, match="unknown task 't9'; a robot can do: t1"):
        observer("t9")
