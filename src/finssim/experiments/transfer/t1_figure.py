"""Position and yaw error against time: the paper's envelope figure, over plants and seeds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from finssim.experiments.envelope import error_envelope, save_envelopes
from finssim.experiments.setpoints import T1_SETPOINTS
from finssim.experiments.transfer.series import read_series

__all__ = ["FIGURE_FILE", "draw_t1"]

FIGURE_FILE = "t1_envelopes.png"

SHOWN = ("calibrated", "mesh", "simplified", "pid-paper", "pid", "calibrated-pool")
"""The paper's four curves, and ours."""


def draw_t1(
    by_row: Mapping[str, list[dict[str, Any]]], titles: Mapping[str, str], folder: Path
) -> Path | None:
    """Draw the rows of `SHOWN` that were played into `folder`; None if none was."""
    envelopes = {}
    for name in SHOWN:
        trials = []
        for result in by_row.get(name, []):
            series = read_series(folder / "trials" / result["key"])
            goal = T1_SETPOINTS[result["job"]["target"]] * np.array([*[result.get("room", 1.0)] * 3, 1.0])
            trials.append((series["t"], series["position"], series["yaw"], goal))
        if trials:
            envelopes[titles[name]] = error_envelope(trials)
    if not envelopes:
        return None
    severities = {result["job"]["severity"] for results in by_row.values() for result in results}
    place = "on hardware" if "hardware" in severities else "in the virtual pool"
    return save_envelopes(envelopes, folder / FIGURE_FILE, f"T1 {place}: median and middle half")
