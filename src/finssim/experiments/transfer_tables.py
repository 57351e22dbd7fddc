"""`finssim experiment t1` and `t2`: rows, tables and figures of station keeping and of trajectory tracking."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.console import Console

from finssim.control.trajectories import TRAJECTORIES, load_trajectory
from finssim.experiments.evaluate import T1_COLUMNS, TrackingRun, cells, draw_tracking
from finssim.experiments.figures import (
    draw_envelopes,
    error_envelope,
    save_figure,
)
from finssim.experiments.paper import PAPER_T2, T1_SETPOINTS, paper_row, paper_t2_row
from finssim.experiments.pool_trial import read_series
from finssim.experiments.tables import Shown, figure_text, print_shown
from finssim.experiments.transfer import INTERVALS, Results, Row, Spec, Training, transfer_experiment
from finssim.experiments.trials import T2_TRAJECTORIES

__all__ = ["T1", "T2", "played_in", "print_transfer", "t1", "t2"]

DR = "hold_for_position"
"""The published ranges of station keeping."""
TRIM = "An integral in front of the policy"
POOL = "Randomisation made for a pool"

T1_TRAININGS = (
    Training("calibrated"),
    Training("calibrated-dr", randomize=DR),
    Training("calibrated-no-lag", randomize="no_thruster_dynamics"),
    Training("mesh", hydrodynamics="mesh"),
    Training("mesh-dr", hydrodynamics="mesh", randomize=DR),
    Training("simplified", hydrodynamics="simplified"),
    Training("simplified-dr", hydrodynamics="simplified", randomize=DR),
    Training("calibrated-intervals", randomize=INTERVALS),
    Training("calibrated-pool", randomize="pool"),
)
T1_ROWS: dict[str, Row] = {
    "calibrated": Row("Calibrated Fossen", "calibrated", "calibrated"),
    "calibrated-dr": Row("+ DR", "calibrated-dr", "calibrated + DR", "Domain randomisation"),
    "noise": Row(
        "+ localization noise",
        "calibrated",
        "calibrated, localisation noise",
        "Localization noise of 5 cm and 10°",
        changes={"position_noise": 0.05, "yaw_noise": math.radians(10.0)},
    ),
    "no-fusion": Row(
        "without EKF", "calibrated", "without EKF", "Leaving out the fusion", changes={"fusion": False}
    ),
    "no-lag": Row(
        "without thruster dynamics",
        "calibrated-no-lag",
        "without thruster dynamics",
        "Training without thruster dynamics",
    ),
    "mesh": Row("Physics-Mesh", "mesh", "mesh", "Training in the mesh model"),
    "mesh-dr": Row("Physics-Mesh + DR", "mesh-dr", "mesh + DR", "Training in the mesh model with DR"),
    "simplified": Row("Simplified Fossen", "simplified", "simplified", "Training in the simplified model"),
    "simplified-dr": Row(
        "Simplified Fossen + DR",
        "simplified-dr",
        "simplified + DR",
        "Training in the simplified model with DR",
    ),
    "pid-paper": Row("PID, published gains", None, "PID", "The published PID", "pid-paper"),
    "pid": Row("PID, tuned from the model", None, None, "The tuned PID", "pid"),
    "calibrated-intervals": Row(
        "Calibrated + ranges of its intervals",
        "calibrated-intervals",
        module="Randomisation within the calibration's intervals",
    ),
    "calibrated-trim": Row("Calibrated, with trim", "calibrated", module=TRIM, changes={"trim": True}),
    "calibrated-pool": Row("Calibrated + pool ranges", "calibrated-pool", module=POOL),
}
"""The paper's ten rows of station keeping in the order of its table, and ours beyond them."""
T1_NOTE = (
    ". paper: its vehicle in its pool, one seed. errors: 40-60 s; e_y is vertical; "
    "success: 0.10 m on each axis and 10° for 10 s. t_s (median) and jitter are of successful trials."
)
T1_DRAWN = ("calibrated", "mesh", "simplified", "pid-paper", "pid", "calibrated-pool")
"""The paper's four curves, and ours."""

