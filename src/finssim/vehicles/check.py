"""Consistency checks of a vehicle's physical parameters: one sentence per result."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.core.registry import CATALOGUE, TERMS
from finssim.core.yaml_file import read_mapping
from finssim.vehicles.capability import panel_drag, terminal_speeds, trim, wrench_capability
from finssim.vehicles.hydrodynamics import HydrodynamicSet
from finssim.vehicles.loader import load_vehicle
from finssim.vehicles.part import VehicleError
from finssim.vehicles.vehicle import AXES, Vehicle

__all__ = ["CheckResult", "check_vehicle"]

PUBLISHED = Path(__file__).with_name("published.yaml")
"""Top speeds and bollard pulls of real vehicles, with sources."""
CURVE_TOLERANCE = 0.01
"""Accepted relative difference between a force limit and the curve at the speed limit."""
PUBLISHED_TOLERANCE = 0.2
"""Relative difference of top speed or bollard pull from the published value that needs no explanation."""
SETS_RATIO = 1.5
"""Ratio of the steady speeds of two hydrodynamic sets under the same force above which a remark is made."""
VOLUME_TOLERANCE = 0.02
CENTROID_TOLERANCE = 0.02
"""Accepted distance between the hull's centroid and the centre of buoyancy, relative to the longest side."""


class CheckResult(NamedTuple):
    """Result of one check."""

    name: str
    passed: bool
    sentence: str
    remark: bool = False
    """True if a check that passed still needs attention."""


def check_vehicle(vehicle: Vehicle) -> list[CheckResult]:
    """Check relations between several numbers; the loader has already refused vehicles that cannot be simulated.

    Returns:
        All results, passed or not: mass matrices, damping, allocation, thrust curves, trim, stability, hull,
        agreement of the hydrodynamic sets, and top speed and bollard pull compared with those of the real
        vehicle, if `published.yaml` contains them.
    """
    return [
        *_mass_matrices(vehicle),
        *_damping(vehicle),
        *([_allocation(vehicle)] if vehicle.thrusters else []),
        *_thrust_curves(vehicle),
        _trim(vehicle),
        _stability(vehicle),
        *_hull(vehicle),
        *_agreement(vehicle),
        *_published(vehicle),
    ]


def _mass_matrices(vehicle: Vehicle) -> Iterator[CheckResult]:
    for name in vehicle.hydrodynamics:
        M = vehicle.mass_matrix(name)
        smallest = float(np.linalg.eigvalsh((M + M.T) / 2.0)[0])
        symmetric = bool(np.allclose(M, M.T, rtol=0.0, atol=1e-9 * np.abs(M).max()))
        yield CheckResult(
            f"mass matrix ({name})",
            symmetric and smallest > 0.0,
            f"M_RB + M_A is {'' if symmetric else 'not '}symmetric, "
            f"its smallest eigenvalue is {smallest:.4g}, expected > 0",
        )


def _damping(vehicle: Vehicle) -> Iterator[CheckResult]:
    for name, chosen in vehicle.hydrodynamics.items():
        if not isinstance(chosen, HydrodynamicSet):
            continue
        coupled = bool(np.any(chosen.quadratic_damping - np.diag(np.diag(chosen.quadratic_damping))))
        parts = {"D1": chosen.linear_damping, "D2": chosen.quadratic_damping}
        if coupled:
            del parts["D2"]
        smallest = {part: float(np.linalg.eigvalsh((D + D.T) / 2.0)[0]) for part, D in parts.items()}
        passed = all(value >= -1e-9 * np.abs(parts[part]).max() for part, value in smallest.items())
        printed = ", ".join(f"{part} {value:.3g}" for part, value in smallest.items())
        sentence = f"smallest eigenvalue of the symmetric parts: {printed}, expected >= 0"
        if coupled:
            share = _least_power(chosen.quadratic_damping)
            passed = passed and share >= 0.0
            sentence += (
                f"; D2 couples axes: over sampled velocities it dissipates at least {share:.3g} of the power "
                "of its diagonal, expected >= 0"
            )
        yield CheckResult(f"damping ({name})", passed, sentence)
        for key, value in chosen.terms.items():
            check = TERMS[key].check
            if check is not None:
                yield CheckResult(f"{key} ({name})", *check(value))


