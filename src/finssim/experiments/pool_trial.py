"""One trial of a controller by the robot's whole software: in the virtual pool, or from the same start on a robot."""

from __future__ import annotations

import math
import tempfile
import time
import zlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from finssim.control.guidance import Station
from finssim.control.modes import action_mode
from finssim.experiments import campaign
from finssim.experiments.metrics import SITE_SIZES, T1_SETPOINTS, T1_START, in_room
from finssim.experiments.on_robot import (
    GETTING_READY,
    Attendant,
    OnRobot,
    Outcome,
    RobotError,
    RobotTrial,
    Session,
    check_starts,
    fault_of,
    session,
)
from finssim.experiments.records import DriveError, read_record
from finssim.experiments.trials import PERIOD, Motion, Trial, guide_of, localization_errors
from finssim.pool import read_truth
from finssim.pool.run import PoolPlan, make_plan
from finssim.provenance import provenance
from finssim.quiet import start_warp
from finssim.robot.goals import check_reachable
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.robot.wiring import link_of
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import room, vehicle_at

HARDWARE = "hardware"
"""In place of the severity of a pool, and of what its camera sends."""


class Firmware(NamedTuple):
    """How a vehicle is tried that it steers."""

    action: str | None
    """Of policies; the task's own if None."""
    site: str
    camera: str


FIRMWARES = {"mcu": Firmware(None, "pool", "corners"), "ardusub": Firmware("pilot6", "tank", "none")}
"""What steers the motors: a controller that takes shaft speeds, in the pool under a camera, or an autopilot that takes
axes, in a tank by Doppler log, depth and compass."""


def firmware_of(name: str, vehicle: Vehicle, robot: OnRobot | None = None) -> str:
    """The name of what steers, or that of what a robot's address says.

    Raises:
        ValueError: There is no such firmware.
        ControlError: The vehicle has no autopilot.
    """
    campaign.check_choices([name], FIRMWARES, "firmware", ValueError)
    name = "ardusub" if robot is not None and robot.wiring.robot.startswith("mavlink") else name
    action = FIRMWARES[name].action
    if action is not None:
        action_mode(action, vehicle)
    return name


@dataclass(frozen=True, kw_only=True)
class PoolJob(campaign.Job):
    """What the robot's whole software does in a pool, whose vehicle it knows only so well."""

    vehicle: str = "finsrov"
    """Name or file of the vehicle as controller and localization know it."""
    pool_vehicle: str = "finsrov"
    """Name or file of the vehicle around which the pool's own is drawn."""
    severity: str = "realistic"
    """nominal, realistic or hard."""
    camera: str = "pictures"
    """pictures (drawn and searched for tags) or corners (of the tags, with noise)."""
    site: str = "pool"
    """pool, tank or open-water."""
    firmware: str = "mcu"
    """mcu or ardusub: an autopilot, on whose vehicle a Doppler log and a compass take the camera's place."""

    def plan(self, seed: int) -> PoolPlan:
        """Of its pool, with a seed for noise."""
        camera: Any = "none" if self.firmware == "ardusub" else self.camera
        return make_plan(
            self.pool_vehicle, str(self.plant), self.severity, camera=camera, seed=seed, site=self.site,
            firmware=self.firmware,
        )  # type: ignore[arg-type]  # fmt: skip

    def equipped(self) -> Vehicle:
        """The vehicle as the robot knows it there."""
        return vehicle_at(self.site, load_vehicle(self.vehicle), navigation=self.firmware == "ardusub")


@dataclass(frozen=True, kw_only=True)
class Job(PoolJob):
    """A controller and what it is to do: a setpoint of T1 or a trajectory of T2."""

    controller: str
    """Policy directory, or the name of a PID."""
    fusion: bool = True
    """Whether the controller sees the fused state, or what each sensor said last."""
    position_noise: float = 0.0
    """Added to what the controller sees, per axis [m]."""
    yaw_noise: float = 0.0
    """Added to what the controller sees [rad]."""
    estimator: str = "error-state"
    """Model of the filter: error-state, with the IMU's accelerations, or constant-velocity, the paper's."""
    duration: float = 60.0
    """[s]; of T2 the trajectory's own."""

    @property
    def task(self) -> str:
        """t1 or t2."""
        return "t1" if self.target in T1_SETPOINTS else "t2"


def noise_seed(*words: Any) -> int:
    """A seed of what a trial is called: trials of other names never share noise."""
    return zlib.crc32(" ".join(map(str, words)).encode()) & 0x7FFFFFFF


