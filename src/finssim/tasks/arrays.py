"""Arrays shared by task, action and learner, all indexed by world."""

from typing import Any

import numpy as np
import warp as wp

from finssim.control.course import Memory
from finssim.physics.funnel import Funnel
from finssim.physics.types import vec6


@wp.struct
class ReferenceTable:
    """Reference trajectory of every world: equally spaced knots, with cubic Hermite interpolation between them."""

    position: wp.array2d(dtype=wp.vec3)  # (worlds, knots), world frame [m]
    velocity: wp.array2d(dtype=wp.vec3)  # at the knots, world frame [m/s]
    spacing: float  # time between two knots [s]
    duration: wp.array(dtype=float)  # time from progress 0 to 1; the end is held from then on [s]
    offset: wp.array(dtype=float)  # progress at the start, fraction of the trajectory
    given: wp.array(dtype=int)  # 1: filled by the caller; a new episode keeps it


@wp.struct
class PathTable:
    """The path of every world: straight legs from point to point."""

    points: wp.array2d(dtype=wp.vec3)  # (worlds, points), world frame [m]
    leg: wp.array(dtype=int)  # index of the leg that is currently followed
    given: wp.array(dtype=int)  # 1: filled by the caller; a new episode keeps it


@wp.struct
class TargetMotion:
    """Motion of the target of every world; its position is in `goal_position`."""

    velocity: wp.array(dtype=wp.vec3)  # world frame [m/s]
    wanted: wp.array(dtype=wp.vec3)  # velocity that the target accelerates to [m/s]
    until: wp.array(dtype=float)  # time in the episode at which the next velocity is drawn [s]
    rng: wp.array(dtype=wp.uint32)  # the world's own random stream


@wp.struct
class MessageTable:
    """Messages that the agents of a world have received, and those in transit; see `communication`."""

    on: int  # 0: every agent observes all others directly
    period: int  # control steps between two messages of an agent
    slots: int  # messages of one agent that can be in transit at once
    processing: float  # [s]
    speed_of_sound: float  # [m/s]
    loss: float  # loss probability for each receiver
    control_step: float  # [s]
    key: wp.array(dtype=int)  # key of the world's random stream in this episode
    sent_position: wp.array2d(dtype=wp.vec3)  # (worlds, sender * slots + slot), world frame [m]
    sent_velocity: wp.array2d(dtype=wp.vec3)  # world frame [m/s]
    sent_step: wp.array2d(dtype=int)
    arrival: wp.array3d(dtype=int)  # (worlds, sender * slots + slot, receiver): control step; -1: never
    position: wp.array2d(dtype=wp.vec3)  # last received positions of the other agents, world frame [m]
    velocity: wp.array2d(dtype=wp.vec3)
    step: wp.array2d(dtype=int)  # control step in which they were sent


@wp.struct
class NetTable:
    """A net that agents carry, and the drifting target that it catches."""

    target: wp.array(dtype=wp.vec3)  # world frame [m]
    drift: wp.array(dtype=wp.vec3)  # velocity of the target while it drifts freely [m/s]
    motion: wp.array(dtype=wp.vec3)  # current velocity of the target [m/s]


@wp.struct
class TorchResults:
    """Results of the functions of a task in plain torch, for the kernels that follow; see `torch_task`."""

    reward: wp.array2d(dtype=float)  # reward, (worlds, agents)
    terminated: wp.array(dtype=int)
    inside: wp.array(dtype=int)  # 1: within the tolerance of success
    counted: wp.array2d(dtype=float)  # (worlds, task.totals): increments of this step, in their units
    position: wp.array2d(dtype=wp.vec3)  # (worlds, vehicles), at the start of an episode; world frame [m]
    quaternion: wp.array2d(dtype=wp.quat)
    velocity: wp.array2d(dtype=vec6)
    goal_position: wp.array(dtype=wp.vec3)
    goal_quaternion: wp.array(dtype=wp.quat)
    begun: wp.array2d(dtype=float)  # (worlds, numbers): memory at the start, in the units of the task
    memory: wp.array2d(dtype=float)  # (worlds, numbers): memory during the episode, in the units of the task


