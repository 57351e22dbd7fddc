"""Station keeping in the virtual pool in the form of an evaluation: the robot's whole software on every setpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from finssim.control.controllers import CONTROLLERS
from finssim.control.policy import Policy
from finssim.experiments.evaluate import Evaluation
from finssim.experiments.metrics import summarize
from finssim.experiments.motion import Motion, on_grid
from finssim.experiments.setpoints import T1_SETPOINTS, in_room
from finssim.experiments.transfer.job import Job
from finssim.experiments.transfer.series import read_series
from finssim.experiments.trials import DURATION, Trials
from finssim.vehicles import load_vehicle

__all__ = ["pool_evaluation", "pool_jobs"]


def pool_jobs(controllers: Mapping[str, str], targets: Sequence[str], **settings: Any) -> list[Job]:
    """A trial of every controller on every setpoint.

    Args:
        controllers: Name of the row -> policy directory or name of a PID.
        targets: Setpoints of T1.
        settings: What all jobs have in common.
    """
    return [
        Job(row=name, controller=controller, target=target, **settings)
        for name, controller in controllers.items()
        for target in targets
    ]


def pool_evaluation(jobs: Sequence[Job], results: Sequence[Mapping[str, Any]], folder: Path) -> Evaluation:
    """The trials of one controller as an evaluation.

    Args:
        jobs: Of one row, on setpoints.
        results: Of `run_jobs`, in the same order.
        folder: Where `run_jobs` left the series.
    """
    first = jobs[0]
    vehicle = load_vehicle(first.vehicle)
    measures = [
        {
            "trial": i,
            "setpoint": job.target,
            **{key: value for key, value in result.items() if key not in ("job", "key", "provenance")},
        }
        for i, (job, result) in enumerate(zip(jobs, results, strict=True))
    ]
    result = {
        "controller": _described(first),
        "task": "t1",
        "vehicle": {"name": vehicle.name, "sha256": vehicle.sha256},
        "hydrodynamics": "calibrated",
        "plant": _plant(first, results[0]),
        "camera": first.camera,
        "seed": first.seed,
        **summarize(measures),
        "provenance": dict(results[0]["provenance"]),
    }
    return Evaluation(result, _trials(jobs, [folder / str(r["key"]) for r in results]))


def _plant(job: Job, result: Mapping[str, Any]) -> dict[str, str]:
    """Where it was, as evaluations describe it."""
    if result.get("robot"):
        return {"name": "hardware", "title": f"robot {result['robot']}, by its own estimate"}
    return {"name": "pool", "title": f"virtual pool {job.plant}, {job.severity}, around {job.pool_vehicle}"}


def _described(job: Job) -> dict[str, Any]:
    """The controller as evaluations describe it."""
    if job.controller in CONTROLLERS:
        return {"name": job.row, "kind": "pid", "action": "wrench6"}
    d = Policy.load(job.controller).description
    randomization = d.training.get("randomization")
    return {
        "name": job.row,
        "kind": "policy",
        "action": d.action["mode"],
        "hydrodynamics": d.hydrodynamics,
        "randomization": randomization["name"] if randomization else None,
        "files": dict(d.files),
    }


def _trials(jobs: Sequence[Job], paths: Sequence[Path]) -> Trials:
    """The true motion on one grid; NaN after a trial that ended early."""
    series = [read_series(path) for path in paths]
    motions = [Motion(t=s["t"], position=s["position"], yaw=s["yaw"]) for s in series]
    standing = load_vehicle(jobs[0].pool_vehicle)
    goals = np.array([in_room(T1_SETPOINTS[job.target], standing) for job in jobs])
    return Trials(tuple(job.target for job in jobs), goals, *on_grid(motions, DURATION))
