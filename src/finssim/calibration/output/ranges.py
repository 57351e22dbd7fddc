"""Ranges of domain randomisation from a calibration's covariance: errors that go together are drawn together."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate, Fit
from finssim.calibration.output.calibrate import calibrated, estimate_at
from finssim.engine.ranges_file import load_ranges
from finssim.files import atomic_write
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle, load_vehicle
from finssim.yaml_file import read_json

__all__ = ["correlated_normals", "range_factors", "write_correlated_ranges", "write_ranges"]

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
    target = Path(path)
    if target.suffix not in (".yaml", ".yml"):
        raise CalibrationError(
            f"{path} ends in '{target.suffix}', expected .yaml: name a ranges file to write"
        )
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


Array = NDArray[np.float64]

FAMILY_OF = {
    "added_mass": "added_mass",
    "m_eff": "added_mass",
    "d1": "linear_damping",
    "d2": "quadratic_damping",
}
"""Parameter of a fit -> family of the ranges file."""

WITHIN_95 = 1.959964
"""Half of a 95 % interval in standard deviations."""
LEAST_STD = 0.01
"""Least relative standard deviation: intervals know of noise, not of a wrong model."""
CUT = 4.0
LEAST = 0.05
"""Factors below this are cut off."""


class Normal(NamedTuple):
    """A factor on a number of the vehicle file."""

    mean: float
    std: float

    def as_range(self) -> dict[str, list[float]]:
        """As a ranges file writes it."""
        within = [max(self.mean - CUT * self.std, LEAST), self.mean + CUT * self.std]
        return {"normal": _short(self), "within": _short(within)}


def correlated_normals(
    fit: Mapping[str, Any], vehicle: Vehicle
) -> tuple[dict[str, Normal], list[str], tuple[list[str], Array]]:
    """What a fit says about factors on a vehicle's numbers.

    Args:
        fit: What `fit.json` of a calibration's report holds.
        vehicle: Whose numbers the factors are on: usually the calibrated one.

    Returns:
        Entry of the ranges table -> factor; the entries that the fit could not tell; and the entries whose errors go
        together with their correlation, (n, n), free of negative eigenvalues.

    Raises:
        CalibrationError: It is no fit, or tells nothing that can be drawn.
    """
    try:
        parameters, correlation = fit["parameters"], fit["correlation"]
        found = {name: value for name, value in parameters.items() if _entry(name) is not None}
    except (KeyError, TypeError, AttributeError):
        raise CalibrationError(
            "expected the fit.json of a calibration's report: parameters and correlation"
        ) from None
    normals, untold, of = dict[str, Normal](), list[str](), dict[str, str]()
    for name, value in found.items():
        entry = str(_entry(name))
        nominal = _nominal(name, value, fit, vehicle)
        if name.endswith(".m_eff") or not nominal:
            continue  # its added mass says the same; and a factor on nothing is nothing
        if (
            value["identifiable"]
            and None not in value["ci95"]
            and value["estimate"]
            and value["estimate"] > 0.0
        ):
            low, high = value["ci95"]
            mean, std = value["estimate"] / nominal, 0.5 * (high - low) / WITHIN_95 / nominal
            normals[entry], of[entry] = Normal(mean, max(std, LEAST_STD * mean)), name
        else:
            untold.append(entry)
    if not normals:
        raise CalibrationError("the fit tells no added mass, damping or thrust that could be drawn")
    return normals, untold, _correlation(of, correlation)


def fit_ranges(
    report: Path,
    *,
    vehicle: str,
    out: Path,
) -> None:
    """Write ranges with the standard errors of a calibration, correlated as its errors are.

    Example: finssim randomize fit report/fit.json --vehicle mine.yaml --out mine-ranges.yaml

    Args:
        report (FIT): fit.json of a calibration's report.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        out (FILE): Ranges file to write (.yaml).
    """
    write_correlated_ranges(report, load_vehicle(vehicle), out)
    print(f"written: {out}")


def write_correlated_ranges(fit: Path, vehicle: Vehicle, out: Path) -> None:
    """Write a ranges file from the `fit.json` of a calibration's report.

    What the fit tells is normal with its standard error, cut at 4 of them, and correlated as the fit's errors are; what
    it could not tell is log-uniform between half and double.

    Args:
        fit: The file.
        vehicle: The calibrated vehicle.
        out: File to write, .yaml.

    Raises:
        CalibrationError: The file cannot be used.
        OutputError: The place cannot be written.
    """
    if out.suffix not in (".yaml", ".yml"):
        raise CalibrationError(f"{out} ends in '{out.suffix}', expected .yaml: name a ranges file to write")
    data = read_json(fit, CalibrationError, such_as="parameters")
    try:
        normals, untold, (names, R) = correlated_normals(data, vehicle)
    except CalibrationError as error:
        raise CalibrationError(f"{fit}: {error}") from None
    ranges = {entry: normal.as_range() for entry, normal in normals.items()}
    ranges |= {entry: {"log_uniform": list(UNTOLD)} for entry in untold}
    source = f"covariance of a calibration of {data['vehicle']['name']}; vehicle {vehicle.sha256[:16]}"
    tree: dict[str, Any] = {"source": source}
    for entry, drawn in ranges.items():
        _place(tree, entry, drawn)
    if len(names) > 1:
        rows = [[round(float(x), 4) + 0.0 for x in row] for row in R]
        tree["correlated"] = [{"entries": names, "correlation": rows}]
    with atomic_write(out) as temporary:
        text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
        temporary.write_text(text, encoding="utf-8")
        load_ranges(temporary)


def _entry(name: str) -> str | None:
    """Entry of the ranges table for a parameter of a fit; None where there is none."""
    axis, _, what = name.partition(".")
    if axis in AXES and what in FAMILY_OF:
        return f"{FAMILY_OF[what]}.{axis}"
    return "thrust.all" if name == "thrust_scale" else None


def _nominal(name: str, value: Mapping[str, Any], fit: Mapping[str, Any], vehicle: Vehicle) -> float:
    """The vehicle's own number for a parameter, in its unit."""
    if name == "thrust_scale":
        return 1.0 if vehicle.sha256 == fit["vehicle"]["sha256"] else float(value["estimate"] or 1.0)
    chosen = vehicle.hydrodynamics.get("calibrated")
    if not isinstance(chosen, HydrodynamicSet):
        raise CalibrationError(f"{vehicle.name} has no coefficients named 'calibrated' to vary")
    axis, _, what = name.partition(".")
    i = AXES.index(axis)
    return float(getattr(chosen, FAMILY_OF[what])[i, i])


