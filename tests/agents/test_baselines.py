"""Baselines solve their tasks from the observation alone, as `Pid` does from the state."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import pytest

from finssim.agents.baselines import (
    StationPid,
    acceleration_ahead,
    attitude_from,
    heading_rate,
    seen_from_goal,
)
from finssim.agents.catalogue import BaselineError, baseline, baselines_of
from finssim.agents.memory import restarted
from finssim.agents.pid import Pid, PidMemory
from finssim.control.guidance import Goal
from finssim.core.rotations import quat_from_euler, quat_multiply, quat_rotate
from finssim.tasks import TASKS, EnvironmentSetupError, StationKeeping, make
from finssim.tasks.fitting import driven_axes
from finssim.vehicles import catalogue, load_vehicle
from finssim.vehicles.capability import coefficients_of

SINGLE = ("t1", "t2", "t3", "docking")
HOLONOMIC = [name for name in catalogue() if len(driven_axes(load_vehicle(name))) == 3]
"""Vehicles that can push forwards, sideways and up."""


def rollout(task, name, vehicle="finsrov", worlds=16, seed=3, **options):
    """Return the metrics of one episode in every world, played by a baseline."""
    body = load_vehicle(vehicle)
    env = make(task, worlds=worlds, vehicle=body, hydrodynamics=coefficients_of(body), seed=seed, **options)
    player = baseline(task, name, body)
    memory, observation = player.reset(worlds), env.arrays.observation.numpy()
    assert player.period == pytest.approx(env.task.control_step)
    for _ in range(round(env.task.time_limit / env.task.control_step)):
        action, memory = player.act(memory, observation)
        assert action.shape == (worlds, env.action_size) and action.dtype == np.float32
        observation = env.step(action).observation
    return env.task.metrics(env.arrays)


@pytest.mark.slow
@pytest.mark.parametrize("observe", ["truth", "estimator"])
@pytest.mark.parametrize("task", SINGLE)
def test_a_baseline_does_its_task(task, observe):
    """FinsROV succeeds in at least 15 of 16 episodes, with the true state and with the estimate of localization."""
    measured = rollout(task, next(iter(baselines_of(task))), observe=observe)
    assert measured["success"].sum() >= 15
    assert measured["length"].min() > 100


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", HOLONOMIC)
@pytest.mark.parametrize("task", SINGLE)
def test_a_baseline_does_its_task_with_every_vehicle_that_can(task, vehicle):
    """Three directions of thrust suffice for 7 of 8 episodes of the tasks whose size is scaled to the vehicle."""
    if task in ("t1", "t2") and max(load_vehicle(vehicle).body.size) > 1.0:
        pytest.skip("the paper's pool is too small for it")
    assert rollout(task, next(iter(baselines_of(task))), vehicle, worlds=8)["success"].sum() >= 7


@pytest.mark.parametrize("task", SINGLE)
def test_a_baseline_needs_the_observation_alone(task):
    """Rows are independent: a vehicle gets the same command alone and among others, whatever the others' memory."""
    player = baseline(task, next(iter(baselines_of(task))))
    rows = [make(task, worlds=6, seed=s).arrays.observation.numpy().copy() for s in range(3)]
    memory, lone = player.reset(6), player.reset(1)
    for observation in rows:
        action, memory = player.act(memory, observation)
        alone, lone = player.act(lone, observation[2:3])
        np.testing.assert_allclose(action[2:3], alone, atol=1e-6)


def test_what_t1_shows_is_enough_for_the_same_command():
    """The command from the observation equals that from the state, integrals included, rotated with the goal."""
    env = make("t1", worlds=32, seed=1)
    player, pid = baseline("t1", "pid"), Pid.from_vehicle(load_vehicle("finsrov"), period=0.1)
    state, a = env.simulator.state, env.arrays
    memory, direct = player.reset(32), pid.reset(32)
    for _ in range(10):
        measured = State(
            *(x.numpy()[:, 0].astype(float) for x in (state.position, state.quaternion, state.velocity))
        )
        tau, direct = pid.command(direct, measured, Goal(a.goal_position.numpy(), a.goal_quaternion.numpy()))
        action, memory = player.act(memory, a.observation.numpy())
        # Observations are float32, with offsets of metres at some 100 N/m.
        np.testing.assert_allclose(action * pid.wrench_limits, tau, atol=1e-3)
        env.step(action)


