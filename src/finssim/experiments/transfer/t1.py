"""The rows of the station-keeping table: the paper's ten, and ours beyond them."""

from __future__ import annotations

import math
from types import MappingProxyType

from finssim.experiments.paper_results import paper_row
from finssim.experiments.setpoints import T1_SETPOINTS
from finssim.experiments.transfer.intervals import mean_of, median_of
from finssim.experiments.transfer.policies import Training
from finssim.experiments.transfer.ranges import INTERVALS
from finssim.experiments.transfer.spec import Row, Spec
from finssim.experiments.transfer.t1_figure import draw_t1
from finssim.experiments.transfer.t1_table import t1_table

__all__ = ["ROWS", "T1"]

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
            Training(name="calibrated-intervals", randomize=INTERVALS),
            Training(name="calibrated-pool", randomize="pool"),
        )
    }
)
"""Every policy of the experiment by name."""


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
    "mesh": Row(title="Physics-Mesh", training="mesh", paper="mesh", module="Training in the mesh model"),
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
    "calibrated-intervals": Row(
        title="Calibrated + ranges of its intervals",
        training="calibrated-intervals",
        module="Randomisation within the calibration's intervals",
    ),
    "calibrated-trim": Row(
        title="Calibrated, with trim",
        training="calibrated",
        changes={"trim": True},
        module="An integral in front of the policy",
    ),
    "calibrated-pool": Row(
        title="Calibrated + pool ranges", training="calibrated-pool", module="Randomisation made for a pool"
    ),
}
"""The table in its order; the last four are ours."""

TITLES = {name: row.title for name, row in ROWS.items()}


def _paper_differences(row: str | None, base: str | None) -> dict[str, float] | None:
    if row is None or base is None:
        return None
    theirs, reference = paper_row(row), paper_row(base)
    rates = theirs["success"] / theirs["trials"] - reference["success"] / reference["trials"]
    errors = {key: theirs[key] - reference[key] for key in ("e_p_m", "e_psi_deg")}
    return {"success_rate": rates, **errors}


T1 = Spec(
    name="t1",
    rows=ROWS,
    trainings=TRAININGS,
    targets=tuple(T1_SETPOINTS),
    known_targets=tuple(T1_SETPOINTS),
    base="calibrated",
    figures={
        "success_rate": mean_of,
        "e_p_m": mean_of,
        "e_y_m": mean_of,
        "e_psi_deg": mean_of,
        "t_s_s": median_of,
        "J_p_m": mean_of,
        "J_psi_deg": mean_of,
    },
    differences=("success_rate", "e_p_m", "e_psi_deg"),
    paper_differences=_paper_differences,
    shown=lambda result: t1_table(result, ROWS),
    draw=lambda by_row, folder: draw_t1(by_row, TITLES, folder),
)
"""`finssim experiment t1`."""
