"""Episodes that start at given poses towards given goals, in place of drawn ones."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from finssim.tasks.environment import Environment


def place(
    environment: "Environment",
    position: ArrayLike,
    quaternion: ArrayLike,
    goal_position: ArrayLike,
    goal_quaternion: ArrayLike,
) -> None:
    """Put vehicle 0 of every world somewhere at rest, with a goal; an episode must just have begun there.

    Args:
        environment: The worlds.
        position: World frame [m], broadcastable to (worlds, 3).
        quaternion: Body to world, xyzw, broadcastable to (worlds, 4).
        goal_position: World frame [m], broadcastable to (worlds, 3).
        goal_quaternion: Body to world, broadcastable to (worlds, 4).
    """
    state, arrays, worlds = environment.simulator.state, environment.arrays, environment.worlds
    for array, value, width in ((state.position, position, 3), (state.quaternion, quaternion, 4)):
        everyone = array.numpy().copy()
        everyone[:, 0] = np.broadcast_to(np.asarray(value, dtype=np.float32), (worlds, width))
        array.assign(everyone)
    state.velocity.zero_()
    for array, value, width in (
        (arrays.goal_position, goal_position, 3),
        (arrays.goal_quaternion, goal_quaternion, 4),
    ):
        array.assign(np.array(np.broadcast_to(np.asarray(value, dtype=np.float32), (worlds, width))))