def _least_power(D2: NDArray[np.float64], samples: int = 4000) -> float:
    """Return the smallest ratio of nu · D2 diag(|nu|) nu to its diagonal part, over sampled velocities.

    With couplings the sign depends on nu, and the eigenvalues of D2 do not determine it.
    """
    generator = np.random.default_rng(0)
    nu = generator.standard_normal((samples, 6)) * 10.0 ** generator.uniform(-1.5, 1.5, (samples, 6))
    square = nu * np.abs(nu)
    power = np.einsum("ni,ij,nj->n", nu, D2, square)
    return float(np.min(power / np.einsum("ni,i,ni->n", nu, np.diag(D2), square)))


def _allocation(vehicle: Vehicle) -> CheckResult:
    rows = [AXES.index(axis) for axis in vehicle.controlled_axes]
    B = vehicle.control_matrix[rows]
    rank = int(np.linalg.matrix_rank(B))
    try:
        reach = wrench_capability(vehicle).symmetric[rows]
    except VehicleError:
        reach = np.zeros(len(rows))
    idle = [AXES[row] for row, limit in zip(rows, reach, strict=True) if limit < 1e-6]
    singular = np.linalg.svd(B, compute_uv=False)
    sentence = (
        f"B has rank {rank} for {len(rows)} controlled axes ({', '.join(vehicle.controlled_axes)}), "
        f"condition number {singular[0] / singular[-1] if singular[-1] > 0.0 else math.inf:.3g}"
    )
    if idle:
        sentence += f"; no pure {', '.join(idle)} in both directions: remove it from controlled_axes"
    return CheckResult("allocation", rank == len(rows) and not idle, sentence)


def _thrust_curves(vehicle: Vehicle) -> Iterator[CheckResult]:
    worst, of_which = 0.0, ""
    for name, thruster in vehicle.thrusters.items():
        for side, force, c, rpm in (
            ("forward", thruster.force_max, thruster.c_plus, thruster.rpm_max),
            ("reverse", -thruster.force_min, thruster.c_minus, -thruster.rpm_min),
        ):
            excess = force / (c * (rpm * math.pi / 30.0) ** 2) - 1.0
            if excess > worst:
                worst, of_which = excess, f" ({name}, {side})"
    yield CheckResult(
        "thrust curves",
        worst <= CURVE_TOLERANCE,
        f"force limits exceed the curve at the speed limit by at most {100.0 * worst:.2g} %{of_which}, expected <= 1 %",
    )


def _trim(vehicle: Vehicle) -> CheckResult:
    level = trim(vehicle)
    net = vehicle.buoyancy - vehicle.weight
    drift = "rises" if net > 0.0 else "sinks"
    sentence = f"it {drift} with {abs(net):.3g} N; level at rest needs {_wrench(level.wrench)}"
    if level.forces is None:
        return CheckResult("trim", False, f"{sentence}, which exceeds the limits of the thrusters")
    uncontrolled = [
        a
        for a, x in zip(AXES, level.wrench, strict=True)
        if a not in vehicle.controlled_axes and abs(x) > 1e-6
    ]
    if uncontrolled:
        sentence += f"; {', '.join(uncontrolled)} is not controlled, so it depends on passive stability"
    lower, upper = vehicle.force_limits
    share = float(
        np.max(np.where(level.forces > 0.0, level.forces / upper, level.forces / lower), initial=0.0)
    )
    return CheckResult(
        "trim", share < 1.0, f"{sentence}; the most loaded thruster is at {100.0 * share:.2g} % of its limit"
    )


def _wrench(wrench: NDArray[np.float64]) -> str:
    units = ("N", "N", "N", "N m", "N m", "N m")
    parts = [
        f"{value:.3g} {unit} of {axis}"
        for value, unit, axis in zip(wrench, units, AXES, strict=True)
        if abs(value) > 1e-6
    ]
    return " and ".join(parts) or "nothing"


def _stability(vehicle: Vehicle) -> CheckResult:
    arm = float(vehicle.body.center_of_buoyancy[2] - vehicle.body.center_of_gravity[2])
    return CheckResult(
        "upright",
        arm > 0.0,
        f"the centre of buoyancy lies {arm:.3g} m above the centre of gravity, expected > 0: "
        "otherwise the vehicle turns over at rest",
    )