def play_in_pool(
    trial: RobotTrial,
    start: Station,
    vehicle: Vehicle,
    plan: PoolPlan,
    *,
    seed: int,
    truth: Path | None = None,
    recorder: Recorder | None = None,
    **estimator: Any,
) -> Outcome:
    """Play a trial by the robot's whole software in lock-step with a pool.

    Args:
        trial: What to do.
        start: Where the vehicle is, at rest.
        vehicle: As the robot knows it.
        plan: Of the pool and the vehicle in it.
        seed: Of the noise.
        truth: File of the truth; none if None.
        recorder: Takes it down.
        estimator: Options of `Perception`.
    """
    world = plan.standing(start, seed=seed, truth=truth)
    if plan.firmware == "ardusub":
        # Dead reckoning counts from where the vehicle is let in, so nobody can be wrong about that place.
        estimator = {"mode": "error-state", "let_in": start.position[:2], **estimator}
    perception = Perception(vehicle, plan.calibrated, **estimator)
    runtime = Runtime(
        vehicle, plan.calibrated, trial.pilot, trial.guide, arm=True, perception=perception, recorder=recorder
    )
    runtime.attach(link_of("mavlink" if plan.firmware == "ardusub" else "pool", vehicle))
    longest = GETTING_READY + trial.duration
    with closing(world):
        run_lockstep(
            runtime, world, longest, show=trial.watch, until=lambda r: r.bridge.state == "fault" or trial.over(r)
        )  # fmt: skip
    return Outcome(trial=trial, runtime=runtime, fault=fault_of(trial, runtime))


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
    guide = guide_of(job.target, standing, site=job.site)
    first = guide.at(0.0)
    *place, yaw = (
        in_room(T1_START, standing, job.site) if job.task == "t1" else (*first.position, float(first.yaw))
    )
    duration = guide.duration if math.isfinite(guide.duration) else job.duration
    pilot = make_pilot(job.controller, vehicle, task=job.task)
    if job.position_noise or job.yaw_noise:
        pilot.disturb_input(position_std=job.position_noise, yaw_std=job.yaw_noise, seed=seed)
    trial = RobotTrial(
        name=f"{job.row}, {job.target}",
        pilot=pilot,
        guide=guide,
        duration=duration,
        over=lambda runtime: runtime.t >= duration,
        watch=_Estimates(),
    )
    return trial, Station(tuple(map(float, place)), float(yaw))  # type: ignore[arg-type]


