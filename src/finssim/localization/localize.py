"""Implementation of `finssim localize`: one measured pose, or the reason for having none, per picture."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from finssim.core.files import atomic_write, refuse_unwritable
from finssim.core.optics import Lens
from finssim.core.provenance import provenance
from finssim.core.text_table import write_csv
from finssim.localization import LocalizationError
from finssim.localization.detection.detections import Frame, in_our_order, read_detections
from finssim.localization.detection.detector import Detector, RegionTracker, detector
from finssim.localization.detection.families import family_named
from finssim.localization.fusion.attitude import roll_pitch, up_of
from finssim.localization.fusion.fuse_log import Series, counted, read_stream_table, series
from finssim.localization.overhead_camera import Pool, load_pool
from finssim.localization.poses import Constraints, PoseMeasurement, refused
from finssim.localization.poses.methods import NEEDS_DEPTH, TagLocator
from finssim.vehicles import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]

# Height and tilt of the vehicle at the exposure of a picture, from files or constants.

LEVEL_STD = math.radians(2.0)
"""Standard deviation of roll and pitch without an IMU [rad]."""
TILT_STD = math.radians(0.5)
"""Standard deviation of an IMU's roll and pitch [rad]."""
DEPTH_STD = 0.01
"""Standard deviation of a depth if the vehicle file has no depth sensor [m]."""
LONGEST_GAP = 1.0
"""Longest gap between samples over which depth and tilt are interpolated [s]."""


@dataclass(frozen=True, eq=False)
class PriorSources:
    """Sources of the vehicle's height and tilt."""

    base: Constraints
    """Constant part of the constraints: vertical, port, standard deviations."""
    surface: float
    """Height of the still surface along `base.up`, from the pool's origin [m]."""
    depth: Series | float | None
    """Depth of the pressure port below the surface, positive down [m]."""
    up: Series | None
    """Unit vector upwards in the body frame; None: level."""
    assumed: tuple[str, ...]
    """Sentences about assumptions."""

    def at(self, time: float, *, needs_height: bool) -> Constraints | str | None:
        """Return height and tilt at a time [s], or the reason why they are unknown; None if unknown but not needed.

        z_b = surface - depth - e3 . R_y(θ) R_x(φ) P_port, along the vertical.
        """
        if not needs_height and self.up is None:
            return None
        roll, pitch = 0.0, 0.0
        if self.up is not None:
            up_b = self.up.at(time)
            if isinstance(up_b, str):
                return up_b if needs_height else None
            roll, pitch = (float(angle) for angle in roll_pitch(up_b))
        depth = self.depth.at(time) if isinstance(self.depth, Series) else self.depth
        if isinstance(depth, str):
            if needs_height:
                return depth
            depth = None
        below = math.nan if depth is None else float(np.ravel(depth)[0])
        lever = float(up_of(roll, pitch) @ np.array(self.base.port))
        return replace(self.base, z_b=self.surface - below - lever, roll=roll, pitch=pitch)


def prior_sources(
    pool: Pool,
    vehicle: Vehicle,
    *,
    depth: str | float | Path | None,
    imu: str | Path | None,
    tilt_std: float | None = None,
    shared_pixel_std: float = 0.0,
) -> PriorSources:
    """Read the sources of height and tilt.

    Args:
        pool: Pool with the water plane. If it is a surface, depth and tilt are relative to it; if it is a wall,
            to the world frame of the pool file.
        vehicle: Vehicle with the position and accuracy of its pressure port.
        depth: File with columns t, depth, or one number [m], or None.
        imu: File with columns t and roll, pitch or qx, qy, qz, qw, or None.
        tilt_std: Standard deviation of roll and pitch [rad]; None: 0.5 degrees with an IMU, 2 degrees without.
        shared_pixel_std: Standard deviation of an error common to all corners [px].

    Raises:
        LocalizationError: A file lacks the columns, or a number is invalid.
    """
    up, surface = _vertical(pool)
    sensor = vehicle.sensors.depth
    port = (0.0, 0.0, 0.0) if sensor is None else tuple(float(x) for x in sensor.position)
    sensor_std = DEPTH_STD if sensor is None else math.hypot(sensor.noise_std, sensor.bias_initial)
    base = Constraints(
        math.nan,
        z_std=sensor_std,
        tilt_std=_spread("tilt_std", tilt_std, LEVEL_STD if imu is None else TILT_STD),
        up=up,
        port=(port[0], port[1], port[2]),
        shared_pixel_std=_spread("shared_pixel_std", shared_pixel_std, 0.0),
    )
    assumed = []
    if imu is None:
        spread = math.degrees(base.tilt_std)
        assumed.append(f"no --imu: the vehicle is assumed level, within {spread:.1f} degrees")
    if sensor is None and depth is not None:
        assumed.append(
            f"{vehicle.name} has no depth sensor: the depth is assumed to be that of the body origin"
        )
    return PriorSources(base, surface, _depth(depth), _tilt(imu), tuple(assumed))


