"""Plays one fault: the robot's whole software in lock-step with a virtual pool, a hand on the wire between them."""

from __future__ import annotations

import math
import tempfile
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.experiments.reliability.catalogue import SCENARIOS
from finssim.experiments.reliability.job import FaultJob
from finssim.experiments.reliability.record_check import check_record
from finssim.experiments.reliability.scenario import Bench, Fault
from finssim.experiments.reliability.verdict import inset, measured, passed
from finssim.experiments.reliability.wire import FaultyWire
from finssim.geometry.rotations import quat_from_yaw
from finssim.pool.camera import PoolCamera
from finssim.pool.draw_plant import draw_plant
from finssim.pool.site import camera_of
from finssim.pool.virtual_pool import VirtualPool
from finssim.provenance import provenance
from finssim.quiet import start_warp
from finssim.robot.bridge import Bridge
from finssim.robot.bridge_settings import BridgeSettings
from finssim.robot.goals import station_of
from finssim.robot.lockstep import run_lockstep
from finssim.robot.pilots import make_pilot
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["MOTIONS", "play"]

Array = NDArray[np.float64]

RATE = 60.0
"""Of the robot's loop [Hz]."""
MOTIONS = {
    "station": ("0,0,-0.5,0", "0,0,-0.5,0", 8.0),
    "moving": ("-1.2,-0.3,-0.5,0", "1.2,0.3,-0.5,60", 3.0),
}
"""Name -> start, goal, and how long after arming the fault comes [s]."""
WATCHED = 10.0
"""How long the vehicle is watched after a fault that stays, and at least after one that passes [s]."""
AFTERWARDS = 4.0
"""How long after a fault that has passed [s]."""
GETTING_READY = 10.0
"""Longest time until the estimator knows where the vehicle is [s]."""


def play(job: FaultJob, path: Path) -> dict[str, Any]:
    """Play a job.

    Args:
        job: Which fault, in what motion, in which pool.
        path: Not used: the record is read, and gone, before this ends.

    Returns:
        The measures of `verdict.measured`; `state` and `reason` of the bridge at the end; `raised`, what broke through,
        or empty; `record_lost_s` and `record_problem`; `ok`.
    """
    start_warp()
    with tempfile.TemporaryDirectory() as folder:
        return _play(job, Path(folder) / "run.mcap")


def _play(job: FaultJob, record: Path) -> dict[str, Any]:
    scenario = SCENARIOS[job.scenario]
    fault, (start, goal, when) = scenario.faults[job.variant], MOTIONS[job.motion]
    vehicle = load_vehicle(job.vehicle)
    box = inset(vehicle.safety.workspace_lower, vehicle.safety.workspace_upper)
    settings = BridgeSettings.of(
        vehicle, **{"workspace_lower": box[0], "workspace_upper": box[1], **scenario.settings}
    )
    pool, known = _pool(vehicle, job, start)
    with Recorder(record, vehicle, {"command": "finssim experiment faults"}) as recorder:
        pilot = make_pilot("pid", vehicle)
        runtime = Runtime(
            vehicle,
            known,
            pilot,
            station_of(goal),
            arm=True,
            bridge=Bridge(vehicle, settings),
            recorder=recorder,
        )
        bench = Bench(pool, FaultyWire(pool, RATE), runtime, recorder)
        script = _Script(bench, fault, when)
        raised = _run(bench, script)
    course = bench.wire.course()
    began = script.began if math.isfinite(script.began) else math.inf
    if math.isinf(began):
        raise RuntimeError(f"{job.key()}: the vehicle was never armed: {runtime.refusal}")
    ended = min(began + fault.lasts, float(course.time[-1]))
    result = {
        **measured(course, began, ended, box),
        "state": script.state,
        "reason": script.reason,
        "raised": raised,
        **check_record(record, script.steps if fault.cuts_record else runtime.counters.steps, RATE),
        "provenance": provenance(),
    }
    return {**result, "ok": passed(result)}


class _Script:
    """Begins and ends the fault, and remembers how the bridge stood before the run was ended."""

    def __init__(self, bench: Bench, fault: Fault, when: float) -> None:
        self._bench, self._fault, self._when = bench, fault, when
        self._armed = self._over = math.nan
        self._ended = False
        self.began = math.nan
        """Pool's clock [s]; NaN before."""
        self.steps = 0
        """Of the robot until the fault."""
        self.state = self.reason = ""

    def look(self, runtime: Runtime) -> None:
        """After every step of the robot."""
        now, fault = self._bench.pool.time, self._fault
        self.state, self.reason = runtime.bridge.state, runtime.bridge.reason
        if math.isnan(self._armed) and not math.isnan(runtime.started):
            self._armed = now
        if math.isnan(self.began) and now >= self._armed + self._when:
            self.began, self.steps = now, runtime.counters.steps
            fault.begin(self._bench)
        elif now >= self.began + fault.lasts and not self._ended:
            self._ended = True
            if fault.end is not None:
                fault.end(self._bench)
        elif now >= self.began and not self._ended and fault.during is not None:
            fault.during(self._bench)

    def over(self, runtime: Runtime) -> bool:
        """Whether enough was seen."""
        lasts = self._fault.lasts
        watched = WATCHED if math.isinf(lasts) else max(WATCHED, lasts + AFTERWARDS)
        return self._bench.pool.time >= self.began + watched


def _pool(vehicle: Vehicle, job: FaultJob, start: str) -> tuple[VirtualPool, Any]:
    """The pool with its camera, and what the robot knows of the camera."""
    true_site, known_site, settings = camera_of(vehicle, job.plant, job.severity)
    seed = zlib.crc32(f"{job.seed} {job.target}".encode()) & 0x7FFFFFFF
    station = station_of(start)
    pool = VirtualPool(
        vehicle,
        draw_plant(vehicle, job.plant, job.severity),
        camera=PoolCamera(vehicle, true_site, mode="corners", settings=settings, seed=seed),
        start=(np.asarray(station.position), quat_from_yaw(station.yaw)),
        seed=seed,
    )
    return pool, known_site


def _run(bench: Bench, script: _Script) -> str:
    """Run to the end; returns what was raised, in this thread or in another, or nothing."""
    with _heard() as raised:
        try:
            longest = GETTING_READY + 60.0
            run_lockstep(bench.runtime, bench.wire, longest, rate=RATE, show=script.look, until=script.over)
        except Exception as error:  # what breaks through is what this experiment looks for
            raised.append(f"{type(error).__name__}: {error}")
        finally:
            bench.recorder.close()
            for undo in bench.undo:
                undo()
            bench.pool.close()
    return "; ".join(raised)


@contextmanager
def _heard() -> Iterator[list[str]]:
    """Collects what threads raise."""
    raised: list[str] = []
    before = threading.excepthook
    threading.excepthook = lambda args: raised.append(f"{args.exc_type.__name__}: {args.exc_value}")
    try:
        yield raised
    finally:
        threading.excepthook = before
