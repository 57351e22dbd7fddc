"""The arrays through which task, action and learner meet: all indexed by world."""

from typing import Any

import numpy as np
import warp as wp

from finssim.control.course import Memory
from finssim.physics.funnel import Funnel
from finssim.physics.types import vec6


@wp.struct
class ReferenceTable:
    """A wanted motion for every world: knots at equal times, between them a cubic with the knots' velocities."""

    position: wp.array2d(dtype=wp.vec3)  # (worlds, knots), world frame [m]
    velocity: wp.array2d(dtype=wp.vec3)  # there [m/s]
    spacing: float  # time between two knots [s]
    duration: wp.array(dtype=float)  # time from progress 0 to 1; held from then on [s]
    offset: wp.array(dtype=float)  # share of the way at the start
    given: wp.array(dtype=int)  # 1: filled from outside; an episode that starts keeps it


@wp.struct
class PathTable:
    """The path of every world: straight legs from point to point."""

    points: wp.array2d(dtype=wp.vec3)  # (worlds, points), world frame [m]
    leg: wp.array(dtype=int)  # the leg that is followed now
    given: wp.array(dtype=int)  # 1: filled from outside; an episode that starts keeps it


@wp.struct
class TargetMotion:
    """Motion of the target of every world; its position is in `goal_position`."""

    velocity: wp.array(dtype=wp.vec3)  # world frame [m/s]
    wanted: wp.array(dtype=wp.vec3)  # what the velocity goes to [m/s]
    until: wp.array(dtype=float)  # time in the episode at which another is drawn [s]
    rng: wp.array(dtype=wp.uint32)  # the world's own random stream


@wp.struct
class MessageTable:
    """Messages that the agents of a world have received, and those under way; see `communication`."""

    on: int  # 0: everybody sees everybody
    period: int  # control steps between two messages of an agent
    slots: int  # messages of one agent that can be under way together
    processing: float  # [s]
    speed_of_sound: float  # [m/s]
    loss: float  # probability, for every receiver
    control_step: float  # [s]
    key: wp.array(dtype=int)  # of the world's random stream in this episode
    sent_position: wp.array2d(dtype=wp.vec3)  # (worlds, sender * slots + slot), world frame [m]
    sent_velocity: wp.array2d(dtype=wp.vec3)  # world frame [m/s]
    sent_step: wp.array2d(dtype=int)
    arrival: wp.array3d(dtype=int)  # (worlds, sender * slots + slot, receiver): control step; -1: never
    position: wp.array2d(dtype=wp.vec3)  # places of the other agents as last heard, world frame [m]
    velocity: wp.array2d(dtype=wp.vec3)
    step: wp.array2d(dtype=int)  # control step at which that was sent


@wp.struct
class NetTable:
    """A net that agents hold, and what drifts in the water to be caught with it."""

    target: wp.array(dtype=wp.vec3)  # world frame [m]
    drift: wp.array(dtype=wp.vec3)  # its velocity while nothing holds it [m/s]
    motion: wp.array(dtype=wp.vec3)  # its velocity now [m/s]


@wp.struct
class Answers:
    """Answers of the functions of a task in plain torch, for the kernels that follow; see `torch_task`."""

    reward: wp.array2d(dtype=float)  # reward, (worlds, agents)
    terminated: wp.array(dtype=int)
    inside: wp.array(dtype=int)  # 1: within the tolerance of success
    counted: wp.array2d(dtype=float)  # (worlds, task.totals): what this step adds to them, in their units
    position: wp.array2d(dtype=wp.vec3)  # (worlds, vehicles), where an episode would start; world frame [m]
    quaternion: wp.array2d(dtype=wp.quat)
    velocity: wp.array2d(dtype=vec6)
    goal_position: wp.array(dtype=wp.vec3)
    goal_quaternion: wp.array(dtype=wp.quat)
    begun: wp.array2d(dtype=float)  # (worlds, numbers): memory at the start, in the units of the task
    memory: wp.array2d(dtype=float)  # (worlds, numbers): what the task keeps within an episode, in its units