def _vertical(pool: Pool) -> tuple[tuple[float, float, float], float]:
    """Return the unit vector upwards, pool frame, and the height of the still surface along it.

    Up is the plane's normal if that is within 45 degrees of the world's z axis, since water is level and
    surveys only nearly so.
    """
    T_pw = pool.T_pw
    if float(T_pw[:3, 2] @ pool.interface.normal) > math.sqrt(0.5):
        x, y, z = (float(a) for a in pool.interface.normal)
        return (x, y, z), -float(pool.interface.offset)
    x, y, z = (float(a) for a in T_pw[:3, 2])
    return (x, y, z), float(T_pw[:3, 2] @ T_pw[:3, 3])


def _depth(depth: str | float | Path | None) -> Series | float | None:
    if depth is None:
        return None
    try:
        number = float(str(depth))
    except ValueError:
        table = read_stream_table(str(depth))
        if not table.has("depth"):
            raise LocalizationError(
                f"{depth}: no column 'depth' with numbers: expected t [s] and depth [m], positive down"
            ) from None
        return series("depth", table.t, table.columns("depth"), LONGEST_GAP, label=str(depth))
    if not math.isfinite(number):
        raise LocalizationError(
            f"depth is {depth}, expected metres below the surface, or a file with t, depth"
        )
    return number


def _tilt(imu: str | Path | None) -> Series | None:
    """Read the direction of up in the body frame; it may be interpolated linearly between rows."""
    if imu is None:
        return None
    table = read_stream_table(imu)
    up = table.up()
    if up is None:
        raise LocalizationError(
            f"{imu}: no attitude: expected columns roll, pitch [rad] or qx, qy, qz, qw; run "
            "`finssim fuse` on gyro and accelerometer to compute one"
        )
    return series("attitude", table.t, up, LONGEST_GAP, label=str(imu))


def _spread(name: str, value: float | None, default: float) -> float:
    if value is None:
        return default
    if not (math.isfinite(value) and value >= 0.0):
        raise LocalizationError(f"{name} is {value}, expected a standard deviation that is not negative")
    return float(value)


# Poses of a vehicle from the tags of each picture, with height and tilt at its exposure.


class Locator:
    """Locator of the vehicle in single pictures; it keeps no state between them."""

    def __init__(
        self,
        pool: Pool,
        vehicle: Vehicle,
        prior: PriorSources,
        *,
        method: str = "refractive",
        pixel_std: float = 0.5,
    ) -> None:
        """
        Args:
            pool: Camera and water.
            vehicle: Vehicle with its tags.
            prior: Height and tilt over time.
            method: A name in `METHODS`.
            pixel_std: Standard deviation of a corner, per axis [px].

        Raises:
            LocalizationError: As `TagLocator`, or the method needs a depth and there is none.
        """
        self._locate = TagLocator(pool, vehicle.file_tags, method=method, pixel_std=pixel_std)
        if self._locate.needs_height and prior.depth is None:
            raise LocalizationError(
                f"method {method} needs --depth FILE (columns t, depth) or --depth METRES, the depth of the pressure "
                "port; --method refractive-6dof needs none"
            )
        self.known, self.tags_b = prior, self._locate.tags_b
        """Corners of the vehicle's tags, body frame [m]: tag id -> (4, 3)."""
        self.family = family_named(self._locate.family).name

    def locate(self, frame: Frame) -> PoseMeasurement:
        """Return the pose in one picture, or a refusal with its reason."""
        locate = self._locate
        of_family = [d for d in frame.detections if _name(d.family) in ("", self.family)]
        if frame.detections and not of_family:
            other = ", ".join(sorted({d.family for d in frame.detections}))
            return refused(locate.method, f"no tag of family {self.family} seen: {other}")
        if not of_family:
            return locate([], None)
        prior = self.known.at(frame.time - locate.pool.latency, needs_height=locate.needs_height)
        return refused(locate.method, prior) if isinstance(prior, str) else locate(of_family, prior)


