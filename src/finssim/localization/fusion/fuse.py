"""What `finssim fuse` runs: a log through the estimator, as it would have gone live."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from finssim.files import atomic_write, refuse_unwritable
from finssim.localization.detection.detections import Frame
from finssim.localization.errors import LocalizationError
from finssim.localization.fusion.estimator import Estimator
from finssim.localization.fusion.fuse_detections import NO_TAGS, Fixes, check_method
from finssim.localization.fusion.fuse_log import Log, NoFix, load_log
from finssim.localization.fusion.fuse_output import row_of, summary_lines, summary_of, write_rows
from finssim.localization.fusion.fuse_settings import settings_of, site_of
from finssim.localization.fusion.streams import Sample
from finssim.localization.pool import Pool, load_pool
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["Run", "fuse", "run"]

Delivery: TypeAlias = "Sample | Frame | NoFix"

FASTEST = 1000.0
"""Highest rate of the output [Hz]."""
LONGEST = 4.0e6
"""Most rows that are written."""


@dataclass
class Run:
    """What a log gave."""

    rows: list[list[Any]] = field(default_factory=list)
    """In the order of `fuse_output.COLUMNS`."""
    summary: dict[str, Any] = field(default_factory=dict)
    interrupted: bool = False


def run(
    log: str | Path,
    *,
    pool: str | Path,
    vehicle: str | Path,
    out: str | Path,
    rate: float = 60.0,
    mode: str = "constant-velocity",
    profile: str = "default",
    method: str = "refractive",
    pixel_std: float | None = None,
    imu_axes: str | None = None,
    as_json: bool = False,
) -> Run:
    """Fuse a log, write the table and print the summary.

    Args:
        log: Folder of tables or one table, see `load_log`.
        pool: Pool file.
        vehicle: Name or file.
        out: Table to write (.csv).
        rate: Of its rows [Hz].
        mode: `constant-velocity` or `error-state`.
        profile: `default` or `published` settings.
        method: How fixes are made of detections.
        pixel_std: Standard deviation of a detected corner [px]; None: what the pool file says.
        imu_axes: `body`, `sensor`, or None for what the columns' names say.
        as_json: Print one JSON object in place of the summary.

    Raises:
        LocalizationError: The log, pool or a word cannot be used.
        OutputError: `out` cannot be written.
        KeyboardInterrupt: After what was done until then has been written.
    """
    out = Path(out)
    refuse_unwritable(atomic_write(out))
    site, body = load_pool(pool), load_vehicle(str(vehicle))
    read = load_log(log, body, latency=site.latency, imu_axes=imu_axes)
    pixel_std = site.pixel_std if pixel_std is None else pixel_std
    found = fuse(read, site, body, rate=rate, mode=mode, profile=profile, method=method, pixel_std=pixel_std)
    write_rows(found.rows, out)
    if as_json:
        print(json.dumps({"out": str(out), "notes": read.notes, **found.summary}, allow_nan=False))
    else:
        print(
            "\n".join(
                [*(f"note: {note}" for note in read.notes), *summary_lines(found.summary), f"wrote {out}"]
            )
        )
    if found.interrupted:
        raise KeyboardInterrupt
    return found


def fuse(
    log: Log,
    pool: Pool,
    vehicle: Vehicle,
    *,
    rate: float = 60.0,
    mode: str = "constant-velocity",
    profile: str = "default",
    method: str = "refractive",
    pixel_std: float = 0.5,
) -> Run:
    """Fuse a log; arguments as `run`. A row at time t rests on what had arrived by t.

    Raises:
        LocalizationError: A word is unknown, the rate is out of range, or the error-state mode finds no acceleration.
    """
    if not 0.0 < rate <= FASTEST:
        raise LocalizationError(f"rate is {rate:g} Hz, expected above 0 and up to {FASTEST:g}")
    check_method(method)
    estimator = Estimator(settings_of(vehicle, profile), site_of(pool, vehicle), mode=mode)
    if mode == "error-state" and not any(getattr(s, "force", None) for s in log.samples):
        raise LocalizationError(
            "mode error-state needs accelerations with gravity (ax, ay, az beside p, q, r): use constant-velocity"
        )
    if log.frames and vehicle.file_tags is None:  # defaults are for the virtual world
        raise LocalizationError(NO_TAGS)
    fixes = Fixes(pool, vehicle, method=method, pixel_std=pixel_std) if log.frames else None
    deliveries = _deliveries(log)
    found = Run()
    try:
        for t, arrived in _by_row(deliveries, rate):
            for item in arrived:
                _take(item, estimator, fixes)
            estimate = estimator.estimate(t)
            found.rows.append(row_of(estimate, estimator.health(estimate)))
    except KeyboardInterrupt:
        found.interrupted = True
    final = estimator.health(estimator.estimate(found.rows[-1][0] if found.rows else None))
    found.summary = summary_of(found.rows, final, estimator.nis, log.truth)
    return found


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
    """Samples and pictures in the order of their arrival; those without a time stay with their neighbour.

    Raises:
        LocalizationError: There is none with a time, or they span too long.
    """
    found: list[tuple[float, Delivery]] = [
        (s.arrival if s.arrival is not None else s.time, s) for s in log.samples
    ]
    found += [(frame.time, frame) for frame in log.frames]
    found += [(item.time, item) for item in log.missed]
    times = [t for t, _ in found if math.isfinite(t)]
    if not times:
        raise LocalizationError("the log holds no sample with a time: nothing to fuse")
    return sorted(((t if math.isfinite(t) else min(times), s) for t, s in found), key=lambda pair: pair[0])


def _by_row(
    deliveries: Sequence[tuple[float, Delivery]], rate: float
) -> Iterator[tuple[float, list[Delivery]]]:
    """Times of the rows, and what arrives between the one before and each.

    Raises:
        LocalizationError: The log would give more than `LONGEST` rows.
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