@wp.struct
class TaskArrays:
    """Inputs and outputs of a task for every world.

    The first vehicles of a world are the agents, those that learn; the task itself commands the others. Where there are
    several agents, their numbers lie one after the other: number i of agent a is [w, a * size + i].
    """

    action: wp.array2d(dtype=float)  # (worlds, agents * size), each in [-1, 1]
    action_size: int  # of one vehicle
    previous_action: wp.array2d(dtype=float)
    time: wp.array(dtype=float)  # in the episode [s]
    scripted: wp.array2d(dtype=float)  # (worlds, others * size): actions of the vehicles that do not learn
    observation: wp.array2d(dtype=float)  # observation, (worlds, agents * size)
    taught: wp.array2d(dtype=float)  # (worlds, agents * size): observation of a teacher
    final_observation: wp.array2d(dtype=float)  # last observation of the episode that ended in this step
    reward: wp.array(dtype=float)  # reward of all agents together: their mean
    agent_reward: wp.array2d(dtype=float)  # (worlds, agents); of a single agent the same memory as `reward`
    terminated: wp.array(dtype=int)  # 1: ended by the task (left the pool, broke)
    truncated: wp.array(dtype=int)  # 1: ended by the time limit
    done: wp.array(dtype=int)  # terminated or truncated: reset in this step
    episode_return: wp.array(dtype=float)  # sum of rewards of the running episode
    final_return: wp.array(dtype=float)  # sum of rewards of the episode that ended last
    final_length: wp.array(dtype=int)  # its control steps
    held: wp.array(dtype=float)  # time inside the success tolerance so far [s]
    final_held: wp.array(dtype=float)  # the same when the last episode ended [s]
    totals: wp.array2d(dtype=float)  # (worlds, task.totals): what the task counts in the episode, from 0
    final_totals: wp.array2d(dtype=float)  # the same when the last episode ended, in their units
    earned: wp.array2d(
        dtype=float
    )  # (worlds, rewards and ends): what each added to the return, mean over agents
    final_earned: wp.array2d(dtype=float)  # the same rewards when the last episode ended
    goal_position: wp.array(dtype=wp.vec3)  # world frame [m]
    goal_quaternion: wp.array(dtype=wp.quat)  # body to world
    reference: ReferenceTable  # of tasks that follow one
    current: wp.array(dtype=wp.vec3)  # of the water at the surface, world frame [m/s]: the simulator's
    seabed: wp.array2d(
        dtype=wp.vec4
    )  # (worlds, ripples) of tasks over a seabed: height [m], wave number [rad/m],
    # direction [rad] and phase [rad] of each
    path: PathTable  # of tasks along a path in space
    target: TargetMotion  # of tasks whose goal moves
    funnel: Funnel  # of tasks with a dock: the simulator's; its pose is the goal's
    steering: wp.array2d(dtype=Memory)  # (worlds, vehicles): memory of autopilots [m, rad, N, N m, m/s]
    messages: MessageTable  # of tasks whose agents talk to each other
    net: NetTable  # of tasks whose agents hold a net
    answers: Answers  # of tasks in plain torch
    position: wp.array2d(dtype=wp.vec3)  # (worlds, vehicles), as measured, maybe with noise; world frame [m]
    quaternion: wp.array2d(dtype=wp.quat)
    velocity: wp.array2d(dtype=vec6)
    ranges: wp.array2d(
        dtype=float
    )  # (worlds, task.ranges), as measured [m]; infinite where nothing is in reach
    privileged: wp.array2d(dtype=float)  # (worlds, agents * P): what was drawn, from nominal, unit scale
    final_privileged: wp.array2d(dtype=float)  # the same of the episode that ended last [-]


def allocated(kind: Any, worlds: int, device: wp.Device, **columns: int | tuple[int, ...]) -> Any:
    """A struct of arrays by world, all zero.

    Args:
        kind: The struct.
        worlds: How many.
        device: Where.
        columns: Sizes of the dimensions after the worlds, by the name of an array. Arrays with such dimensions that are
            not named are left for who fills or aliases them.
    """
    out = kind()
    for name, variable in kind.vars.items():
        if isinstance(variable.type, wp.array) and (name in columns or variable.type.ndim == 1):
            shape = np.append(worlds, columns.get(name, ())).astype(int)
            setattr(out, name, wp.zeros(tuple(shape.tolist()), dtype=variable.type.dtype, device=device))
    return out
