"""A task in plain torch equals the same task in Warp, for T1 and for all other functions of environments."""

import importlib.util
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
import warp as wp

import finssim
from finssim.tasks import EnvironmentSetupError, MeasurementNoise, ObservationPart, StationKeeping
from finssim.tasks.check import TaskError, check_task
from finssim.tasks.torch_rotations import (
    about_axis,
    angle,
    arctangent,
    conjugate,
    heading,
    matrix,
    multiply,
    rotate,
    wrapped,
)
from finssim.tasks.torch_task import Start, TorchTask

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TorchStationKeeping = example("t1_in_torch").TorchStationKeeping
KeepDepth = example("own/task/keep_depth").KeepDepth


@dataclass(frozen=True, kw_only=True)
class Herding(TorchTask):
    """A task with two agents and one other vehicle that uses everything a task may define."""

    agents: ClassVar = ("left", "right")
    others: ClassVar = ("stray",)
    action: ClassVar = "wrench4"
    pool: ClassVar = None
    totals: ClassVar = ("way", "steps")
    memory: ClassVar = {"phase": 1, "last": 3}
    name: str = "herding"
    observation: tuple = (
        ObservationPart("to the stray", 3, "m", scale=4.0, clip=3.0),
        ObservationPart("phase", 1, "1"),
    )

    def reset(self, w):
        apart = torch.tensor([[-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, 0.0, 0.0]], device=w.device)
        middle = w.uniform((-1.0, -1.0, -2.0), (1.0, 1.0, -1.5))
        return Start(position=middle[:, None] + apart, memory={"phase": w.uniform(0.0, 6.0)})

    def observe(self, w):
        way = w.position[:, 2:] - w.position[:, :2]
        return way, torch.sin(w.memory["phase"]).expand(-1, 2)

    def reward(self, w):
        w.memory["last"][:] = w.position[:, 2]
        w.memory["phase"][:] += 0.1
        way = torch.linalg.vector_norm(w.position[:, 2:] - w.position[:, :2], dim=2)
        return -way - (w.action - w.previous_action).square().mean(dim=2)

    def counted(self, w):
        return {"steps": w.full(1.0), "way": torch.linalg.vector_norm(w.velocity[:, 2, :3], dim=1)}

    def inside(self, w):
        return w.time > 0.35

    def script(self, w):
        return torch.cat((torch.sin(w.memory["phase"]), 0.3 * w.normal(3)), dim=1)[:, None]


def actions(environment, steps, seed=0):
    agents = () if environment.agents == 1 else (environment.agents,)
    shape = (steps, environment.worlds, *agents, environment.action_size)
    return np.random.default_rng(seed).uniform(-1.5, 1.5, shape).astype(np.float32)


def played(environment, given):
    out = []
    for action in given:
        s = environment.step(action)
        out.append([np.array(x) for x in (s.observation, s.reward, s.terminated, s.truncated)])
    return [np.array(column) for column in zip(*out, strict=True)]


def test_t1_in_torch_is_t1():
    """Equal states and actions give equal ends; observations, rewards and metrics agree to float rounding.

    Noise separates measured from true values; some worlds leave a pool made small.
    """
    noise = MeasurementNoise(position_std=0.05, yaw_std=0.1, velocity_std=0.05, position_bias=0.05, delay=0.2)
    limits = {"time_limit": 2.0, "bounds": (1.0, 0.5), "tolerance": 0.6, "yaw_tolerance": 2.0, "hold": 0.5}
    one, other = (
        finssim.make(kind(**limits), worlds=96, seed=3, observe=noise, auto_reset=False)
        for kind in (StationKeeping, TorchStationKeeping)
    )
    for name in ("position", "quaternion", "velocity"):
        getattr(other.simulator.state, name).assign(getattr(one.simulator.state, name).numpy())
    for name in ("goal_position", "goal_quaternion"):
        getattr(other.arrays, name).assign(getattr(one.arrays, name).numpy())
    given = actions(one, 20)
    first, second = played(one, given), played(other, given)
    assert first[2].any() and first[3].any()
    np.testing.assert_array_equal(first[2], second[2])
    np.testing.assert_array_equal(first[3], second[3])
    np.testing.assert_allclose(first[0], second[0], atol=5e-6)
    np.testing.assert_allclose(first[1], second[1], atol=5e-5)
    wanted, found = one.task.metrics(one.arrays), other.task.metrics(other.arrays)
    assert 0.0 < wanted["success"].mean() < 1.0 and wanted.keys() - found.keys() == {"left"}
    assert all(np.allclose(wanted[name], found[name], atol=1e-3) for name in found)


