"""Levels of programmes by what they do to a vehicle: those that move it as others move FinsROV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from finssim.calibration.excitation.programmes import Programme
from finssim.control.pole_placement import AxisModel, axis_model
from finssim.vehicles import AXES, Vehicle, load_vehicle
from finssim.vehicles.capability import level_speed, terminal_speed
from finssim.vehicles.defaults import room

__all__ = ["matched", "trimmed"]

SHARE = 0.9
"""Largest level, part of the wrench limit: the rest is for the controller that holds the other axes."""
BALLASTED = 0.25
"""Weight less buoyancy of a vehicle that floats well enough by itself [N]."""
STEADY = 0.8
"""Fastest surge and sway, part of `level_speed` [-]."""


def matched(levels: Mapping[str, Sequence[float]], vehicle: Vehicle) -> dict[str, list[float]]:
    """Levels that take a vehicle as fast as given ones take FinsROV, in its own lengths, and tilt it as far.

    A linear axis comes to FinsROV's terminal speed times the vehicle's `room`, yaw to FinsROV's rate, roll and pitch to
    FinsROV's angle at rest. Surge and sway stay slower where the vehicle's own righting moment would not hold it: see
    `level_speed`. Programmes then last as long and go as far, in a pool that is `room` times as large.

    Args:
        levels: Axis -> levels for FinsROV [N, N m].
        vehicle: Whose file gives damping, stiffness and limits; axes that it does not control are left out.

    Returns:
        Axis -> levels, to three digits and at most `SHARE` of the limit; FinsROV's own as they are.
    """
    published = load_vehicle("finsrov")
    if vehicle.name == published.name:
        return {axis: list(values) for axis, values in levels.items()}
    ours, theirs, size = axis_model(vehicle), axis_model(published), room(vehicle.body.size)
    found = {}
    for axis, values in levels.items():
        i = AXES.index(axis)  # type: ignore[arg-type]
        if axis not in vehicle.controlled_axes or not vehicle.wrench_limits[i] > 0.0:
            continue
        scale = size if i < 3 else 1.0
        if i < 2:  # all levels of the axis alike, so that those of different trials stay different
            fastest = size * _speed(theirs, i, float(published.wrench_limits[i]))
            scale *= min(1.0, STEADY * level_speed(vehicle, axis=i) / fastest)
        wanted = [_level(ours, theirs, i, scale, value) for value in values]
        most = SHARE * float(vehicle.wrench_limits[i])
        found[axis] = list(dict.fromkeys(float(f"{min(x, most):.3g}") for x in wanted))
    return found


def trimmed(programme: Programme, vehicle: Vehicle) -> Programme:
    """The programme with the vehicle's weight less its buoyancy carried by the thrusters, where it is not ballasted.

    A BlueROV2 that rises with 2 N is out of a shallow pool before its first step; the fit takes what acted.

    Args:
        programme: On any axis.
        vehicle: Whose weight and displaced volume are known.
    """
    net = vehicle.weight - vehicle.buoyancy
    if abs(net) < BALLASTED:
        return programme
    tau = programme.tau_desired.copy()
    tau[:, 2] += net
    return replace(programme, tau_desired=tau)


def _speed(model: AxisModel, i: int, level: float) -> float:
    return terminal_speed(float(model.linear_damping[i]), float(model.quadratic_damping[i]), level)


def _level(ours: AxisModel, theirs: AxisModel, i: int, scale: float, level: float) -> float:
    stiffness = float(ours.stiffness[i]), float(theirs.stiffness[i])
    if min(stiffness) > 0.0:
        return level * stiffness[0] / stiffness[1]
    v = scale * _speed(theirs, i, level)
    return float(ours.linear_damping[i] * v + ours.quadratic_damping[i] * v * v)
