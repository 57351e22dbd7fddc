"""What `finssim calibrate pool` runs: read, match, fit, write the pool file, report."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import plain
from finssim.calibration.fit import Estimate
from finssim.calibration.output.report import (
    AS_GIVEN,
    BLUE,
    GRAY,
    HEADS,
    ORANGE,
    Report,
    command_line,
    draw_correlation,
    new_figure,
    picture_axes,
    png,
    publish,
    refuse_places,
)
from finssim.calibration.vision.pool_fit import HeldOut, PoolFit, calibrate_pool, doubted, rms
from finssim.calibration.vision.pool_model import Settings
from finssim.calibration.vision.survey import Observations, observe, observe_combined, read_survey
from finssim.geometry.optics import Layer
from finssim.localization.camera_file import CameraFile, load_camera
from finssim.localization.pool import Pool, write_pool
from finssim.provenance import provenance

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["pool_record", "run"]

Array = NDArray[np.float64]

DIGITS = {"m": 4, "deg": 3, "px": 2}
"""Digits after the point: tenths of a millimetre, thousandths of a degree, hundredths of a pixel; five without unit."""

MOST_NAMES = 12
"""Outliers that a sentence names."""

LEAST_SPREAD = 5.0
"""Largest width of all pixels that are refused: numbers from 0 to 1 are no pixels [px]."""

READING = (
    "The interval holds the true value in 19 of 20 such calibrations, if what was given beforehand (index, tape, "
    "level, camera file) is as exact as it was said to be. A note says where the pixels do not tell a number and what "
    "it rests on instead. Judge the result by the error at points held out, in the depth where it will be used. "
    "Arrows that swirl or grow outwards tell of a wrong lens, window or water height; others are noise."
)


def pool_json(
    fit: PoolFit, *, out: Path | None = None, inputs: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """What `--json` prints and the report's `fit.json` holds.

    Args:
        fit: The calibration.
        out: Pool file that was written.
        inputs: File -> SHA-256 of what the fit was made from.
    """
    held_out, pinhole = (None if h is None else h.as_json() for h in (fit.held_out, fit.pinhole_held_out))
    figures = {
        "residual": fit.residual_json(),
        "held_out": held_out and {**held_out, "survey_cm": _survey_share(fit)},
        "pinhole": {"rms_px": rms(fit.pinhole_residual[fit.used]), "held_out": pinhole},
    }
    return {
        "kind": "pool",
        "interface": "surface" if fit.surface else "wall",
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        **plain(figures),
        "lens_fitted": list(fit.lens_fitted),
        "outliers": fit.outliers,
        "correlation": plain(fit.correlation.as_json(), 4),
        "findings": [one.as_json() for one in fit.findings],
        "settings": plain(asdict(fit.settings)),
        "inputs": dict(inputs or {}),
        "out": None if out is None else str(out),
        "provenance": provenance(),
    }


def pool_record(fit: PoolFit, inputs: Mapping[str, str]) -> dict[str, Any]:
    """What the pool file remembers of its making: the same, less what is long."""
    record = pool_json(fit, inputs=inputs)
    return {key: value for key, value in record.items() if key not in ("kind", "correlation", "out")}


def pool_report(fit: PoolFit) -> Report:
    """The calibration in words."""
    figures, held_out = (
        fit.residual_json(),
        "too few points to hold any out: the error at other points is not known",
    )
    summary = [
        f"residual {figures['rms_px']:.2f} px, {figures['rms_mm']:.1f} mm at the points; of it a pixel is worth "
        f"{figures['pixel_sigma']:.2f} px, the survey {figures['survey_sigma_mm']:.1f} mm"
    ]
    if fit.held_out is not None:
        share = _survey_share(fit)
        of_it = f"; of it the survey's own error {share:.2f} cm" if math.isfinite(share) else ""
        held_out = f"held out ({fit.held_out.folds} parts): {_figures(fit.held_out)}{of_it}"
    summary.append(held_out)
    if fit.pinhole_held_out is not None:
        summary.append(f"straight lines, held out: {_figures(fit.pinhole_held_out)}")
    if fit.outliers:
        more = ", ..." if len(fit.outliers) > MOST_NAMES else ""
        summary.append(f"left out as wrong: {', '.join(fit.outliers[:MOST_NAMES])}{more}")
    kind = "water surface" if fit.surface else "wall"
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
    interval = "" if estimate.note == AS_GIVEN else f"{low} to {high}"
    return estimate.name, value, interval, estimate.unit, estimate.note


def _figures(held_out: HeldOut) -> str:
    figures = held_out.as_json()
    text = f"{figures['rms_px']:.2f} px"
    if figures["rms_cm"] is not None:
        text += f", in the water {figures['rms_cm']:.2f} cm rms, 95 % within {figures['p95_cm']:.2f} cm"
    return text


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


# Pictures of a calibrated pool: errors on the map and in the picture, and beside straight lines.


def pool_pictures(fit: PoolFit) -> dict[str, tuple[str, bytes]]:
    """File name -> what the picture shows, and the PNG; equal fits give equal pictures."""
    drawn = {
        "map.png": ("Where each pixel's ray meets the point's plane, less the surveyed point", _map(fit)),
        "picture.png": ("Measured less predicted pixels, enlarged", _picture(fit)),
    }
    if len(fit.correlation.names) > 1:
        drawn["correlation.png"] = ("Correlation of the errors", draw_correlation(fit.correlation))
    return {name: (text, png(figure)) for name, (text, figure) in drawn.items()}


def _map(fit: PoolFit) -> Figure:
    """Seen along the plane's normal."""
    figure = new_figure(7.4, 5.6)
    axes = figure.subplots()
    across, names = np.eye(3)[:2], ("x [m]", "y [m]")
    if not fit.surface:
        across, names = fit.model.tangents, ("along the wall [m]", "along the wall, across [m]")
    axes.plot(*(across @ fit.model.camera.position), "^", color="black", markersize=8, label="camera")
    _draw_arrows(axes, fit.seen.points @ across.T, 1000.0 * fit.error @ across.T, fit.used, "mm", 1000.0)
    axes.set(xlabel=names[0], ylabel=names[1], aspect="equal")
    return figure


