"""Ranges of domain randomisation from a calibration's covariance: errors that go together are drawn together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.engine.ranges_file import load_ranges
from finssim.files import atomic_write
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle, load_vehicle
from finssim.yaml_file import read_json

__all__ = ["Normal", "correlated_normals", "write_correlated_ranges"]

Array = NDArray[np.float64]

FAMILIES = {
    "added_mass": "added_mass",
    "m_eff": "added_mass",
    "d1": "linear_damping",
    "d2": "quadratic_damping",
}
"""Parameter of a fit -> family of the ranges file."""

WITHIN_95 = 1.959964
"""Half of a 95 % interval in standard deviations."""
NARROWEST = 0.01
"""Least relative standard deviation: intervals know of noise, not of a wrong model."""
CUT = 4.0
LEAST = 0.05
"""Factors below this are cut off."""
UNTOLD = (0.5, 2.0)
"""Log-uniform, for what the fit could not tell."""


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
            normals[entry], of[entry] = Normal(mean, max(std, NARROWEST * mean)), name
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
    if axis in AXES and what in FAMILIES:
        return f"{FAMILIES[what]}.{axis}"
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
    return float(getattr(chosen, FAMILIES[what])[i, i])


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


def _place(tree: dict[str, Any], entry: str, drawn: dict[str, list[float]]) -> None:
    family, _, axis = entry.partition(".")
    if axis in AXES:
        tree.setdefault(family, {}).setdefault("axes", {})[axis] = drawn
    else:
        tree.setdefault(family, {})[axis] = drawn


def _short(numbers: Any) -> list[float]:
    return [float(f"{x:.5g}") for x in numbers]
