"""Plays one job: the robot's whole software in lock-step with a virtual pool, scored from the truth afterwards."""

from __future__ import annotations

import math
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.guidance import Guide, Station
from finssim.control.trajectories import load_trajectory
from finssim.control.trim import Trim
from finssim.experiments.motion import PERIOD, Motion, localization_errors, measure
from finssim.experiments.on_robot.play import RobotTrial
from finssim.experiments.on_robot.play import play as play_trial
from finssim.experiments.setpoints import T1_SETPOINTS, T1_START, in_room
from finssim.experiments.transfer.job import Job
from finssim.experiments.transfer.series import write_series
from finssim.geometry.rotations import quat_from_yaw, quat_yaw
from finssim.pool.camera import PoolCamera
from finssim.pool.draw_plant import draw_plant
from finssim.pool.site import camera_of
from finssim.pool.truth import Truth, read_truth
from finssim.pool.virtual_pool import VirtualPool
from finssim.provenance import provenance
from finssim.quiet import start_warp
from finssim.robot.ablation import NoisyInput
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.pilots import Pilot, make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import room

__all__ = ["job_trial", "play"]

Array = NDArray[np.float64]


def job_trial(job: Job, vehicle: Vehicle, *, seed: int = 0) -> tuple[RobotTrial, Station]:
    """The trial of a job, which ends when its time is over, and where it starts.

    Args:
        job: Who, and to what.
        vehicle: As the robot knows it.
        seed: Of noise on what the pilot sees.

    Raises:
        PolicyError, ControlError: The controller does not fit the vehicle or the task.
    """
    standing = load_vehicle(job.pool_vehicle)
    guide: Guide
    if job.task == "t1":
        x, y, z, yaw = in_room(T1_SETPOINTS[job.target], standing).tolist()
        guide, first = Station((x, y, z), yaw, name=job.target), in_room(T1_START, standing).tolist()
    else:
        guide = load_trajectory(job.target, vehicle=standing)
        reference = guide.at(0.0)
        first = [*reference.position.tolist(), float(reference.yaw)]
    duration = guide.duration if math.isfinite(guide.duration) else job.duration
    trial = RobotTrial(
        name=f"{job.row}, {job.target}",
        pilot=_pilot(job, vehicle, seed),
        guide=guide,
        duration=duration,
        over=lambda runtime: runtime.t >= duration,
        watch=_Estimates(),
    )
    return trial, Station((first[0], first[1], first[2]), first[3])


class _Estimates:
    """What the robot believed, at the period of the series."""

    def __init__(self) -> None:
        self.rows: list[tuple[float, ...]] = []

    def __call__(self, runtime: Runtime) -> None:
        reading, t = runtime.reading, runtime.t
        if reading is None or math.isnan(t) or (self.rows and t < self.rows[-1][0] + PERIOD - 1e-6):
            return
        self.rows.append((t, *reading.position, float(quat_yaw(reading.quaternion))))


def play(job: Job, path: Path) -> dict[str, Any]:
    """Play a job.

    Args:
        job: Who, where and what.
        path: PATH.npz takes the series of truth and estimate.

    Returns:
        The measures of its task, `fault` (why the bridge stopped it, or empty), `localization` (errors of the estimate
        against the truth, rms) and how the robot's loop did.
    """
    start_warp()
    began = time.perf_counter()
    vehicle, standing = load_vehicle(job.vehicle), load_vehicle(job.pool_vehicle)
    true_site, known_site, settings = camera_of(standing, job.plant, job.severity)
    seed = zlib.crc32(f"{job.seed} {job.target}".encode()) & 0x7FFFFFFF
    trial, start = job_trial(job, vehicle, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        world = VirtualPool(
            standing,
            draw_plant(standing, job.plant, job.severity),
            camera=PoolCamera(standing, true_site, mode=job.camera, settings=settings, seed=seed),
            start=(np.asarray(start.position), quat_from_yaw(start.yaw)),
            seed=seed,
            truth=Path(folder) / "truth",
        )
        try:
            outcome = play_trial(
                trial,
                lambda runtime, **how: run_lockstep(runtime, world, **how),
                vehicle,
                known_site,
                perception=Perception(vehicle, known_site, fusion=job.fusion),
            )
        finally:
            world.close()
        found = read_truth(Path(folder) / "truth")
    assert isinstance(trial.watch, _Estimates)
    series = _series(found, outcome.runtime.started, trial.duration, np.array(trial.watch.rows))
    write_series(path, series)
    truth = Motion(**{name: series[name] for name in ("t", "position", "yaw", "quaternion", "thrust")})
    estimate = Motion(t=series["estimate_t"], position=series["estimate"], yaw=series["estimate_yaw"])
    return {
        **measure(job.task, trial.guide, truth, vehicle.force_limits, stopped=bool(outcome.fault)),
        "fault": outcome.fault,
        "room": room(standing.body.size),
        "localization": localization_errors(truth, estimate),
        "missed_decisions": outcome.runtime.counters.missed,
        "seconds": time.perf_counter() - began,
        "provenance": provenance(),
    }


def _pilot(job: Job, vehicle: Vehicle, seed: int) -> Pilot:
    pilot: Pilot = make_pilot(job.controller, vehicle, task=job.task, trim=Trim() if job.trim else None)
    if job.position_noise or job.yaw_noise:
        return NoisyInput(pilot, position_std=job.position_noise, yaw_std=job.yaw_noise, seed=seed)
    return pilot


def _series(truth: Truth, started: float, duration: float, estimates: Array) -> dict[str, Array]:
    """Truth from the start of the guide's time, and the estimates at their own times."""
    t = truth.time - started
    kept = (t >= 0.0) & (t <= duration + 1e-6)
    every = max(1, round(PERIOD / np.median(np.diff(truth.time))))
    t, position, quaternion = t[kept][::every], truth.position[kept][::every], truth.quaternion[kept][::every]
    estimates = estimates.reshape(-1, 5)
    return {
        "t": t,
        "position": position,
        "quaternion": quaternion,
        "yaw": np.asarray(quat_yaw(quaternion)),
        "nu": truth.nu[kept][::every],
        "thrust": truth.thrust[kept][::every],
        "estimate_t": estimates[:, 0],
        "estimate": estimates[:, 1:4],
        "estimate_yaw": estimates[:, 4],
    }
