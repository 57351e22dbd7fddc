"""The TorchRL environment: its specs, its ends, its seeds and its groups of agents."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, GymWrapper, RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs

from finssim.learning.gymnasium_env import VectorEnv
from finssim.learning.torchrl_env import TorchRlEnv
from finssim.tasks import EnvironmentSetupError, StationKeeping, make
from reference.pair import KINDS, Pair

SHORT = StationKeeping(time_limit=0.5)
APART = {"port": ["right"], "starboard": ["left"]}


@pytest.mark.slow
@KINDS
def test_torchrls_checker_passes(task):
    check_env_specs(TorchRlEnv(task, worlds=3), seed=1)
    check_env_specs(TorchRlEnv(task, worlds=3), break_when_any_done="both")


def test_torchrls_checker_passes_with_groups():
    env = TorchRlEnv(Pair(), worlds=3, groups=APART)
    check_env_specs(env, break_when_any_done="both")
    assert set(env.rollout(2)["next"].keys()) >= {"port", "starboard", "done", "terminated", "truncated"}


def test_torchrls_own_wrapper_takes_gymnasiums_form():
    """With GymWrapper around VectorEnv, its checker passes, and a rollout spans two ends."""
    env = GymWrapper(VectorEnv(3, SHORT))
    check_env_specs(env)
    done = env.rollout(12, break_when_any_done=False)["next", "done"][..., 0]
    assert done.sum(1).tolist() == [2, 2, 2] and done[:, [4, 9]].all()


def played(env, steps=12, seed=5):
    """Return a rollout over ends, with predetermined actions."""
    rng = np.random.default_rng(9)
    env.set_seed(seed)
    now, out = env.reset(), []
    for _ in range(steps):
        action = torch.as_tensor(rng.uniform(-1.0, 1.0, env.action_spec.shape).astype(np.float32))
        before, now = env.step_and_maybe_reset(now.set("action", action))
        out.append(before)
    return torch.stack(out, 1)


def test_a_rollout_is_the_environments_own_steps():
    """Observations, last observations, rewards and ends are those of `Environment.step`, over two ends."""
    got, plain, rng = played(TorchRlEnv(SHORT, worlds=4)), make(SHORT, worlds=4), np.random.default_rng(9)
    observation = plain.reset(seed=5).copy()
    for k in range(12):
        np.testing.assert_array_equal(got["observation"][:, k], observation)
        step = plain.step(rng.uniform(-1.0, 1.0, (4, 6)).astype(np.float32))
        done = step.terminated | step.truncated
        last = np.where(done[:, None], step.final_observation, step.observation)
        np.testing.assert_array_equal(got["next", "observation"][:, k], last)
        np.testing.assert_array_equal(got["next", "reward"][:, k, 0], step.reward)
        np.testing.assert_array_equal(got["next", "truncated"][:, k, 0], step.truncated)
        np.testing.assert_array_equal(got["next", "terminated"][:, k, 0], step.terminated)
        np.testing.assert_array_equal(got["next", "done"][:, k, 0], done)
        assert not got["done"][:, k].any()
        observation = step.observation.copy()
    assert got["next", "done"].sum() == 8


def test_the_short_way_to_the_next_episode_gives_what_torchrls_own_gives():
    class Plain(TorchRlEnv):
        step_and_maybe_reset = EnvBase.step_and_maybe_reset

    short, own = played(TorchRlEnv(SHORT, worlds=4)), played(Plain(SHORT, worlds=4))
    assert (short == own).all()
    assert set(short.keys(True, True)) == set(own.keys(True, True))


def test_transforms_see_ends_and_new_episodes():
    """The sum of rewards starts over with each episode, also through TorchRL's own reset."""
    env = TransformedEnv(TorchRlEnv(SHORT, worlds=3), RewardSum())
    data = env.rollout(10, break_when_any_done=False)
    sums = data["next", "episode_reward"][..., 0]
    rewards = data["next", "reward"][..., 0]
    torch.testing.assert_close(sums[:, 4], rewards[:, :5].sum(1))
    torch.testing.assert_close(sums[:, 9], rewards[:, 5:].sum(1))


def test_equal_seeds_are_equal_rollouts_and_others_are_not():
    env = TorchRlEnv(SHORT, worlds=3)
    first, second, other = played(env), played(env), played(env, seed=6)
    assert (first == second).all() and not (first == other).all()


def test_a_mask_starts_only_its_worlds():
    env = TorchRlEnv(SHORT, worlds=3)
    env.rollout(3)
    before = env.environment.arrays.observation.numpy().copy()
    mask = torch.tensor([[True], [False], [True]])
    over = torch.zeros(3, 1, dtype=torch.bool)
    env.reset(TensorDict({"_reset": mask, "done": over, "terminated": over, "truncated": over}, [3]))
    changed = (env.environment.arrays.observation.numpy() != before).any(axis=1)
    assert changed.tolist() == [True, False, True]
    assert env.environment.simulator.state.steps.numpy().tolist() == [0, 3, 0]


def test_staggered_episodes_end_at_different_times():
    env = TorchRlEnv(StationKeeping(time_limit=2.0), worlds=200, stagger=True)
    ends = env.rollout(20, break_when_any_done=False)["next", "done"].sum(0)
    assert (ends > 0).all() and (ends < 60).all()


def test_agents_of_a_group_are_its_rows_in_its_order():
    """Each group's action reaches its agents, and its observations and rewards are theirs."""
    together, apart = TorchRlEnv(Pair(), worlds=3, seed=2), TorchRlEnv(Pair(), worlds=3, seed=2, groups=APART)
    action = torch.rand(3, 2, 6)
    one, other = together.reset(), apart.reset()
    one["agents", "action"] = action
    other["port", "action"], other["starboard", "action"] = action[:, 1:], action[:, :1]
    one, other = together.step(one)["next"], apart.step(other)["next"]
    for key in ("observation", "reward"):
        torch.testing.assert_close(one["agents", key][:, 1:], other["port", key])
        torch.testing.assert_close(one["agents", key][:, :1], other["starboard", key])
    assert one["agents", "observation"][:, :, 6].tolist() == [[0.0, 1.0]] * 3


def test_what_cannot_be_is_refused():
    env = TorchRlEnv(SHORT, worlds=2)
    now = env.reset()
    with pytest.raises(EnvironmentSetupError, match="not finite: the network has diverged"):
        env.step(now.clone().set("action", torch.full((2, 6), torch.nan)))
    with pytest.raises(EnvironmentSetupError, match=r"shape \(2, 5\), expected 2 rows of 6"):
        env.step(now.clone().set("action", torch.zeros(2, 5)))
    with pytest.raises(EnvironmentSetupError, match="groups name left, expected each of left, right once"):
        TorchRlEnv(Pair(), groups={"some": ["left"]})


def test_ends_are_of_two_kinds():
    """Done, terminated and truncated are booleans by world: categories 0 and 1."""
    spec = TorchRlEnv(SHORT, worlds=2).done_spec
    assert {
        key: (spec[key].n, tuple(spec[key].shape)) for key in ("done", "terminated", "truncated")
    } == dict.fromkeys(("done", "terminated", "truncated"), (2, (2, 1)))
