"""Parameter arrays of the physics kernel, filled from vehicle files."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.core.registry import TERMS
from finssim.physics.plant import VehicleParameters
from finssim.physics.terms.composed import Item, layout, row_length
from finssim.physics.types import MAX_THRUSTERS
from finssim.sim.packed import Packed
from finssim.vehicles.actuators import installed

if TYPE_CHECKING:
    from finssim.vehicles import Vehicle

Matrix = NDArray[np.float64]

NO_LIMIT = 1.0e9
"""Slew limit of a motor whose file states none."""


class SimulatorError(ValueError):
    """A simulation cannot be set up, or does not support a request."""


def twist_shift(r: Sequence[float]) -> Matrix:
    """Return H with nu(at r) = H nu(at the origin): [[1, -S(r)], [0, 1]]; a 6x6 inertia at r is Hᵀ M H at the
    origin."""
    x, y, z = r
    H = np.eye(6)
    H[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return H


def vehicle_parameters(vehicle: "Vehicle", model: str) -> dict[str, Any]:
    """Return every field of `PlantArrays`, without derived ones, for one vehicle and one hydrodynamic model.

    Args:
        vehicle: The vehicle.
        model: Key of its hydrodynamics.

    Returns:
        Field name -> scalar, vector or matrix, each in its unit.

    Raises:
        SimulatorError: the vehicle has no such model, too many thrusters, or thrusters with different delays.
    """
    if model not in vehicle.hydrodynamics:
        have = ", ".join(sorted(vehicle.hydrodynamics))
        raise SimulatorError(
            f"vehicle '{vehicle.name}' has no hydrodynamics '{model}'; its file gives: {have}"
        )
    body, hydro = vehicle.body, vehicle.hydrodynamics[model]
    zeros = np.zeros((6, 6))
    r_h = np.asarray(hydro.reference_point, dtype=float)
    H = twist_shift(r_h)
    # The simplified model has no added mass by definition (paper, eq. 5), even if the file gives one.
    added = zeros if model == "simplified" else np.asarray(hydro.added_mass, dtype=float)
    r_g = np.asarray(body.center_of_gravity, dtype=float)
    inertia = np.asarray(body.inertia, dtype=float)
    return {
        "mass": body.mass,
        "r_g": r_g,
        "inertia": inertia + body.mass * (r_g @ r_g * np.eye(3) - np.outer(r_g, r_g)),
        "volume": body.displaced_volume,
        "r_b": np.asarray(body.center_of_buoyancy, dtype=float),
        "surface_half_height": body.surface_half_height,
        "half_size": 0.5 * np.asarray(body.size, dtype=float),
        "M_A": H.T @ added @ H,
        "r_h": r_h,
        "D1": np.asarray(getattr(hydro, "linear_damping", zeros), dtype=float),
        "D2": np.asarray(getattr(hydro, "quadratic_damping", zeros), dtype=float),
        "form_drag": getattr(hydro, "form_drag", 0.0),
        "skin_drag": getattr(hydro, "skin_drag", 0.0),
        **getattr(hydro, "term_parameters", {}),
        **thruster_parameters(vehicle),
        **{p: x for item, part in installed(vehicle).items() for p, x in item.numbers(part, vehicle).items()},
    }


def terms_of(vehicles: Sequence["Vehicle"], model: str) -> tuple[Item, ...]:
    """Return the terms and actuators of at least one of the vehicles, in the order of their rows."""
    names = {name for vehicle in vehicles for name in getattr(vehicle.hydrodynamics.get(model), "terms", {})}
    actuators = {item for vehicle in vehicles for item in installed(vehicle)}
    return (*(TERMS[name] for name in sorted(names)), *sorted(actuators, key=lambda item: item.name))


class PlantArrays(Packed):
    """Parameters of vehicles by (world, vehicle): the fields of `VehicleParameters`, and those of terms and
    actuators."""

    def __init__(self, terms: tuple[Item, ...], shape: tuple[int, int], device: wp.Device) -> None:
        """Allocate zeros."""
        super().__init__(VehicleParameters, shape, device)
        self.terms = terms
        rows = (*shape, row_length(terms)) if terms else (1, 1, row_length(terms))
        self.extra: wp.array = wp.zeros(rows, dtype=wp.float32, device=device)
        """Parameters of the terms, (worlds, vehicles, numbers) if there are terms."""
        for slot in layout(terms):
            view = wp.array(
                ptr=self.extra.ptr + 4 * slot.first, dtype=slot.kind, shape=shape, strides=self.extra.strides[:2],
                device=device,
            )  # fmt: skip
            view._ref = self.extra
            self.fields[slot.path] = view


def thruster_parameters(vehicle: "Vehicle") -> dict[str, Any]:
    """Return the fields of `VehicleParameters` by channel for one vehicle: thrusters, other actuators, then
    zeros.

    A channel whose c_plus is 0 follows its command, in the unit of the actuator, for either domain of the
    thrusters.
    """
    thrusters, others = list(vehicle.thrusters.values()), list(vehicle.actuators.values())
    n = len(thrusters)
    if n + len(others) > MAX_THRUSTERS:
        count = f"{n} thrusters" + (f" and {len(others)} other actuators" if others else "")
        raise SimulatorError(f"vehicle '{vehicle.name}' has {count}; at most {MAX_THRUSTERS} are simulated")
    delays = {t.delay for t in thrusters}
    domains = {t.domain for t in thrusters}
    if len(delays) > 1 or len(domains) > 1:
        raise SimulatorError(
            f"vehicle '{vehicle.name}': thrusters differ in delay or domain; give all the same, for they share one link"
        )
    speed = domains == {"speed"}

    def column(values: Iterable[float], of_others: Iterable[float] = ()) -> Matrix:
        row = [*values, *(of_others or [0.0] * len(others))]
        return np.array(row + [0.0] * (MAX_THRUSTERS - len(row)))

    B = np.zeros((6, MAX_THRUSTERS))
    B[:, :n] = vehicle.thruster_matrix()
    return {
        "B": B,
        "force_min": column((t.force_min for t in thrusters), [a.minimum for a in others]),
        "force_max": column((t.force_max for t in thrusters), [a.maximum for a in others]),
        "dead_minus": column(-_force_at(t.dead_rpm_minus, t.c_minus) if speed else 0.0 for t in thrusters),
        "dead_plus": column(_force_at(t.dead_rpm_plus, t.c_plus) if speed else 0.0 for t in thrusters),
        "play": column((0.0 for _ in thrusters), [a.play for a in others]),
        "gain": np.ones(MAX_THRUSTERS),
        "time_constant": column((t.time_constant for t in thrusters), [a.time_constant for a in others]),
        "slew": column(
            (min(t.slew, NO_LIMIT) for t in thrusters), [min(a.rate_limit, NO_LIMIT) for a in others]
        ),
        "delay": max(delays, default=0.0),
        "speed_lag": int(speed),
        "c_plus": column(t.c_plus for t in thrusters),
        "c_minus": column(t.c_minus for t in thrusters),
    }


def _force_at(rpm: float | None, c: float | None) -> float:
    """Return the magnitude of the steady thrust at a shaft speed in rpm [N]; 0 if the file states none."""
    return (c or 0.0) * (abs(rpm or 0.0) * 2.0 * np.pi / 60.0) ** 2


def build_plant(
    vehicles: Sequence["Vehicle"], model: str, worlds: int, hulls: Sequence[int], device: wp.Device
) -> PlantArrays:
    """Return the parameters of `worlds` equal worlds with these vehicles; derived fields are zero until
    refreshed."""
    parameters = [{**vehicle_parameters(v, model), "hull": h} for v, h in zip(vehicles, hulls, strict=True)]
    plant = PlantArrays(terms_of(vehicles, model), (worlds, len(vehicles)), device)
    for name in dict.fromkeys(name for p in parameters for name in p):
        shape = next(np.shape(p[name]) for p in parameters if name in p)
        row = np.stack([np.broadcast_to(p.get(name, 0.0), shape) for p in parameters])
        full = np.broadcast_to(row, (worlds, *row.shape))
        plant.fields[name].assign(np.ascontiguousarray(full, dtype=plant.fields[name].numpy().dtype))
    return plant
