"""The rows of the trajectory-tracking table: the paper's three, and ours beyond them."""

from __future__ import annotations

from types import MappingProxyType

from finssim.control.trajectories import TRAJECTORIES
from finssim.experiments.paper_results import paper_t2_row
from finssim.experiments.transfer.intervals import mean_of
from finssim.experiments.transfer.policies import Training
from finssim.experiments.transfer.spec import Row, Spec
from finssim.experiments.transfer.t2_figure import draw_t2
from finssim.experiments.transfer.t2_table import t2_table

__all__ = ["ROWS", "T2"]

PUBLISHED = ("straight", "broken", "ellipse", "lemniscate")
"""The trajectories of the paper's table."""

TRAININGS = MappingProxyType(
    {
        t.name: t
        for t in (
            Training(name="calibrated-dr", task="t2", randomize="hold_for_position"),
            Training(name="calibrated", task="t2"),
            Training(name="calibrated-pool", task="t2", randomize="pool"),
        )
    }
)

ROWS: dict[str, Row] = {
    "calibrated-dr": Row(title="Calibrated + DR", training="calibrated-dr", paper="calibrated + DR"),
    "calibrated": Row(
        title="Calibrated", training="calibrated", paper="calibrated", module="Training without randomisation"
    ),
    "pid": Row(title="PID, tuned from the model", controller="pid", module="The tuned PID"),
    "pid-paper": Row(
        title="PID, published gains", controller="pid-paper", paper="PID", module="The published PID"
    ),
    "calibrated-dr-trim": Row(
        title="Calibrated + DR, with trim",
        training="calibrated-dr",
        changes={"trim": True},
        module="An integral in front of the policy",
    ),
    "calibrated-pool": Row(
        title="Calibrated + pool ranges", training="calibrated-pool", module="Randomisation made for a pool"
    ),
}
"""The table in its order."""

TITLES = {name: row.title for name, row in ROWS.items()}


def _paper_differences(row: str | None, base: str | None) -> dict[str, float] | None:
    if row is None or base is None:
        return None
    pairs = [(paper_t2_row(row, name), paper_t2_row(base, name)) for name in PUBLISHED]
    return {
        key: sum(theirs[key] - reference[key] for theirs, reference in pairs) / len(pairs)
        for key in pairs[0][0]
    }


T2 = Spec(
    name="t2",
    rows=ROWS,
    trainings=TRAININGS,
    targets=PUBLISHED,
    known_targets=tuple(TRAJECTORIES),
    base="calibrated-dr",
    figures=dict.fromkeys(("horizontal_rmse_m", "vertical_rmse_m", "p95_m", "cross_track_rmse_m"), mean_of),
    differences=("horizontal_rmse_m", "vertical_rmse_m", "p95_m"),
    paper_differences=_paper_differences,
    shown=lambda result: t2_table(result, ROWS),
    draw=lambda by_row, folder: draw_t2(by_row, TITLES, folder),
)
"""`finssim experiment t2`."""
