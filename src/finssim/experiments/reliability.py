"""`finssim experiment soak` and `timing`, and what they share with `faults`: the processes of a robot and its pool."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from finssim.experiments.campaign import Progress, check_choices, write_json
from finssim.experiments.tables import Table
from finssim.pool import TruthError, read_truth
from finssim.pool.run import make_plan
from finssim.provenance import provenance
from finssim.robot.goals import station_of
from finssim.robot.lockstep import run_lockstep
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle

# The processes of a robot and its virtual pool: started as a person starts them, watched, and killed.


STARTING = 120.0
"""Longest time that a process takes to start, or to do what is waited for [s]."""
POLL = 0.005
"""Between looks [s]."""


class ReliabilityError(ValueError):
    """A trial could not be made: what it needs did not come about."""


class Process:
    """A `finssim` command in a process of its own, its words kept in files."""

    def __init__(self, words: Sequence[str], folder: Path, name: str) -> None:
        """
        Args:
            words: Of the command line, after `finssim`.
            folder: Takes NAME.out and NAME.err.
            name: Of its files.
        """
        self.name = name
        self._out, self._err = folder / f"{name}.out", folder / f"{name}.err"
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "finssim", *words], stdout=out, stderr=err, env=environment
            )

    @property
    def said(self) -> str:
        """Standard output so far."""
        return self._out.read_text(encoding="utf-8", errors="replace")

    @property
    def complained(self) -> str:
        """Standard error so far."""
        return self._err.read_text(encoding="utf-8", errors="replace")

    @property
    def running(self) -> bool:
        """Whether it is there."""
        return self._process.poll() is None

    def kill(self) -> None:
        """As `kill -9`."""
        self._process.kill()
        self._process.wait()

    def end(self) -> int:
        """As Ctrl-C, and not as gently where that is not heard; returns the exit status."""
        if self.running:
            self._process.send_signal(signal.SIGINT)
        try:
            return self._process.wait(20.0)
        except subprocess.TimeoutExpired:
            self.kill()
            return self._process.returncode

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        """A process does not outlive its block."""
        if self.running:
            self.kill()

    def broke(self) -> str:
        """What broke through to the person who started it; nothing if it ended as it should."""
        lines = self.complained.splitlines()
        if any(line.startswith("Traceback") for line in lines) or self._process.returncode == 1:
            return f"{self.name}: {lines[-1] if lines else 'exit status 1'}"
        return ""


@dataclass(frozen=True)
class Pair:
    """A robot in a pool, each in a process of its own."""

    pool: Process
    robot: Process
    port: int
    """Of the motor controller."""


@contextmanager
def pair(
    folder: Path, vehicle: str, goal: str, *, pool: Sequence[str], robot: Sequence[str]
) -> Iterator[Pair]:
    """Both at work on free ports, the robot armed.

    Args:
        folder: Takes what they say, and the pool's file.
        vehicle: Name or file.
        goal: As `finssim run` takes it.
        pool: Further words of `finssim pool`.
        robot: Further words of `finssim run`.

    Raises:
        ReliabilityError: The pool never stood.
    """
    port, peer = free_ports()
    end, both = f"127.0.0.1:{peer}", ["--vehicle", vehicle, "--pool-file", str(folder / "pool.yaml")]
    world = ["pool", *both, "--port", str(port), "--robot", end, *pool]
    ours = ["run", *both, "--goal", goal, "--arm", "--json", "--bind", end, *robot]
    wires = ["--robot", f"udp://127.0.0.1:{port}", "--pictures", f"udp://127.0.0.1:{port + 1}"]
    with Process(world, folder, "pool") as first:
        silent = "the pool never said 'pictures: '"
        _await(
            lambda: "pictures: " in first.said,
            10.0 * POLL,
            lambda: first.running,
            lambda: f"{silent}: {first.complained.strip()[-300:] or 'no error'}",
        )
        with Process([*ours, *wires], folder, "robot") as second:
            yield Pair(first, second, port)


def _await(
    ready: Callable[[], bool], poll: float, running: Callable[[], bool], failure: Callable[[], str]
) -> None:
    """Wait for something.

    Args:
        ready: Whether it has come about.
        poll: Between looks [s].
        running: Whether it still can.
        failure: What is raised if it does not, or takes too long.

    Raises:
        ReliabilityError: It did not come about.
    """
    deadline = time.monotonic() + STARTING
    while not ready():
        if not running() or time.monotonic() > deadline:
            raise ReliabilityError(failure())
        time.sleep(poll)


def await_thrust(truth: Path, bound: float, process: Process) -> None:
    """Wait until the thrusters of a pool turn, as its truth file tells.

    Raises:
        ReliabilityError: They never do, or the process that should turn them has ended.
    """

    def turning() -> bool:
        try:
            return bool(abs(read_truth(truth).thrust[-50:]).max(initial=0.0) > bound)
        except TruthError:
            return False  # not begun yet

    def failure() -> str:
        why = (process.complained + process.said).strip()[-300:] or "it said nothing"
        return f"no thruster ever turned: {process.name}: {why}"

    _await(turning, 20.0 * POLL, lambda: process.running, failure)


def await_flush(truth: Path) -> float:
    """Wait for the next piece of a truth file that grows; returns the pool's clock then [s].

    The pool writes half a second at a time, so that the last record is as old as one look takes.
    """
    size = truth.stat().st_size
    still = f"{truth} does not grow: the pool stands still"
    _await(lambda: truth.stat().st_size > size, POLL, lambda: True, lambda: still)
    return float(read_truth(truth).time[-1])


def free_ports() -> tuple[int, int]:
    """Ports of the pool's and of the robot's end; the two after the first and the one after the second are free too."""
    for _ in range(100):
        with ExitStack() as stack:
            probes = [
                stack.enter_context(socket.socket(socket.AF_INET, kind))
                for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM) * 6
            ]
            try:
                probes[0].bind(("127.0.0.1", 0))
                first: int = probes[0].getsockname()[1]
                for k, probe in enumerate(probes[1:], start=1):
                    probe.bind(("127.0.0.1", first + k // 2))
            except (OSError, OverflowError):
                continue
            return first, first + 4
    raise ReliabilityError("no six free ports in a row on this machine: end some programs")


# `finssim experiment soak`: the robot's whole software at work for hours of vehicle time, its memory watched.


Array = NDArray[np.float64]

SAMPLED = 10.0
"""Vehicle time between two samples [s]."""
WARM = 0.25
"""The first part of a run does not count: caches fill [-]."""
FLAT = 1.0
"""Memory is flat if it grows by less in an hour of vehicle time [MiB/h]; 20 MiB in 20 hours."""
GOAL = "0,0,-0.5,0"
HEADS = ("vehicle_s", "wall_s", "memory_mib", "error_m", "state")


def soak(
    *,
    out: Path,
    hours: Annotated[float, (0.001, None)] = 20.0,
    seed: int = 1,
    severity: str = "realistic",
    vehicle: str = "finsrov",
    progress: Progress = lambda part, what: None,
) -> dict[str, Any]:
    """Keep a station for hours in lock-step and watch the memory [MiB]. Ctrl-C ends it with what is known until then.

    Exit status 3: the memory grew, or the bridge stopped the vehicle.

    Example: finssim experiment soak --hours 20 --out soak

    Args:
        out (DIR): Directory for the result and the samples.
        hours: Vehicle time to keep a station [h].
        seed: Seed of every random number; equal seeds give equal results.
        severity (WORD): How far the pools are from the vehicle file: nominal, realistic or hard.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        progress: Told the share that is done and how it goes.

    Returns:
        What `soak.json` holds: `verdict`, `slope_mib_per_h`, first and last memory [MiB], errors [m], and totals.
    """
    duration, folder = 3600.0 * hours, Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    body, station = load_vehicle(vehicle), station_of(GOAL)
    plan = make_plan(body, str(seed), severity, camera="corners", seed=seed)  # type: ignore[arg-type]
    pool, site = plan.standing(station, seed=seed), plan.calibrated
    runtime = Runtime(body, site, make_pilot("pid", body), station, arm=True)
    began = time.perf_counter()
    samples: list[tuple[float, ...]] = []
    with (folder / "soak.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(HEADS)

        def sample(runtime: Runtime) -> None:
            """A row of the table for every so much of vehicle time."""
            if pool.time < len(samples) * SAMPLED:
                return
            error = float(np.linalg.norm(pool.plant.position - runtime.guide.at(0.0).position))
            row = (pool.time, time.perf_counter() - began, memory_mib(), error)
            samples.append(row)
            writer.writerow([*(f"{value:.4f}" for value in row), runtime.bridge.state])
            file.flush()
            text = f"{row[0] / 3600.0:.2f} h, {row[2]:.1f} MiB, {runtime.bridge.state}"
            progress(min(pool.time / duration, 1.0), text)

        run_lockstep(
            runtime, pool, duration, gentle=True, show=sample, until=lambda r: r.bridge.state == "fault"
        )
    took = time.perf_counter() - began
    rows = np.array(samples, float)
    result = {
        "experiment": "soak",
        "vehicle_h": pool.time / 3600.0,
        "wall_s": took,
        "times_real_time": pool.time / took,
        **verdict(rows[:, 0], rows[:, 2]),
        "error_rms_m": float(np.sqrt(np.mean(rows[1:, 3] ** 2))) if len(rows) > 1 else None,
        "error_max_m": float(rows[1:, 3].max()) if len(rows) > 1 else None,
        "faults": [event.text for event in runtime.counters.events if event.kind == "fault"],
        "missed_decisions": runtime.counters.missed,
        "decisions": runtime.counters.decisions,
        "fixes": runtime.counters.fixes,
        "severity": severity,
        "seed": seed,
        "provenance": provenance(),
    }
    result["ok"] = result["verdict"] != "grows" and not result["faults"]
    write_json(folder / "soak.json", result)
    return result


def verdict(vehicle_s: Array, memory: Array) -> dict[str, Any]:
    """Whether memory is flat: its slope over all but the warm-up, by least squares.

    Args:
        vehicle_s: Time of each sample [s], (k,).
        memory: [MiB], (k,).

    Returns:
        `verdict`: flat, grows, or too short to tell; `slope_mib_per_h`, None if too short; `first_mib`, `last_mib`.
    """
    kept = vehicle_s >= vehicle_s[-1] * WARM
    ends = {"first_mib": float(memory[0]), "last_mib": float(memory[-1])}
    if kept.sum() < 10:
        return {"verdict": "too short to tell", "slope_mib_per_h": None, **ends}
    slope = 3600.0 * float(np.polyfit(vehicle_s[kept], memory[kept], 1)[0])
    return {"verdict": "flat" if slope < FLAT else "grows", "slope_mib_per_h": slope, **ends}


def memory_mib() -> float:
    """Memory of this process that is in use now [MiB]; the most it ever was where the system tells no more."""
    try:
        # Not statm, which on a machine of many processors may be tens of MiB behind.
        told = Path("/proc/self/smaps_rollup").read_text(encoding="ascii")
        return int(re.search(r"^Rss:\s+(\d+) kB", told, re.MULTILINE)[1]) / 1024.0  # type: ignore[index]
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def _soak_lines(result: Mapping[str, Any]) -> list[str]:
    slope = result["slope_mib_per_h"]
    grown = "" if slope is None else f", {slope:+.2f} MiB per hour of vehicle time"
    rms = result["error_rms_m"]
    return [
        f"{result['vehicle_h']:.2f} h of vehicle time in {result['wall_s'] / 60.0:.1f} min, "
        f"{result['times_real_time']:.1f} times real time",
        f"memory: {result['verdict']}{grown}; {result['first_mib']:.1f} MiB at the start, "
        f"{result['last_mib']:.1f} at the end",
        f"off the station: rms {math.nan if rms is None else 100.0 * rms:.1f} cm; "
        f"faults: {'; '.join(result['faults']) or 'none'}; "
        f"decisions missed: {result['missed_decisions']} of {result['decisions']}",
    ]


# `finssim experiment timing`: does the robot keep its times on this machine, and how fast does lock-step go?


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
    progress: Progress = lambda part, what: None,
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
        progress: Told the share that is done and what comes next.

    Returns:
        What `timing.json` holds: `realtime` (what the robot told at the end, and what the pool said), `lockstep` (times
        real time by camera), `reached` (each figure against its limit).

    Raises:
        ReliabilityError: An unknown camera, or a process that did not start or end.
    """
    check_choices([camera], CAMERAS, "camera", ReliabilityError)
    lockstep = {}
    for k, mode in enumerate(CAMERAS):
        progress(0.1 * k, f"lock-step, {mode}")
        lockstep[mode] = lockstep_speed(vehicle, mode, seed=seed, policy=policy)  # type: ignore[arg-type]
    realtime = _realtime(60.0 * minutes, camera, policy, seed, vehicle, progress)
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
    plan = make_plan(body, str(seed), "realistic", camera=camera, seed=seed)
    pool, site = plan.standing(station, seed=seed), plan.calibrated
    runtime = Runtime(body, site, make_pilot(policy, body), station, arm=True)
    run_lockstep(runtime, pool, WARM_UP)
    before, began = pool.time, time.perf_counter()
    run_lockstep(runtime, pool, duration or TRIED[camera], start=before)
    return (pool.time - before) / (time.perf_counter() - began)