class _Estimates:
    """What the robot believed, at the period of the series."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, Any, Any]] = []

    def __call__(self, runtime: Runtime) -> None:
        reading, t = runtime.reading, runtime.t
        if reading is None or math.isnan(t) or (self._rows and t < self._rows[-1][0] + PERIOD - 1e-6):
            return
        self._rows.append((t, reading.position, reading.quaternion))

    def motion(self) -> Motion:
        """All of it."""
        t, position, quaternion = zip(*self._rows, strict=True) if self._rows else ((), (), ())
        columns = (np.reshape(x, (-1, n)) for x, n in ((position, 3), (quaternion, 4)))
        return Motion(t=np.array(t), **dict(zip(("position", "quaternion"), columns, strict=True)))


def play(job: Job, path: Path) -> dict[str, Any]:
    """Play a job in its pool.

    Args:
        job: Who, where and what.
        path: PATH.npz takes the true motion.

    Returns:
        The measures of its task, `fault` (why the bridge stopped it, or empty), `localization` (errors of the estimate
        against the truth, rms) and how the robot's loop did.
    """
    start_warp()
    began, seed = time.perf_counter(), noise_seed(job.seed, job.target)
    trial, start = job_trial(job, load_vehicle(job.vehicle), seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "truth"
        outcome = play_in_pool(
            trial,
            start,
            job.equipped(),
            job.plan(seed),
            seed=seed,
            truth=file,
            fusion=job.fusion,
            mode=job.estimator,
        )
        truth = read_truth(file)
    t = truth.time - outcome.runtime.started
    rows = np.flatnonzero((t >= 0.0) & (t <= trial.duration + 1e-6))
    rows = rows[:: max(1, round(PERIOD / np.median(np.diff(t))))]
    states = {name: getattr(truth, name) for name in ("position", "quaternion", "nu", "thrust")}
    motion = Motion(t=t, **states).between(rows)
    assert isinstance(trial.watch, _Estimates)
    localization = localization_errors(motion, trial.watch.motion())
    return _result(job, path, motion, outcome, began) | {"localization": localization}


def _result(job: Job, path: Path, motion: Motion, outcome: Outcome, began: float) -> dict[str, Any]:
    """Write the motion of a trial to PATH.npz, and measure it."""
    motion.write(path)
    trial = Trial(name=job.target, guide=outcome.trial.guide, motion=motion)
    limits = load_vehicle(job.vehicle).force_limits
    return {
        **trial.measures(job.task, limits, stopped=bool(outcome.fault)),
        "fault": outcome.fault,
        "room": room(load_vehicle(job.pool_vehicle).body.size) * SITE_SIZES[job.site],
        "localization": None,
        "missed_decisions": outcome.runtime.counters.missed,
        "seconds": time.perf_counter() - began,
        "provenance": provenance(),
    }


def played_trial(result: Mapping[str, Any], folder: Path) -> Trial:
    """The trial of a result, with its motion.

    Args:
        result: As `run_jobs` returns it.
        folder: Where `run_jobs` left the motions.
    """
    target = result["job"]["target"]
    guide = guide_of(target, size=result.get("room", 1.0))
    return Trial(name=target, guide=guide, motion=Motion.read(folder / result["key"]))


def play_jobs(
    jobs: Sequence[Job],
    folder: Path,
    robot: OnRobot | None = None,
    *,
    attendant: Attendant | None = None,
    console: Console | None = None,
    **options: Any,
) -> list[dict[str, Any]]:
    """Play in their pools, or on a robot, what has no result yet, scored by the truth or by the robot's own estimate.

    Of a robot: a trial that the bridge stopped counts; with nobody beside the water nothing is played after it. Those
    that are skipped are left out.

    Args:
        jobs: On a robot of one vehicle; plant 0, severity and camera `HARDWARE`.
        folder: Takes KEY.json, KEY.npz and, of a robot, KEY.mcap of each, made if missing.
        robot: Which, and how; not opened where nothing is left to play. None: in pools.
        attendant: Instead of the terminal's keyboard.
        console: Where it is told how it stands; standard error if None.
        options: Of `run_jobs`, for pools.

    Raises:
        RobotError: A trial was stopped, and nobody is there to look at the vehicle; the next call goes on. Or every
            trial was skipped.
        GoalError: A start or a goal lies outside the workspace.
        PolicyError, ControlError: A controller does not fit the vehicle.
        KeyboardInterrupt: Ctrl-C, or the operator ended the session.
    """
    if robot is None:
        return campaign.run_jobs(jobs, folder, play, **options)
    vehicle, console = load_vehicle(jobs[0].vehicle), console or Console(stderr=True)
    trials = {job.target: job_trial(job, vehicle) for job in jobs}
    equipped = robot.equipped(vehicle)
    check_starts({target: start for target, (_, start) in trials.items()}, equipped)
    for trial, _ in trials.values():
        check_reachable(trial.guide, equipped)

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

        def play_next(job: Job, path: Path) -> dict[str, Any] | None:
            if not opened:
                opened.append(
                    stack.enter_context(session(robot, vehicle, attendant=attendant, console=console))
                )
            return _play_on_robot(job, path, opened[0])

        results = campaign.run_jobs(jobs, folder, play_next, processes=1, show=show)
    if not results:
        raise RobotError("every trial was skipped: there is nothing to report")
    return results


def _play_on_robot(job: Job, path: Path, opened: Session) -> dict[str, Any] | None:
    """One job; PATH.mcap takes the record, PATH.npz the estimate of the motion. None if it was skipped."""
    began, vehicle, record = time.perf_counter(), opened.vehicle, path.with_name(f"{path.name}.mcap")
    trial, start = job_trial(job, vehicle, seed=job.seed)
    outcome = opened.trial(
        lambda: job_trial(job, vehicle, seed=job.seed)[0],
        start,
        record,
        counts=True,
        perception=lambda: Perception(opened.equipped, opened.site, mode=job.estimator, fusion=job.fusion),
        about={"command": f"finssim experiment {job.task}", "row": job.row},
    )
    if outcome is None:
        return None
    try:
        motion = read_record(record, job.task, vehicle, guide=trial.guide, duration=trial.duration).estimate
    except DriveError:  # stopped before its first decision
        nowhere = np.full((2, 4), np.nan)
        motion = Motion(t=np.array([0.0, 0.1]), position=nowhere[:, :3], quaternion=nowhere)
    where = {"robot": opened.robot.title, "record": record.name}
    return _result(job, path, motion, outcome, began) | where