@cache
def _name(family: str) -> str:
    """Return the family's canonical name, such as `tag25h9` for `25h9`; unknown names are returned unchanged."""
    try:
        return family_named(family).name if family else ""
    except LocalizationError:
        return family


# Output table of `finssim localize`, and its summary.

Row = tuple[Frame, PoseMeasurement]

COLUMNS = (
    *("time", "image", "x", "y", "z", "yaw", "std_x", "std_y", "std_yaw", "roll", "pitch"),
    *("qx", "qy", "qz", "qw", "cov_xy", "cov_xyaw", "cov_yyaw", "residual_px", "tags", "corners", "medium"),
    *("status", "reason"),
)
"""Columns of the table, metres and radians, pool frame; z of the body origin; q rotates body vectors to the
pool frame. `time` is the stamp of the picture. A refused picture has empty numbers, status `refused` and a
reason."""


def write_rows(rows: Sequence[Row], out: Path) -> None:
    """Write one row for each picture.

    Raises:
        OutputError: The file cannot be written.
    """
    write_csv(out, COLUMNS, (_cells(frame, measurement) for frame, measurement in rows))


def _cells(frame: Frame, measurement: PoseMeasurement) -> list[Any]:
    time = "" if math.isnan(frame.time) else repr(float(frame.time))
    tags = " ".join(map(str, measurement.tags))
    if not measurement.ok:
        return [time, frame.image, *[""] * (len(COLUMNS) - 7), tags, "", "", "refused", measurement.reason]
    C = measurement.covariance
    numbers = [*measurement.position, measurement.yaw, *measurement.std, measurement.roll, measurement.pitch]
    numbers += [*measurement.quaternion, C[0, 1], C[0, 2], C[1, 2], measurement.residual_px]
    texts = [f"{float(x):.9g}" for x in numbers]
    return [time, frame.image, *texts, tags, measurement.corners, measurement.medium, "ok", ""]


def summary_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the figures of a run, as plain values."""
    located = [measurement for _, measurement in rows if measurement.ok]
    reasons = Counter(counted(measurement.reason) for _, measurement in rows if not measurement.ok)
    rejected: Counter[str] = Counter()
    for _, measurement in rows:
        rejected.update(measurement.rejected)
    return {
        "frames": len(rows),
        "located": len(located),
        "refused": dict(reasons.most_common()),
        "corners_rejected": dict(rejected.most_common()),
        "median_residual_px": _median([measurement.residual_px for measurement in located]),
        "median_std_m": _median([float(np.hypot(*measurement.std[:2])) for measurement in located]),
        "median_std_yaw_deg": _median([math.degrees(measurement.std[2]) for measurement in located]),
    }


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return the lines of the printed summary."""
    lines = [f"{summary['located']} of {summary['frames']} pictures located with method {summary['method']}"]
    lines += [f"refused {n:5d}: {reason}" for reason, n in summary["refused"].items()]
    if summary["corners_rejected"]:
        text = ", ".join(f"{n} {reason}" for reason, n in summary["corners_rejected"].items())
        lines.append(f"corners not used: {text}")
    if summary["located"]:
        lines.append(
            f"median residual {summary['median_residual_px']:.2f} px; standard deviations "
            f"{100 * summary['median_std_m']:.2f} cm, {summary['median_std_yaw_deg']:.2f} degrees (median)"
        )
    return lines


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


# Pictures with their tags: from pictures and videos, or from detections files.

TABLES = (".csv", ".tsv", ".txt")
"""Suffixes of detections files."""


