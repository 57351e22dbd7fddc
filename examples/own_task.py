"""A task of your own in Warp: keep a depth that is drawn in every episode."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp

from finssim.sim import State
from finssim.tasks import (
    Environment,
    ObservationPart,
    RewardTerm,
    Task,
    TaskArrays,
    Terms,
    action_effort,
    check_task,
    place_at_rest,
)


@wp.func
def way_up(arrays: TaskArrays, w: int) -> float:
    """Return the distance up to the depth [m]; observations use the *measured* state, `arrays.position`."""
    return arrays.goal_position[w][2] - arrays.position[w, 0][2]


@wp.func
def heave(arrays: TaskArrays, w: int) -> float:
    """Return the velocity along the body's z axis [m/s]."""
    return arrays.velocity[w, 0][2]


@wp.func
def error(state: State, arrays: TaskArrays, w: int) -> float:
    """Return the distance to the depth [m]; rewards and success use the true state, `state.position`."""
    return wp.abs(arrays.goal_position[w][2] - state.position[w, 0][2])


@wp.func
def near(state: State, arrays: TaskArrays, w: int) -> float:
    """Return a reward whose slope does not vanish at the depth."""
    return wp.exp(-error(state, arrays, w) / 0.1)


@wp.func
def there(state: State, arrays: TaskArrays, p: Any, w: int) -> bool:
    """Return True within the tolerance of success; `p` contains the task's settings."""
    return error(state, arrays, w) < p.tolerance


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Draw the start of an episode, which depends only on the episode's key and the world."""
    rng = wp.rand_init(key, w)
    arrays.goal_position[w] = wp.vec3(0.0, 0.0, -wp.randf(rng, 0.3, p.deepest))
    place_at_rest(state, w, 0, wp.vec3(0.0, 0.0, -wp.randf(rng, 0.3, p.deepest)), 0.0)


@dataclass(frozen=True, kw_only=True)
class KeepDepth(Task):
    """Settings and terms of the task."""

    succeeds: ClassVar[str] = "held"
    name: str = "keep-depth"
    observation: tuple[ObservationPart, ...] = (
        ObservationPart("way to the depth, upwards", 1, "m", term=way_up),
        ObservationPart("heave", 1, "m/s", clip=2.0, term=heave),
    )
    deepest: float = 0.8
    tolerance: float = 0.05
    hold: float = 5.0

    def terms(self) -> Terms:
        """Return the rewards with their weights, the start and the success condition."""
        return Terms(
            start=start,
            rewards=(
                RewardTerm("near", near, 1.0),
                RewardTerm("error", error, -1.0),
                RewardTerm("action", action_effort, -0.05),
            ),
            inside=there,
        )


if __name__ == "__main__":
    check_task(KeepDepth())
    environment = Environment(KeepDepth(), "finsrov", worlds=64, seed=1)
    action, observation = np.zeros((64, environment.action_size)), environment.reset()
    for _ in range(200):
        action[:, 2] = 5.0 * observation[:, 0] - 2.0 * observation[:, 1]  # heave
        observation = environment.step(action).observation
    measured = environment.task.metrics(environment.arrays)
    print(f"held the depth within 5 cm in {measured['success'].mean():.0%} of the episodes")
