"""The held evaluation measures the mean policy on its own episodes, without side effects."""

import numpy as np
import torch
from torch import nn

import finssim
from finssim.learning.episodes import HeldEvaluation, held_seed
from finssim.learning.resume import random_state
from reference.guess import BEST, Guess, GuessTogether


def gain(value):
    """Return a network whose output is `value` times the observed sign."""
    linear = nn.Linear(1, 6, bias=False)
    nn.init.constant_(linear.weight, value)
    return linear


def test_what_it_measures_is_known():
    """r = 1 - (value - c)² for each agent, with one and with two agents; success from 0.9 on."""
    for task in (Guess(), GuessTogether()):
        held = HeldEvaluation(finssim.make(task, worlds=4, seed=held_seed(1)))
        for value in (0.0, 0.3, BEST):
            found = held(gain(value))
            expected = 1.0 - (value - BEST) ** 2
            np.testing.assert_allclose(found["evaluation_return"], expected, rtol=1e-5)
            assert found["evaluation_success"] == float(expected >= 0.9) and found["evaluation_length"] == 1.0


def test_it_is_always_the_same_and_draws_from_no_stream_of_the_learner():
    """Whole episodes of T1 give the same result twice, and leave the random streams of torch and NumPy unchanged."""
    held = HeldEvaluation(finssim.make("t1", worlds=3, seed=held_seed(2), observe="training"))
    network = nn.Linear(16, 6)
    before = random_state()
    first = held(network)
    assert held(network) == first and {"evaluation_return", "evaluation_success"} <= first.keys()
    after = random_state()
    assert torch.equal(before["torch"], after["torch"]) and before["python"] == after["python"]
    assert np.array_equal(before["numpy"][1], after["numpy"][1]) and before["numpy"][2] == after["numpy"][2]