@pytest.mark.slow
@pytest.mark.parametrize("task", [KeepDepth(), TorchStationKeeping(), Herding()], ids=lambda task: task.name)
def test_tasks_in_torch_pass_the_check(task):
    """The check covers equal seeds, the number of worlds, resets, bounds, ends, starts and metrics."""
    check_task(task)


def test_the_check_finds_a_draw_that_knows_nothing_of_the_seed():
    """The task calls `torch.rand`."""

    @dataclass(frozen=True, kw_only=True)
    class Dicing(KeepDepth):
        def reset(self, w):
            return Start(position=-torch.rand(w.count, 3))

    with pytest.raises(TaskError, match="equal seeds give other numbers"):
        check_task(Dicing())


def test_the_number_of_worlds_and_threads_changes_nothing():
    """This holds across ends of episodes, with several agents, memory and totals."""
    short = replace(Herding(), time_limit=0.5)
    few, many = (finssim.make(short, worlds=n, threads=t, seed=5) for n, t in ((3, 1), (130, 2)))
    given = actions(many, 12)
    for a, b in zip(played(few, given[:, :3]), played(many, given), strict=True):
        np.testing.assert_array_equal(a, b[:, :3])
    assert few.task.metrics(few.arrays)["steps"].tolist() == [5.0, 5.0, 5.0]
    assert few.task.metrics(few.arrays)["success"].tolist() == [1.0, 1.0, 1.0]


def test_a_saved_state_goes_on_bit_for_bit():
    """Memory and draws are included; everything is drawn, measured and delayed."""
    options = {"worlds": 6, "seed": 4, "randomize": "fossen_learn_to_swim", "observe": "estimator"}
    whole, other = (finssim.make(replace(Herding(), time_limit=0.7), **options) for _ in range(2))
    played(whole, actions(whole, 5))
    played(other, actions(other, 3, seed=9))
    other.reset(seed=77)
    other.load_state(whole.state())
    given = actions(whole, 10, seed=1)
    for a, b in zip(played(whole, given), played(other, given), strict=True):
        np.testing.assert_array_equal(a, b)
    before, after = whole.state(), other.state()
    assert all(np.array_equal(before[name], after[name], equal_nan=True) for name in before)


def test_a_reset_with_a_seed_starts_over_and_a_mask_leaves_the_others_alone():
    env = finssim.make(KeepDepth(), worlds=4, seed=1)
    first = env.reset(seed=1).copy()
    assert not np.array_equal(env.reset(seed=2), first)
    played(env, actions(env, 3))
    np.testing.assert_array_equal(env.reset(seed=1), first)
    after = env.reset(mask=[True, False, True, False])
    np.testing.assert_array_equal(after[[1, 3]], first[[1, 3]])
    assert np.all(np.any(after[[0, 2]] != first[[0, 2]], axis=1))


def test_a_world_that_breaks_ends_alone(tmp_path):
    """It is terminated without reward, with the last finite observation; the others continue."""
    env = finssim.make(KeepDepth(), worlds=3, seed=1, crash_directory=tmp_path)
    seen = env.reset().copy()
    velocity = env.simulator.state.velocity.numpy().copy()
    velocity[1] = np.nan
    env.simulator.state.velocity.assign(velocity)
    step = env.step(np.zeros((3, 6)))
    assert step.terminated.tolist() == [False, True, False] and step.reward[1] == 0.0
    np.testing.assert_array_equal(step.final_observation[1], seen[1])
    assert np.isfinite(step.observation).all() and np.isfinite(step.reward).all()


@pytest.mark.parametrize(
    "library",
    ["gymnasium", "sb3", pytest.param("torchrl", marks=pytest.mark.slow), "rsl_rl", "pettingzoo"],
)
def test_adapters_take_it_and_their_checkers_pass(library):
    """They accept it like any other task."""
    if library == "gymnasium":
        from gymnasium.utils.env_checker import check_env

        from finssim.learning.gymnasium_env import Env

        check_env(Env(KeepDepth()), skip_render_check=True)
    elif library == "sb3":
        from finssim.learning.sb3 import Sb3VecEnv

        env = Sb3VecEnv(finssim.make(replace(KeepDepth(), time_limit=0.3), worlds=4))
        env.reset()
        ends = [env.step(np.zeros((4, 6), np.float32)) for _ in range(3)][-1]
        assert ends[2].all() and all(info["TimeLimit.truncated"] for info in ends[3])
    elif library == "torchrl":
        check = pytest.importorskip("torchrl.envs.utils").check_env_specs
        from finssim.learning.torchrl_env import TorchRlEnv

        check(TorchRlEnv(Herding(), worlds=4))
    elif library == "rsl_rl":
        pytest.importorskip("rsl_rl")
        from finssim.learning.rsl_rl_env import RslRlVecEnv

        env = RslRlVecEnv(KeepDepth(), worlds=4)
        seen, reward, done, info = env.step(torch.zeros(4, 6))
        assert seen["policy"].shape == (4, 2) and reward.shape == done.shape == (4,)
    else:
        check = pytest.importorskip("pettingzoo.test").parallel_api_test
        from finssim.learning.pettingzoo_env import PettingZooEnv

        check(PettingZooEnv(replace(Herding(), time_limit=0.5)), num_cycles=20)