def _correlation(of: Mapping[str, str], found: Mapping[str, Any] | None) -> tuple[list[str], Array]:
    """Of the entries that the fit's correlation has."""
    known = list(found["names"]) if found else []
    at = {}
    for entry, name in of.items():
        for spelling in (name, name.replace(".added_mass", ".m_eff")):
            if spelling in known:
                at.setdefault(entry, known.index(spelling))
    names, places = list(at), list(at.values())
    if not found or not names:
        return [], np.zeros((0, 0))
    R = np.array([[x if x is not None and math.isfinite(x) else 0.0 for x in row] for row in found["matrix"]])
    R = R[np.ix_(places, places)]
    values, vectors = np.linalg.eigh(0.5 * (R + R.T))
    R = (vectors * np.maximum(values, 1e-4)) @ vectors.T  # rounded matrices have eigenvalues just below 0
    scale = np.sqrt(np.diag(R))
    return names, R / np.outer(scale, scale)


def _place(tree: dict[str, Any], entry: str, drawn: Any) -> None:
    """Put what is drawn where a ranges file has it: `linear_damping.surge` under `axes` of its family."""
    *above, key = entry.split(".")
    for name in [*above, "axes"] if key in AXES else above:
        tree = tree.setdefault(name, {})
    tree[key] = drawn


def _short(numbers: Any) -> list[float]:
    return [float(f"{x:.5g}") for x in numbers]
