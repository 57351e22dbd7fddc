"""Scoring blocks of worlds equals scoring worlds one by one."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from finssim.sim import launch
from finssim.tasks import Environment, StationKeeping
from finssim.tasks.blocks import evaluate_in_blocks
from finssim.tasks.task import kernels_of, settings_of
from finssim.tasks.terms import RewardTerm, Terms


@pytest.mark.slow
def test_a_step_of_t1_is_scored_in_blocks_as_world_by_world(monkeypatch):
    """Observations, rewards and ends of 20 random steps agree across ends of episodes; the last block is not
    full."""
    runs = []
    for many in (1, 10**9):
        monkeypatch.setattr(launch, "MANY", many)
        environment = Environment(StationKeeping(time_limit=1.0), worlds=19, action="thruster8", threads=1)
        random, steps = np.random.default_rng(0), []
        for _ in range(20):
            step = environment.step(random.uniform(-1.0, 1.0, (19, 8)))
            a = environment.arrays
            kept = (step.observation, step.reward, step.terminated, step.truncated, step.final_observation)
            totals = (a.earned, a.episode_return, a.final_return, a.held, a.previous_action)
            steps.append([np.array(x, float) for x in (*kept, *(array.numpy() for array in totals))])
        runs.append(steps)
    assert sum(step[3].sum() for step in runs[0]) == 2 * 19
    for blocks, single in zip(*runs, strict=True):
        for x, y in zip(blocks, single, strict=True):
            np.testing.assert_allclose(x, y, rtol=2e-6, atol=2e-6)


def test_a_term_that_cannot_be_traced_leaves_the_task_to_the_kernel_for_one_world():
    """A task whose reward draws random numbers has no blocks."""

    @wp.func
    def drawn(w: int) -> float:
        return wp.randf(wp.rand_init(1, w))

    class Lottery(StationKeeping):
        def terms(self) -> Terms:
            return replace(super().terms(), rewards=(RewardTerm("drawn", drawn, 1.0),))

    environment = Environment(StationKeeping(), worlds=1)
    task = Lottery(fit=environment.task.fit)
    kernels = kernels_of(task)
    inputs = [environment.simulator.state, environment.arrays, settings_of(task), kernels.weights()]
    assert evaluate_in_blocks(kernels.score, inputs) is None
