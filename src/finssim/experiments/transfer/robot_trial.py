"""Plays jobs on a robot: the trial of the virtual pool, from the same start, scored by the robot's own estimate."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from finssim.experiments.motion import Motion, measure
from finssim.experiments.on_robot.play import Attendant
from finssim.experiments.on_robot.session import OnRobot, RobotError, Session, check_starts, session
from finssim.experiments.recorded import RecordedError, read_record
from finssim.experiments.transfer.campaign import run_in_turn
from finssim.experiments.transfer.job import Job
from finssim.experiments.transfer.pool_trial import job_trial
from finssim.experiments.transfer.series import write_series
from finssim.provenance import provenance
from finssim.robot.goals import check_reachable
from finssim.robot.perception import Perception
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import room

__all__ = ["HARDWARE", "run_on_robot"]

HARDWARE = "hardware"
"""In place of the severity of a pool, and of what its camera sends."""


def run_on_robot(
    jobs: Sequence[Job],
    folder: Path,
    robot: OnRobot,
    *,
    attendant: Attendant | None = None,
    console: Console | None = None,
) -> list[dict[str, Any]]:
    """Play on a robot what has no result yet; those that are skipped are left out.

    A trial that the bridge stopped counts. With nobody beside the water nothing is played after it.

    Args:
        jobs: Of one vehicle; plant 0, severity and camera `HARDWARE`.
        folder: Takes KEY.json, KEY.npz and KEY.mcap of each, made if missing.
        robot: Which, and how; not opened where nothing is left to play.
        attendant: Instead of the terminal's keyboard.
        console: Where it is told how it stands; standard error if None.

    Raises:
        RobotError: A trial was stopped, and nobody is there to look at the vehicle; the next call goes on. Or every
            trial was skipped.
        GoalError: A start or a goal lies outside the workspace.
        PolicyError, ControlError: A controller does not fit the vehicle.
        KeyboardInterrupt: Ctrl-C, or the operator ended the session.
    """
    vehicle, console = load_vehicle(jobs[0].vehicle), console or Console(stderr=True)
    trials = {job.target: job_trial(job, vehicle) for job in jobs}
    check_starts({target: start for target, (_, start) in trials.items()}, vehicle)
    for trial, _ in trials.values():
        check_reachable(trial.guide, vehicle)

    def show(job: Job, result: Mapping[str, Any]) -> None:
        held = "done" if result["success"] else result["fault"] or "not held"
        console.print(f"  {held}", highlight=False, markup=False)
        if result["fault"] and robot.unattended:
            raise RobotError(
                f"{job.row}, {job.target}: stopped, which counts: {result['fault']}: look at the vehicle, then give "
                "the command again, which goes on with the next trial"
            )

    with ExitStack() as stack:
        opened: list[Session] = []

        def play(job: Job, path: Path) -> dict[str, Any] | None:
            if not opened:
                opened.append(
                    stack.enter_context(session(robot, vehicle, attendant=attendant, console=console))
                )
            return _play(job, path, opened[0])

        results = run_in_turn(jobs, folder, play, show=show)
    if not results:
        raise RobotError("every trial was skipped: there is nothing to report")
    return results


def _play(job: Job, path: Path, opened: Session) -> dict[str, Any] | None:
    """One job; PATH.mcap takes the record, PATH.npz the series of the estimate. None if it was skipped."""
    began, vehicle, record = time.perf_counter(), opened.vehicle, path.with_name(f"{path.name}.mcap")
    trial, start = job_trial(job, vehicle, seed=job.seed)
    outcome = opened.trial(
        lambda: job_trial(job, vehicle, seed=job.seed)[0],
        start,
        record,
        counts=True,
        perception=lambda: Perception(vehicle, opened.site, fusion=job.fusion),
        about={"command": f"finssim experiment {job.task}", "row": job.row},
    )
    if outcome is None:
        return None
    try:
        motion = read_record(record, job.task, vehicle, guide=trial.guide, duration=trial.duration).estimate
    except RecordedError:  # stopped before its first decision
        nowhere = np.full((2, 3), np.nan)
        motion = Motion(t=np.array([0.0, 0.1]), position=nowhere, yaw=nowhere[:, 0])
    write_series(path, {"t": motion.t, "position": motion.position, "yaw": motion.yaw})
    return {
        **measure(job.task, trial.guide, motion, vehicle.force_limits, stopped=bool(outcome.fault)),
        "fault": outcome.fault,
        "room": room(vehicle.body.size),
        "localization": None,
        "robot": opened.robot.title,
        "record": record.name,
        "missed_decisions": outcome.runtime.counters.missed,
        "seconds": time.perf_counter() - began,
        "provenance": provenance(),
    }