def _realtime(
    seconds: float, camera: str, policy: str, seed: int, vehicle: str, progress: Progress
) -> dict[str, Any]:
    world = ["--plant", str(seed), "--camera", camera]
    ours = ["--policy", policy, "--duration", str(seconds)]
    with (
        tempfile.TemporaryDirectory() as folder,
        pair(Path(folder), vehicle, STATION, pool=world, robot=ours) as both,
    ):
        robot = both.robot
        _wait(robot, seconds, progress)
        if robot.running or not robot.said:
            raise ReliabilityError(f"the robot did not end: {robot.complained.strip()[-300:]}")
        robot.end()
        both.pool.end()
        return {"robot": json.loads(robot.said), "pool": both.pool.said.splitlines()}


def _wait(robot: Process, seconds: float, progress: Progress) -> None:
    began = time.monotonic()
    while robot.running and (passed := time.monotonic() - began) < seconds + PATIENCE:
        progress(0.2 + 0.8 * min(passed / seconds, 1.0), f"real time: {passed / 60.0:.1f} min")
        time.sleep(0.5)


def _timing_lines(result: Mapping[str, Any]) -> list[str]:
    told, reached = result["realtime"]["robot"], result["reached"]
    latency = told["latency_s"]
    ms = ", ".join(f"{name} {1e3 * value:.0f} ms" for name, value in latency.items() if value is not None)
    return [
        f"real time, {result['camera']}, {result['minutes']:g} min, {result['processors']} processors, "
        f"load {result['load']:.1f} before: ended {told['state']}{': ' + told['reason'] if told['reason'] else ''}",
        f"decisions missed: {told['missed']} of {told['decisions'] + told['missed']}; "
        f"late steps: {told['overruns']} of {told['steps']}",
        f"picture to command: {ms or 'no picture'}",
        *(f"lock-step, {mode}: {speed:.1f} times real time" for mode, speed in result["lockstep"].items()),
        "; ".join(f"{what}: {'reached' if good else 'not reached'}" for what, good in reached.items()),
    ]


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """What came out of either, in sentences."""
    lines = _soak_lines if result["experiment"] == "soak" else _timing_lines
    return [Table(title=str(result["experiment"]), sentences=lines(result))]
