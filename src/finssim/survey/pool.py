"""`finssim calibrate pool`: read and match surveyed points, fit camera and water plane, write pool file and report."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finssim.core.least_squares import rms
from finssim.core.provenance import provenance
from finssim.identification.fit import Estimate
from finssim.identification.report import (
    AS_STATED,
    HEADS,
    Report,
    command_line,
    draw_arrows,
    draw_correlation,
    new_figure,
    picture_axes,
    png,
    publish,
    refuse_places,
)
from finssim.localization.camera_file import CameraFile, load_camera
from finssim.localization.overhead_camera import Pool, write_pool
from finssim.survey.points import Observations
from finssim.survey.pool_fit import PoolFit, calibrate_pool, with_critical_findings
from finssim.survey.pool_refine import HeldOut
from finssim.survey.survey_file import load_survey_file
from finssim.trials.findings import CalibrationError, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIGITS = {"m": 4, "deg": 3, "px": 2}
"""Decimals by unit: tenths of a millimetre, thousandths of a degree, hundredths of a pixel; five without a unit."""

MAX_NAMES = 12
"""Greatest number of outliers that a sentence names."""

LEAST_SPREAD = 5.0
"""Least spread of pixels [px]: values with a smaller one, such as from 0 to 1, are not pixels."""

READING = (
    "The interval holds the true value in 19 of 20 such calibrations, if the priors (index, tape, "
    "level, camera file) are as accurate as stated. A note marks a number that the pixels do not "
    "determine, and names its prior. Judge the result by the error at points held out, in the depth "
    "where it will be used. "
    "Arrows that swirl or grow outwards indicate a wrong lens, window or water height; others are noise."
)


def pool_json(
    fit: PoolFit, *, out: Path | None = None, inputs: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the content of `--json` and of the report's `fit.json`.

    Args:
        fit: The calibration.
        out: Pool file that was written.
        inputs: Input file -> its SHA-256.
    """
    held_out, pinhole = (None if h is None else h.as_json() for h in (fit.held_out, fit.pinhole_held_out))
    figures = {
        "residual": fit.residual_json(),
        "held_out": held_out and {**held_out, "survey_cm": _survey_share(fit)},
        "pinhole": {"rms_px": rms(fit.pinhole_residual[fit.used]), "held_out": pinhole},
    }
    return {
        "kind": "pool",
        "interface": "surface" if fit.settings.surface else "window",
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        **plain(figures),
        "lens_fitted": list(fit.lens_fitted),
        "outliers": fit.outliers,
        "correlation": plain(fit.correlation.as_json(), 4),
        "findings": [item.as_json() for item in fit.findings],
        "settings": plain(asdict(fit.settings)),
        "inputs": dict(inputs or {}),
        "out": None if out is None else str(out),
        "provenance": provenance(),
    }


