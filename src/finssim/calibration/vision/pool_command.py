"""What `finssim calibrate pool` runs: read, match, fit, write the pool file, report."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate
from finssim.calibration.output.fit_figures import draw_correlation
from finssim.calibration.vision.pool_fit import EXACT_LENS, PoolFit, calibrate_pool, doubted
from finssim.calibration.vision.pool_model import Settings
from finssim.calibration.vision.pool_refine import rms
from finssim.calibration.vision.survey import Observations, observe, observe_combined, read_survey
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.geometry.optics import Layer
from finssim.localization.camera_file import CameraFile, load_camera
from finssim.localization.pool import Pool, write_pool
from finssim.page import html_page, html_picture, html_table
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
        "held_out": _held_out_json(fit),
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


def _held_out_json(fit: PoolFit) -> dict[str, float | int | None] | None:
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


# Pictures of a calibrated pool: errors on the map and in the picture, and beside straight lines.


BLUE, ORANGE, GRAY = "#0072B2", "#D55E00", "0.6"
ARROW = 0.06
"""Length of the 95th percentile of the arrows, in widths of what is drawn."""


def pool_pictures(fit: PoolFit) -> dict[str, tuple[str, bytes]]:
    """File name -> what the picture shows, and the PNG; equal fits give equal pictures."""
    drawn = {
        "map.png": ("Where each pixel's ray meets the point's plane, less the surveyed point", _map(fit)),
        "picture.png": ("Measured less predicted pixels, enlarged", _picture(fit)),
        "outwards.png": ("Residual against the angle from the plane's normal", _outwards(fit)),
        "held_out.png": ("Errors at points held out, refraction beside straight lines", _held_out(fit)),
    }
    if len(fit.correlation.names) > 1:
        drawn["correlation.png"] = ("Correlation of the errors", draw_correlation(fit.correlation))
    return {name: (text, _png(figure)) for name, (text, figure) in drawn.items() if figure is not None}


def _map(fit: PoolFit) -> Figure:
    """Seen along the plane's normal."""
    figure = _figure(7.4, 5.6)
    axes = figure.subplots()
    axis = _across(fit)
    at, error = fit.seen.points @ axis.T, 1000.0 * fit.error @ axis.T
    _arrows(axes, at, error, fit.used, "mm", 1000.0)
    foot = axis @ np.asarray(fit.model.camera.position)
    axes.plot(*foot, "^", color="black", markersize=8, label="camera")
    axes.set_aspect("equal")
    names = ("x [m]", "y [m]") if fit.surface else ("along the wall [m]", "along the wall, across [m]")
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 1.1), ncols=3, frameon=False)
    return figure


def _picture(fit: PoolFit) -> Figure:
    lens = fit.model.camera.lens
    figure = _figure(7.4, 7.4 * lens.height / lens.width + 0.6)
    axes = figure.subplots()
    _arrows(axes, fit.seen.pixels, fit.residual, fit.used, "px", 1.0)
    axes.set_xlim(-0.5, lens.width - 0.5)
    axes.set_ylim(lens.height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("u [px]")
    axes.set_ylabel("v [px]")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 1.1), ncols=3, frameon=False)
    return figure


def _arrows(axes: Axes, at: Array, vectors: Array, used: NDArray[np.bool_], unit: str, per: float) -> None:
    """Points and enlarged arrows; `per` of the arrows' unit make one of the axes'."""
    good = used & np.isfinite(vectors).all(axis=1)
    size = float(np.percentile(np.linalg.norm(vectors[good], axis=1), 95)) if good.any() else 1.0
    span = float(np.ptp(at, axis=0).max()) * ARROW
    scale = max(size, 1e-12) / max(span, 1e-12)
    axes.plot(*at[good].T, ".", color=GRAY, markersize=3)
    axes.quiver(
        *at[good].T, *vectors[good].T, angles="xy", scale_units="xy", scale=scale, width=0.0022, color=BLUE,
        label=f"longest of 95 %: {size:.2g} {unit}, enlarged {per / scale:.2g} times",
    )  # fmt: skip
    if not good.all():
        axes.plot(*at[~good].T, "x", color=ORANGE, markersize=6, label="left out")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="0.93", linewidth=0.6)


