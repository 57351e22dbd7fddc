"""Implementation of `finssim fuse`: process a log with the estimator, as in real time."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from finssim.core.files import atomic_write, refuse_unwritable
from finssim.core.rotations import wrap_angle
from finssim.core.text_table import write_csv
from finssim.localization import LocalizationError
from finssim.localization.detection.detections import Frame
from finssim.localization.fusion.estimator import MODES, Estimator, Fixes, Health
from finssim.localization.fusion.fuse_log import Log, NoFix, StreamTable, load_log, series
from finssim.localization.fusion.fuse_settings import settings_of, site_of
from finssim.localization.fusion.streams import USED, PoseEstimate, Sample
from finssim.localization.overhead_camera import Pool, load_pool
from finssim.localization.poses.methods import TagLocator, check_method
from finssim.vehicles import Vehicle, load_vehicle

# Output table of the fusion, and its summary.

Array = npt.NDArray[np.float64]

AXES = ("x", "y", "z", "vx", "vy", "vz")
COLUMNS = (
    *("t", *AXES, "roll", "pitch", "yaw", "r"),
    *(f"std_{name}" for name in (*AXES, "yaw")),
    *("state", "ready", "n_vision", "n_yaw", "n_depth", "n_imu", "n_refused"),
)
"""Columns of the table, in metres, m/s, rad and rad/s, pool frame; `n_` columns count the accepted samples so far."""

GAP = 0.25
"""Longest gap of the truth that is interpolated [s]."""


def row_of(estimate: PoseEstimate, health: Health) -> list[Any]:
    """Return one row of the table, in the order of `COLUMNS`."""
    numbers = [
        estimate.time,
        *estimate.x,
        estimate.roll,
        estimate.pitch,
        estimate.yaw,
        estimate.yaw_rate,
        *estimate.std(),
    ]
    used = {stream: sum(v.get(word, 0) for word in USED) for stream, v in health.counts.items()}
    counts = [used.get(stream, 0) for stream in ("vision", "yaw", "depth", "imu")]
    refused = sum(
        n for verdicts in health.counts.values() for word, n in verdicts.items() if word not in USED
    )
    return [*map(float, numbers), health.vision_mode, int(health.ready), *counts, refused]


def write_rows(rows: Sequence[Sequence[Any]], out: Path) -> None:
    """Write the table; unknown values are empty cells.

    Raises:
        OutputError: The table cannot be written.
    """
    write_csv(out, COLUMNS, ([_cell(value) for value in row] for row in rows))


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.9g}" if abs(value) < 1e6 else repr(value)
    return value


def summary_of(
    rows: Sequence[Sequence[Any]],
    health: Health,
    nis: dict[str, tuple[float, int]],
    truth: StreamTable | None,
) -> dict[str, Any]:
    """Return the summary of a run, as plain values.

    Args:
        rows: Rows of the table.
        health: Status at the end.
        nis: Stream -> sum of squared Mahalanobis distances [-] and sum of their dimensions.
        truth: True pose of the vehicle, if known.
    """
    modes = Counter(row[COLUMNS.index("state")] for row in rows)
    counts = health.counts
    return {
        "rows": len(rows),
        "states": {mode: modes[mode] / max(len(rows), 1) for mode in MODES},
        "ready": float(np.mean([row[COLUMNS.index("ready")] for row in rows])) if rows else 0.0,
        "accepted": {s: sum(v.get(word, 0) for word in USED) for s, v in counts.items() if s != "clock"},
        "reacquired": {s: v["reacquired"] for s, v in counts.items() if v.get("reacquired")},
        "refused": {
            s: {word: n for word, n in v.items() if word not in USED}
            for s, v in counts.items()
            if set(v) - set(USED)
        },
        "nis_per_dimension": {s: total / n for s, (total, n) in nis.items() if n},
        "health": health.as_json(),
        **({} if truth is None else {"errors": error_figures(rows, truth)}),
    }


def error_figures(rows: Sequence[Sequence[Any]], truth: StreamTable) -> dict[str, Any]:
    """Return the errors relative to the truth, by vision mode: root mean square and 95th percentile.

    Returns:
        Vision mode (and `all`) -> samples, rms_x, rms_y, rms_z, p95_horizontal [m], rms_yaw [rad], as far as
        the truth has them.
    """
    ours = np.array([[float(row[k]) for k in (0, 1, 2, 3, 9)] for row in rows])
    states = np.array([row[COLUMNS.index("state")] for row in rows])
    names = [name for name in ("x", "y", "z", "yaw") if truth.has(name)]
    if not names:
        return {}
    surveyed = series("truth", truth.t, truth.columns(*names), GAP, label=truth.name)
    if "yaw" in names:
        surveyed.values[:, -1] = np.unwrap(surveyed.values[:, -1])
    reference, covered = surveyed.between(ours[:, 0])
    errors = {}
    for name, true in zip(names, reference.T, strict=True):
        e = ours[:, 1 + ("x", "y", "z", "yaw").index(name)] - true
        errors[name] = np.where(covered, wrap_angle(e) if name == "yaw" else e, np.nan)
    figures = {}
    for state in ("all", *MODES[1:]):
        chosen = covered if state == "all" else covered & (states == state)
        if chosen.any():
            figures[state] = {"samples": int(chosen.sum()), **_figures(errors, chosen)}
    return figures


def _figures(errors: dict[str, Array], chosen: npt.NDArray[np.bool_]) -> dict[str, float]:
    figures = {}
    for name, e in errors.items():
        finite = e[chosen & np.isfinite(e)]
        if len(finite):
            figures[f"rms_{name}"] = float(np.sqrt(np.mean(finite**2)))
    if "x" in errors and "y" in errors:
        far = np.hypot(errors["x"], errors["y"])[chosen]
        far = far[np.isfinite(far)]
        if len(far):
            figures["p95_horizontal"] = float(np.percentile(far, 95))
    return figures


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return the lines of the printed summary."""
    shares = ", ".join(f"{mode} {share:.1%}" for mode, share in summary["states"].items() if share)
    lines = [f"{summary['rows']} rows: {shares}; ready {summary['ready']:.1%}"]
    for stream, accepted in summary["accepted"].items():
        refused = summary["refused"].get(stream, {})
        text = ", ".join(f"{word} {n}" for word, n in sorted(refused.items())) or "none"
        nis = summary["nis_per_dimension"].get(stream)
        lines.append(
            f"{stream:7s} accepted {accepted}, refused: {text}"
            + ("" if nis is None else f"; NIS per dimension {nis:.2f} (1 expected)")
        )
    if summary["refused"].get("clock"):
        lines.append(f"the clock restarted {summary['refused']['clock'].get('restart', 0)} times")
    health = summary["health"]
    ages = ", ".join(f"{s} {_age(health[f'age_{s}'])}" for s in ("vision", "depth", "imu"))
    lines.append(f"ages at the end: {ages}")
    for state, figures in summary.get("errors", {}).items():
        text = ", ".join(
            f"{name} {math.degrees(v):.2f}°" if "yaw" in name else f"{name} {100 * v:.2f} cm"
            for name, v in figures.items()
            if name != "samples"
        )
        lines.append(f"against the truth, {state} ({figures['samples']} rows): {text}")
    return lines


