"""Thrusters inside the physics kernel: what the lag tends to, what it delivers, and the delay line's command."""

import warp as wp

from finssim.physics.motors import speed_of_thrust, steps_ago, thrust_of_speed
from finssim.physics.plant import VehicleParameters
from finssim.physics.types import MAX_THRUSTERS, vec8


@wp.func
def delivered_thrust(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, actuator: vec8) -> vec8:
    """Force of each thruster [N] for the state of its lag."""
    T = actuator
    if plant[w, v].speed_lag != 0:
        c_plus = plant[w, v].c_plus
        c_minus = plant[w, v].c_minus
        for k in range(MAX_THRUSTERS):
            T[k] = thrust_of_speed(actuator[k], c_plus[k], c_minus[k])
    return wp.cw_mul(plant[w, v].gain, T)


@wp.func
def lag_target(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, force: vec8) -> vec8:
    """What the lag tends to for a force command: the force itself, or the propeller speed that gives it.

    Args:
        plant: Parameters.
        w: World.
        v: Vehicle.
        force: Command, along the thrusters' axes [N].

    Returns:
        In lag units: force [N], or propeller speed [rad/s].
    """
    target = force
    if plant[w, v].speed_lag != 0:
        c_plus = plant[w, v].c_plus
        c_minus = plant[w, v].c_minus
        for k in range(MAX_THRUSTERS):
            target[k] = speed_of_thrust(force[k], c_plus[k], c_minus[k])
    return target


@wp.func
def delayed_command(
    commands: wp.array3d(dtype=vec8),
    w: int,
    v: int,
    head: int,
    elapsed: float,
    delay: float,
    h: float,
    rate: float,
) -> vec8:
    """Mean of the delayed command over the coming substep.

    Args:
        commands: The delay line, by world, vehicle and slot.
        w: World.
        v: Vehicle.
        head: Slot of the delay line that holds the newest command.
        elapsed: Time since the newest command was issued [s].
        delay: Of the command [s].
        h: Substep [s].
        rate: Commands a second [1/s].

    Returns:
        Command in lag units; the exact mean, also when the delay ends inside the substep.
    """
    age = delay - elapsed
    old = steps_ago(age, rate)
    new = steps_ago(age - h, rate)
    command = commands[w, v, slot_before(head, old, commands.shape[2])]
    newer = commands[w, v, slot_before(head, new, commands.shape[2])]
    part = wp.clamp((age * rate - float(new)) / (h * rate), 0.0, 1.0)
    return newer + wp.where(new == old, 1.0, part) * (command - newer)


@wp.func
def slot_before(head: int, steps: int, slots: int) -> int:
    """Slot of a ring that lies `steps` (fewer than `slots`) before its head."""
    slot = head - steps
    return wp.where(slot < 0, slot + slots, slot)
