"""Ranges that a calibration's own intervals give, for the row that is trained in them."""

from __future__ import annotations

from pathlib import Path

from finssim.calibration.output.calibrated_ranges import write_ranges
from finssim.experiments.identify import identify
from finssim.files import atomic_directory

__all__ = ["INTERVALS", "interval_ranges"]

INTERVALS = "intervals"
"""Stands for the ranges that the calibration's intervals give."""

RANGES_FILE = "ranges.yaml"


def interval_ranges(folder: Path, vehicle: str, seed: int) -> Path:
    """The ranges file in a folder; where there is none yet, the vehicle is identified from trials first.

    Args:
        folder: Takes the trials, the fit and the ranges.
        vehicle: Name or file.
        seed: Of the trials.
    """
    if not (folder / RANGES_FILE).is_file():
        with atomic_directory(folder, replaces=RANGES_FILE) as place:
            found = identify(place, vehicle, seed=seed, shown=folder)
            write_ranges(found.fit, place / RANGES_FILE, found.vehicle)
    return folder / RANGES_FILE
