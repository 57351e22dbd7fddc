"""One programme in the virtual pool: the robot's whole software plays it, a record is kept, and becomes a trial."""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from finssim.calibration.excitation.programmes import Programme
from finssim.calibration.trials.trial_files import write_trial
from finssim.experiments.excitation.places import box_of, place_of
from finssim.experiments.excitation.programme_trial import (
    ESTIMATOR,
    about_programme,
    fastest,
    programme_trial,
    trial_of_record,
)
from finssim.experiments.on_robot.play import play
from finssim.geometry.rotations import quat_from_yaw
from finssim.pool.camera import PoolCamera
from finssim.pool.draw_plant import draw_plant
from finssim.pool.site import camera_of
from finssim.pool.virtual_pool import VirtualPool
from finssim.quiet import start_warp
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.recorder import Recorder
from finssim.vehicles import load_vehicle

__all__ = ["PoolRun", "play_programme"]


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
    fault, duration, speed = _record(run, record)
    trial = trial_of_record(record, run.programme.name, run.row)
    write_trial(trial, path, format="parquet")
    return {"fault": fault, "duration": duration, "fastest": speed, "notes": list(trial.notes)}


def _record(run: PoolRun, record: Path) -> tuple[str, float, float]:
    """Run robot and pool against each other; returns why it ended early, how long it took [s], and how fast it was."""
    vehicle, standing = load_vehicle(run.vehicle), load_vehicle(run.pool_vehicle)
    spec = draw_plant(standing, run.plant, run.severity)  # type: ignore[arg-type]
    true_site, known_site, settings = camera_of(standing, run.plant, run.severity)  # type: ignore[arg-type]
    place = place_of(run.programme, vehicle, box_of(spec.basin))
    seed = zlib.crc32(f"{run.seed} {run.row} {run.target}".encode()) & 0x7FFFFFFF
    trial = programme_trial(run.programme, vehicle, place, hold=run.hold)
    world = VirtualPool(
        standing,
        spec,
        camera=PoolCamera(standing, true_site, mode="corners", settings=settings, seed=seed),
        start=(place.position, quat_from_yaw(place.yaw)),
        seed=seed,
    )
    about = {**about_programme(run.programme, "virtual pool"), "seed": run.seed}
    with Recorder(record, vehicle, about, pictures="none") as recorder:
        outcome = play(
            trial,
            lambda runtime, **how: run_lockstep(runtime, world, **how),
            vehicle,
            known_site,
            perception=Perception(vehicle, known_site, mode=ESTIMATOR),
            recorder=recorder,
        )
        world.close()
    t = outcome.runtime.t
    return outcome.fault, 0.0 if math.isnan(t) else t, fastest(trial)
