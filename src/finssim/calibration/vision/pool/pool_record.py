"""A calibrated pool as plain values, as a table for people, and as the record in its pool file."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.table import Table

from finssim.calibration.fit import Estimate
from finssim.calibration.vision.pool.pool_doubts import EXACT_LENS
from finssim.calibration.vision.pool.pool_fit import PoolFit
from finssim.calibration.vision.pool.pool_held_out import rms
from finssim.provenance import provenance

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["cells", "file_hashes", "pool_json", "pool_record", "print_pool", "summary"]

DIGITS = {"m": 4, "deg": 3, "px": 2}
"""Digits after the point: tenths of a millimetre, thousandths of a degree, hundredths of a pixel; five without unit."""

MOST_NAMES = 12
"""Outliers that a sentence names."""


def pool_json(
    fit: PoolFit, *, out: Path | None = None, inputs: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """What `--json` prints and the report's `fit.json` holds.

    Args:
        fit: The calibration.
        out: Pool file that was written.
        inputs: File -> SHA-256 of what the fit was made from.
    """
    return {
        "kind": "pool",
        "interface": "surface" if fit.surface else "wall",
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        "residual": _finite(fit.residual_json()),
        "held_out": _held_out(fit),
        "pinhole": {
            "rms_px": _number(rms(fit.pinhole_residual[fit.used])),
            "held_out": None if fit.pinhole_held_out is None else _finite(fit.pinhole_held_out.as_json()),
        },
        "lens_fitted": list(fit.lens_fitted),
        "outliers": fit.outliers,
        "other_minima": [
            {"residual_ratio": _number(a), "camera_clearance": _number(b)} for a, b in fit.minima
        ],
        "correlation": {
            "names": list(fit.correlation.names),
            "matrix": [[_number(round(float(x), 4)) for x in row] for row in fit.correlation.matrix],
        },
        "notes": [note for note in fit.notes if note != EXACT_LENS],
        "advice": [*fit.advice, *(note for note in fit.notes if note == EXACT_LENS)],
        "settings": _settings(fit),
        "inputs": dict(inputs or {}),
        "out": None if out is None else str(out),
        "provenance": provenance(),
    }


def pool_record(fit: PoolFit, inputs: Mapping[str, str]) -> dict[str, Any]:
    """What the pool file remembers of its making: the same, less what is long."""
    whole = pool_json(fit, inputs=inputs)
    return {key: value for key, value in whole.items() if key not in ("kind", "correlation", "out")}


def file_hashes(paths: Sequence[Path]) -> dict[str, str]:
    """File -> SHA-256 of its bytes."""
    return {
        str(path): hashlib.sha256(Path(path).read_bytes()).hexdigest()
        for path in paths
        if Path(path).is_file()
    }


def print_pool(fit: PoolFit, console: Console) -> None:
    """Print estimates, residuals and advice; fits 100 columns."""
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("parameter", "estimate", "95 % interval", "unit", "note"):
        table.add_column(heading, justify="right" if heading == "estimate" else "left", overflow="fold")
    for estimate in fit.estimates.values():
        if estimate.note != "as given":
            table.add_row(*cells(estimate), style="" if estimate.identifiable else "yellow")
    what = "water surface" if fit.surface else "wall"
    console.print(
        f"camera before a {what}, from {fit.residual_json()['locations']} surveyed places", highlight=False
    )
    console.print(table)
    for sentence in summary(fit):
        console.print(f"  {sentence}", highlight=False, markup=False)
    for sentence in fit.notes:
        console.print(f"- {sentence}", highlight=False, markup=False)
    for sentence in fit.advice:
        console.print(f"! {sentence}", highlight=False, markup=False, style="yellow")


def summary(fit: PoolFit) -> list[str]:
    """The figures that say how good the calibration is, one sentence each."""
    of = fit.residual_json()
    found = [
        f"residual {of['rms_px']:.2f} px, {of['rms_mm']:.1f} mm at the points; of it a pixel is worth "
        f"{of['pixel_sigma']:.2f} px, the survey {of['survey_sigma_mm']:.1f} mm"
    ]
    if fit.held_out is None:
        found.append("too few points to hold any out: the error at other points is not known")
    else:
        share = _survey_share(fit)
        of_it = f"; of it the survey's own error {share:.2f} cm" if math.isfinite(share) else ""
        found.append(f"held out ({fit.held_out.folds} parts): {_figures(fit.held_out.as_json())}{of_it}")
    if fit.pinhole_held_out is not None:
        found.append(f"straight lines, held out: {_figures(fit.pinhole_held_out.as_json())}")
    if fit.outliers:
        more = ", ..." if len(fit.outliers) > MOST_NAMES else ""
        found.append(f"left out as wrong: {', '.join(fit.outliers[:MOST_NAMES])}{more}")
    return found


def cells(estimate: Estimate) -> tuple[str, ...]:
    """Row of the table of estimates."""
    digits = DIGITS.get(estimate.unit, 5)
    low, high = (f"{x:.{digits}f}" for x in estimate.ci95)
    interval = "" if estimate.note == "as given" else f"{low} to {high}"
    return estimate.name, f"{estimate.estimate:.{digits}f}", interval, estimate.unit, estimate.note


def _figures(of: Mapping[str, float | int | None]) -> str:
    text = f"{of['rms_px']:.2f} px"
    if of["rms_cm"] is not None:
        text += f", in the water {of['rms_cm']:.2f} cm rms, 95 % within {of['p95_cm']:.2f} cm"
    return text


def _held_out(fit: PoolFit) -> dict[str, float | int | None] | None:
    if fit.held_out is None:
        return None
    return _finite({**fit.held_out.as_json(), "survey_cm": _survey_share(fit)})


def _survey_share(fit: PoolFit) -> float:
    """Root mean square of the survey's own error across the planes of the points held out [cm].

    Two coordinates of each place, and the turn of tags; it is in the held-out error, and not one of the calibration.
    """
    if fit.held_out is None or not len(fit.held_out.rows):
        return math.nan
    seen, noise = fit.seen.subset(fit.held_out.rows), fit.noise
    sigma = np.where(np.isfinite(seen.sigma), seen.sigma, noise.survey)
    turn = noise.survey_yaw**2 * np.sum(seen.arm**2, axis=1)
    return 100.0 * noise.scale * float(np.sqrt(np.mean(2.0 * sigma**2 + turn)))


def _settings(fit: PoolFit) -> dict[str, Any]:
    values = asdict(fit.settings)
    return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}


def _finite(values: Mapping[str, float | int | None]) -> dict[str, float | int | None]:
    return {key: value if isinstance(value, int) else _number(value) for key, value in values.items()}


def _number(value: float | None) -> float | None:
    return float(np.float64(value)) if value is not None and math.isfinite(value) else None