def frames_of(
    inputs: Sequence[Path],
    lens: Lens,
    find: Detector,
    corners: Mapping[int, Array],
    times: Path | None,
    notes: list[str],
) -> tuple[Iterator[Frame], int | None]:
    """Return an iterator over the frames, and their number if it is known in advance.

    Args:
        inputs: Pictures, folders of them, videos or detections files.
        lens: Lens of the camera: pictures of another size are refused.
        find: Detector of the tags in pictures.
        corners: Tag id -> its corners on the vehicle [m], (4, 3). In videos these tags are first searched
            near their previous positions.
        times: File with the time stamps of the pictures.
        notes: List to which one sentence is appended for each thing that was left out.

    Raises:
        LocalizationError: An input is missing, of unknown kind or cannot be read.
    """
    if not inputs:
        raise LocalizationError(
            "no input: give pictures, a folder of them, a video, or a detections file (.csv)"
        )
    tables = [path for path in inputs if path.suffix.lower() in TABLES]
    if tables and len(tables) < len(inputs):
        raise LocalizationError("detection files and pictures are mixed: give the ones or the others")
    if tables:
        frames = []
        for path in tables:
            ordered, remark = in_our_order(read_detections(path, notes), corners)
            frames += ordered
            notes += [f"{path}: {remark}"] if remark else []
        return iter(frames), len(frames)
    return _seen(inputs, lens, find, tuple(corners), times, notes), _count(inputs)


def _seen(
    inputs: Sequence[Path],
    lens: Lens,
    find: Detector,
    tags: tuple[int, ...],
    times: Path | None,
    notes: list[str],
) -> Iterator[Frame]:
    from finssim.localization.detection.pictures import pictures

    film, tracker = "", None
    for time, name, image in pictures(list(inputs), times=times, notify=notes.append):
        if image.shape != (lens.height, lens.width):
            raise LocalizationError(
                f"{name}: {image.shape[1]} x {image.shape[0]} pixels, expected {lens.width} x {lens.height} as the "
                "pool file's lens: calibrate at the size at which you record"
            )
        of_film, number, _ = name.rpartition("#")
        if not number:  # a single picture
            yield Frame(time, name, tuple(find.detect(image)))
            continue
        if tracker is None or of_film != film:
            film, tracker = of_film, RegionTracker(find, tags or None)
        yield Frame(time, name, tuple(tracker.detect(image, time)))


def _count(inputs: Sequence[Path]) -> int | None:
    """Return the number of pictures; None if there are videos."""
    from finssim.localization.detection.pictures import PICTURE_FILES

    count = 0
    for path in inputs:
        inside = path.iterdir() if path.is_dir() else [path]
        here = sum(file.suffix.lower() in PICTURE_FILES for file in inside)
        if not here:
            return None
        count += here
    return count


@dataclass
class LocalizeResult:
    """Result of localizing the vehicle in pictures."""

    rows: list[Row] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    interrupted: bool = False


@dataclass(frozen=True, kw_only=True)
class ImageTables:
    """Additional measurements: depth, tilt and times of the images."""

    depth: str | float | Path | None = None
    """(FILE|Z) Table with columns t, depth, or one depth of the pressure port below the surface [m]."""
    imu: str | Path | None = None
    """(FILE) Table with columns t and roll, pitch [rad] or qx, qy, qz, qw; by default the vehicle is level."""
    tilt_std_deg: float | None = None
    """Standard deviation of roll and pitch [deg]; default 0.5 with --imu, 2 without."""
    times: str | Path | None = None
    """(FILE) Table with columns image, time [s], if the image names contain no times."""


@dataclass(frozen=True, kw_only=True)
class LocalizeSettings:
    """Method of the localization, refinement of corners and their errors."""

    method: str = "refractive"
    """(METHOD) refractive, refractive-weighted, refractive-6dof, pinhole-depth or pinhole."""
    refine: str = "fit"
    """(METHOD) Corner refinement: fit, edges (AprilTag's own) or none."""
    gamma: float = 1.0
    """Exponent gamma of the images: 1 linear, 2.2 video."""
    pixel_std: float | None = None
    """Standard deviation of a detected corner, per axis [px]; by default that of the pool's calibration,
    otherwise 0.5."""
    shared_pixel_std: float = 0.0
    """Standard deviation of an error common to all corners of an image, such as by waves, per axis [px]."""


