"""What `finssim calibrate pool` runs: read, match, fit, write the pool file, report."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.console import Console

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool.observations import Observations, observe, observe_combined
from finssim.calibration.vision.pool.pool_doubts import doubted
from finssim.calibration.vision.pool.pool_fit import PoolFit, calibrate_pool
from finssim.calibration.vision.pool.pool_record import file_hashes, pool_json, pool_record, print_pool
from finssim.calibration.vision.pool.pool_settings import Settings
from finssim.calibration.vision.pool.survey import read_survey
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.geometry.optics import Layer
from finssim.localization.camera_file import CameraFile, load_camera
from finssim.localization.pool import Pool, write_pool

__all__ = ["run"]

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
    folds: Annotated[int, (2, None)] = 5,
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
        from finssim.calibration.vision.pool.pool_report import write_pool_report

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
        from finssim.calibration.vision.pool.pool_report import RECORD_FILE

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