@wp.struct
class TaskArrays:
    """Inputs and outputs of a task for every world.

    The first vehicles of a world are the agents, which learn; the task itself commands the others. The numbers of
    several agents are concatenated: number i of agent a is [w, a * size + i].
    """

    action: wp.array2d(dtype=float)  # (worlds, agents * size), each in [-1, 1]
    action_size: int  # numbers in the action of one vehicle
    previous_action: wp.array2d(dtype=float)
    time: wp.array(dtype=float)  # time in the episode [s]
    scripted: wp.array2d(dtype=float)  # (worlds, others * size): actions of the vehicles that do not learn
    observation: wp.array2d(dtype=float)  # observation, (worlds, agents * size)
    taught: wp.array2d(dtype=float)  # (worlds, agents * size): observation of a teacher
    final_observation: wp.array2d(dtype=float)  # last observation of the latest finished episode
    reward: wp.array(dtype=float)  # reward, mean over all agents
    agent_reward: wp.array2d(dtype=float)  # (worlds, agents); the same memory as `reward` for a single agent
    terminated: wp.array(dtype=int)  # 1: ended by the task (left the pool, diverged)
    truncated: wp.array(dtype=int)  # 1: ended by the time limit
    done: wp.array(dtype=int)  # terminated or truncated: reset in this step
    episode_return: wp.array(dtype=float)  # sum of rewards of the current episode
    final_return: wp.array(dtype=float)  # sum of rewards of the latest finished episode
    final_length: wp.array(dtype=int)  # its length in control steps
    held: wp.array(dtype=float)  # time so far within the success tolerance without a break [s]
    final_held: wp.array(dtype=float)  # the same at the end of the latest finished episode [s]
    totals: wp.array2d(dtype=float)  # (worlds, task.totals): totals of the episode, from 0, in their units
    final_totals: wp.array2d(dtype=float)  # the same of the latest finished episode, in their units
    earned: wp.array2d(
        dtype=float
    )  # (worlds, rewards and ends): contributions to the return, mean over agents
    final_earned: wp.array2d(dtype=float)  # the same rewards of the latest finished episode
    goal_position: wp.array(dtype=wp.vec3)  # world frame [m]
    goal_quaternion: wp.array(dtype=wp.quat)  # body to world
    reference: ReferenceTable  # only for tasks that follow a reference
    current: wp.array(dtype=wp.vec3)  # current at the surface, world frame [m/s]: the simulator's array
    seabed: wp.array2d(
        dtype=wp.vec4
    )  # (worlds, ripples): height [m], wave number [rad/m], direction, phase [rad]
    path: PathTable  # only for tasks along a path in space
    target: TargetMotion  # only for tasks with a moving goal
    funnel: Funnel  # only for tasks with a dock: the simulator's struct; its pose is the goal's
    steering: wp.array2d(dtype=Memory)  # (worlds, vehicles): state of the autopilots [m, rad, N, N m, m/s]
    messages: MessageTable  # only for tasks with communication between agents
    net: NetTable  # only for tasks with a net
    torch_results: TorchResults  # only for tasks in plain torch
    position: wp.array2d(dtype=wp.vec3)  # (worlds, vehicles), as measured; world frame [m]
    quaternion: wp.array2d(dtype=wp.quat)
    velocity: wp.array2d(dtype=vec6)
    ranges: wp.array2d(dtype=float)  # (worlds, task.ranges), as measured [m]; infinite without an echo
    privileged: wp.array2d(dtype=float)  # (worlds, agents * P): drawn parameters, scaled deviations [-]
    final_privileged: wp.array2d(dtype=float)  # the same of the latest finished episode [-]


def allocated(kind: Any, worlds: int, device: wp.Device, **columns: int | tuple[int, ...]) -> Any:
    """Return a struct of arrays by world, all zero.

    Args:
        kind: The struct.
        worlds: Number of worlds.
        device: Warp device of the arrays.
        columns: Sizes of the dimensions after the worlds, by the name of an array. Arrays with further dimensions that
            are not named are not allocated: the caller fills or aliases them.
    """
    out = kind()
    for name, variable in kind.vars.items():
        if isinstance(variable.type, wp.array) and (name in columns or variable.type.ndim == 1):
            shape = np.append(worlds, columns.get(name, ())).astype(int)
            setattr(out, name, wp.zeros(tuple(shape.tolist()), dtype=variable.type.dtype, device=device))
    return out
