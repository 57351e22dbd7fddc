"""What is the same in every step and start of a task in plain torch: kernels that go on with the functions' answers."""

from collections.abc import Sequence

import warp as wp

from finssim.engine.state import State
from finssim.physics.types import vec6
from finssim.tasks.arrays import Answers, TaskArrays
from finssim.tasks.episode import close_episode, open_episode, report_frozen


@wp.struct
class Times:
    """The times of a task [s]."""

    time_limit: float
    control_step: float


@wp.kernel(enable_backward=False)
def finish_step(state: State, arrays: TaskArrays, times: Times, world_offset: int):
    """After a step, with reward, ends, totals and observation answered: what every task does with them."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        for a in range(arrays.agent_reward.shape[1]):
            arrays.agent_reward[w, a] = 0.0
        report_frozen(state, arrays, w)
        return
    total = float(0.0)
    for a in range(arrays.agent_reward.shape[1]):
        arrays.agent_reward[w, a] = arrays.answers.reward[w, a]
        total += arrays.answers.reward[w, a]
    reward = total / float(arrays.agent_reward.shape[1])
    failed = arrays.answers.terminated[w] != 0
    late = float(state.steps[w]) * times.control_step >= times.time_limit - 0.5 * times.control_step
    done = failed or late
    arrays.held[w] = wp.where(arrays.answers.inside[w] != 0, arrays.held[w] + times.control_step, 0.0)
    arrays.reward[w] = reward
    arrays.terminated[w] = wp.where(failed, 1, 0)
    arrays.truncated[w] = wp.where(late and not failed, 1, 0)
    arrays.done[w] = wp.where(done, 1, 0)
    arrays.episode_return[w] = arrays.episode_return[w] + reward
    for i in range(arrays.totals.shape[1]):
        arrays.totals[w, i] = arrays.totals[w, i] + arrays.answers.counted[w, i]
    for i in range(arrays.observation.shape[1]):
        arrays.observation[w, i] = arrays.answers.observation[w, i]
    for i in range(arrays.action.shape[1]):
        arrays.previous_action[w, i] = wp.clamp(arrays.action[w, i], -1.0, 1.0)
    if done:
        close_episode(state, arrays, w)


@wp.kernel(enable_backward=False)
def begin_episode(state: State, arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """Take the answered start where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    for v in range(state.position.shape[1]):
        state.position[w, v] = arrays.answers.position[w, v]
        state.quaternion[w, v] = wp.normalize(arrays.answers.quaternion[w, v])
        state.velocity[w, v] = arrays.answers.velocity[w, v]
    arrays.goal_position[w] = arrays.answers.goal_position[w]
    arrays.goal_quaternion[w] = wp.normalize(arrays.answers.goal_quaternion[w])
    for i in range(arrays.answers.memory.shape[1]):
        arrays.answers.memory[w, i] = arrays.answers.begun[w, i]
    open_episode(arrays, w)


@wp.kernel(enable_backward=False)
def first_observation(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """Take the answered observation where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        for i in range(arrays.observation.shape[1]):
            arrays.observation[w, i] = arrays.answers.observation[w, i]


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
    observation: int,
    totals: int,
    memory: int,
    device: wp.Device,
) -> Answers:
    """Room for the answers of a task's functions; nothing is answered yet.

    Args:
        worlds: How many.
        vehicles: In each.
        agents: Of these.
        observation: Numbers in the observation of an agent.
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
        "observation": ((worlds, agents * observation), wp.float32),
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
