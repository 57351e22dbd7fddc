"""The terms of every task in plain torch, which go on with what its functions answered; and its draws."""

from collections.abc import Sequence

import warp as wp

from finssim.engine.state import State
from finssim.physics.types import vec6
from finssim.tasks.arrays import Answers, TaskArrays


@wp.func
def answered_reward(arrays: TaskArrays, w: int, a: int) -> float:
    """What `reward` gave."""
    return arrays.answers.reward[w, a]


@wp.func
def answered_failure(arrays: TaskArrays, w: int) -> bool:
    """What `terminated` gave."""
    return arrays.answers.terminated[w] != 0


@wp.func
def answered_inside(arrays: TaskArrays, w: int) -> bool:
    """What `inside` gave."""
    return arrays.answers.inside[w] != 0


@wp.func
def answered_total(arrays: TaskArrays, w: int, was: float, k: int) -> float:
    """The total, and what `counted` gave."""
    return was + arrays.answers.counted[w, k]


@wp.func
def answered_start(state: State, arrays: TaskArrays, w: int):
    """Take the start that `reset` gave."""
    for v in range(state.position.shape[1]):
        state.position[w, v] = arrays.answers.position[w, v]
        state.quaternion[w, v] = wp.normalize(arrays.answers.quaternion[w, v])
        state.velocity[w, v] = arrays.answers.velocity[w, v]
    arrays.goal_position[w] = arrays.answers.goal_position[w]
    arrays.goal_quaternion[w] = wp.normalize(arrays.answers.goal_quaternion[w])
    for i in range(arrays.answers.memory.shape[1]):
        arrays.answers.memory[w, i] = arrays.answers.begun[w, i]


@wp.kernel(enable_backward=False)
def draw(
    out: wp.array2d(dtype=float),
    episode: wp.array(dtype=int),
    steps: wp.array(dtype=int),
    seed: int,
    place: int,
    normal: int,
):
    """Fill rows with draws from [0, 1), or of a standard normal: by seed, world, episode, step and place alone."""
    w = wp.tid()
    own = wp.rand_init(seed + 15485863 * episode[w], w)
    rng = wp.rand_init(wp.randi(own) + 104729 * steps[w], place)
    for i in range(out.shape[1]):
        out[w, i] = wp.where(normal != 0, wp.randn(rng), wp.randf(rng))


def answers(
    worlds: int,
    vehicles: int,
    agents: int,
    totals: int,
    memory: int,
    device: wp.Device,
) -> Answers:
    """Room for the answers of a task's functions; nothing is answered yet.

    Args:
        worlds: How many.
        vehicles: In each.
        agents: Of these.
        totals: Numbers that the task counts.
        memory: Numbers that it keeps within an episode.
        device: Where.
    """
    out = Answers()
    shapes: dict[str, tuple[Sequence[int], type]] = {
        "reward": ((worlds, agents), wp.float32),
        "terminated": ((worlds,), wp.int32),
        "inside": ((worlds,), wp.int32),
        "counted": ((worlds, totals), wp.float32),
        "position": ((worlds, vehicles), wp.vec3),
        "quaternion": ((worlds, vehicles), wp.quat),
        "velocity": ((worlds, vehicles), vec6),
        "goal_position": ((worlds,), wp.vec3),
        "goal_quaternion": ((worlds,), wp.quat),
        "begun": ((worlds, memory), wp.float32),
        "memory": ((worlds, memory), wp.float32),
    }
    for name, (shape, dtype) in shapes.items():
        setattr(out, name, wp.zeros(shape, dtype=dtype, device=device))
    return out