@pytest.mark.slow
def test_it_is_trained_like_any_task(tmp_path):
    """The policy directory has the task's name and observation; equal seeds give equal networks."""
    from finssim.control.policy import Policy
    from finssim.learning.train import TrainingSettings, train

    short = replace(KeepDepth(), time_limit=2.0)
    done = [
        train(
            short,
            TrainingSettings(worlds=16, steps=8192, seed=2, settings={"epochs": 1}),
            out=tmp_path / name,
        )
        for name in ("a", "b")
    ]
    told = Policy.load(done[0]).description
    assert told.task == "keep-depth" and [e.name for e in told.observation.entries][1] == "heave"
    assert (done[0] / "policy.onnx").read_bytes() == (done[1] / "policy.onnx").read_bytes()


@pytest.mark.parametrize(
    ("function", "answer", "sentence"),
    [
        ("reward", lambda self, w: w.zeros(3), r"reward gives \(2, 3\), expected a tensor \(2,\)"),
        ("reward", TorchTask.reward, r"define reward\(self, w\) -> tensor"),
        ("terminated", lambda self, w: False, r"terminated gives bool, expected a tensor \(2,\)"),
        ("observe", lambda self, w: (w.zeros(1),), "observe gives 1 tensors, expected 2"),
        (
            "observe",
            lambda self, w: (w.zeros(3), w.zeros()),
            r"'way to the depth, upwards' of shape \(2, 3\)",
        ),
        ("reset", lambda self, w: Start(position=w.zeros(2)), r"reset: position gives \(2, 2\), expected"),
        ("reset", lambda self, w: Start(position=w.zeros(3), memory={"x": w.zeros()}), "memory 'x'"),
        ("counted", lambda self, w: {"way": w.zeros()}, "counted gives way, expected the totals: none"),
    ],
)
def test_a_wrong_answer_is_named(function, answer, sentence):
    """The message gives the function, its answer, and what was expected."""
    wrong = dataclass(frozen=True, kw_only=True)(type("Wrong", (KeepDepth,), {function: answer}))
    with pytest.raises(EnvironmentSetupError, match=sentence):
        finssim.make(wrong(), worlds=2).step(np.zeros((2, 6)))


def test_rotations_are_those_of_warp():
    """They also equal closed forms: a rotation about z has its angle as heading, all round the circle."""
    rng = np.random.default_rng(0)
    q, p = (torch.tensor(x / np.linalg.norm(x, axis=1)[:, None]) for x in rng.normal(size=(2, 50, 4)))
    v = torch.tensor(rng.normal(size=(50, 3)))
    for i in range(50):
        a, b = wp.quat(*q[i].tolist()), wp.quat(*p[i].tolist())
        np.testing.assert_allclose(multiply(p, q)[i], list(b * a), atol=1e-6)
        np.testing.assert_allclose(
            rotate(q, v)[i], list(wp.quat_rotate(a, wp.vec3(*v[i].tolist()))), atol=1e-5
        )
    np.testing.assert_allclose((matrix(q) @ v[:, :, None])[:, :, 0], rotate(q, v), atol=1e-12)
    turns = torch.linspace(-3.14, 3.14, 41, dtype=torch.float64)
    np.testing.assert_allclose(heading(about_axis(2, turns)), turns, atol=1e-12)
    np.testing.assert_allclose(angle(about_axis(0, turns)), turns.abs(), atol=1e-12)
    np.testing.assert_allclose(angle(multiply(q, conjugate(q))), 0.0, atol=1e-7)
    np.testing.assert_allclose(wrapped(turns + 4.0 * torch.pi), turns, atol=1e-12)
    corners = torch.tensor([[0.0, -1.0], [-0.0, -1.0], [1.0, 0.0], [-1.0, -1e-30], [0.0, 0.0], [1e-20, -1.0]])
    np.testing.assert_allclose(arctangent(*corners.T), torch.atan2(*corners.T), atol=1e-6)
