"""Simulated steady speeds beside those measured by the vehicle's authors: `python
benchmarks/published_responses.py`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from finssim.cli.command_line import run_script
from finssim.control.allocation import Allocator
from finssim.core.provenance import provenance
from finssim.evaluation.tables import Table
from finssim.sim import Simulator
from finssim.vehicles import AXES, Vehicle, load_vehicle

PUBLISHED = Path(__file__).parent / "published"
DURATION = 6.0
"""Length of each run [s]: eight of the slowest time constants, but too short for added mass to turn a straight run."""
AGREES = 0.15
"""Largest relative difference at which a simulated speed counts as equal to the measured one [-]."""


class ValidationError(ValueError):
    """No published responses to compare with."""


def simulate_responses(vehicle: Vehicle, hydrodynamics: str = "calibrated") -> dict[str, Any]:
    """Simulate every published command from rest in deep water, each in its own world of one batch.

    Args:
        vehicle: The vehicle.
        hydrodynamics: The model.

    Returns:
        `source` of the measurements, and `responses`, each with `name`, `axis`, `command` about the centre of gravity
        and `applied`, the same axis of the wrench that the thrusters can give [N or N m]; `simulated`, mean speed over
        the last quarter of the run, and `measured`, the least and greatest published [m/s or rad/s]; `difference`,
        relative to the nearer end of the measured range, 0 inside it; `agrees`; `why`, the known reason of a
        disagreement.

    Raises:
        ValidationError: No responses of this vehicle are published; the message lists the vehicles that have some.
    """
    path = PUBLISHED / f"{vehicle.name}.yaml"
    if not path.is_file():
        have = ", ".join(sorted(p.stem for p in PUBLISHED.glob("*.yaml")))
        raise ValidationError(
            f"no published responses of '{vehicle.name}' to compare with; available: {have}"
        )
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    cases = data["responses"]
    rows, axis = np.arange(len(cases)), [AXES.index(case["axis"]) for case in cases]
    tau = np.zeros((len(cases), 6))
    tau[rows, axis] = [case["command"] for case in cases]
    allocator = Allocator.from_vehicle(vehicle)
    thrust = allocator.allocate(tau)
    simulator = Simulator(vehicle, worlds=len(cases), hydrodynamics=hydrodynamics, control_step=0.1)
    simulator.place(position=(0.0, 0.0, -100.0))
    simulator.set_thrust(thrust[:, None, :])
    speeds = []
    for _ in range(round(DURATION / simulator.control_step)):
        simulator.step()
        speeds.append(simulator.numpy("velocity")[rows, 0, axis].astype(float))
    simulated = np.mean(speeds[3 * len(speeds) // 4 :], axis=0)
    low, high = np.transpose([case["measured"] for case in cases])
    nearest = np.clip(np.abs(simulated), low, high)
    difference = np.abs(simulated) / nearest - 1.0
    numbers = {
        "applied": allocator.achieved(thrust)[rows, axis],
        "simulated": simulated,
        "difference": difference,
        "agrees": np.abs(difference) <= AGREES,
    }
    return {
        "source": data["source"],
        "responses": [
            {"why": "", **case, **{name: values[i].item() for name, values in numbers.items()}}
            for i, case in enumerate(cases)
        ],
    }


def validate(name: str = "finsrov", *, hydrodynamics: str = "calibrated") -> dict[str, Any]:
    """Compare simulated with published pool responses, and report where they disagree.

    Example: python benchmarks/published_responses.py --hydrodynamics simplified

    Args:
        name (NAME): Vehicle with published responses: finsrov.
        hydrodynamics (MODEL): Hydrodynamic model: calibrated, simplified or mesh.

    Raises:
        ValidationError: No responses of this vehicle are published.
    """
    vehicle = load_vehicle(name)
    return {
        "vehicle": {"name": vehicle.name, "sha256": vehicle.sha256},
        "hydrodynamics": hydrodynamics,
        **simulate_responses(vehicle, hydrodynamics),
        "provenance": provenance(),
    }


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return a table with a row for each response, and the known reasons of disagreements."""
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
        sentences=[
            f"{r['name']}: {r['why'].strip()}" for r in result["responses"] if r["why"] and not r["agrees"]
        ],
    )
    return [table]


if __name__ == "__main__":
    run_script("__main__:validate")