def pool_record(fit: PoolFit, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Return the record in the pool file: the content of `pool_json` without its long parts."""
    record = pool_json(fit, inputs=inputs)
    return {key: value for key, value in record.items() if key not in ("kind", "correlation", "out")}


def pool_report(fit: PoolFit) -> Report:
    """Return the report of the calibration."""
    figures = fit.residual_json()
    held_out = "too few points to hold any out: the error at other points is not known"
    summary = [
        f"residual {figures['rms_px']:.2f} px, {figures['rms_mm']:.1f} mm at the points; standard errors: pixel "
        f"{figures['pixel_sigma']:.2f} px, survey {figures['survey_sigma_mm']:.1f} mm"
    ]
    if fit.held_out is not None:
        share = _survey_share(fit)
        of_it = f"; of it the survey's own error {share:.2f} cm" if math.isfinite(share) else ""
        held_out = f"held out ({fit.held_out.folds} parts): {_figures(fit.held_out)}{of_it}"
    summary.append(held_out)
    if fit.pinhole_held_out is not None:
        summary.append(f"straight lines, held out: {_figures(fit.pinhole_held_out)}")
    if fit.outliers:
        more = ", ..." if len(fit.outliers) > MAX_NAMES else ""
        summary.append(f"left out as wrong: {', '.join(fit.outliers[:MAX_NAMES])}{more}")
    kind = "water surface" if fit.settings.surface else "window"
    return Report(
        title=f"Camera and {kind} from {figures['locations']} surveyed places",
        heads=(*HEADS, "note"),
        headline=f"camera before a {kind}, from {figures['locations']} surveyed places",
        estimates=list(fit.estimates.values()),
        cells=_cells,
        summary=summary,
        findings=fit.findings,
        reading=READING,
    )


def _cells(estimate: Estimate) -> tuple[str, ...]:
    value, low, high = (f"{x:.{DIGITS.get(estimate.unit, 5)}f}" for x in (estimate.estimate, *estimate.ci95))
    interval = "" if estimate.note == AS_STATED else f"{low} to {high}"
    return estimate.name, value, interval, estimate.unit, estimate.note


def _figures(held_out: HeldOut) -> str:
    figures = held_out.as_json()
    text = f"{figures['rms_px']:.2f} px"
    if figures["rms_cm"] is not None:
        text += f", in the water {figures['rms_cm']:.2f} cm rms, 95 % within {figures['p95_cm']:.2f} cm"
    return text


def _survey_share(fit: PoolFit) -> float:
    """Return the root mean square of the survey's own error within the planes of the held-out points [cm].

    It covers two coordinates of each location and the rotation of tags, and is part of the held-out error.
    """
    if fit.held_out is None or not len(fit.held_out.rows):
        return math.nan
    held_out_rows, noise = fit.observed.subset(fit.held_out.rows), fit.noise
    sigma = np.where(np.isfinite(held_out_rows.sigma), held_out_rows.sigma, noise.survey)
    turn = noise.survey_yaw**2 * np.sum(held_out_rows.arm**2, axis=1)
    return 100.0 * noise.scale * float(np.sqrt(np.mean(2.0 * sigma**2 + turn)))


# Figures of a calibrated pool: errors on the map and in the picture, next to those of straight lines.


def pool_pictures(fit: PoolFit) -> dict[str, tuple[str, bytes]]:
    """Return the figures: file name -> caption and PNG; equal fits give equal figures."""
    drawn = {
        "map.png": (
            "Errors at the points: back-projected minus surveyed, in the plane of each point",
            _map(fit),
        ),
        "picture.png": ("Measured less predicted pixels, enlarged", _picture(fit)),
    }
    if len(fit.correlation.names) > 1:
        drawn["correlation.png"] = ("Correlation of the errors", draw_correlation(fit.correlation))
    return {name: (text, png(figure)) for name, (text, figure) in drawn.items()}


def _map(fit: PoolFit) -> Figure:
    """Draw the errors, viewed along the plane's normal."""
    figure = new_figure(7.4, 5.6)
    axes = figure.subplots()
    across, names = np.eye(3)[:2], ("x [m]", "y [m]")
    if not fit.settings.surface:
        across, names = fit.model.tangents, ("along the window [m]", "along the window, across [m]")
    axes.plot(*(across @ fit.model.camera.position), "^", color="black", markersize=8, label="camera")
    draw_arrows(axes, fit.observed.points @ across.T, 1000.0 * fit.error @ across.T, fit.used, "mm", 1000.0)
    axes.set(xlabel=names[0], ylabel=names[1], aspect="equal")
    return figure


def _picture(fit: PoolFit) -> Figure:
    lens = fit.model.camera.lens
    figure = new_figure(7.4, 7.4 * lens.height / lens.width + 0.6)
    axes = figure.subplots()
    draw_arrows(axes, fit.observed.pixels, fit.residual, fit.used, "px", 1.0)
    picture_axes(axes, lens)
    return figure


def run(
    inputs: Sequence[Path],
    *,
    survey: Path,
    camera: Path,
    out: Path,
    report: Path | None = None,
    seed: int = 1,
    as_json: bool = False,
) -> PoolFit:
    """Estimate camera pose [m, deg] and water plane (height [m], tilt [deg], index) from surveyed points in the
    water.

    Example: finssim calibrate pool pixels.csv --survey survey.yaml --camera camera.yaml --out pool.yaml

    Args:
        inputs (INPUT): Detections (.csv), pixels (id,u,v), pixels with points (u,v,x,y,z), or images of tags.
        survey (FILE): Survey file (.yaml): the points, the kind of interface (surface or window), and priors.
        camera (FILE): Camera file: ours, or that of another program (see the page Bring what you have).
        out (FILE): Pool file to write (.yaml).
        report (DIR): Directory for the report and its figures.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The calibration.

    Raises:
        CalibrationError: The inputs cannot be used or do not determine the camera; nothing is written.
        LocalizationError: The camera file or an image cannot be read; nothing is written.
        OutputError: A file cannot be written.
    """
    refuse_places(out, report, "pool")
    camera_file, survey_file = load_camera(camera), load_survey_file(survey)
    focal_sigma, center_sigma = _lens_sigma(camera_file)
    settings = survey_file.fit_settings(focal_sigma=focal_sigma, center_sigma=center_sigma, seed=seed)
    for path in inputs:
        if not Path(path).exists():
            raise CalibrationError(f"{path}: no such file")
    observed = survey_file.observe(list(map(Path, inputs)))
    _refuse_pixels(observed, camera_file)
    lens_stated = bool({"focal_sigma", "center_sigma"} & survey_file.settings.keys()) or any(
        (focal_sigma, center_sigma)
    )
    pool_fit = with_critical_findings(
        calibrate_pool(observed, camera_file.lens, settings), lens_stated=lens_stated
    )
    hashes = {
        str(path): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in map(Path, [*inputs, *survey_file.sources, camera])
        if path.is_file()
    }
    record = pool_record(pool_fit, hashes)
    write_pool(Pool(pool_fit.model.camera, pool_fit.model.interface, survey_file.latency, record=record), out)
    full_record, summary = pool_json(pool_fit, out=Path(out), inputs=hashes), pool_report(pool_fit)
    if report is not None:
        options = {"survey": survey, "camera": camera, "out": out, "seed": seed}
        repeat = [command_line("pool", inputs, options)]
        repeat += [f"{path}  sha256 {digest}" for path, digest in hashes.items()]
        summary.write(report, full_record, pool_pictures(pool_fit), repeat)
    publish(full_record if as_json else None, summary.show, (out, report))
    return pool_fit


def _refuse_pixels(observed: Observations, file: CameraFile) -> None:
    """Refuse pixels of a picture of another size, and numbers that are not pixels."""
    spread = float(np.ptp(observed.pixels, axis=0).max())
    if len(observed) > 1 and 0.0 < spread < LEAST_SPREAD:
        raise CalibrationError(
            f"the pixels spread over {spread:.3g} px in all: expected pixels, u from 0 to {file.lens.width - 1} and v "
            f"from 0 to {file.lens.height - 1}, not parts of the picture's size or coordinates on a plane before the "
            "lens: multiply them by the size"
        )
    outside = ~file.lens.inside(observed.pixels)
    if outside.mean() > 0.2:
        raise CalibrationError(
            f"{int(outside.sum())} of {len(observed)} pixels lie outside the camera file's picture of "
            f"{file.lens.width} x {file.lens.height}: the pixels come from another camera or another resolution"
        )


def _lens_sigma(file: CameraFile) -> tuple[float, float]:
    """Return the standard errors in the camera file's record: of the focal length, relative, and of the
    centre [px]; 0 if absent."""
    std = {}
    for name in ("fx", "cx", "cy"):
        try:
            low, high = (float(x) for x in file.record["estimates"][name]["ci95"])
        except (KeyError, TypeError, ValueError):
            low = high = 0.0
        std[name] = max(0.0, (high - low) / 3.92)
    return std["fx"] / file.lens.fx, max(std["cx"], std["cy"])
