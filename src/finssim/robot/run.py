"""`finssim run`: put a robot together, run it on its wires or in lock-step, and tell how it went."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.control.controllers import CONTROLLERS
from finssim.control.trim import Trim
from finssim.localization.pool import Pool, load_pool
from finssim.robot.goals import check_reachable, guide_of
from finssim.robot.link.transports import DEFAULT_BIND, host_port, open_transport
from finssim.robot.lockstep import DEFAULT_PORT, LockstepClient, run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.picture_source import DEFAULT_CAMERA, NoPictures, open_pictures
from finssim.robot.pilots import make_pilot
from finssim.robot.realtime import run_realtime
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.robot.summary import Summary, show
from finssim.robot.tag_finder import TagFinder
from finssim.vehicles import load_vehicle

__all__ = ["FAULT", "POOL_ADDRESS", "Wiring", "run"]

POOL_ADDRESS = "udp://127.0.0.1:58766"
"""Where the motor controller of a virtual pool on this machine listens."""
FAULT = 3
"""Exit status of a run that ended in a fault of the vehicle."""
AFTERWARDS = 2.0
"""A trajectory's end is held for so long before the run ends [s]."""


@dataclass(frozen=True, kw_only=True)
class Wiring:
    """How the robot is connected."""

    robot: str = "pool"
    """Address of the motor controller, or `pool`."""
    bind: str = DEFAULT_BIND
    """Own end, for UDP; pictures come to the port after it."""
    pictures: str | None = None
    """Address of the camera; that of the virtual pool for `pool`, else none, if None."""
    lockstep: bool = False
    """Take turns with a virtual pool."""


def run(
    policy: str,
    *,
    goal: str | None,
    trajectory: str | None,
    pool_file: Path,
    vehicle: str = "finsrov",
    task: str | None = None,
    wiring: Wiring | None = None,
    record: Path | None = None,
    duration: float | None = None,
    mode: str = "constant-velocity",
    trim: bool = False,
    arm: bool = False,
    as_json: bool = False,
) -> int:
    """Run a robot and print how it went.

    Args:
        policy: A policy's directory, or the name of a PID.
        goal: "x,y,z,yaw_deg" or a file.
        trajectory: Name or file, in place of a goal.
        pool_file: Camera, water and frames.
        vehicle: Name or file.
        task: That the policy must have been trained for.
        wiring: How the robot is connected; to the virtual pool of this machine if None.
        record: File that takes down everything.
        duration: When to end [s]; at the end of a trajectory, or when interrupted, if None.
        mode: Of the estimator.
        trim: Put an integral in front of a policy.
        arm: Let thrusters turn.
        as_json: Print one JSON object.

    Returns:
        Exit status: 0, or `FAULT`.
    """
    wiring, console = wiring or Wiring(), Console(stderr=True)
    ours, guide = load_vehicle(vehicle), guide_of(goal, trajectory)
    check_reachable(guide, ours)
    if task is None and trajectory is not None and policy in CONTROLLERS:
        task = "t2"
    pilot = make_pilot(policy, ours, task=task, trim=Trim() if trim else None)
    pool = load_pool(pool_file)
    perception = Perception(ours, pool, mode=mode)
    if not arm:
        console.print("dry run: thrusters will not turn without --arm")
    meta = {"command": "finssim run", "pilot": pilot.describe(), "guide": guide.name, "armed": arm}
    with _recording(record, ours, {**meta, "pool_sha256": pool.sha256}, pool_file, wiring) as recorder:
        runtime = Runtime(ours, pool, pilot, guide, arm=arm, perception=perception, recorder=recorder)
        summary, watch = Summary(), _Watch(runtime, duration)
        with _progress(console) as say:

            def look(runtime: Runtime) -> None:
                watch.look(runtime)
                summary.look(runtime)
                say(runtime, summary)

            drive = _lockstep if wiring.lockstep else _realtime
            took = drive(runtime, pool, wiring, duration or math.inf, look, watch.over)
    told = summary.tell(runtime, took, watch.state)
    if as_json:
        print(json.dumps(told))
    else:
        show(told, Console())
    return FAULT if watch.state == "fault" else 0


class _Watch:
    """Remembers the state of the bridge while the run lasts, and when the run is over."""

    def __init__(self, runtime: Runtime, duration: float | None) -> None:
        self.state = runtime.bridge.state
        follows = duration is None and math.isfinite(runtime.guide.duration)
        self._end = runtime.guide.duration + AFTERWARDS if follows else math.inf

    def look(self, runtime: Runtime) -> None:
        self.state = runtime.bridge.state

    def over(self, runtime: Runtime) -> bool:
        return self.state == "fault" or runtime.t > self._end


Look = Callable[[Runtime], None]


def _realtime(
    runtime: Runtime,
    pool: Pool,
    wiring: Wiring,
    duration: float,
    look: Look,
    over: Callable[[Runtime], bool],
) -> float:
    """Run on the wires; returns how long [s]."""
    local = wiring.robot == "pool"
    camera = wiring.pictures or (f"udp://{DEFAULT_CAMERA}" if local else "none")
    transport = open_transport(POOL_ADDRESS if local else wiring.robot, wiring.bind)
    host, port = host_port(wiring.bind, "bind")
    pictures = open_pictures(camera, f"{host}:{port + 1 if port else 0}")
    if not isinstance(pictures, NoPictures):
        lens = pool.camera.lens
        pictures = TagFinder(pictures, runtime.vehicle, size=(lens.height, lens.width))
    try:
        return run_realtime(runtime, transport, pictures, duration=duration, show=look, until=over)
    finally:
        transport.close()
        pictures.close()


def _lockstep(
    runtime: Runtime,
    pool: Pool,
    wiring: Wiring,
    duration: float,
    look: Look,
    over: Callable[[Runtime], bool],
) -> float:
    """Take turns with a virtual pool; returns how long [s]."""
    address = f"127.0.0.1:{DEFAULT_PORT}" if wiring.robot == "pool" else wiring.robot.removeprefix("tcp://")
    with LockstepClient(address) as world:
        return run_lockstep(runtime, world, duration, show=look, until=over)


@contextmanager
def _recording(
    path: Path | None, vehicle: Any, meta: dict[str, Any], pool_file: Path, wiring: Wiring
) -> Iterator[Recorder | None]:
    """A recorder for as long as the run lasts, or none."""
    if path is None:
        yield None
        return
    epoch = 0.0 if wiring.lockstep else time.time() - time.monotonic()
    with Recorder(path, vehicle, meta, epoch=epoch, files={"pool.yaml": pool_file}) as recorder:
        yield recorder


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[Runtime, Summary], None]]:
    """Says once a second how it goes, where somebody watches."""
    if not console.is_terminal:
        yield lambda runtime, summary: None
        return
    spoken = -math.inf
    with console.status("waiting for the vehicle", refresh_per_second=2.0) as status:

        def say(runtime: Runtime, summary: Summary) -> None:
            nonlocal spoken
            reading = runtime.reading
            if reading is not None and reading.time - spoken >= 1.0:
                spoken = reading.time
                state = runtime.bridge.state
                why = runtime.bridge.reason or reading.reason or runtime.refusal
                status.update(f"{state}{f' ({why})' if why else ''}: {summary.newest}")

        yield say
