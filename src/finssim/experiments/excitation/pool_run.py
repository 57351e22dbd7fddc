"""One programme in the virtual pool: the robot's whole software plays it, a record is kept, and becomes a trial."""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from finssim.calibration.excitation.programmes import Programme
from finssim.calibration.importers.dispatch import read_trials
from finssim.calibration.trials.trial import Trial
from finssim.calibration.trials.trial_files import write_trial
from finssim.control.guidance import Station
from finssim.experiments.excitation.places import place_of
from finssim.geometry.rotations import quat_from_yaw
from finssim.pool.camera import PoolCamera
from finssim.pool.draw_plant import draw_plant
from finssim.pool.site import camera_of
from finssim.pool.virtual_pool import VirtualPool
from finssim.quiet import start_warp
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.programme_pilot import ProgrammePilot
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.vehicles import AXES, Vehicle, load_vehicle

__all__ = ["PoolRun", "play_programme", "trial_of_record"]

GETTING_READY = 10.0
"""Longest time until the estimator knows where the vehicle is [s]."""

ESTIMATOR = "error-state"
"""Mode of the estimator: it predicts with the accelerometer, so that its velocity does not lag behind the motion."""


@dataclass(frozen=True, kw_only=True)
class PoolRun:
    """A programme, who plays it and where; equal ones give equal trials."""

    row: str
    """fit or held-out."""
    programme: Programme
    vehicle: str
    """Name or file of the vehicle as the robot knows it."""
    pool_vehicle: str
    """Name or file of the vehicle around which the pool's own is drawn."""
    plant: int = 1
    """Seed of the pool."""
    severity: str = "realistic"
    """nominal, realistic or hard."""
    seed: int = 1
    """Of noise; programmes of different names never share it."""
    hold: str | None = "pid"
    """PID that keeps the other axes."""

    @property
    def target(self) -> str:
        """What is to be done."""
        return self.programme.name

    def described(self) -> dict[str, Any]:
        """Everything that decides the trial, as plain data."""
        told = asdict(self)
        told.pop("programme")
        digest = hashlib.sha256(self.programme.tau_desired.tobytes())
        digest.update("".join(self.programme.phase).encode())
        told["programme"] = {"name": self.programme.name, "sha256": digest.hexdigest()}
        for name in ("vehicle", "pool_vehicle"):
            told[name] = load_vehicle(getattr(self, name)).sha256
        return told

    def key(self) -> str:
        """File name of its result."""
        digest = hashlib.sha256(json.dumps(self.described(), sort_keys=True).encode()).hexdigest()[:10]
        return f"{self.row}_{self.target}_{digest}"


class _Phases:
    """Tells the record when the programme's phase changes, and remembers how fast the vehicle was."""

    def __init__(self, pilot: ProgrammePilot, recorder: Recorder, axis: int) -> None:
        self._pilot, self._recorder, self._said = pilot, recorder, ""
        self._axis, self.fastest = axis, 0.0

    def __call__(self, runtime: Runtime) -> None:
        if self._said and runtime.reading is not None:
            self.fastest = max(self.fastest, abs(float(runtime.reading.nu[self._axis])))
        if self._pilot.phase != self._said and runtime.reading is not None:
            self._said = self._pilot.phase
            self._recorder.event(runtime.reading.time, "phase", self._said)


def play_programme(run: PoolRun, path: Path) -> dict[str, Any]:
    """Play a programme.

    Args:
        run: What, who and where.
        path: PATH.mcap takes the record, PATH (a folder) the trial.

    Returns:
        `fault` (why the bridge ended it early, or empty), `duration` [s], `fastest` (the highest speed along the
        programme's first axis, as the robot estimates it [m/s, rad/s]) and the `notes` of the import.
    """
    start_warp()
    path.mkdir(parents=True, exist_ok=True)
    record = path.with_name(f"{path.name}.mcap")
    record.unlink(missing_ok=True)
    fault, duration, fastest = _record(run, record)
    trial = trial_of_record(record, run.programme.name, run.row)
    write_trial(trial, path, format="parquet")
    return {"fault": fault, "duration": duration, "fastest": fastest, "notes": list(trial.notes)}


def trial_of_record(record: Path, name: str, role: str) -> Trial:
    """The trial of a record, from where its programme began.

    Args:
        record: MCAP of one programme.
        name: Of the trial.
        role: fit or held-out.
    """
    trial = read_trials([record], split="phase")[0]
    return replace(trial, name=name, header=trial.header.model_copy(update={"role": role}))


def _record(run: PoolRun, record: Path) -> tuple[str, float, float]:
    """Run robot and pool against each other; returns why it ended early, how long it took [s], and how fast it was."""
    vehicle, standing = load_vehicle(run.vehicle), load_vehicle(run.pool_vehicle)
    spec = draw_plant(standing, run.plant, run.severity)  # type: ignore[arg-type]
    true_site, known_site, settings = camera_of(standing, run.plant, run.severity)  # type: ignore[arg-type]
    place = place_of(run.programme, vehicle, spec.basin)
    seed = zlib.crc32(f"{run.seed} {run.row} {run.target}".encode()) & 0x7FFFFFFF
    pilot = _pilot(run.programme, vehicle, place.room, run.hold)
    about = {"trial": {"axis": list(run.programme.axes), "description": f"virtual pool: {run.target}"}}
    with Recorder(record, vehicle, {**about, "seed": run.seed}, pictures="none") as recorder:
        runtime = Runtime(
            vehicle,
            known_site,
            pilot,
            Station(place.position, place.yaw, name=run.target),
            arm=True,
            perception=Perception(vehicle, known_site, mode=ESTIMATOR),
            recorder=recorder,
        )
        world = VirtualPool(
            standing,
            spec,
            camera=PoolCamera(standing, true_site, mode="corners", settings=settings, seed=seed),
            start=(place.position, quat_from_yaw(place.yaw)),
            seed=seed,
        )
        phases = _Phases(pilot, recorder, AXES.index(run.programme.axes[0]))
        run_lockstep(
            runtime,
            world,
            GETTING_READY + run.programme.duration,
            show=phases,
            until=lambda r: pilot.finished or r.bridge.state == "fault",
        )
        world.close()
    return _fault(runtime, pilot), 0.0 if math.isnan(runtime.t) else runtime.t, phases.fastest


def _pilot(programme: Programme, vehicle: Vehicle, room: float | None, hold: str | None) -> ProgrammePilot:
    return ProgrammePilot(
        programme.tau_desired,
        programme.phase,
        programme.rate,
        programme.axes,
        vehicle,
        room=room,
        ascent_speed=programme.ascent_speed,
        ascent_time=programme.ascent_time,
        hold=hold,
    )


def _fault(runtime: Runtime, pilot: ProgrammePilot) -> str:
    """Why the programme ended before its time, or never began; empty if it did neither."""
    if math.isnan(runtime.started):
        return f"never armed: {runtime.refusal or 'no state'}"
    if runtime.bridge.state == "fault":
        return runtime.bridge.reason
    return "" if pilot.finished else "not finished"
