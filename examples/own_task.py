"""A task of one's own in Warp: keep a depth that is drawn in every episode."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from finssim.engine.state import State
from finssim.tasks import Environment, ObservationPart, Task
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.check import check_task
from finssim.tasks.episode import action_effort, close_episode, open_episode, report_frozen


@wp.struct
class DepthParameters:
    """The task's settings, for the kernels."""

    deepest: float
    time_limit: float
    control_step: float


@wp.func
def look(arrays: TaskArrays, w: int):
    """Write the observation, from what is *measured*: `arrays.position`, not `state.position`."""
    arrays.observation[w, 0] = arrays.goal_position[w][2] - arrays.position[w, 0][2]
    arrays.observation[w, 1] = wp.clamp(arrays.velocity[w, 0][2], -2.0, 2.0)


@wp.kernel(enable_backward=False)
def evaluate(state: State, arrays: TaskArrays, p: DepthParameters, world_offset: int):
    """After each step, one world a thread: reward, ends and observation."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:  # a number stopped being finite: the environment reports it
        report_frozen(state, arrays, w)
        return
    error = wp.abs(arrays.goal_position[w][2] - state.position[w, 0][2])  # the truth is what counts
    effort = action_effort(arrays, w)
    reward = wp.exp(-error / 0.1) - error - 0.05 * effort[0]
    late = float(state.steps[w]) * p.control_step >= p.time_limit - 0.5 * p.control_step
    arrays.held[w] = wp.where(error < 0.05, arrays.held[w] + p.control_step, 0.0)
    arrays.reward[w] = reward
    arrays.terminated[w] = 0  # a failure would be 1: nothing is bootstrapped there
    arrays.truncated[w] = wp.where(late, 1, 0)
    arrays.done[w] = wp.where(late, 1, 0)
    arrays.episode_return[w] = arrays.episode_return[w] + reward
    look(arrays, w)
    if late:
        close_episode(state, arrays, w)


@wp.kernel(enable_backward=False)
def spawn(
    state: State,
    arrays: TaskArrays,
    p: DepthParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Where an episode starts: draw it from the seed, the episode and the world alone."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    rng = wp.rand_init(seed + 15485863 * state.episode[w], w)
    arrays.goal_position[w] = wp.vec3(0.0, 0.0, -wp.randf(rng, 0.3, p.deepest))
    state.position[w, 0] = wp.vec3(0.0, 0.0, -wp.randf(rng, 0.3, p.deepest))
    state.quaternion[w, 0] = wp.quat_identity()
    nu = state.velocity[w, 0]
    for i in range(6):
        nu[i] = 0.0
    state.velocity[w, 0] = nu
    open_episode(arrays, w)


@wp.kernel(enable_backward=False)
def observe(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """First observation of the episodes that start."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        look(arrays, w)


@dataclass(frozen=True, kw_only=True)
class KeepDepth(Task):
    """Settings, and which kernels to run."""

    name: str = "keep-depth"
    observation: tuple[ObservationPart, ...] = (
        ObservationPart("way to the depth, upwards", 1, "m"),
        ObservationPart("heave", 1, "m/s", clip=2.0),
    )
    deepest: float = 0.8

    evaluate = staticmethod(evaluate)
    spawn = staticmethod(spawn)
    observe = staticmethod(observe)

    def parameters(self) -> Any:
        """The struct that the kernels take."""
        p = DepthParameters()
        p.deepest, p.time_limit, p.control_step = self.deepest, self.time_limit, self.control_step
        return p


if __name__ == "__main__":
    check_task(KeepDepth())
    environment = Environment(KeepDepth(), "finsrov", worlds=64, seed=1)
    action, observation = np.zeros((64, environment.action_size)), environment.reset()
    for _ in range(200):
        action[:, 2] = 5.0 * observation[:, 0] - 2.0 * observation[:, 1]  # heave
        observation = environment.step(action).observation
    held = environment.task.metrics(environment.arrays)["held"]
    print(f"held the depth within 5 cm for {held.mean():.1f} s at the end, on average")