def run(
    inputs: Sequence[str | Path] | str | Path,
    *,
    pool: str | Path,
    vehicle: str | Path,
    out: str | Path,
    tables: Annotated[ImageTables, "options"] = ImageTables(),
    settings: Annotated[LocalizeSettings, "options"] = LocalizeSettings(),
    as_json: bool = False,
) -> LocalizeResult:
    """Measure position and yaw in every image: x, y, z [m], yaw [rad], pool frame, with standard deviations.

    Example: finssim localize video.mp4 --pool pool.yaml --vehicle finsrov --depth depth.csv --out poses.csv

    Args:
        inputs (INPUT): Images, folders of them, videos, or detections files (.csv).
        pool (FILE): Pool file: camera, water plane and frames (.yaml).
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        out (FILE): Table to write (.csv), one row per image.
        tables: Additional measurements: depth, tilt and times of the images.
        settings: Method, refinement and errors of corners.
        as_json: Print one JSON object instead of tables.

    Raises:
        LocalizationError: An input cannot be used, or the method needs a depth and there is none.
        OutputError: `out` cannot be written.
        KeyboardInterrupt: The run was interrupted; the rows measured until then have been written.
    """
    out, paths = Path(out), [Path(p) for p in ([inputs] if isinstance(inputs, (str, Path)) else inputs)]
    refuse_unwritable(atomic_write(out))
    site, body = load_pool(pool), load_vehicle(str(vehicle))
    prior = prior_sources(
        site,
        body,
        depth=tables.depth,
        imu=tables.imu,
        tilt_std=None if tables.tilt_std_deg is None else math.radians(tables.tilt_std_deg),
        shared_pixel_std=settings.shared_pixel_std,
    )
    method = settings.method
    pixel_std = site.pixel_std if settings.pixel_std is None else settings.pixel_std
    locator = Locator(site, body, prior, method=method, pixel_std=pixel_std)
    find = detector(locator.family, refine=settings.refine, gamma=settings.gamma)
    stamps = None if tables.times is None else Path(tables.times)
    notes: list[str] = []
    frames, count = frames_of(paths, site.camera.lens, find, locator.tags_b, stamps, notes)
    result = _measure(frames, count, locator)
    write_rows(result.rows, out)
    result.summary = {
        "method": method,
        **summary_of(result.rows),
        "assumed": list(prior.assumed) if method in NEEDS_DEPTH else [],
        "notes": notes,
        "out": str(out),
        "interrupted": result.interrupted,
    }
    if as_json:
        document = {
            **result.summary,
            "pool": {"file": str(pool), "sha256": site.sha256},
            "vehicle": {"name": body.name, "sha256": body.sha256},
            "settings": {
                "depth": None if tables.depth is None else str(tables.depth),
                "imu": None if tables.imu is None else str(tables.imu),
                "pixel_std": pixel_std,
                "depth_std": prior.base.z_std,
                "tilt_std_deg": math.degrees(prior.base.tilt_std),
                "shared_pixel_std": prior.base.shared_pixel_std,
            },
            "provenance": provenance(),
        }
        print(json.dumps(document, allow_nan=False))
    else:
        _print(result.summary)
    if result.interrupted:
        raise KeyboardInterrupt
    return result


def _measure(frames: Iterator[Frame], count: int | None, locator: Locator) -> LocalizeResult:
    """Measure all frames, until the end or Ctrl-C."""
    result = LocalizeResult()
    screen = Console(stderr=True)
    columns = (TextColumn("localize"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
    bars = Progress(
        *columns, TimeElapsedColumn(), console=screen, transient=True, disable=not screen.is_terminal
    )
    try:
        with bars:
            bar = bars.add_task("", total=count)
            located = 0
            for frame in frames:
                measured = locator.locate(frame)
                result.rows.append((frame, measured))
                located += measured.ok
                bars.update(bar, advance=1, description=f"{located} located")
    except KeyboardInterrupt:
        result.interrupted = True
    return result


def _print(summary: dict[str, Any]) -> None:
    console = Console() if sys.stdout.isatty() else Console(width=120)
    lines = [f"note: {note}" for note in summary["notes"]]
    lines += [f"assumed: {sentence}" for sentence in summary["assumed"]]
    lines += [*summary_lines(summary), f"written: {summary['out']}"]
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
