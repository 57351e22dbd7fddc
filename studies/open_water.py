"""Drift of dead reckoning after minutes in open water: `python -m studies.open_water --out drift`.

The vehicle has a Doppler log, depth sensor, IMU and compass, with or without fixes.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from finssim.cli.command_line import run_script
from finssim.control.guidance import Station
from finssim.control.trajectories import Trajectory
from finssim.core.progress import Progress
from finssim.core.provenance import provenance
from finssim.core.quiet import start_warp
from finssim.core.rotations import quat_yaw
from finssim.evaluation.campaign import check_choices, write_json
from finssim.evaluation.robot_trials import RobotTrial, play_in_pool
from finssim.evaluation.tables import Columns, Table, cells
from finssim.evaluation.trials import interpolated
from finssim.pool import read_truth
from finssim.pool.drawn_plant import positioning_of
from finssim.pool.plan import make_plan
from finssim.pool.plant_spec import Severity
from finssim.robot.perception import LET_IN_STD
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]

DEPTH = -5.0
"""Height of the path, world frame [m]."""
SIDE = 10.0
"""Side of the square [m]."""
PERIOD = 0.5
"""Interval of compared estimates [s]."""
INSIDE = 5.991
"""95 % quantile of squared Mahalanobis distances in the plane [-]."""
WAYS = ("line", "square")
COLUMNS: Columns = {
    "seed": ("seed", ".0f"),
    "way_m": ("way [m]", ".1f"),
    "drift_m": ("drift [m]", ".2f"),
    "drift": ("drift [%]", ".2f", 100.0),
    "std_m": ("std [m]", ".2f"),
    "nees": ("NEES", ".2f"),
    "inside": ("inside", ".0%"),
    "off_m": ("off way [m]", ".2f"),
}


def way_of(shape: str, duration: float, speed: float) -> Trajectory:
    """Return a straight path along x, or squares of 10 m, at a constant speed.

    Args:
        shape: Name in `WAYS`.
        duration: Shortest duration [s]; squares are completed.
        speed: Speed [m/s].

    Raises:
        ValueError: Unknown shape.
    """
    check_choices([shape], WAYS, "way", ValueError)
    corners = [[0.0, 0.0], [speed * duration, 0.0]]
    if shape == "square":
        around = [[SIDE, 0.0], [SIDE, SIDE], [0.0, SIDE], [0.0, 0.0]]
        corners = [[0.0, 0.0], *around * math.ceil(duration * speed / (4.0 * SIDE))]
    points = np.column_stack([np.array(corners), np.full(len(corners), DEPTH)])
    steps = np.diff(points, axis=0)
    times = np.linalg.norm(steps, axis=1) / speed
    starts = np.concatenate([[0.0], np.cumsum(times)])

    def motion(t: Array) -> tuple[Array, Array]:
        i = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, len(times) - 1)
        return interpolated(t, starts, points), steps[i] / times[i][..., None]

    return Trajectory(name=shape, duration=float(starts[-1]), motion=motion)


def swim(
    vehicle: Vehicle,
    way: Trajectory,
    *,
    plant: int = 1,
    severity: Severity = "realistic",
    positioning: str = "none",
    controller: str = "pid",
    seed: int = 1,
) -> dict[str, Any]:
    """Follow a path through open water with the robot's complete software in lock-step.

    Args:
        vehicle: Vehicle, to which `vehicle_at` adds the instruments of open water.
        way: Path, followed by the robot's own estimate.
        plant: Seed of the vehicle's plant.
        severity: nominal, realistic or hard.
        positioning: none, motion-capture or usbl.
        controller: Name of a PID.
        seed: Seed of instruments and wire.

    Returns:
        `way_m`; `drift_m`, the error in the plane at the end; `worst_m`, the largest one; `std_m`, its estimated
        standard deviation; `inside`, fraction of estimates inside their 95 % ellipse; `nees`, the squared Mahalanobis
        distance at the end; `off_m`, the largest distance from the required motion; `heading_deg`; `fault`.

    Raises:
        ValueError: The robot was never armed.
    """
    start_warp()
    plan = make_plan(vehicle, str(plant), severity, camera="none", seed=seed, site="open-water")
    rows: list[tuple[float, ...]] = []

    def watch(runtime: Runtime) -> None:
        """Store the estimate and its covariance."""
        reading = runtime.reading
        if reading is None or math.isnan(runtime.t) or (rows and reading.time < rows[-1][0] + PERIOD - 1e-6):
            return
        estimate = runtime.perception.estimator.estimate(reading.time)
        P = estimate.P[:2, :2].ravel().tolist()
        rows.append((reading.time, *estimate.x[:2].tolist(), estimate.yaw, *P))

    let_in = np.random.default_rng([seed, 0x57A]).normal(0.0, LET_IN_STD, 2).tolist()
    start = Station((0.0, 0.0, DEPTH), 0.0)
    trial = RobotTrial(
        name=way.name,
        pilot=make_pilot(controller, plan.vehicle, task="t2"),
        guide=way,
        duration=way.duration,
        over=lambda runtime: runtime.t >= way.duration,
        watch=watch,
    )
    with tempfile.TemporaryDirectory() as folder:
        runtime = play_in_pool(
            trial, start, plan.vehicle, replace(plan, positioning=positioning), seed=seed,
            truth=Path(folder) / "truth", mode="error-state", let_in=let_in,
        ).runtime  # fmt: skip
        truth = read_truth(Path(folder) / "truth")
    if not rows:
        raise ValueError(f"open water: never armed: {runtime.refusal or 'no state'}")
    a = np.array(rows)
    true = interpolated(a[:, 0], truth.time, truth.position)
    yaw = np.interp(a[:, 0], truth.time, np.unwrap(quat_yaw(truth.quaternion)))
    error, P = a[:, 1:3] - true[:, :2], a[:, 4:8].reshape(-1, 2, 2)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error)
    off = np.linalg.norm(true - way.at(a[:, 0] - runtime.started).position, axis=1)
    far = np.linalg.norm(error, axis=1)
    return {
        "seed": seed,
        "way_m": float(np.sum(np.linalg.norm(np.diff(true[:, :2], axis=0), axis=1))),
        "drift_m": float(far[-1]),
        "worst_m": float(far.max()),
        "std_m": float(np.sqrt(np.trace(P[-1]))),
        "nees": float(nees[-1]),
        "inside": float(np.mean(nees <= INSIDE)),
        "heading_deg": math.degrees(math.remainder(float(a[-1, 3] - yaw[-1]), math.tau)),
        "off_m": float(off.max()),
        "fault": runtime.bridge.reason,
    }


def open_water(
    *,
    out: Path,
    vehicle: str = "bluerov2_heavy",
    minutes: Annotated[float, (0.1, None)] = 10.0,
    speed: Annotated[float, (0.01, None)] = 0.3,
    shape: Annotated[str, "--way"] = "line",
    positioning: str = "none",
    seeds: Annotated[int, (1, 1000)] = 3,
    seed: int = 1,
    severity: Severity = "realistic",
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Measure the drift of dead reckoning (DVL, depth, IMU, compass) in open water [m].

    Example: python -m studies.open_water --seeds 1 --out drift

    Args:
        out (DIR): Directory for the result.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        minutes: Duration of each run [min].
        speed: Speed [m/s].
        shape (WORD): line or square (of 10 m).
        positioning (NAME): Fixes: none, motion-capture or usbl.
        seeds: Number of runs, each with different water and noise.
        seed: Seed of every random number; equal seeds give equal results.
        severity (WORD): Deviation of the pools from the vehicle file: nominal, realistic or hard.
        progress: Receives the completed fraction and the next run.
    """
    ours, way = load_vehicle(vehicle), way_of(shape, 60.0 * minutes, speed)
    positioning_of(positioning, seed)  # refuse an unknown name before the first run
    trials = []
    for k, s in enumerate(range(seed, seed + seeds)):
        progress(k / seeds, f"seed {s}")
        trials.append(swim(ours, way, plant=s, severity=severity, positioning=positioning, seed=s))
    result = {
        "experiment": "open-water",
        "vehicle": {"name": ours.name, "sha256": ours.sha256},
        "minutes": minutes,
        "speed": speed,
        "shape": shape,
        "positioning": positioning,
        "severity": severity,
        "trials": trials,
        "provenance": provenance(),
    }
    write_json(Path(out) / "open_water.json", result, tables_of(result))
    return result


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return a table with a row for each run."""
    title = f"{result['vehicle']['name']}, {result['shape']}, positioning {result['positioning']}"
    heads = [*(heading for heading, *_ in COLUMNS.values()), ""]
    drifts = [{**t, "drift": t["drift_m"] / t["way_m"]} for t in result["trials"]]
    return [Table(title=title, heads=heads, rows=[[*cells(t, COLUMNS), t["fault"]] for t in drifts], left=())]


if __name__ == "__main__":
    run_script("studies.open_water:open_water")
