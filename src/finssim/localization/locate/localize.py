"""What `finssim localize` runs: pictures in, one measured pose or one reason for each out."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from finssim.files import atomic_write, refuse_unwritable
from finssim.localization.detection.detections import Frame
from finssim.localization.errors import LocalizationError
from finssim.localization.locate.localize_inputs import Seeing, frames_of
from finssim.localization.locate.localize_known import known_of
from finssim.localization.locate.localize_output import Row, summary_lines, summary_of, write_rows
from finssim.localization.locate.localize_truth import load_truth
from finssim.localization.locate.locator import Locator
from finssim.localization.pool import Pool, load_pool
from finssim.localization.poses.methods import NEEDS_DEPTH
from finssim.provenance import provenance
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["Run", "run"]


@dataclass
class Run:
    """What the pictures gave."""

    rows: list[Row] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    interrupted: bool = False


def run(
    inputs: Sequence[str | Path] | str | Path,
    *,
    pool: str | Path,
    vehicle: str | Path,
    out: str | Path,
    depth: str | float | Path | None = None,
    imu: str | Path | None = None,
    method: str = "refractive",
    as_json: bool = False,
    family: str | None = None,
    library: str | None = None,
    refine: str = "fit",
    gamma: float = 1.0,
    times: str | Path | None = None,
    pixel_std: float | None = None,
    shared_pixel_std: float = 0.0,
    depth_std: float | None = None,
    tilt_std_deg: float | None = None,
    longest_gap: float = 1.0,
    truth: str | Path | None = None,
) -> Run:
    """Measure where the vehicle was in each picture, write the table and print the summary.

    Args:
        inputs: Pictures, folders of them, videos or detection files (.csv).
        pool: Pool file.
        vehicle: Name or file, with a section `tags`.
        out: Table to write (.csv); columns in `localize_output.COLUMNS`.
        depth: File with columns t, depth, or the depth of the pressure port [m], positive down.
        imu: File with columns t and roll, pitch [rad] or qx, qy, qz, qw; level without it.
        method: A name of `METHODS`.
        as_json: Print one JSON object in place of the summary.
        family: Of the tags; None: that of the vehicle file.
        library: `apriltag` or `opencv`, for pictures.
        refine: How corners are placed, see `detector`.
        gamma: Encoding of the pictures, see `detector`.
        times: File with columns image, time [s], for pictures whose names hold no time.
        pixel_std: Standard deviation of a corner, per axis [px]; None: what the pool file says.
        shared_pixel_std: Error that all corners of a picture share, per axis [px].
        depth_std: Of the depth [m]; None: that of the vehicle file.
        tilt_std_deg: Of roll and pitch [degrees]; None: 0.5 with an IMU, 2 without.
        longest_gap: Depth and tilt are not interpolated between samples further apart [s].
        truth: File with columns image or t, x, y and perhaps yaw, to compare with.

    Raises:
        LocalizationError: An input cannot be used, or the method needs a depth that is not given.
        OutputError: `out` cannot be written.
        KeyboardInterrupt: After what was done until then has been written.
    """
    out, paths = Path(out), [Path(p) for p in ([inputs] if isinstance(inputs, (str, Path)) else inputs)]
    refuse_unwritable(atomic_write(out))
    if not longest_gap >= 0.0:
        raise LocalizationError(
            f"longest_gap is {longest_gap}, expected a time in seconds that is not negative"
        )
    site, body = load_pool(pool), load_vehicle(str(vehicle))
    known = known_of(
        site,
        body,
        depth=depth,
        imu=imu,
        depth_std=depth_std,
        tilt_std=None if tilt_std_deg is None else math.radians(tilt_std_deg),
        shared_pixel_std=shared_pixel_std,
        longest_gap=longest_gap,
    )
    pixel_std = site.pixel_std if pixel_std is None else pixel_std
    locator = Locator(site, body, known, method=method, pixel_std=pixel_std, family=family)
    surveyed = None if truth is None else load_truth(truth, longest_gap)
    seeing = Seeing(
        locator.family, locator.tags, library, refine, gamma, None if times is None else Path(times)
    )
    notes: list[str] = []
    frames, count = frames_of(paths, site.camera.lens, seeing, notes)
    found = _measure(frames, count, locator)
    write_rows(found.rows, out)
    found.summary = {
        "method": method,
        **summary_of(found.rows),
        **({} if surveyed is None else {"truth": surveyed.figures(found.rows, site.latency)}),
        "assumed": list(known.assumed) if method in NEEDS_DEPTH else [],
        "notes": notes,
        "out": str(out),
        "interrupted": found.interrupted,
    }
    if as_json:
        sources = {"depth": None if depth is None else str(depth), "imu": None if imu is None else str(imu)}
        settings = {**sources, "pixel_std": pixel_std, **known.settings}
        print(json.dumps(_document(found.summary, site, str(pool), body, settings), allow_nan=False))
    else:
        _print(found.summary)
    if found.interrupted:
        raise KeyboardInterrupt
    return found


def _measure(frames: Iterator[Frame], count: int | None, locator: Locator) -> Run:
    """Measure one frame after the other, until the end or Ctrl-C."""
    found = Run()
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
                found.rows.append((frame, measured))
                located += measured.ok
                bars.update(bar, advance=1, description=f"{located} located")
    except KeyboardInterrupt:
        found.interrupted = True
    return found


def _document(
    summary: dict[str, Any], pool: Pool, file: str, vehicle: Vehicle, settings: dict[str, Any]
) -> dict[str, Any]:
    """The summary with what it rests on."""
    return {
        **summary,
        "pool": {"file": file, "sha256": pool.sha256},
        "vehicle": {"name": vehicle.name, "sha256": vehicle.sha256},
        "settings": settings,
        "provenance": provenance(),
    }


def _print(summary: dict[str, Any]) -> None:
    console = Console() if sys.stdout.isatty() else Console(width=120)
    lines = [f"note: {note}" for note in summary["notes"]]
    lines += [f"assumed: {sentence}" for sentence in summary["assumed"]]
    lines += [*summary_lines(summary), f"written: {summary['out']}"]
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
