"""State of every simulated vehicle, as one struct of Warp arrays."""

import warp as wp

from finssim.physics.types import vec6, vec8
from finssim.sim.packed import Packed

HISTORY = 50
"""Number of control steps that are stored to diagnose a frozen world."""

vec13 = wp.types.vector(length=13, dtype=wp.float32)


@wp.struct
class VehicleState:
    """State of one vehicle."""

    position: wp.vec3  # body origin, world frame [m]
    quaternion: wp.quat  # body to world, xyzw
    velocity: vec6  # nu, body frame [m/s, rad/s]
    acceleration: vec6  # nu_dot in this state, body frame [m/s², rad/s²]
    coasting: vec6  # extrapolated: mean nu_dot of the last substep without thrust and contacts [m/s², rad/s²]
    pressed: vec6  # mean nu_dot of the last substep by contacts [m/s², rad/s²]
    actuator: vec8  # lagged force [N] or propeller speed [rad/s]; value of other actuators
    thrust: vec8  # thrust of each thruster [N]; value of other actuators [rad, m³ or m]
    clearing: wp.vec4  # a sphere without solids of the world: centre, world frame, and radius [m]


@wp.struct
class State:
    """Views of the vehicles' states by (world, vehicle); clocks and status by world; delay line and history."""

    vehicle: wp.array2d(dtype=VehicleState)  # memory of the following nine views
    position: wp.array2d(dtype=wp.vec3)  # body origin, world frame [m]
    quaternion: wp.array2d(dtype=wp.quat)  # body to world, xyzw
    velocity: wp.array2d(dtype=vec6)  # nu, body frame [m/s, rad/s]
    acceleration: wp.array2d(dtype=vec6)  # nu_dot in this state, body frame [m/s², rad/s²]
    coasting: wp.array2d(
        dtype=vec6
    )  # mean nu_dot of the last substep without thrust and contacts [m/s², rad/s²]
    pressed: wp.array2d(dtype=vec6)  # mean nu_dot of the last substep by contacts [m/s², rad/s²]
    actuator: wp.array2d(dtype=vec8)  # lagged force [N] or propeller speed [rad/s]
    thrust: wp.array2d(dtype=vec8)  # delivered by each thruster [N]
    clearing: wp.array2d(dtype=wp.vec4)  # a sphere without solids: centre, world frame, and radius [m]
    commands: wp.array3d(dtype=vec8)  # delay line: past commands [N], a ring buffer over control steps
    steps: wp.array(dtype=int)  # control steps since the world's reset
    episode: wp.array(dtype=int)  # resets so far
    broken: wp.array(dtype=int)  # 1: a number stopped being finite in this control step
    frozen: wp.array(dtype=int)  # 1: the world is frozen since a number stopped being finite
    history: wp.array3d(
        dtype=vec13
    )  # (slot, world, vehicle): position [m], quaternion, velocity [m/s, rad/s]


def new_state(vehicles: Packed, slots: int) -> State:
    """Return the state of upright vehicles at the origin.

    Args:
        vehicles: Memory of the `VehicleState`s, by (world, vehicle).
        slots: Length of the delay line, in control steps.
    """
    shape, device = vehicles.array.shape, vehicles.array.device
    state = State()
    state.vehicle = vehicles.array
    for name, view in vehicles.fields.items():
        setattr(state, name, view)
    state.quaternion.fill_(wp.quat(0.0, 0.0, 0.0, 1.0))
    state.commands = wp.zeros((*shape, slots), dtype=vec8, device=device)
    state.history = wp.zeros((HISTORY, *shape), dtype=vec13, device=device)
    for name in ("steps", "episode", "broken", "frozen"):
        setattr(state, name, wp.zeros(shape[0], dtype=wp.int32, device=device))
    return state


@wp.kernel(enable_backward=False)
def clear_actuators(state: State, mask: wp.array(dtype=int), world_offset: int):
    """Start an episode in the worlds where mask is not 0: motors at rest, delay line empty, clocks at zero."""
    i = wp.tid()
    w = world_offset + i
    if mask[w] == 0:
        return
    for v in range(state.position.shape[1]):
        state.acceleration[w, v] = vec6()
        state.coasting[w, v] = vec6()
        state.pressed[w, v] = vec6()
        state.actuator[w, v] = vec8()
        state.thrust[w, v] = vec8()
        for k in range(state.commands.shape[2]):
            state.commands[w, v, k] = vec8()
    state.steps[w] = 0
    state.episode[w] = state.episode[w] + 1
    state.broken[w] = 0
    state.frozen[w] = 0


@wp.func
def is_finite(position: wp.vec3, q: wp.quat, nu: vec6) -> bool:
    """Return True if every number of a state is finite.

    Args:
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        nu: Twist, body frame [m/s, rad/s]; or any other six numbers, such as a wrench.
    """
    return (
        wp.isfinite(wp.dot(position, position))
        and wp.isfinite(q[0] + q[1] + q[2] + q[3])
        and wp.isfinite(wp.dot(nu, nu))
    )


@wp.func
def snapshot(p: wp.vec3, q: wp.quat, nu: vec6) -> vec13:
    """Return a row of the history: position, quaternion, velocity.

    Args:
        p: Body origin, world frame [m].
        q: Attitude, body to world.
        nu: Twist, body frame [m/s, rad/s].
    """
    return vec13(p[0], p[1], p[2], q[0], q[1], q[2], q[3], nu[0], nu[1], nu[2], nu[3], nu[4], nu[5])
