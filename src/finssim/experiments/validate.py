"""`finssim validate`: simulated steady speeds beside those that the vehicle's authors measured in their pool."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from finssim.control.allocation import Allocator
from finssim.engine import Simulator
from finssim.experiments.tables import Table
from finssim.provenance import provenance
from finssim.vehicles import AXES, Vehicle, load_vehicle

PUBLISHED = Path(__file__).parent / "published"
DURATION = 6.0
"""Of each run [s]: eight of the slowest time constants, but too short for added mass to turn a straight run."""
AGREES = 0.15
"""Relative difference up to which a simulated speed is said to agree with the measured one."""


class ValidationError(ValueError):
    """There is nothing published to compare with."""


@dataclass(frozen=True)
class Response:
    """One published response, and ours."""

    name: str
    axis: str
    command: float
    """About the centre of gravity [N or N m]."""
    applied: float
    """The same axis of the wrench that the thrusters can give [N or N m]."""
    simulated: float
    """Steady speed [m/s or rad/s]."""
    measured: tuple[float, float]
    """Published, least and greatest [m/s or rad/s]."""
    why: str = ""
    """What is known of a disagreement."""

    @property
    def difference(self) -> float:
        """(simulated - measured) / measured, from the nearer end of the measured range; 0 inside it."""
        low, high = self.measured
        speed = abs(self.simulated)
        nearest = min(max(speed, low), high)
        return (speed - nearest) / nearest

    @property
    def agrees(self) -> bool:
        """Whether the difference is at most `AGREES`."""
        return abs(self.difference) <= AGREES


def published(vehicle: Vehicle) -> dict[str, Any]:
    """The responses published for a vehicle.

    Raises:
        ValidationError: none are, and it says for which vehicles some are.
    """
    path = PUBLISHED / f"{vehicle.name}.yaml"
    if not path.is_file():
        have = ", ".join(sorted(p.stem for p in PUBLISHED.glob("*.yaml")))
        raise ValidationError(
            f"no published responses of '{vehicle.name}' to compare with; available: {have}"
        )
    data: dict[str, Any] = yaml.safe_load(path.read_text())
    return data


def simulate_responses(vehicle: Vehicle, hydrodynamics: str = "calibrated") -> list[Response]:
    """Apply every published command to the vehicle at rest in deep water, all as worlds of one batch.

    Args:
        vehicle: The vehicle.
        hydrodynamics: The model.

    Returns:
        One response per published one, in that order; speeds are means over the last quarter of the run.
    """
    cases = published(vehicle)["responses"]
    axis = [AXES.index(case["axis"]) for case in cases]
    tau = np.zeros((len(cases), 6))
    tau[np.arange(len(cases)), axis] = [case["command"] for case in cases]
    allocator = Allocator.from_vehicle(vehicle)
    thrust = allocator.allocate(tau)
    speed = steady_speeds(vehicle, hydrodynamics, thrust)
    given = allocator.achieved(thrust)
    return [
        Response(
            name=case["name"],
            axis=case["axis"],
            command=case["command"],
            applied=float(given[i, axis[i]]),
            simulated=float(speed[i, axis[i]]),
            measured=(case["measured"][0], case["measured"][1]),
            why=case.get("why", "").strip(),
        )
        for i, case in enumerate(cases)
    ]


def steady_speeds(vehicle: Vehicle, hydrodynamics: str, thrust: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean nu over the last quarter of a run from rest under constant thrust.

    Args:
        vehicle: The vehicle.
        hydrodynamics: The model.
        thrust: Of each thruster, in the vehicle's order [N], (cases, n).

    Returns:
        Twist, body frame [m/s, rad/s], (cases, 6).
    """
    simulator = Simulator(vehicle, worlds=len(thrust), hydrodynamics=hydrodynamics, control_step=0.1)
    simulator.place(position=(0.0, 0.0, -100.0))
    simulator.set_thrust(thrust[:, None, :])
    steps = round(DURATION / simulator.control_step)
    total = np.zeros((len(thrust), 6))
    for step in range(steps):
        simulator.step()
        if step >= 3 * steps // 4:
            total += simulator.numpy("velocity")[:, 0]
    return total / (steps - 3 * steps // 4)


def validate(name: str, *, hydrodynamics: str = "calibrated") -> dict[str, Any]:
    """Print simulated beside published pool responses, and say where they disagree.

    Example: finssim validate finsrov

    Args:
        name (NAME): Vehicle with published responses: finsrov.
        hydrodynamics (MODEL): Hydrodynamic model: calibrated, simplified or mesh.

    Raises:
        ValidationError: nothing is published of this vehicle.
    """
    vehicle = load_vehicle(name)
    source = published(vehicle)["source"]
    responses = simulate_responses(vehicle, hydrodynamics)
    return {
        "vehicle": {"name": vehicle.name, "sha256": vehicle.sha256},
        "hydrodynamics": hydrodynamics,
        "source": source,
        "responses": [{**asdict(r), "difference": r.difference, "agrees": r.agrees} for r in responses],
        "provenance": provenance(),
    }


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """A row for each response, and what is known of those that disagree."""
    rows = []
    for r in result["responses"]:
        unit, speed = ("N m", "rad/s") if r["axis"] in AXES[3:] else ("N", "m/s")
        low, high = r["measured"]
        measured = f"{low:.3f}" if low == high else f"{low:.3f} to {high:.3f}"
        numbers = (f"{r['applied']:.2f} {unit}", f"{abs(r['simulated']):.3f} {speed}", f"{measured} {speed}")
        verdict = "agrees" if r["agrees"] else "DISAGREES"
        rows.append([r["name"], *numbers, f"{100.0 * r['difference']:+.0f} %", verdict])
    table = Table(
        title=f"{result['vehicle']['name']}, {result['hydrodynamics']}: steady speeds",
        heads=("command", "applied", "simulated", "measured in the pool", "difference", ""),
        rows=rows,
        left=(0, 5),
        note=f"measured: {result['source']}; agreement is within {100 * AGREES:.0f} %",
        sentences=[f"{r['name']}: {r['why']}" for r in result["responses"] if r["why"] and not r["agrees"]],
    )
    return [table]