def _age(age: float | None) -> str:
    return "never" if age is None else f"{age:.2f} s"


Delivery: TypeAlias = "Sample | Frame | NoFix"

FASTEST = 1000.0
"""Highest rate of the output [Hz]."""
LONGEST = 4.0e6
"""Greatest number of rows that are written."""


@dataclass
class FuseResult:
    """Result of fusing a log."""

    rows: list[list[Any]] = field(default_factory=list)
    """Rows in the order of `COLUMNS`."""
    summary: dict[str, Any] = field(default_factory=dict)
    interrupted: bool = False


@dataclass(frozen=True, kw_only=True)
class FuseSettings:
    """Rate of the output rows, and methods of the estimation."""

    rate: float = 60.0
    """Rate of the output rows [Hz]."""
    estimator: str | None = None
    """(NAME) error-state, which uses the IMU's accelerations (default if the log contains them), or
    constant-velocity (paper, eq. 14-15)."""
    method: str = "refractive"
    """(METHOD) Localization method: refractive, refractive-weighted, refractive-6dof, pinhole-depth or
    pinhole."""
    pixel_std: float | None = None
    """Standard deviation of a detected corner, per axis [px]; by default that of the pool's calibration,
    otherwise 0.5."""


def run(
    log: str | Path,
    *,
    pool: str | Path,
    vehicle: str | Path,
    out: str | Path,
    settings: Annotated[FuseSettings, "options"] = FuseSettings(),
    as_json: bool = False,
) -> FuseResult:
    """Fuse vision, depth and IMU in the order of arrival: position [m], velocity [m/s], yaw [rad], status.

    Example: finssim fuse log --pool pool.yaml --vehicle finsrov --out fused.csv

    Args:
        log (LOG): Folder of imu.csv, depth.csv and vision.csv or detections.csv, or one table.
        pool (FILE): Pool file: camera, water plane and frames (.yaml).
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        out (FILE): Table to write (.csv).
        settings: Rate of the output rows, and methods of the estimation.
        as_json: Print one JSON object instead of tables.

    Raises:
        LocalizationError: The log, pool or a name cannot be used.
        OutputError: `out` cannot be written.
        KeyboardInterrupt: The run was interrupted; the rows computed until then have been written.
    """
    out = Path(out)
    refuse_unwritable(atomic_write(out))
    site, body = load_pool(pool), load_vehicle(str(vehicle))
    read = load_log(log, body, latency=site.latency)
    fused = fuse(read, site, body, settings)
    write_rows(fused.rows, out)
    if as_json:
        print(json.dumps({"out": str(out), "notes": read.notes, **fused.summary}, allow_nan=False))
    else:
        print(
            "\n".join(
                [*(f"note: {note}" for note in read.notes), *summary_lines(fused.summary), f"wrote {out}"]
            )
        )
    if fused.interrupted:
        raise KeyboardInterrupt
    return fused