class State(NamedTuple):
    position: np.ndarray
    quaternion: np.ndarray
    nu: np.ndarray


def test_t1s_observation_gives_the_pose_in_the_goals_axes():
    env = make("t1", worlds=64)
    seen, a = seen_from_goal(env.arrays.observation.numpy()), env.arrays
    q_goal = a.goal_quaternion.numpy().astype(float)
    position = a.goal_position.numpy() + quat_rotate(q_goal, seen.position)
    np.testing.assert_allclose(position, env.simulator.state.position.numpy()[:, 0], atol=2e-6)
    q = quat_multiply(q_goal, seen.quaternion)
    np.testing.assert_allclose(
        np.abs(np.sum(q * env.simulator.state.quaternion.numpy()[:, 0], axis=1)), 1.0, atol=1e-6
    )


def test_an_attitude_is_read_from_where_up_is():
    """Up in the body frame gives roll and pitch, with the heading as given; the body's rate gives the heading's."""
    rng = np.random.default_rng(0)
    roll, pitch, yaw = rng.uniform(-1.0, 1.0, (3, 100))
    q = quat_from_euler(roll, pitch, yaw)
    up = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=-1)
    np.testing.assert_allclose(attitude_from(up, yaw), q, atol=1e-12)
    nu = rng.normal(size=(100, 6))
    expected = (nu[:, 4] * np.sin(roll) + nu[:, 5] * np.cos(roll)) / np.cos(pitch)
    np.testing.assert_allclose(heading_rate(up, nu), expected, rtol=1e-9)


def test_an_acceleration_is_read_from_where_a_reference_will_be():
    """The acceleration is exact on cubics, whatever the jerk."""
    a, jerk, v = np.array([[0.03, -0.02, 0.01]]), np.array([[0.5, 0.4, -0.3]]), np.array([[0.2, 0.1, -0.05]])
    offsets = [v * t + a * t**2 / 2.0 + jerk * t**3 / 6.0 for t in (0.0, 0.1, 0.2)]
    np.testing.assert_allclose(acceleration_ahead(offsets, v), a, atol=1e-12)


def test_memories_start_over_row_by_row():
    """Masked rows are reset and the others stay, in tuples too; nothing is changed in place."""
    old = (np.ones(3), PidMemory(np.full((3, 3), 2.0), np.full((3, 3), 3.0)), None)
    fresh = (np.zeros(3), PidMemory(np.zeros((3, 3)), np.zeros((3, 3))), None)
    heading, pid, nothing = restarted(old, fresh, np.array([False, True, False]))
    assert heading.tolist() == [1.0, 0.0, 1.0] and nothing is None
    assert pid.force[:, 0].tolist() == [2.0, 0.0, 2.0] and pid.moment[:, 2].tolist() == [3.0, 0.0, 3.0]
    assert old[0].tolist() == [1.0] * 3
    with pytest.raises(TypeError, match="memory of a baseline is a str"):
        restarted("a", "b", np.array([True]))


def test_an_unknown_baseline_is_refused_with_what_there_is():
    with pytest.raises(BaselineError, match="unknown baseline 'lqr' of task 't1'; available: pid"):
        baseline("t1", "lqr")
    with pytest.raises(EnvironmentSetupError, match="unknown task 't9'"):
        baseline("t9", "pid")


def test_a_subclass_under_another_name_has_the_baselines_alone_that_it_defines():
    """A subclass may observe something other than its base's baseline expects."""

    @dataclass(frozen=True, kw_only=True)
    class Renamed(StationKeeping):
        name: str = "renamed"

    @dataclass(frozen=True, kw_only=True)
    class WithOwn(Renamed):
        baselines: ClassVar = {"mine": lambda vehicle: StationPid.for_vehicle(vehicle)}
        name: str = "with-own"

    assert list(baselines_of(StationKeeping())) == ["pid"] and not baselines_of(Renamed())
    assert list(baselines_of(WithOwn())) == ["mine"]
    assert isinstance(baseline(WithOwn(), "mine"), StationPid)


def test_every_task_has_a_baseline():
    """A learned policy has a baseline to compare with."""
    assert all(baselines_of(task) for task in TASKS.usable())
