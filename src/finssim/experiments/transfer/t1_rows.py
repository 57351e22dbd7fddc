"""The rows of the station-keeping table: the paper's ten, and ours beyond them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from finssim.experiments.transfer.policies import Training

__all__ = ["BASE", "ROWS", "TRAININGS", "Row"]

POSITION_NOISE, YAW_NOISE = 0.05, math.radians(10.0)
"""Of the paper's row with localization noise: per axis [m], and in heading [rad]."""

DR = "hold_for_position"
"""The published ranges of this task."""

TRAININGS = MappingProxyType(
    {
        t.name: t
        for t in (
            Training(name="calibrated"),
            Training(name="calibrated-dr", randomize=DR),
            Training(name="calibrated-no-lag", randomize="no_thruster_dynamics"),
            Training(name="mesh", hydrodynamics="mesh"),
            Training(name="mesh-dr", hydrodynamics="mesh", randomize=DR),
            Training(name="simplified", hydrodynamics="simplified"),
            Training(name="simplified-dr", hydrodynamics="simplified", randomize=DR),
            Training(name="calibrated-pool", randomize="pool"),
        )
    }
)
"""Every policy of the experiment by name."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row: who steers and what is taken from it."""

    title: str
    training: str | None = None
    """Key of `TRAININGS`; None for a PID."""
    controller: str = ""
    """Name of the PID."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Fields of its jobs."""
    paper: str | None = None
    """Row of the paper's table; None where it has none."""
    module: str = ""
    """What the row takes away or puts in place of the reference, as a sentence begins."""


ROWS: dict[str, Row] = {
    "calibrated": Row(title="Calibrated Fossen", training="calibrated", paper="calibrated"),
    "calibrated-dr": Row(
        title="+ DR", training="calibrated-dr", paper="calibrated + DR", module="Domain randomisation"
    ),
    "noise": Row(
        title="+ localization noise",
        training="calibrated",
        changes={"position_noise": POSITION_NOISE, "yaw_noise": YAW_NOISE},
        paper="calibrated, localisation noise",
        module="Localization noise of 5 cm and 10°",
    ),
    "no-fusion": Row(
        title="without EKF",
        training="calibrated",
        changes={"fusion": False},
        paper="without EKF",
        module="Leaving out the fusion",
    ),
    "no-lag": Row(
        title="without thruster dynamics",
        training="calibrated-no-lag",
        paper="without thruster dynamics",
        module="Training without thruster dynamics",
    ),
    "mesh": Row(
        title="Physics-Mesh", training="mesh", paper="mesh", module="Training in the mesh model"
    ),
    "mesh-dr": Row(
        title="Physics-Mesh + DR",
        training="mesh-dr",
        paper="mesh + DR",
        module="Training in the mesh model with DR",
    ),
    "simplified": Row(
        title="Simplified Fossen",
        training="simplified",
        paper="simplified",
        module="Training in the simplified model",
    ),
    "simplified-dr": Row(
        title="Simplified Fossen + DR",
        training="simplified-dr",
        paper="simplified + DR",
        module="Training in the simplified model with DR",
    ),
    "pid-paper": Row(
        title="PID, published gains", controller="pid-paper", paper="PID", module="The published PID"
    ),
    "pid": Row(title="PID, tuned from the model", controller="pid", module="The tuned PID"),
    "calibrated-pool": Row(
        title="Calibrated + pool ranges", training="calibrated-pool", module="Randomisation made for a pool"
    ),
}
"""The table in its order; the last two are ours."""

BASE = "calibrated"
"""The row that the others are compared with."""
