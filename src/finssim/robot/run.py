"""`finssim run`: put a robot together, run it on its wires or in lock-step, and tell how it went."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.control.controllers import CONTROLLERS
from finssim.control.errors import ControlError
from finssim.control.guidance import Station
from finssim.control.trim import Trim
from finssim.localization.pool import load_pool
from finssim.robot.goals import check_reachable, guide_of
from finssim.robot.perception import Perception
from finssim.robot.pilots import Pilot, make_pilot
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.robot.summary import Summary, show
from finssim.robot.team import Team
from finssim.robot.wiring import POOL_ADDRESS, Drive, Wiring, connected
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import numbered, vehicle_at

__all__ = ["FAULT", "POOL_ADDRESS", "UNHEARD", "Wiring", "run"]

FAULT = 3
"""Exit status of a run that ended in a fault of the vehicle."""
UNHEARD = 4
"""Exit status of a run in which the vehicle said nothing."""
_GO = Station((0.0, 0.0, 0.0), 0.0, name="team")
"""The guide of a vehicle that goes by the others alone."""
AFTERWARDS = 2.0
"""A trajectory's end is held for so long before the run ends [s]."""
MUTE = 3.0
"""A vehicle that has said nothing for so long is told of [s]."""


def run(
    policy: str,
    *,
    goal: str | None,
    trajectory: str | None,
    pool_file: Path | None,
    vehicle: str | Vehicle = "finsrov",
    site: str = "pool",
    number: int = 0,
    task: str | None = None,
    agent: str | None = None,
    let_in: Sequence[float] | None = None,
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
        pool_file: Camera, water and frames; None: no camera looks, and the pool frame is the world's.
        vehicle: A vehicle, its name or file, for which a policy must have been trained.
        site: Where it is, by which it is equipped: pool, tank or open-water.
        number: Among several under one camera, by which its tags have other ids.
        task: That the policy must have been trained for, or whose baseline acts.
        agent: Place of this vehicle in a task of several.
        let_in: x, y of where it begins, world frame [m], where nothing else tells; None: something does.
        wiring: How the robot is connected; to the virtual pool of this machine if None.
        record: File that takes down everything.
        duration: When to end [s]; at the end of a trajectory, or when interrupted, if None.
        mode: Of the estimator.
        trim: Put an integral in front of a policy.
        arm: Let thrusters turn.
        as_json: Print one JSON object.

    Returns:
        Exit status: 0, `FAULT` or `UNHEARD`.
    """
    wiring, console = wiring or Wiring(), Console(stderr=True)
    filed = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    ours = numbered(vehicle_at(site, filed), number)
    guide = _GO if wiring.team and goal is None and trajectory is None else guide_of(goal, trajectory)
    if guide is not _GO:
        check_reachable(guide, ours)
    if ours.defaults:
        console.print(
            f"{ours.name}: {', '.join(ours.defaults)} are defaults, fit for the virtual world; give a real vehicle "
            "its own in the file",
            highlight=False,
        )
    pilot = _pilot(policy, filed, task, trim, agent=agent, follows=trajectory is not None)
    pool = None if pool_file is None else load_pool(pool_file)
    perception = Perception(ours, pool, mode=mode, let_in=let_in)
    meta = {
        "command": "finssim run",
        "site": site,
        "pilot": pilot.describe(),
        "guide": guide.name,
        "armed": arm,
    }
    record_with = (
        record,
        filed,
        {**meta, **({"pool_sha256": pool.sha256} if pool else {})},
        pool_file,
        wiring,
    )
    with _opened(connected(wiring, ours, pool), *record_with) as (drive, recorder):
        if not arm:
            console.print("dry run: thrusters will not turn without --arm")
        runtime = Runtime(
            ours,
            pool,
            pilot,
            guide,
            arm=arm,
            perception=perception,
            recorder=recorder,
            team=_team(pilot, wiring),
        )
        watch, summary = _Watch(runtime, duration, wiring.robot, console), Summary()
        with _progress(console) as say:

            def look(runtime: Runtime) -> None:
                watch.look(runtime)
                summary.look(runtime)
                say(runtime, summary)

            longest = math.inf if duration is None else duration
            took = drive(runtime, duration=longest, show=look, until=watch.over)
    told = summary.tell(runtime, took, watch.state)
    if as_json:
        print(json.dumps(told))
    else:
        show(told, Console())
    if watch.state == "fault":
        return FAULT
    return UNHEARD if runtime.counters.steps and not runtime.counters.telemetry else 0


def _pilot(
    policy: str, vehicle: Vehicle, task: str | None, trim: bool, *, agent: str | None, follows: bool
) -> Pilot:
    """Who steers; a PID that follows a trajectory is that of T2."""
    if task is not None:
        from finssim.tasks.observer import fitted_task

        fitted_task(task, vehicle)  # refuses what is no task, or none for this vehicle
    if policy in CONTROLLERS:
        if trim:
            raise ControlError(f"{policy} has an integral of its own: leave --trim out")
        task = task or ("t2" if follows else None)
    return make_pilot(policy, vehicle, task=task, agent=agent, trim=Trim() if trim else None)


def _team(pilot: Pilot, wiring: Wiring) -> Team | None:
    """This vehicle's end of the team's wire; None where it is alone.

    Raises:
        ControlError: The task has one vehicle, or several and no wire between them.
    """
    observer = getattr(pilot, "observer", None)
    names = observer.task.vehicles if observer is not None else ()
    if not wiring.team:
        return None
    if len(names) < 2:
        raise ControlError(
            "--messages is for a policy or baseline of a task of several vehicles: give it with --task"
        )
    talk = getattr(observer.task, "communication", None)
    period = observer.task.control_step if talk is None else talk.period
    others = (*(name for name in names if name != observer.agent), *observer.targets)
    return Team(observer.agent, others, period=period, turn=period * names.index(observer.agent) / len(names))


@contextmanager
def _opened(
    link: AbstractContextManager[Drive], path: Path | None, *about: Any
) -> Iterator[tuple[Drive, Recorder | None]]:
    """What the robot is connected to, and a record; none is left of a run that could not be connected."""
    with ExitStack() as stack:
        recorder = stack.enter_context(_recording(path, *about))
        try:
            drive = stack.enter_context(link)
        except ValueError:
            if recorder is not None:
                recorder.close()
                recorder.path.unlink()
            raise
        yield drive, recorder


class _Watch:
    """Remembers the state of the bridge, and when the run is over; tells of a vehicle that says nothing."""

    def __init__(self, runtime: Runtime, duration: float | None, robot: str, console: Console) -> None:
        self.state = runtime.bridge.state
        follows = duration is None and math.isfinite(runtime.guide.duration)
        self._end = runtime.guide.duration + AFTERWARDS if follows else math.inf
        self._robot, self._console = robot, console
        self._waits_since = math.nan
        self._told = False

    def look(self, runtime: Runtime) -> None:
        self.state = runtime.bridge.state
        if self._told or runtime.counters.telemetry or runtime.reading is None:
            return
        now = runtime.reading.time
        self._waits_since = now if math.isnan(self._waits_since) else self._waits_since
        if now - self._waits_since >= MUTE:
            self._told = True
            self._console.print(
                f"no telemetry from {self._robot} yet: is it on, and does it know this end's address?"
            )

    def over(self, runtime: Runtime) -> bool:
        return self.state == "fault" or runtime.t > self._end


@contextmanager
def _recording(
    path: Path | None, vehicle: Any, meta: dict[str, Any], pool_file: Path | None, wiring: Wiring
) -> Iterator[Recorder | None]:
    """A recorder for as long as the run lasts, or none."""
    if path is None:
        yield None
        return
    epoch = 0.0 if wiring.lockstep else time.time() - time.monotonic()
    with Recorder(
        path, vehicle, meta, epoch=epoch, files={"pool.yaml": pool_file} if pool_file else {}
    ) as recorder:
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