def _picture(fit: PoolFit) -> Figure:
    lens = fit.model.camera.lens
    figure = new_figure(7.4, 7.4 * lens.height / lens.width + 0.6)
    axes = figure.subplots()
    _draw_arrows(axes, fit.seen.pixels, fit.residual, fit.used, "px", 1.0)
    picture_axes(axes, lens)
    return figure


ARROW = 0.06
"""Length of the 95th percentile of arrows in a figure, in widths of what is drawn."""


def _draw_arrows(
    axes: Axes,
    at: Array,
    vectors: Array,
    used: NDArray[np.bool_],
    unit: str,
    per: float,
) -> None:
    """Points and enlarged arrows, and crosses where there is none; `per` of the arrows' unit make one of the axes'.

    Args:
        axes: To draw into.
        at: (N, 2).
        vectors: (N, 2).
        used: Which rows the calibration used, (N,).
        unit: Of the arrows.
        per: Arrow units in one of the axes' units.
    """
    good = used & np.isfinite(vectors).all(axis=1)
    size = float(np.percentile(np.linalg.norm(vectors[good], axis=1), 95)) if good.any() else 1.0
    scale = max(size, 1e-12) / max(float(np.ptp(at, axis=0).max()) * ARROW, 1e-12)
    axes.plot(*at[good].T, ".", color=GRAY, markersize=3)
    label = f"longest of 95 %: {size:.2g} {unit}, enlarged {per / scale:.2g} times"
    arrows = {"angles": "xy", "scale_units": "xy", "scale": scale, "width": 0.0022}
    axes.quiver(*at[good].T, *vectors[good].T, color=BLUE, label=label, **arrows)
    if not good.all():
        axes.plot(*at[~good].T, "x", color=ORANGE, markersize=6, label="left out")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 1.1), ncols=3, frameon=False)
    axes.grid(True, color="0.93", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def run(
    inputs: Sequence[Path],
    *,
    camera: Path,
    out: Path,
    surveyed: Path | None = None,
    report: Path | None = None,
    interface: str = "auto",
    plane: str | None = None,
    window: Sequence[str] = (),
    water_height: float | None = None,
    water_depth: float | None = None,
    water_height_sigma: float | None = None,
    index: float = 1.333,
    index_sigma: float | None = None,
    tilt_sigma: float | None = None,
    fit: str | None = None,
    focal_sigma: float | None = None,
    center_sigma: float | None = None,
    pixel_sigma: float | None = None,
    survey_sigma: float = 0.002,
    survey_yaw_sigma: float = 0.5,
    unit: str | None = None,
    z: float | None = None,
    edge: float | None = None,
    family: str | None = None,
    latency: float = 0.0,
    folds: Annotated[int, (2, 1000)] = 5,
    seed: int = 0,
    as_json: bool = False,
) -> PoolFit:
    """Find camera pose [m, deg] and water plane (height [m], tilt [deg], index) from surveyed points in the water.

    Example: finssim calibrate pool points.csv --surveyed survey.csv --camera camera.yaml --out pool.yaml

    Args:
        inputs (INPUT): Detections (.csv), pixels (id,u,v), pixels with points (u,v,x,y,z), or pictures of tags.
        camera (FILE): Camera file: ours, or one of OpenCV, ROS or Kalibr.
        out (FILE): Pool file to write (.yaml).
        surveyed (FILE): Survey (.csv): id,x,y,z of points, or tag,x,y,z,yaw_deg,edge of tags, or
            image,x,y,z,yaw_deg,edge of one tag that was moved; not needed where the inputs hold the points.
        report (DIR): Directory for the report and its pictures.
        interface (KIND): What the camera looks through: surface, wall, or auto to try.
        plane (PLANE): The surveyed plane itself, n_x,n_y,n_z,b with n . X + b = 0 [m].
        window (LAYER): Solid layer THICKNESS:INDEX, such as 0.010:1.52 for 10 mm of glass; several from the camera on.
        water_height: z of the surface in the survey's frame, by a tape [m].
        water_depth: In place of it: from the surveyed points to the surface [m].
        water_height_sigma: Error of either, or of the plane's place [m]; 0.005 if not given.
        index: Refractive index of the water.
        index_sigma: Error of that; 0.003 if neither is given, 0 (held) if only --index is.
        tilt_sigma: How far the plane may lean [deg]; 0.2 for a surface, 0.5 for --plane, free for a wall.
        fit (NAMES): What is fitted, of pose,height,tilt,index,focal,center,distortion; chosen if not given.
        focal_sigma: Relative error of the camera file's focal length; what the file says if not given.
        center_sigma: Error of its optical centre [px]; what the file says if not given.
        pixel_sigma: Error of a pixel [px]; from the residuals if not given.
        survey_sigma: Error of a surveyed coordinate [m].
        survey_yaw_sigma: Error of a tag's direction [deg].
        unit (UNIT): Of lengths in tables that do not say: m, cm, mm, in, ft.
        z: Height of points whose table has no such column [m].
        edge: Of tags whose survey has no such column [m].
        family (NAME): Of tags in pictures.
        latency: Time stamps of pictures minus their exposure [s], kept in the file.
        folds: Parts that are held out in turn.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The calibration.

    Raises:
        CalibrationError, LocalizationError, OutputError: As they say; nothing is written then.
    """
    given = {k: v for k, v in locals().items() if k not in ("inputs", "out", "as_json", "report", "camera")}
    for name, value in given.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise CalibrationError(f"--{name.replace('_', '-')} is {value}, expected a finite number")
    refuse_places(out, report, "pool")
    file = load_camera(camera)
    settings = _settings(given, file)
    seen = _observations(list(map(Path, inputs)), surveyed, unit, z, edge, family)
    _refuse_pixels(seen, file)
    lens_told = focal_sigma is not None or center_sigma is not None or any(_lens_sigma(file))
    found = doubted(calibrate_pool(seen, file.lens, settings), file.lens, lens_told=lens_told)
    hashes = {
        str(path): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in map(Path, [*inputs, *filter(None, [surveyed]), camera])
        if path.is_file()
    }
    record = pool_record(found, hashes)
    write_pool(Pool(found.model.camera, found.model.interface, latency, record=record), out)
    words = pool_report(found)
    if report is not None:
        defaults = run.__kwdefaults__ or {}
        options = {k: v for k, v in given.items() if v != defaults.get(k)}
        repeat = [command_line("pool", inputs, {"camera": camera, "out": out, **options})]
        repeat += [f"{path}  sha256 {digest}" for path, digest in hashes.items()]
        words.write(report, pool_json(found, out=Path(out), inputs=hashes), pool_pictures(found), repeat)
    as_object = pool_json(found, out=Path(out), inputs=hashes) if as_json else None
    publish(as_object, words.show, (out, report))
    return found


def _settings(given: Mapping[str, Any], file: CameraFile) -> Settings:
    """The options as `Settings`: texts read, degrees as radians, what is not given from the camera file."""
    options = {f.name: given[f.name] for f in fields(Settings) if given.get(f.name) is not None}
    options["plane"] = _plane(given["plane"])
    options["window"] = tuple(_layer(text) for text in given["window"])
    fit = given["fit"]
    options["fit"] = None if fit in (None, "auto") else tuple(filter(None, map(str.strip, fit.split(","))))
    for name in {"tilt_sigma", "survey_yaw_sigma"} & options.keys():
        options[name] = math.radians(options[name])
    focal, center = _lens_sigma(file)
    held = given["index"] != Settings.index and "index" not in (options["fit"] or ())
    defaults = {"focal_sigma": focal, "center_sigma": center}
    return Settings(**{**defaults, **({"index_sigma": 0.0} if held else {}), **options})


def _observations(
    paths: Sequence[Path],
    surveyed: Path | None,
    unit: str | None,
    z: float | None,
    edge: float | None,
    family: str | None,
) -> Observations:
    if not paths:
        raise CalibrationError("no input: give detections, pixels or pictures")
    for path in paths:
        if not path.exists():
            raise CalibrationError(f"{path}: no such file")
    if surveyed is None or all(path.resolve() == Path(surveyed).resolve() for path in paths):
        return observe_combined(paths, unit=unit, z=z)
    return observe(paths, read_survey(surveyed, unit=unit, edge=edge, z=z), family=family)


def _refuse_pixels(seen: Observations, file: CameraFile) -> None:
    """Refuse pixels that another size of picture must have had, and what are none."""
    spread = float(np.ptp(seen.pixels, axis=0).max())
    if len(seen) > 1 and 0.0 < spread < LEAST_SPREAD:
        raise CalibrationError(
            f"the pixels spread over {spread:.3g} px in all: expected pixels, u from 0 to {file.lens.width - 1} and v "
            f"from 0 to {file.lens.height - 1}, not parts of the picture's size or coordinates on a plane before the "
            "lens: multiply them by the size"
        )
    outside = ~file.lens.inside(seen.pixels)
    if outside.mean() > 0.2:
        raise CalibrationError(
            f"{int(outside.sum())} of {len(seen)} pixels lie outside the camera file's picture of {file.lens.width} x "
            f"{file.lens.height}: the pixels come from another camera or another resolution"
        )


def _lens_sigma(file: CameraFile) -> tuple[float, float]:
    """Standard errors that the camera file remembers: of the focal length, relative, and of the centre [px]; or 0."""
    fx, cx, cy = (_remembered(file, name) for name in ("fx", "cx", "cy"))
    return fx / file.lens.fx, max(cx, cy)


def _remembered(file: CameraFile, name: str) -> float:
    estimates = file.record.get("estimates")
    found = estimates.get(name) if isinstance(estimates, Mapping) else None
    try:
        low, high = (float(x) for x in found["ci95"])  # type: ignore[index]
    except (KeyError, TypeError, ValueError):
        return 0.0
    return max(0.0, (high - low) / 3.92)


def _plane(text: str | None) -> tuple[float, float, float, float] | None:
    if text is None:
        return None
    try:
        x, y, z, b = (float(word) for word in text.split(","))
    except ValueError:
        raise CalibrationError(
            f"plane is '{text}', expected n_x,n_y,n_z,b with n . X + b = 0, such as 0,1,0,0 for a wall at y = 0"
        ) from None
    return x, y, z, b


def _layer(text: str) -> Layer:
    thickness, mark, index = text.partition(":")
    try:
        return Layer(float(thickness), float(index) if mark else 1.52)
    except ValueError as error:
        raise CalibrationError(
            f"window is '{text}', expected THICKNESS:INDEX in metres, such as 0.010:1.52 ({error})"
        ) from None