def _outwards(fit: PoolFit) -> Figure:
    """Length of the residuals of both models against the direction of the ray in the air."""
    figure = _figure(7.4, 3.8)
    axes = figure.subplots()
    rays, ok = fit.model.camera.lens.rays(fit.seen.pixels)
    cosine = np.abs((rays @ np.asarray(fit.model.camera.R_pc).T) @ fit.model.interface.normal)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    good = ok & fit.used
    for residual, color, name in (
        (fit.pinhole_residual, ORANGE, "straight lines"),
        (fit.residual, BLUE, "refraction"),
    ):
        size = np.maximum(np.linalg.norm(residual[good], axis=1), 1e-3)
        axes.semilogy(angle[good], size, ".", color=color, markersize=4, alpha=0.6, label=name)
    axes.set_xlabel("angle between the ray in the air and the plane's normal [degrees]")
    axes.set_ylabel("residual [px]")
    axes.legend(fontsize=8, frameon=False)
    axes.grid(True, color="0.93", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _held_out(fit: PoolFit) -> Figure | None:
    """Share of held-out points within an error, for both models."""
    both = ((fit.held_out, BLUE, "refraction"), (fit.pinhole_held_out, ORANGE, "straight lines"))
    if fit.held_out is None:
        return None
    figure = _figure(7.4, 3.8)
    axes = figure.subplots()
    for out, color, name in both:
        if out is None:
            continue
        size = 100.0 * np.linalg.norm(out.points, axis=1)
        size = np.sort(size[np.isfinite(size)])
        share = 100.0 * np.arange(1, len(size) + 1) / max(len(size), 1)
        axes.semilogx(np.maximum(size, 1e-3), share, color=color, label=name)
    axes.set_xlabel("error in the water, at the point's own depth [cm]")
    axes.set_ylabel("points within [%]")
    axes.set_ylim(0.0, 101.0)
    axes.legend(fontsize=8, frameon=False)
    axes.grid(True, which="both", color="0.93", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _across(fit: PoolFit) -> Array:
    """Two axes across the normal of the points' planes, (2, 3): x and y of the survey for a surface."""
    if fit.surface:
        return np.eye(3)[:2]
    return np.stack([np.asarray(e, float) for e in fit.model.interface.tangents()])


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


REPORT_FILE, MARKDOWN_FILE, RECORD_FILE = "report.html", "report.md", "fit.json"
HEADS = ("parameter", "estimate", "95 % interval", "unit", "note")

READING = (
    "The interval holds the true value in 19 of 20 such calibrations, if what was given beforehand (index, tape, "
    "level, camera file) is as exact as it was said to be. A note says where the pixels do not tell a number and what "
    "it rests on instead. Judge the result by the error at points held out, in the depth where it will be used. "
    "Arrows that swirl or grow outwards tell of a wrong lens, window or water height; others are noise."
)


def write_pool_report(
    fit: PoolFit,
    folder: str | os.PathLike[str],
    *,
    out: Path | None = None,
    inputs: Mapping[str, str] | None = None,
    command: str = "",
) -> None:
    """Write `report.html`, `report.md`, the pictures as PNG and `fit.json`.

    Args:
        fit: The calibration.
        folder: Directory to make; an earlier report there is replaced.
        out: Pool file that was written.
        inputs: File -> SHA-256 of what the fit was made from.
        command: The command line that makes the fit again.

    Raises:
        OutputError: The folder holds other files, or cannot be written.
    """
    pictures = pool_pictures(fit)
    whole = pool_json(fit, out=out, inputs=inputs)
    with atomic_directory(folder, replaces=RECORD_FILE) as temporary:
        for name, (_, data) in pictures.items():
            (temporary / name).write_bytes(data)
        text = json.dumps(whole, indent=1, allow_nan=False)
        (temporary / RECORD_FILE).write_text(text + "\n", encoding="utf-8")
        (temporary / REPORT_FILE).write_text(_html(fit, pictures, inputs or {}, command), encoding="utf-8")
        (temporary / MARKDOWN_FILE).write_text(
            _markdown(fit, pictures, inputs or {}, command), encoding="utf-8"
        )


def _title(fit: PoolFit) -> str:
    what = "water surface" if fit.surface else "wall"
    return f"Camera and {what} from {fit.residual_json()['locations']} surveyed places"


def _html(
    fit: PoolFit, pictures: Mapping[str, tuple[str, bytes]], inputs: Mapping[str, str], command: str
) -> str:
    rows = [
        f'<tr class="{"" if e.identifiable or e.note == "as given" else "doubt"}">'
        + "".join(f"<td>{escape(cell)}</td>" for cell in cells(e)[:4])
        + f'<td class="words">{escape(e.note)}</td></tr>'
        for e in fit.estimates.values()
    ]
    parts = [
        f"<h1>{escape(_title(fit))}</h1>",
        *(f'<p class="lead">{escape(sentence)}</p>' for sentence in summary(fit)),
    ]
    if fit.advice:
        items = "".join(f'<li class="warning">{escape(sentence)}</li>' for sentence in fit.advice)
        parts += ["<h2>Advice</h2>", f"<ul>{items}</ul>"]
    parts += ["<h2>Estimates</h2>", html_table(HEADS, rows), f'<p class="note">{escape(READING)}</p>']
    parts += [f'<p class="note">{escape(note)}</p>' for note in fit.notes]
    for text, data in pictures.values():
        parts += [f"<h2>{escape(text)}</h2>", html_picture(data, text)]
    lines = [command, *(f"{path}  sha256 {digest}" for path, digest in inputs.items())]
    parts += ["<h2>How to repeat it</h2>", f"<pre>{escape(chr(10).join(filter(None, lines)))}</pre>"]
    return html_page(_title(fit), parts)


def _markdown(
    fit: PoolFit, pictures: Mapping[str, tuple[str, bytes]], inputs: Mapping[str, str], command: str
) -> str:
    lines = [f"# {_title(fit)}", "", *(f"{sentence}.  " for sentence in summary(fit))]
    if fit.advice:
        lines += ["", "## Advice", "", *(f"- {sentence}" for sentence in fit.advice)]
    lines += ["", "## Estimates", "", *_md_table([cells(e) for e in fit.estimates.values()]), "", READING]
    lines += ["", *(f"- {note}" for note in fit.notes)] if fit.notes else []
    lines += ["", "## Pictures", "", *(f"![{text}]({name})" for name, (text, _) in pictures.items())]
    lines += ["", "## How to repeat it", "", "```text", *filter(None, [command])]
    lines += [*(f"{path}  sha256 {digest}" for path, digest in inputs.items()), "```"]
    return "\n".join(lines) + "\n"


def _md_table(rows: Sequence[Sequence[str]]) -> list[str]:
    def line(words: Sequence[str]) -> str:
        return "| " + " | ".join(word.replace("|", "\\|") for word in words) + " |"

    return [line(HEADS), line(["---"] * len(HEADS)), *(line(row) for row in rows)]


LEAST_SPREAD = 5.0
"""Largest width of all pixels that are refused: numbers from 0 to 1 are no pixels [px]."""


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
    folds: int = 5,
    seed: int = 0,
    as_json: bool = False,
) -> PoolFit:
    """Calibrate a camera and the plane it looks through, and write the pool file.

    Args:
        inputs: Detections CSV, pixel CSV (`[image,]id,u,v`), combined CSV (`u,v,x,y,z`), or pictures with tags.
        camera: Camera file with the lens.
        out: Pool file to write, .yaml.
        surveyed: Survey; None where the inputs hold the points themselves.
        report: Directory of the report, or None.
        interface: `surface`, `wall` or `auto`.
        plane: Surveyed plane `n_x,n_y,n_z,b` [m] with n . X + b = 0, such as `0,1,0,0` for a wall at y = 0.
        window: Layers `THICKNESS:INDEX` [m], the first one next to the camera, such as `0.010:1.52`.
        water_height: z of the water's surface in the survey's frame, measured with a tape [m].
        water_depth: Distance from the surveyed points' plane to the surface [m], in place of it.
        water_height_sigma: Standard error of either or of the plane's place [m]; 5 mm if None.
        index: Refractive index of the water.
        index_sigma: Standard error of that; 0.003 if None and the index is not given, else it is held.
        tilt_sigma: Standard error of the plane's direction [degrees]; see `Settings`.
        fit: What is fitted, separated by commas, of pose, height, tilt, index, focal, center, distortion.
        focal_sigma: Relative standard error of the camera file's focal length; the file's own if None.
        center_sigma: Standard error of its optical centre [px]; the file's own if None.
        pixel_sigma: Standard error of a pixel [px]; from the residuals if None.
        survey_sigma: Standard error of a surveyed coordinate [m].
        survey_yaw_sigma: Of a tag's direction [degrees].
        unit: Of lengths in tables that do not say: m, cm, mm, in, ft.
        z: Height of points whose table has no such column [m].
        edge: Of tags whose survey has no such column [m].
        family: Of the tags in pictures.
        latency: Kept in the pool file [s].
        folds: Parts that are held out in turn.
        seed: Of everything random.
        as_json: Print one JSON object in place of the table.

    Returns:
        The calibration.

    Raises:
        CalibrationError, LocalizationError, OutputError: As they say; nothing is written then.
    """
    given = {k: v for k, v in locals().items() if k not in ("inputs", "out", "as_json", "report", "camera")}
    _refuse_numbers(given)
    _refuse_places(out, report)
    file = load_camera(camera)
    if index_sigma is None:
        index_sigma = Settings.index_sigma if index == Settings.index or _names(fit, "index") else 0.0
    remembered = _lens_sigma(file)
    settings = Settings(
        interface=interface,
        plane=_plane(plane),
        window=tuple(_layer(text) for text in window),
        water_height=water_height,
        water_depth=water_depth,
        water_height_sigma=Settings.water_height_sigma if water_height_sigma is None else water_height_sigma,
        index=index,
        index_sigma=index_sigma,
        tilt_sigma=None if tilt_sigma is None else math.radians(tilt_sigma),
        fit=_groups(fit),
        focal_sigma=remembered[0] if focal_sigma is None else focal_sigma,
        center_sigma=remembered[1] if center_sigma is None else center_sigma,
        pixel_sigma=pixel_sigma,
        survey_sigma=survey_sigma,
        survey_yaw_sigma=math.radians(survey_yaw_sigma),
        folds=folds,
        seed=seed,
    )
    seen = _observations(inputs, surveyed, unit=unit, z=z, edge=edge, family=family)
    _refuse_pixels(seen, file)
    lens_told = focal_sigma is not None or center_sigma is not None or any(remembered)
    found = doubted(calibrate_pool(seen, file.lens, settings), file.lens, lens_told=lens_told)
    files = [*map(Path, inputs), *([] if surveyed is None else [Path(surveyed)]), Path(camera)]
    hashes = file_hashes(files)
    model = found.model
    pool = Pool(model.camera, model.interface, latency, record=pool_record(found, hashes))
    write_pool(pool, out)
    if report is not None:
        from finssim.calibration.vision.pool_command import write_pool_report

        command = _command(inputs, camera, out, given)
        write_pool_report(found, report, out=Path(out), inputs=hashes, command=command)
    if as_json:
        print(json.dumps(pool_json(found, out=Path(out), inputs=hashes), allow_nan=False))
    else:
        console = Console() if sys.stdout.isatty() else Console(width=100)
        print_pool(found, console)
        for place in filter(None, (out, report)):
            console.print(f"written: {place}", highlight=False, markup=False, soft_wrap=True)
    return found


def _refuse_numbers(given: Mapping[str, Any]) -> None:
    for name, value in given.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise CalibrationError(f"--{name.replace('_', '-')} is {value}, expected a finite number")


def _refuse_places(out: Path, report: Path | None) -> None:
    if Path(out).suffix not in (".yaml", ".yml"):
        raise CalibrationError(
            f"{out} ends in '{Path(out).suffix}', expected .yaml: name a pool file to write"
        )
    refuse_unwritable(atomic_write(out))
    if report is not None:
        from finssim.calibration.vision.pool_command import RECORD_FILE

        refuse_unwritable(atomic_directory(report, replaces=RECORD_FILE))


def _observations(
    inputs: Sequence[Path],
    surveyed: Path | None,
    *,
    unit: str | None,
    z: float | None,
    edge: float | None,
    family: str | None,
) -> Observations:
    paths = [Path(path) for path in inputs]
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


def _groups(text: str | None) -> tuple[str, ...] | None:
    if text is None or text == "auto":
        return None
    return tuple(word for word in (part.strip() for part in text.split(",")) if word)


def _names(text: str | None, name: str) -> bool:
    return name in (_groups(text) or ())


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


def _command(inputs: Sequence[Path], camera: Path, out: Path, given: Mapping[str, Any]) -> str:
    """The command line that does this again."""
    words = ["finssim", "calibrate", "pool", *map(str, inputs), "--camera", str(camera), "--out", str(out)]
    defaults = run.__kwdefaults__ or {}
    for name, value in given.items():
        if value != defaults.get(name) and value not in (None, ()):
            several = value if isinstance(value, (list, tuple)) else [value]
            words += [word for item in several for word in (f"--{name.replace('_', '-')}", str(item))]
    return shlex.join(words)
