"""The motion that programmes cause: every programme in a world of one simulator, recorded as it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.excitation.programmes import Programme
from finssim.control.allocation import Allocator
from finssim.engine import Pool, Simulator, TetherLine, Water
from finssim.geometry.rotations import quat_from_euler
from finssim.physics.plant import DERIVED
from finssim.vehicles import Vehicle

__all__ = ["Recording", "record"]

Array = NDArray[np.float64]

STEP = 0.005
"""Physics step and time between recorded states [s]."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """True motion of some worlds, one programme each, by (step, world)."""

    step: float
    """Between states [s]."""
    position: NDArray[np.float32]
    """Body origin, world frame [m], (n, W, 3)."""
    quaternion: NDArray[np.float32]
    """Body to world, xyzw, (n, W, 4)."""
    velocity: NDArray[np.float32]
    """nu [m/s, rad/s], (n, W, 6)."""
    acceleration: NDArray[np.float32]
    """nu_dot [m/s², rad/s²], (n, W, 6)."""
    thrust: NDArray[np.float32]
    """What the vehicle file says the propellers give at their speeds, before a plant's `gain` [N], (n, W, k)."""
    command: NDArray[np.float32]
    """Thrust asked for from this state on [N], (n, W, k)."""


def record(
    programmes: Sequence[Programme],
    vehicle: Vehicle,
    *,
    seed: int = 0,
    hydrodynamics: str = "calibrated",
    plant: Mapping[str, ArrayLike] | None = None,
    disturbance: ArrayLike = 0.0,
    water: Water | None = None,
    pool: Pool | None = None,
    tether: TetherLine | None = None,
    depth: float | None = None,
    spread: float = 1.0,
    threads: int | None = None,
    each_step: Callable[[Simulator], None] | None = None,
) -> Recording:
    """The motion that programmes cause, each in a world of one simulator, through motors and allocation.

    Args:
        programmes: What to run, W of them.
        vehicle: The vehicle; its thrusters are commanded by the allocator of `finssim.control.allocation`.
        seed: Of the initial conditions.
        hydrodynamics: Key of the vehicle's hydrodynamic sets.
        plant: Where the real plant differs from the file: field of `VehicleParameters` -> value, or one for each world.
        disturbance: Extra wrench about the body origin, body frame [N, N m], (6,) or (W, 6).
        water: Currents and waves; still water if None.
        pool: Walls and floor; open water if None.
        tether: None if None.
        depth: Of the body origin at the start [m]; 20 m in open water, the middle of a pool.
        spread: Scales the initial conditions, which are at rest and level at 0: at 1, standard deviations of 0.02 m/s,
            0.02 rad/s, 0.01 rad of roll and pitch, and any heading (in a pool 0.05 rad).
        threads: Of the simulator.
        each_step: Called before every step, for what the engine does not have: it may read the simulator's state and
            write `command.disturbance` or plant fields that nothing is derived from, such as `gain`.

    Raises:
        CalibrationError: There is no programme, a field of the plant is unknown, or the motion did not stay finite.
    """
    if not programmes:
        raise CalibrationError("no programme to simulate: give at least one")
    worlds, per_command = len(programmes), round(1.0 / (programmes[0].rate * STEP))
    if any(p.rate != programmes[0].rate for p in programmes) or per_command < 1:
        raise CalibrationError(f"programmes need one common rate of at most {1.0 / STEP:g} Hz")
    simulator = Simulator(
        vehicle,
        worlds=worlds,
        hydrodynamics=hydrodynamics,
        control_step=STEP,
        substeps=1,
        integrator="rk4",
        water=water,
        pool=pool,
        tether=tether,
        seed=seed,
        threads=threads,
        max_delay=_longest_delay(vehicle, plant),
    )
    _override(simulator, plant or {})
    simulator.command.disturbance.numpy()[:, 0] = np.asarray(disturbance)
    _start(simulator, pool, depth, spread, seed)
    command = np.repeat(_commands(programmes, vehicle), per_command, axis=0)
    n, k = len(command) + 1, len(vehicle.thrusters)
    shapes = {"position": 3, "quaternion": 4, "velocity": 6, "acceleration": 6, "actuator": k}
    states = {name: np.empty((n, worlds, size), dtype=np.float32) for name, size in shapes.items()}
    for i in range(n):
        if i > 0:
            simulator.command.thrust.numpy()[:, 0, :k] = command[i - 1]
            if each_step is not None:
                each_step(simulator)
            simulator.step()
        for name, out in states.items():
            out[i] = simulator.numpy(name)[:, 0, : shapes[name]]
    if len(simulator.frozen_worlds()):
        first = programmes[int(simulator.frozen_worlds()[0])].name
        raise CalibrationError(f"{first}: the motion did not stay finite; give lower levels")
    # There is no acceleration before the first step; the one right after it is that of the start.
    states["acceleration"][0] = states["acceleration"][1]
    thrust = _nominal_thrust(states.pop("actuator"), vehicle, bool(simulator.plant.speed_lag.numpy().any()))
    return Recording(step=STEP, thrust=thrust, command=np.concatenate([command, command[-1:]]), **states)


