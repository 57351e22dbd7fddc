"""From a fit to a vehicle: the numbers that the data determine, each with its origin and interval, and the record."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Estimate, Fit
from finssim.calibration.output.vehicle_file import Key, file_tree, folded, leaves, numbers
from finssim.provenance import provenance
from finssim.vehicles import CalibrationRecord, Provenance, Vehicle, VehicleError, check_vehicle

__all__ = ["SCALED", "all_findings", "calibrated", "concerns", "estimate_at", "kept", "number_in"]


SCALED = ("c_plus", "c_minus", "force_min", "force_max")
"""Numbers of a thruster that `thrust_scale` multiplies."""


def calibrated(fit: Fit) -> Vehicle:
    """The vehicle with what the fit determined; everything else keeps its number and its origin.

    A number that the fit changed is `measured`, its note is its 95 % interval. The record of the calibration, with the
    digests of its trials, comes after those that the vehicle had.

    Raises:
        CalibrationError: The estimates make no vehicle that can be simulated.
    """
    before = fit.vehicle
    number = len(before.calibrations) + 1
    record = _record(fit)
    source = f"calibration {number}: {record.sentence()}"
    try:
        changes = {path: _rounded(value) for path, value in fit.changes.items()}
        after = before.replace(changes, Provenance("measured", source)) if changes else before
    except VehicleError as error:
        raise CalibrationError(
            f"the estimates make no vehicle: {error}: use fewer axes, or trials that excite them more"
        ) from None
    old_values = dict(leaves(before.values()))
    changed = [tuple(path.split(".")) for path in fit.changes]
    origins = {}
    for path, whole, value in numbers(after):
        estimate = _estimate_of(path, fit.estimates, after) or _scale_of(path, fit.estimates)
        told = estimate is not None and estimate.identifiable and _covers(changed, path, after)
        if old_values.get(whole) == value and not told:
            origins[path] = before.origin_of(".".join(whole))
        else:
            origins[path] = Provenance("measured", source, _note(estimate, value))
    tree = file_tree(after)
    tree.pop("calibrations", None)
    return after.model_copy(
        update={
            "provenance": folded(tree, origins),
            "calibrations": (*before.calibrations, record),
        }
    )


def kept(fit: Fit, vehicle: Vehicle) -> dict[str, float]:
    """Parameters with a place in the vehicle file that the fit left as they were, with the number they keep.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
    """
    found = {}
    for name, estimate in fit.estimates.items():
        if estimate.path is None:
            continue
        before, after = number_in(fit.vehicle, estimate.path), number_in(vehicle, estimate.path)
        if before is not None and before == after and not estimate.identifiable:
            found[name] = before
    return found


def all_findings(fit: Fit, vehicle: Vehicle) -> list[Finding]:
    """The findings of a fit and what speaks against its vehicle.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
    """
    return [*fit.findings, *concerns(fit, vehicle)]


def concerns(fit: Fit, vehicle: Vehicle) -> list[Finding]:
    """What speaks against the calibrated vehicle: checks that it fails and its parent did not, and fits without use.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
    """
    passed = {check.name for check in check_vehicle(fit.vehicle) if check.passed}
    found = [
        finding("check_failed", check=check.name, sentence=check.sentence)
        for check in check_vehicle(vehicle)
        if not check.passed and check.name in passed
    ]
    for what, figures in fit.quality.items():
        r2 = figures.get("r2", math.nan)
        if r2 < 0.0:
            found.append(finding("further_than_mean", what, r2=r2))
    return found if fit.changes else [*found, finding("nothing_determined")]


def number_in(vehicle: Vehicle, path: str) -> float | None:
    """The number at a dotted path of the vehicle file, `*` and groups by their first thruster; None where none is."""
    wanted = tuple(path.split("."))
    for leaf, whole, value in numbers(vehicle):
        if _same_place(wanted, leaf, vehicle) or wanted == whole:
            return value
    return dict(leaves(vehicle.values())).get(wanted)  # a coupling of a matrix whose file gives the diagonal


def estimate_at(path: str, fit: Fit, vehicle: Vehicle) -> Estimate | None:
    """The estimate that is of the number at a dotted path, or None; an entry of a matrix by row and column."""
    leaf = tuple(path.split("."))
    return _estimate_of(leaf, fit.estimates, vehicle) or (
        _estimate_of(leaf[:-1], fit.estimates, vehicle) if leaf[-1] == leaf[-2] else None
    )


def _record(fit: Fit) -> CalibrationRecord:
    origin = provenance()
    return CalibrationRecord(
        kind=fit.kind,  # type: ignore[arg-type]
        method=fit.method,
        trials=dict(fit.trials),
        settings=json.loads(json.dumps(dict(fit.settings), default=_plain)),
        start=fit.vehicle.sha256,
        finssim=origin["finssim"],
        revision=origin["revision"],
        interrupted=fit.interrupted,
    )


def _rounded(value: Any) -> Any:
    """Numbers with seven digits: far more than any interval is worth, and a file that can be read."""
    if isinstance(value, Mapping):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_rounded(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.7g}")
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    return str(value)


def _covers(changes: Sequence[Key], leaf: Key, vehicle: Vehicle) -> bool:
    """Whether one of the changes set this number, or a list or section that holds it."""
    return any(
        _same_place(change, leaf[: len(change)], vehicle) or _same_place(change, leaf, vehicle)
        for change in changes
    )


def _same_place(pattern: Key, leaf: Key, vehicle: Vehicle) -> bool:
    """Whether a path of an estimate or change means a number of the file's tree.

    `*` is any name; `thruster_groups.G.x` is x of every thruster of G; an entry of a diagonal matrix may be given by
    row and column or by row alone.
    """
    if pattern[0] == "thruster_groups" and leaf[0] == "thrusters" and len(leaf) > 1:
        thruster = vehicle.thrusters.get(leaf[1])
        if thruster is None or thruster.group != pattern[1]:
            return False
        pattern = ("thrusters", leaf[1], *pattern[2:])
    shapes = [leaf]
    if leaf[-1].isdigit():
        shapes.append((*leaf, leaf[-1]))
    return any(
        len(pattern) == len(shape) and all(p in ("*", q) for p, q in zip(pattern, shape, strict=True))
        for shape in shapes
    )


def _estimate_of(leaf: Key, estimates: Mapping[str, Estimate], vehicle: Vehicle) -> Estimate | None:
    for estimate in estimates.values():
        if estimate.path is not None and _same_place(tuple(estimate.path.split(".")), leaf, vehicle):
            return estimate
    return None


def _scale_of(leaf: Key, estimates: Mapping[str, Estimate]) -> Estimate | None:
    """The common scale of all thrusts, for the numbers that it multiplies."""
    return estimates.get("thrust_scale") if leaf[0] == "thrusters" and leaf[-1] in SCALED else None


def _note(estimate: Estimate | None, value: float) -> str:
    """`95 % interval 37.9 to 40.2`, with the estimate itself where the file holds something else of it."""
    if estimate is None:
        return ""
    low, high = estimate.ci95
    words = f"95 % interval {low:.4g} to {high:.4g}" if math.isfinite(low) and math.isfinite(high) else ""
    if words and not math.isclose(estimate.estimate, value, rel_tol=1e-6):
        words = f"from {estimate.name} {estimate.estimate:.4g} {estimate.unit}, {words}"
    return "; ".join(filter(None, [words, estimate.note]))
