"""An episode that time ends has the value of its last observation, checked with a value in closed form.

If every step pays 1 and only time ends an episode, V = 1 / (1 - discount) everywhere. With a critic that returns
this value, all returns that a learner computes are V, also in the steps in which an episode ends.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

import finssim
from finssim.learning.learners import learner_named
from reference.guess import Guess, Steady, SteadyTogether

DISCOUNT = 0.9


def made(name, task):
    kind = learner_named(name)
    few = {"worlds": 4, "rollout": 12, "batch": 16, "epochs": 1, "hidden": (8,), "discount": DISCOUNT}
    settings = replace(kind.settings(task), steps=1000, **few)
    return kind(finssim.make(task, worlds=4, seed=2), settings, seed=2)


def answer(critic, value):
    """Make a network's last layer return `value` for any input."""
    last = [layer for layer in critic.modules() if isinstance(layer, nn.Linear)][-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(value)


def returns(name, learner, value):
    """Return the returns that an update learns from, with a critic that returns `value`."""
    if name.startswith("sb3-"):
        answer(learner.model.policy.value_net, value)
        learner.update()
        return learner.model.rollout_buffer.returns
    if name == "rsl-rl":
        answer(learner.ppo.critic, value)
        learner.update()
        return learner.ppo.storage.returns.numpy()
    answer(learner.critic, value)
    with torch.no_grad():
        return learner._rollout()[learner.loss.tensor_keys.value_target].numpy()


@pytest.mark.parametrize(
    ("name", "task"),
    [
        *((name, Steady) for name in ("sb3-ppo", "rsl-rl", "torchrl-ppo")),
        *((name, SteadyTogether) for name in ("torchrl-ippo", "torchrl-mappo")),
    ],
)
def test_time_ends_no_value(name, task):
    """All returns equal V in four worlds over twelve steps, with an end by time at least twice in each."""
    learner = made(name, task())
    value = 1.0 / (1.0 - DISCOUNT)
    np.testing.assert_allclose(returns(name, learner, value), value, rtol=1e-5)
    assert learner.environment.simulator.state.episode.numpy().min() >= 3


@pytest.mark.parametrize("name", ["sb3-ppo", "rsl-rl", "torchrl-ppo"])
def test_an_end_by_the_task_ends_the_value(name):
    """In a task of one step the return is its reward, whatever the critic returns for later states."""
    learner = made(name, Guess())
    assert returns(name, learner, 10.0).max() <= 1.0 + 1e-5