T2_TRAININGS = (
    Training("calibrated-dr", "t2", randomize=DR),
    Training("calibrated", "t2"),
    Training("calibrated-pool", "t2", randomize="pool"),
)
T2_ROWS: dict[str, Row] = {
    "calibrated-dr": Row("Calibrated + DR", "calibrated-dr", "calibrated + DR"),
    "calibrated": Row("Calibrated", "calibrated", "calibrated", "Training without randomisation"),
    "pid": Row("PID, tuned from the model", None, None, "The tuned PID", "pid"),
    "pid-paper": Row("PID, published gains", None, "PID", "The published PID", "pid-paper"),
    "calibrated-dr-trim": Row(
        "Calibrated + DR, with trim", "calibrated-dr", module=TRIM, changes={"trim": True}
    ),
    "calibrated-pool": Row("Calibrated + pool ranges", "calibrated-pool", module=POOL),
}
"""The paper's three rows of tracking, and ours beyond them."""
T2_HEADS = {
    "horizontal_rmse_m": "horizontal RMSE [m]",
    "vertical_rmse_m": "vertical RMSE [m]",
    "p95_m": "3-D P95 [m]",
}
T2_NOTE = "; done: trials that reached the end. paper: its vehicle in its pool."
T2_DRAWN = 4
"""Rows that are drawn, at most: more cannot be told apart."""


def played_in(result: Mapping[str, Any], what: str) -> str:
    """In what an experiment was played, and with which vehicle."""
    plants, seeds = len(result["plants"]), len(result["seeds"])
    of = f"{what}: {len(result['targets'])}; {result['vehicle']['name']} {result['vehicle']['sha256'][:12]}"
    if result.get("robot"):
        return f"on hardware, robot {result['robot']}, by its own estimate; seeds: {seeds}, {of}"
    pool = f"severity {result['severity']}, camera {result['camera']}; plants: {plants}"
    return f"in the virtual pool, {pool}, seeds: {seeds}, {of}"


def _ours(result: Mapping[str, Any]) -> str:
    """What our rows are, as a note begins."""
    source, units = (
        ("hardware, by the robot's own estimate, whose error is not in it", "seeds")
        if result.get("robot")
        else ("a virtual pool whose vehicle, water and camera no training has seen", "plants and seeds")
    )
    return f"ours: {source}; mean, in brackets 95 % from a bootstrap of {units}"


def _title(row: Row, result: Mapping[str, Any]) -> str:
    """Of a row of ours; on hardware it says so."""
    return f"{row.title}, hardware" if result.get("robot") else row.title


def _t1_table(result: Mapping[str, Any]) -> Shown:
    rows = []
    for name, figures in result["rows"].items():
        row = T1_ROWS[name]
        texts = [figure_text(figures[key], form) for key, (_, form) in list(T1_COLUMNS.items())[1:]]
        rows.append([_title(row, result), f"{figures['success']}/{figures['trials']}", *texts])
        if row.paper is not None:
            rows.append([f"  paper: {row.paper}", *cells(paper_row(row.paper))])
    return Shown(
        title="Station keeping (T1)",
        headline=f"T1 {played_in(result, 'setpoints')}",
        heads=["", *(heading for heading, _ in T1_COLUMNS.values())],
        rows=rows,
        note=_ours(result) + T1_NOTE,
        sentences=result["sentences"],
    )


def _t2_table(result: Mapping[str, Any]) -> Shown:
    rows = []
    for name, figures in result["rows"].items():
        row = T2_ROWS[name]
        for target, one in figures["by_target"].items():
            texts = [figure_text(one[key], ".3f") for key in T2_HEADS]
            rows.append([_title(row, result), target, f"{one['success']}/{one['trials']}", *texts])
            paper = PAPER_T2.get(row.paper or "", {}).get(target)
            if paper is not None:
                rows.append([f"  paper: {row.paper}", target, "", *(f"{value:.3f}" for value in paper)])
    return Shown(
        title="Trajectory tracking (T2)",
        headline=f"T2 {played_in(result, 'trajectories')}",
        heads=["", "trajectory", "done", *T2_HEADS.values()],
        rows=rows,
        note=_ours(result) + T2_NOTE,
        sentences=result["sentences"],
    )


def _draw_t1(by_row: Results, folder: Path) -> Path | None:
    """Position and yaw error against time of the rows of `T1_DRAWN` that were played; None if none was."""
    envelopes = {}
    for name in T1_DRAWN:
        trials = []
        for result in by_row.get(name, []):
            series = read_series(folder / "trials" / result["key"])
            goal = T1_SETPOINTS[result["job"]["target"]] * np.array([*[result.get("room", 1.0)] * 3, 1.0])
            trials.append((series["t"], series["position"], series["yaw"], goal))
        if trials:
            envelopes[T1_ROWS[name].title] = error_envelope(trials)
    if not envelopes:
        return None
    severities = {result["job"]["severity"] for results in by_row.values() for result in results}
    place = "on hardware" if "hardware" in severities else "in the virtual pool"
    figure = draw_envelopes(envelopes, f"T1 {place}: median and middle half")
    return save_figure(figure, folder / "t1_envelopes.png")