def _longest_delay(vehicle: Vehicle, plant: Mapping[str, ArrayLike] | None) -> float:
    own = max(t.delay for t in vehicle.thrusters.values())
    return max(own, float(np.max((plant or {}).get("delay", 0.0))))


def _override(simulator: Simulator, plant: Mapping[str, ArrayLike]) -> None:
    """Write fields of the plant and refresh what follows from them."""
    for name, value in plant.items():
        if name not in simulator.plant.fields or name in DERIVED:
            known = ", ".join(f for f in simulator.plant.fields if f not in DERIVED)
            raise CalibrationError(f"plant has no field '{name}'; available: {known}")
        view = simulator.plant.fields[name].numpy()[:, 0]
        try:
            view[...] = np.asarray(value)
        except ValueError:
            raise CalibrationError(
                f"plant.{name} has shape {np.shape(value)}, expected {view.shape[1:]} or that for each world"
            ) from None
    simulator.refresh()


def _start(simulator: Simulator, pool: Pool | None, depth: float | None, spread: float, seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    worlds = simulator.worlds
    tilt = 0.01 * spread * rng.standard_normal((2, worlds))
    yaw = spread * (0.05 * rng.standard_normal(worlds) if pool else rng.uniform(-np.pi, np.pi, worlds))
    velocity = 0.02 * spread * rng.standard_normal((worlds, 6))
    if depth is None:
        depth = 0.5 * pool.depth if pool else 20.0
    simulator.place(
        position=(0.0, 0.0, -depth),
        quaternion=quat_from_euler(tilt[0], tilt[1], yaw)[:, None],
        velocity=velocity[:, None],
    )


def _commands(programmes: Sequence[Programme], vehicle: Vehicle) -> NDArray[np.float32]:
    """Thrusts by (row, world, thruster) [N], zero after the end of a programme."""
    allocator = Allocator.from_vehicle(vehicle)
    length = max(len(p.phase) for p in programmes)
    tau = np.zeros((length, len(programmes), 6))
    for w, programme in enumerate(programmes):
        tau[: len(programme.phase), w] = programme.tau_desired
    distinct, index = np.unique(tau.reshape(-1, 6), axis=0, return_inverse=True)
    thrust = allocator.allocate(distinct)
    # The allocator leaves dust of its rounding where nothing is wanted.
    thrust[~distinct.any(axis=1)] = 0.0
    return np.asarray(thrust[index.ravel()].reshape(length, len(programmes), -1), dtype=np.float32)


def _nominal_thrust(actuator: NDArray[np.float32], vehicle: Vehicle, speeds: bool) -> NDArray[np.float32]:
    """Thrusts from what lags in the simulator: forces already, or shaft speeds."""
    if not speeds:
        return actuator
    thrusters = vehicle.thrusters.values()
    return np.stack([x.thrust(actuator[..., k]) for k, x in enumerate(thrusters)], axis=-1).astype(np.float32)
