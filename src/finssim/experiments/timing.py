"""`finssim experiment timing`: does the robot keep its times on this machine, and how fast does lock-step go?"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import Console

from finssim.experiments.campaign import Say, choice, write_json
from finssim.experiments.pool_trial import stand_in_pool
from finssim.experiments.processes import Process, ReliabilityError, pair
from finssim.provenance import provenance
from finssim.robot.goals import station_of
from finssim.robot.lockstep import run_lockstep
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle

__all__ = ["print_timing", "timing"]

CAMERAS = ("pictures", "corners")
STATION = "0,0,-0.5,0"
LATENCY_LIMIT = 0.060
"""What the newest picture may have been here when the command that it decided leaves, 99 of 100 times [s]."""
SPEED_LIMITS = {"corners": 20.0, "pictures": 2.0}
"""Lock-step: at least so many times real time."""
TRIED = {"corners": 60.0, "pictures": 10.0}
"""Vehicle time over which lock-step is timed [s]."""
WARM_UP = 3.0
"""Before it [s]."""
PATIENCE = 120.0
"""How long a run may take beyond its time, to start and to end [s]."""


def timing(
    *,
    out: Path,
    minutes: Annotated[float, (0.05, None)] = 10.0,
    camera: str = "pictures",
    policy: str = "pid",
    seed: int = 1,
    vehicle: str = "finsrov",
    say: Say = lambda part, what: None,
) -> dict[str, Any]:
    """Time the robot beside its pool on this machine: decisions missed, picture to command [ms], lock-step speed.

    Example: finssim experiment timing --minutes 10 --out timing

    Args:
        out (DIR): Directory for the result.
        minutes: Of the run in real time [min].
        camera (MODE): corners (projected through the rippling water, with noise), or pictures (drawn, and searched for
            tags: several times slower).
        policy (DIR|pid|pid-paper): A policy's directory, or pid, or pid-paper.
        seed: Seed of every random number; equal seeds give equal results.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        say: Told the share that is done and what comes next.

    Returns:
        What `timing.json` holds: `realtime` (what the robot told at the end, and what the pool said), `lockstep` (times
        real time by camera), `reached` (each figure against its limit).

    Raises:
        ReliabilityError: An unknown camera, or a process that did not start or end.
    """
    choice(CAMERAS, camera, "camera", ReliabilityError)
    lockstep = {}
    for k, mode in enumerate(CAMERAS):
        say(0.1 * k, f"lock-step, {mode}")
        lockstep[mode] = lockstep_speed(vehicle, mode, seed=seed, policy=policy)  # type: ignore[arg-type]
    realtime = _realtime(60.0 * minutes, camera, policy, seed, vehicle, say)
    told = realtime["robot"]
    p99 = told["latency_s"]["p99"]
    result = {
        "experiment": "timing",
        "camera": camera,
        "policy": policy,
        "minutes": minutes,
        "processors": os.cpu_count(),
        "load": os.getloadavg()[0],
        "realtime": realtime,
        "lockstep": lockstep,
        "reached": {
            "no decision missed": told["missed"] == 0 and told["state"] == "armed",
            "picture to command, p99": p99 is not None and p99 <= LATENCY_LIMIT,
            **{f"lock-step, {mode}": lockstep[mode] >= limit for mode, limit in SPEED_LIMITS.items()},
        },
        "provenance": provenance(),
    }
    write_json(Path(out) / "timing.json", result)
    return result


def lockstep_speed(
    vehicle: str,
    camera: Literal["pictures", "corners"],
    *,
    seed: int = 1,
    policy: str = "pid",
    duration: float | None = None,
) -> float:
    """How many times real time the robot's whole software and its pool go together, in this process.

    Args:
        vehicle: Name or file.
        camera: pictures or corners.
        seed: Of the pool.
        policy: Who steers.
        duration: Vehicle time [s]; long enough for the camera if None.
    """
    body, station = load_vehicle(vehicle), station_of(STATION)
    pool, site = stand_in_pool(body, station, plant=seed, severity="realistic", seed=seed, camera=camera)
    runtime = Runtime(body, site, make_pilot(policy, body), station, arm=True)
    run_lockstep(runtime, pool, WARM_UP)
    before, began = pool.time, time.perf_counter()
    run_lockstep(runtime, pool, duration or TRIED[camera], start=before)
    return (pool.time - before) / (time.perf_counter() - began)


def _realtime(seconds: float, camera: str, policy: str, seed: int, vehicle: str, say: Say) -> dict[str, Any]:
    world = ["--plant", str(seed), "--camera", camera]
    ours = ["--policy", policy, "--duration", str(seconds)]
    with (
        tempfile.TemporaryDirectory() as folder,
        pair(Path(folder), vehicle, STATION, pool=world, robot=ours) as both,
    ):
        robot = both.robot
        _wait(robot, seconds, say)
        if robot.running or not robot.said:
            raise ReliabilityError(f"the robot did not end: {robot.complained.strip()[-300:]}")
        robot.end()
        both.pool.end()
        return {"robot": json.loads(robot.said), "pool": both.pool.said.splitlines()}


def _wait(robot: Process, seconds: float, say: Say) -> None:
    began = time.monotonic()
    while robot.running and (passed := time.monotonic() - began) < seconds + PATIENCE:
        say(0.2 + 0.8 * min(passed / seconds, 1.0), f"real time: {passed / 60.0:.1f} min")
        time.sleep(0.5)


def print_timing(result: Mapping[str, Any], console: Console) -> None:
    """Print what came out."""
    told, reached = result["realtime"]["robot"], result["reached"]
    latency = told["latency_s"]
    ms = ", ".join(f"{name} {1e3 * value:.0f} ms" for name, value in latency.items() if value is not None)
    lines = [
        f"real time, {result['camera']}, {result['minutes']:g} min, {result['processors']} processors, "
        f"load {result['load']:.1f} before: ended {told['state']}{': ' + told['reason'] if told['reason'] else ''}",
        f"decisions missed: {told['missed']} of {told['decisions'] + told['missed']}; "
        f"late steps: {told['overruns']} of {told['steps']}",
        f"picture to command: {ms or 'no picture'}",
        *(f"lock-step, {mode}: {speed:.1f} times real time" for mode, speed in result["lockstep"].items()),
        "; ".join(f"{what}: {'reached' if good else 'not reached'}" for what, good in reached.items()),
    ]
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)
