"""Ranges of domain randomisation from the intervals of a calibration."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate, Fit
from finssim.calibration.output.vehicle_file import calibrated, estimate_at, yaml_path
from finssim.engine.ranges_file import load_ranges
from finssim.files import atomic_write
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle

NARROWEST = 0.02
"""A told parameter varies by at least this part to either side: intervals know of noise, not of a wrong model."""
WIDEST = (0.0, 5.0)
"""Factors beyond these are cut."""
UNTOLD = (0.5, 2.0)
"""For what the trials could not tell, and for what the vehicle file guesses."""
OTHER = (0.9, 1.1)
"""For what was not asked of the trials, and the vehicle file has from somewhere."""

FAMILIES = ("added_mass", "linear_damping", "quadratic_damping")


class Factor(NamedTuple):
    """Range of a factor, and why."""

    low: float
    high: float
    why: str


def write_ranges(fit: Fit, path: str | os.PathLike[str], vehicle: Vehicle | None = None) -> None:
    """Write a ranges file for `finssim train --randomize`, around the calibrated vehicle.

    A factor on a number of the vehicle file is drawn uniformly between

    - the ends of its 95 % interval over the estimate, where the trials tell it; at least 2 % to either side;
    - 0.5 and 2, where they do not, or where the vehicle file guesses it;
    - 0.9 and 1.1, where it was not asked for and the file has it from somewhere.

    The numbers are drawn one by one, though the errors of linear and quadratic damping go against each other: the drag
    varies by more than the data allow, never by less.

    Args:
        fit: The fit.
        path: File to write, .yaml.
        vehicle: `calibrated(fit)`, where it is at hand.

    Raises:
        CalibrationError: Another suffix, or a vehicle without a calibrated set.
        OutputError: The place cannot be written.
    """
    target = yaml_path(path, "ranges")
    vehicle = calibrated(fit) if vehicle is None else vehicle
    text = _text(fit, vehicle)
    with atomic_write(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
        load_ranges(temporary)


def range_factors(fit: Fit, vehicle: Vehicle) -> dict[str, Factor]:
    """Every factor by its place in the ranges file, `linear_damping.surge` or `delay`.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
    """
    chosen = vehicle.hydrodynamics.get("calibrated")
    if not isinstance(chosen, HydrodynamicSet):
        raise CalibrationError(f"{vehicle.name} has no coefficients named 'calibrated' to vary")
    factors = {}
    for family in FAMILIES:
        matrix = getattr(chosen, family)
        for i, axis in enumerate(AXES):
            if matrix[i, i] != 0.0:  # a factor on nothing is nothing
                path = f"hydrodynamics.calibrated.{family}.{i}.{i}"
                factors[f"{family}.{axis}"] = _factor(path, fit, vehicle)
    for path in chosen.term_scalars:
        if chosen.term_parameters[path] != 0.0:
            factors[path] = _factor(f"hydrodynamics.calibrated.{path}", fit, vehicle)
    excess = fit.estimates.get("buoyancy_excess")
    if excess is not None and excess.identifiable:
        low, high = ((vehicle.weight + x) / (vehicle.weight + excess.estimate) for x in excess.ci95)
        factors["volume"] = Factor(low, high, "told")
    scale = fit.estimates.get("thrust_scale")
    if scale is not None:
        factors["thrust.all"] = _of(scale)
    names = list(vehicle.thrusters)
    factors["thrust.each"] = _around(
        _factor(f"thrusters.{name}.{key}", fit, vehicle) for name in names for key in ("c_plus", "c_minus")
    )
    for key in ("time_constant", "delay"):
        paths = [f"thrusters.{name}.{key}" for name in names if getattr(vehicle.thrusters[name], key) > 0.0]
        if paths and all(_given(vehicle, path) for path in paths):
            factors[key] = _around(_factor(path, fit, vehicle) for path in paths)
    return factors


def _factor(path: str, fit: Fit, vehicle: Vehicle) -> Factor:
    estimate = estimate_at(path, fit, vehicle)
    if estimate is not None:
        return _of(estimate)
    if vehicle.origin_of(path).origin == "guessed":
        return Factor(*UNTOLD, "guessed")
    return Factor(*OTHER, "not asked for")


def _of(estimate: Estimate) -> Factor:
    """The range that an estimate allows."""
    low, high = estimate.ci95
    if not (
        estimate.identifiable and math.isfinite(low) and math.isfinite(high) and estimate.estimate != 0.0
    ):
        return Factor(*UNTOLD, "not told")
    low, high = sorted((low / estimate.estimate, high / estimate.estimate))
    low, high = min(low, 1.0 - NARROWEST), max(high, 1.0 + NARROWEST)
    return Factor(max(low, WIDEST[0]), min(high, WIDEST[1]), "told")


def _around(factors: Iterable[Factor]) -> Factor:
    """The range that holds all of them."""
    every = list(factors)
    why = ", ".join(dict.fromkeys(factor.why for factor in every))
    return Factor(min(f.low for f in every), max(f.high for f in every), why)


def _given(vehicle: Vehicle, path: str) -> bool:
    return any(path == known or known.startswith(f"{path}.") for known in vehicle.provenance)


def _text(fit: Fit, vehicle: Vehicle) -> str:
    record, tree = vehicle.calibrations[-1], dict[str, Any]()
    for entry, factor in range_factors(fit, vehicle).items():
        _place(tree, entry, factor)
    lines = [
        "# Factors on the numbers of the calibrated vehicle. told: 95 % interval over the estimate, at least",
        "# 2 % to either side; not told by the trials, or guessed: half to double; not asked for: 0.9 to 1.1.",
        f'source: "95 % intervals, {record.sentence()}; vehicle {vehicle.sha256[:16]}"',
        *_lines(tree),
    ]
    return "\n".join(lines) + "\n"


def _lines(tree: Mapping[str, Any], pad: str = "") -> Iterator[str]:
    """YAML of factors, each with its reason."""
    for key, node in tree.items():
        if isinstance(node, Factor):
            yield f"{pad}{key}: [{node.low:.4g}, {node.high:.4g}]  # {node.why}"
        else:
            yield f"{pad}{key}:"
            yield from _lines(node, pad + "  ")


def _place(tree: dict[str, Any], entry: str, drawn: Any) -> None:
    """Put what is drawn where a ranges file has it: `linear_damping.surge` under `axes` of its family."""
    *above, key = entry.split(".")
    for name in [*above, "axes"] if key in AXES else above:
        tree = tree.setdefault(name, {})
    tree[key] = drawn