def _draw_t2(by_row: Results, folder: Path) -> Path | None:
    """Of each row and trajectory the trial with the median error; None if nothing was flown."""
    runs: dict[str, list[TrackingRun]] = {}
    for name, results in by_row.items():
        flown = sorted((r for r in results if r["p95_m"] is not None), key=lambda r: float(r["p95_m"]))
        for target in dict.fromkeys(r["job"]["target"] for r in results):
            of_target = [r for r in flown if r["job"]["target"] == target]
            if of_target:
                middle = of_target[len(of_target) // 2]
                series = read_series(folder / "trials" / middle["key"])
                guide = load_trajectory(target).scaled(middle.get("room", 1.0))
                runs.setdefault(T2_ROWS[name].title, []).append((guide, series["t"], series["position"]))
    if not runs:
        return None
    return save_figure(draw_tracking(dict(list(runs.items())[:T2_DRAWN])), folder / "t2_paths.png")


def _paper_t1(row: str) -> dict[str, float]:
    theirs = paper_row(row)
    return {**theirs, "success_rate": theirs["success"] / theirs["trials"]}


def _paper_t2(row: str) -> dict[str, float]:
    each = [paper_t2_row(row, name) for name in T2_TRAJECTORIES]
    return {key: sum(theirs[key] for theirs in each) / len(each) for key in each[0]}


T1 = Spec(
    name="t1",
    rows=T1_ROWS,
    trainings={training.name: training for training in T1_TRAININGS},
    targets=tuple(T1_SETPOINTS),
    known_targets=tuple(T1_SETPOINTS),
    base="calibrated",
    figures={
        **dict.fromkeys(("success_rate", "e_p_m", "e_y_m", "e_psi_deg", "J_p_m", "J_psi_deg"), np.mean),
        "t_s_s": np.median,
    },
    differences=("success_rate", "e_p_m", "e_psi_deg"),
    paper=_paper_t1,
    shown=_t1_table,
    draw=_draw_t1,
)
"""`finssim experiment t1`."""
T2 = Spec(
    name="t2",
    rows=T2_ROWS,
    trainings={training.name: training for training in T2_TRAININGS},
    targets=T2_TRAJECTORIES,
    known_targets=tuple(TRAJECTORIES),
    base="calibrated-dr",
    figures=dict.fromkeys(("horizontal_rmse_m", "vertical_rmse_m", "p95_m", "cross_track_rmse_m"), np.mean),
    differences=("horizontal_rmse_m", "vertical_rmse_m", "p95_m"),
    paper=_paper_t2,
    shown=_t2_table,
    draw=_draw_t2,
)
"""`finssim experiment t2`."""


def t1(*, setpoints: Annotated[Sequence[str] | None, ","] = None, **options: Any) -> dict[str, Any]:
    """Station keeping in the virtual pool (the paper's Table IV): success, errors [m, deg], time to settle [s], jitter.

    With --robot the published protocol on a vehicle, guided on the screen, marked as hardware.

    Example: finssim experiment t1 --rows calibrated,pid --seeds 1 --out t1

    Example: finssim experiment t1 --rows pid --seeds 1 --robot serial:/dev/ttyUSB0 --pool-file p.yaml --arm --out hw

    Args:
        setpoints (NAMES): Setpoints, separated by commas; all published ones if not given.
        options: As of `experiments.transfer.transfer_experiment`.
    """
    return transfer_experiment(T1, targets=setpoints, **options)


def t2(*, trajectories: Annotated[Sequence[str] | None, ","] = None, **options: Any) -> dict[str, Any]:
    """Trajectory tracking in the virtual pool (the paper's Table V): horizontal and vertical RMSE, 3-D P95 [m].

    With --robot the published protocol on a vehicle, guided on the screen, marked as hardware.

    Example: finssim experiment t2 --rows calibrated-dr,pid --trajectories lemniscate --seeds 1 --out t2

    Args:
        trajectories (NAMES): Trajectories, separated by commas; all published ones if not given.
        options: As of `experiments.transfer.transfer_experiment`.
    """
    return transfer_experiment(T2, targets=trajectories, **options)


def print_transfer(result: Mapping[str, Any], console: Console) -> None:
    """Print the table of either."""
    print_shown({"t1": T1, "t2": T2}[result["experiment"]].shown(result), console)