def _hull(vehicle: Vehicle) -> Iterator[CheckResult]:
    if vehicle.hull is None:
        return
    from finssim.core.mesh import mesh_centroid, mesh_volume

    try:
        vertices, faces = vehicle.hull_mesh()
    except VehicleError as error:
        yield CheckResult("hull", False, str(error))
        return
    yield CheckResult("hull", True, f"the hull of {len(faces)} faces is closed and its normals point outward")
    volume, stated = mesh_volume(vertices, faces), vehicle.body.displaced_volume
    centre, loads, without = vehicle.body.center_of_buoyancy, list(vehicle.payloads.values()), ""
    if vehicle.hull.file is not None and loads:  # payloads are not part of a mesh
        moment = stated * centre - sum(load.volume * load.position for load in loads)
        stated -= math.fsum(load.volume for load in loads)
        centre, without = moment / stated, " without payloads"
    yield CheckResult(
        "hull volume",
        abs(volume / stated - 1.0) <= VOLUME_TOLERANCE,
        f"the hull encloses {volume:.6g} m³, the displaced volume{without} is {stated:.6g} m³, "
        f"expected within {100.0 * VOLUME_TOLERANCE:g} %",
    )
    gap = float(np.linalg.norm(mesh_centroid(vertices, faces) - centre))
    yield CheckResult(
        "hull centroid",
        gap <= CENTROID_TOLERANCE * float(vehicle.body.size.max()),
        f"the hull's centroid is {gap:.3g} m from the centre of buoyancy",
    )


def _agreement(vehicle: Vehicle) -> Iterator[CheckResult]:
    """Remark on hydrodynamic sets of one vehicle whose steady speeds under the same force differ strongly."""
    speeds = {}
    with suppress(VehicleError):  # an invalid hull is reported by another check
        for name, chosen in vehicle.hydrodynamics.items():
            if isinstance(chosen, HydrodynamicSet):
                speeds[name] = terminal_speeds(vehicle, name)[:3]
            else:
                speeds[name] = np.sqrt(vehicle.wrench_limits[:3] / panel_drag(vehicle, name))
    if len(speeds) < 2:
        return
    apart = []
    for i, force in enumerate(vehicle.wrench_limits[:3]):
        ends = [float(speed[i]) for speed in speeds.values()]
        if min(ends) > 0.0 and max(ends) > SETS_RATIO * min(ends):
            found = ", ".join(f"'{name}' {speed[i]:.2f}" for name, speed in speeds.items())
            apart.append(f"{force:.3g} N of {AXES[i]} give {found} m/s")
    sentence = "; ".join(apart) or f"their steady speeds differ by less than a factor of {SETS_RATIO:g}"
    advice = ": they are not the same vehicle; choose one by trials" if apart else ""
    yield CheckResult("hydrodynamic sets", True, sentence + advice, bool(apart))


def _published(vehicle: Vehicle) -> Iterator[CheckResult]:
    """Compare a vehicle of the catalogue with published data of the real one."""
    if vehicle.path is None or vehicle.path.parent != CATALOGUE or "calibrated" not in vehicle.hydrodynamics:
        return
    if vehicle.sha256 != load_vehicle(vehicle.name).sha256:  # the vehicle's parameters have been changed
        return
    rows = read_mapping(PUBLISHED, VehicleError, such_as="remus100: {top_speed: 2.5}")
    row = rows.get(vehicle.name, {})
    ours = {
        "top_speed": (float(terminal_speeds(vehicle)[0]), "top speed", "m/s"),
        **{
            axis: (float(force), f"bollard pull in {axis}", "N")
            for axis, force in zip(AXES, vehicle.wrench_limits, strict=True)
        },
    }
    for key in (key for key in ours if key in row):
        (value, name, unit), real = ours[key], row[key]
        apart = abs(value / real - 1.0) > PUBLISHED_TOLERANCE
        why = f"; {row['why']}" if apart and "why" in row else ""
        sentence = f"{value:.3g} {unit}; the real one {real:g} {unit} ({row['source']}){why}"
        yield CheckResult(name, not apart or "why" in row, sentence, apart)
