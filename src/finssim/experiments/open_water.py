"""How far off a vehicle is after minutes in open water: Doppler log, depth, IMU and compass, with fixes or without."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from finssim.control.trajectories import Trajectory
from finssim.experiments.campaign import Say, check_choices, write_json
from finssim.experiments.tables import Table
from finssim.geometry.rotations import quat_from_yaw, quat_yaw
from finssim.pool import PlantSpec, VirtualPool, draw_plant, read_truth
from finssim.pool.draw_plant import positioning_of, site_of
from finssim.provenance import provenance
from finssim.quiet import start_warp
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import LET_IN_STD, Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import vehicle_at

__all__ = ["open_water", "tables_of"]

Array = npt.NDArray[np.float64]

DEPTH = -5.0
"""Height of the way [m]."""
SIDE = 10.0
"""Of the square [m]."""
GETTING_READY = 10.0
"""Longest time until the estimator knows where the vehicle is [s]."""
PERIOD = 0.5
"""Between compared estimates [s]."""
INSIDE = 5.991
"""95 % of squared Mahalanobis distances in the plane are smaller."""
WAYS = ("line", "square")


def way_of(shape: str, duration: float, speed: float) -> Trajectory:
    """A straight way along x, or squares of 10 m, at a constant speed.

    Args:
        shape: A name of `WAYS`.
        duration: At least [s]; squares are finished.
        speed: [m/s]

    Raises:
        ValueError: There is no such shape.
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
        return points[i] + ((t - starts[i]) / times[i])[..., None] * steps[i], steps[i] / times[i][..., None]

    return Trajectory(name=shape, duration=float(starts[-1]), motion=motion)


def swim(
    vehicle: Vehicle,
    spec: PlantSpec,
    way: Trajectory,
    *,
    positioning: str = "none",
    controller: str = "pid",
    seed: int = 1,
) -> dict[str, Any]:
    """One way through open water, by the robot's whole software in lock-step.

    Args:
        vehicle: Of the catalogue or a file; it is equipped by `vehicle_at`.
        spec: Drawn for the pool.
        way: What is followed, by its own estimate.
        positioning: none, motion-capture or usbl.
        controller: PID.
        seed: Of instruments and wire.

    Returns:
        `way_m`; `drift_m`, the error in the plane at the end, `worst_m` on the way, `std_m`, its own estimate of it;
        `inside`, share of estimates inside their own 95 % ellipse; `nees`, the squared Mahalanobis distance at the end;
        `off_m`, the largest distance from the wanted motion; `heading_deg`; `fault`.

    Raises:
        ValueError: The robot was never ready.
    """
    start_warp()
    equipped = vehicle_at("open-water", vehicle)
    start = np.random.default_rng([seed, 0x57A]).normal(0.0, LET_IN_STD, 2).tolist()
    perception = Perception(equipped, None, mode="error-state", let_in=start)
    rows: list[tuple[float, ...]] = []

    def watch(runtime: Runtime) -> None:
        """Keep what the estimator says of itself."""
        reading = runtime.reading
        if reading is None or math.isnan(runtime.t) or (rows and reading.time < rows[-1][0] + PERIOD - 1e-6):
            return
        estimate = perception.estimator.estimate(reading.time)
        P = estimate.P[:2, :2].ravel().tolist()
        rows.append((reading.time, *estimate.x[:2].tolist(), estimate.yaw, *P))

    pilot = make_pilot(controller, equipped, task="t2")
    runtime = Runtime(equipped, None, pilot, way, arm=True, perception=perception)
    with tempfile.TemporaryDirectory() as folder:
        world = VirtualPool(
            equipped,
            site_of("open-water", spec),
            positioning=positioning_of(positioning, seed),
            start=((0.0, 0.0, DEPTH), quat_from_yaw(0.0)),
            seed=seed,
            truth=Path(folder) / "truth",
        )
        over: Callable[[Runtime], bool] = lambda r: r.t >= way.duration or r.bridge.state == "fault"  # noqa: E731
        with closing(world):
            run_lockstep(runtime, world, GETTING_READY + way.duration, show=watch, until=over)
        truth = read_truth(Path(folder) / "truth")
    if not rows:
        raise ValueError(f"open water: never armed: {runtime.refusal or 'no state'}")
    a = np.array(rows)
    true = np.stack([np.interp(a[:, 0], truth.time, column) for column in truth.position.T], axis=1)
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
    severity: str = "realistic",
    say: Say = lambda part, what: None,
) -> dict[str, Any]:
    """Drift of Doppler log, depth, IMU and compass in open water [m], and whether the estimator's ellipse holds it.

    Example: finssim experiment open-water --seeds 1 --out drift

    Args:
        out (DIR): Directory for the result.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        minutes: Of each way [min].
        speed: [m/s]
        shape (WORD): line or square (of 10 m).
        positioning (NAME): Fixes: none, motion-capture or usbl.
        seeds: Ways, each with its own water and noise.
        seed: Seed of every random number; equal seeds give equal results.
        severity (WORD): How far the pools are from the vehicle file: nominal, realistic or hard.
        say: Told the share that is done and what comes next.
    """
    ours, way = load_vehicle(vehicle), way_of(shape, 60.0 * minutes, speed)
    positioning_of(positioning, seed)  # refuses what is none
    trials = []
    for k, s in enumerate(range(seed, seed + seeds)):
        say(k / seeds, f"seed {s}")
        plant = draw_plant(ours, s, severity)  # type: ignore[arg-type]
        trials.append(swim(ours, plant, way, positioning=positioning, seed=s))
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
    """A row for each way."""
    title = f"{result['vehicle']['name']}, {result['shape']}, positioning {result['positioning']}"
    heads = ("seed", "way [m]", "drift [m]", "drift [%]", "std [m]", "NEES", "inside", "off way [m]", "")
    rows = [
        [
            str(t["seed"]), f"{t['way_m']:.1f}", f"{t['drift_m']:.2f}", f"{100.0 * t['drift_m'] / t['way_m']:.2f}",
            f"{t['std_m']:.2f}", f"{t['nees']:.2f}", f"{100.0 * t['inside']:.0f} %", f"{t['off_m']:.2f}", t["fault"],
        ]
        for t in result["trials"]
    ]  # fmt: skip
    return [Table(title=title, heads=heads, rows=rows, left=())]