def fuse(log: Log, pool: Pool, vehicle: Vehicle, settings: FuseSettings) -> FuseResult:
    """Fuse a log; arguments as in `run`. A row at time t depends only on samples that had arrived by t.

    Raises:
        LocalizationError: A name is unknown, the rate is out of range, or the error-state mode lacks accelerations.
    """
    rate, method = settings.rate, settings.method
    mode = settings.estimator or ("error-state" if _has_accelerations(log) else "constant-velocity")
    if not 0.0 < rate <= FASTEST:
        raise LocalizationError(f"rate is {rate:g} Hz, expected above 0 and up to {FASTEST:g}")
    check_method(method)
    estimator = Estimator(settings_of(vehicle), site_of(pool, vehicle), mode=mode)
    if mode == "error-state" and not _has_accelerations(log):
        raise LocalizationError(
            "estimator error-state needs accelerations with gravity (ax, ay, az beside p, q, r): use constant-velocity"
        )
    fixes = None
    if log.frames:  # default tags are for the virtual world
        pixel_std = pool.pixel_std if settings.pixel_std is None else settings.pixel_std
        fixes = Fixes(TagLocator(pool, vehicle.file_tags, method=method, pixel_std=pixel_std))
    deliveries = _deliveries(log)
    result = FuseResult()
    try:
        for t, arrived in _by_row(deliveries, rate):
            for item in arrived:
                _take(item, estimator, fixes)
            estimate = estimator.estimate(t)
            result.rows.append(row_of(estimate, estimator.health(estimate)))
    except KeyboardInterrupt:
        result.interrupted = True
    final = estimator.health(estimator.estimate(result.rows[-1][0] if result.rows else None))
    result.summary = summary_of(result.rows, final, estimator.nis, log.truth)
    return result


def _has_accelerations(log: Log) -> bool:
    """Return whether the IMU of a log measured specific force."""
    return any(getattr(sample, "force", None) for sample in log.samples)


def _take(item: Delivery, estimator: Estimator, fixes: Fixes | None) -> None:
    if isinstance(item, NoFix):
        estimator.refuse("vision", item.reason)
        return
    if isinstance(item, Frame):
        assert fixes is not None
        fix = fixes.fix(item, estimator)
        if isinstance(fix, str):
            estimator.refuse("vision", fix)
            return
        item = fix
    estimator.add(item)


def _deliveries(log: Log) -> list[tuple[float, Delivery]]:
    """Return samples and pictures in the order of their arrival; those without a time come first.

    Raises:
        LocalizationError: No sample has a time.
    """
    deliveries: list[tuple[float, Delivery]] = [
        (s.arrival if s.arrival is not None else s.time, s) for s in log.samples
    ]
    deliveries += [(frame.time, frame) for frame in log.frames]
    deliveries += [(item.time, item) for item in log.missed]
    times = [t for t, _ in deliveries if math.isfinite(t)]
    if not times:
        raise LocalizationError("the log holds no sample with a time: nothing to fuse")
    return sorted(
        ((t if math.isfinite(t) else min(times), s) for t, s in deliveries), key=lambda pair: pair[0]
    )


def _by_row(
    deliveries: Sequence[tuple[float, Delivery]], rate: float
) -> Iterator[tuple[float, list[Delivery]]]:
    """Return an iterator over the times of the rows, each with the data that arrived since the previous row.

    Raises:
        LocalizationError: The log would result in more than `LONGEST` rows.
    """
    first, last = deliveries[0][0], deliveries[-1][0]
    if (last - first) * rate > LONGEST:
        raise LocalizationError(
            f"the log spans {last - first:.3g} s, which is {(last - first) * rate:.2g} rows, expected at most "
            f"{LONGEST:.0e}: is a stamp wrong, or a stream on another clock?"
        )
    k = 0
    for t in first + np.arange(math.floor((last - first) * rate + 1e-9) + 1) / rate:
        arrived = []
        while k < len(deliveries) and deliveries[k][0] <= t + 1e-9:
            arrived.append(deliveries[k][1])
            k += 1
        yield float(t), arrived
