"""What `finssim calibrate mounts` runs: read a log, find the mounts, write the vehicle, report."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from finssim.calibration.output.calibrate import calibrated, doubts, kept
from finssim.calibration.output.fit_output import fit_json, print_fit
from finssim.calibration.output.report import FIT_FILE, write_report
from finssim.calibration.output.vehicle_file import check_vehicle_path, write_vehicle
from finssim.calibration.vision.mounts.mount_log import read_mount_log
from finssim.calibration.vision.mounts.mounts import calibrate_mounts
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.localization.pool import load_pool
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["run"]


def run(
    log: Path,
    *,
    pool: Path,
    vehicle: str,
    out: Path,
    estimate: str = "tags",
    turns_about: Sequence[float] | None = None,
    report: Path | None = None,
    seed: int = 0,
    as_json: bool = False,
) -> Vehicle:
    """Find mounts in a recording and write the vehicle.

    Args:
        log: Folder with detections.csv, imu.csv, depth.csv.
        pool: Pool file.
        vehicle: Name or file.
        out: Vehicle file to write, .yaml.
        estimate: `tags` (sensors are right in the file) or `sensors` (the tag seen most is).
        turns_about: Body point that stays in place while the vehicle turns on the spot [m], (3,).
        report: Directory of the report, or None.
        seed: Recorded.
        as_json: Print one JSON object in place of the table.

    Returns:
        The vehicle written.

    Raises:
        CalibrationError, LocalizationError, VehicleError, OutputError: As they say; nothing is written then.
    """
    refuse_unwritable(atomic_write(check_vehicle_path(out)))
    if report is not None:
        refuse_unwritable(atomic_directory(report, replaces=FIT_FILE))
    where, body = load_pool(pool), load_vehicle(vehicle)
    recording = read_mount_log(log, where, body)
    fit = calibrate_mounts(
        recording, where, body, name=Path(log).name, estimate=estimate, centre=turns_about, seed=seed
    )
    after = calibrated(fit)
    warnings = doubts(fit, after)
    write_vehicle(after, out)
    if report is not None:
        words = [
            "finssim",
            "calibrate",
            "mounts",
            str(log),
            "--pool",
            str(pool),
            "--vehicle",
            vehicle,
            "--out",
            str(out),
        ]
        words += ["--estimate", estimate, "--seed", str(seed)]
        words += [] if turns_about is None else ["--turns-about", ",".join(f"{x:g}" for x in turns_about)]
        write_report(fit, report, after, command=shlex.join(words), warnings=warnings, out=out)
    if as_json:
        print(json.dumps(fit_json(fit, after, out=out, warnings=warnings), allow_nan=False))
        return after
    console = Console() if sys.stdout.isatty() else Console(width=100)
    print_fit(fit, after, console, warnings)
    left = kept(fit, after)
    if left:
        console.print(f"kept from the file: {', '.join(left)}", highlight=False, markup=False)
    for place in filter(None, (out, report)):
        console.print(f"written: {place}", highlight=False, markup=False, soft_wrap=True)
    return after
