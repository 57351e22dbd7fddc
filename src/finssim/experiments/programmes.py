"""Programmes of a demonstration: levels that move a vehicle as FinsROV is moved, square waves, and steps on rails."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.excitation.programmes import RATE, Programme, which_axes
from finssim.control.allocator import Allocator
from finssim.control.pole_placement import AxisModel, axis_model
from finssim.pool import PlantSpec, draw_plant
from finssim.pool.plant import Plant
from finssim.pool.plant_spec import Basin
from finssim.pool.water_spec import BuoyancyDrift, Circulation
from finssim.quiet import start_warp
from finssim.vehicles import AXES, Vehicle, load_vehicle
from finssim.vehicles.capability import level_speed, terminal_speed
from finssim.vehicles.defaults import room

__all__ = ["compare_steps", "matched", "shuttles", "trimmed"]

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


PERIODS = {"surge": 4.0, "sway": 4.0, "heave": 2.4, "roll": 2.0, "pitch": 2.0, "yaw": 4.0}
"""Of the wave, some five time constants of a small vehicle [s]."""
WAVES = 2.5
"""The first and the last half of a half wave, so that the middle of the way is where it began."""


def shuttles(levels: Mapping[str, Sequence[float]], vehicle: Vehicle) -> list[Programme]:
    """Square waves, two and a half periods each, which begin with half of a push.

    Steps tell the drag, for most of a step is steady; mass is told by what is not, and the propellers of the two
    directions, which differ, average out within a trial.

    Args:
        levels: Axis -> magnitudes [N, N m].
        vehicle: Must control the axes.

    Raises:
        CalibrationError: An axis that the vehicle does not control.
    """
    return [
        _shuttle(axis, level, PERIODS[axis])
        for axis in which_axes(list(levels), vehicle)
        for level in levels[axis]
    ]


def _shuttle(axis: str, level: float, period: float) -> Programme:
    counts = [round(s * RATE) for s in (1.0, 1.0, WAVES * period, 2.0, 1.0)]
    phase = np.repeat(np.array(["rest", "baseline", "excitation", "coast", "rest"]), counts)
    t = np.arange(counts[2]) / RATE
    tau = np.zeros((len(phase), 6))
    # A cosine's sign: a quarter of the period forward, half of it back, and so on.
    tau[phase == "excitation", AXES.index(axis)] = level * np.sign(
        np.cos(2.0 * math.pi * (t + 1e-6) / period)
    )
    return Programme(
        name=f"{axis}_shuttle_{level:.4g}",
        axes=(axis,),  # type: ignore[arg-type]
        rate=RATE,
        tau_desired=tau,
        phase=phase,
    )


Array = NDArray[np.float64]

PUSH, REST = 6.0, 1.0
"""Lengths of a step and of the pause before the next one [s]."""
OPEN = Basin(length=60.0, width=60.0, depth=60.0)


@dataclass(frozen=True)
class StepResponse:
    """Of one axis to one level, the mean of both directions."""

    speed: float
    """Terminal [m/s, rad/s]."""
    time_constant: float
    """Until 63 % of it, motors included [s]."""


def step_responses(
    vehicle: Vehicle, spec: PlantSpec, levels: Mapping[str, Sequence[float]]
) -> dict[tuple[str, float], StepResponse]:
    """Steps of a plant on rails: it can move along one axis alone, in water at rest, far from everything.

    Args:
        vehicle: By whose file the wrench is allocated and becomes shaft speeds.
        spec: The plant; current, tether and drift of the buoyancy are left out.
        levels: Axis -> wrenches [N, N m].

    Returns:
        (axis, level) -> response.
    """
    start_warp()
    still = {"basin": OPEN, "circulation": Circulation(), "tether": None, "buoyancy": BuoyancyDrift()}
    plant = Plant(vehicle, spec.model_copy(update=still), position=(0.0, 0.0, -30.0))
    found = {}
    for axis, values in levels.items():
        for level in values:
            both = [_step(plant, vehicle, AXES.index(axis), sign * level) for sign in (1.0, -1.0)]
            speed, time = np.mean(both, axis=0)
            found[axis, level] = StepResponse(float(speed), float(time))
    return found


def compare_steps(
    identified: Vehicle, standing: Vehicle, spec: PlantSpec, levels: Mapping[str, Sequence[float]]
) -> list[dict[str, float | str]]:
    """Terminal speeds and time constants of an identified vehicle beside those of the plant that it was identified in.

    Args:
        identified: The vehicle; its plant is its file to the letter.
        standing: Around which the plant was drawn.
        spec: The plant.
        levels: Axis -> wrenches, by the file that robots have [N, N m].

    Returns:
        A row for each axis and level: axis, level, speed and time constant of `model` and `plant`.
    """
    model = step_responses(identified, draw_plant(identified, 0, "nominal"), levels)
    real = step_responses(standing, spec, levels)
    return [
        {
            "axis": axis,
            "level": level,
            "model_speed": model[axis, level].speed,
            "plant_speed": response.speed,
            "model_time_constant": model[axis, level].time_constant,
            "plant_time_constant": response.time_constant,
        }
        for (axis, level), response in real.items()
    ]


def _step(plant: Plant, vehicle: Vehicle, axis: int, level: float) -> tuple[float, float]:
    """Terminal speed and time constant."""
    tau = np.zeros(6)
    tau[axis] = level
    force, _ = Allocator.from_vehicle(vehicle).allocate(tau)
    speeds = [t.speed(f) for t, f in zip(vehicle.thrusters.values(), force, strict=True)]
    _ride(plant, axis, np.zeros(len(speeds)), REST)
    plant.nu[:] = 0.0
    nu = np.abs(_ride(plant, axis, np.array(speeds), PUSH))
    speed = float(nu[-round(0.5 / plant.step) :].mean())
    return speed, float(np.argmax(nu >= 0.632 * speed) * plant.step)


def _ride(plant: Plant, axis: int, target: Array, duration: float) -> Array:
    """Speed along the rail at every physics step."""
    out = np.empty(round(duration / plant.step))
    plant.target[:] = target
    for k in range(len(out)):
        plant.advance()
        out[k] = plant.nu[axis]
        plant.nu[:] = np.where(np.arange(6) == axis, plant.nu, 0.0)
        plant.position[:] = (0.0, 0.0, -30.0)
        plant.quaternion[:] = (0.0, 0.0, 0.0, 1.0)
    return out
