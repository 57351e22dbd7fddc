"""`finssim run`: assemble a robot, or a team's, run it on its wires or in lock-step, and report the result."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.agents.controllers import CONTROLLERS
from finssim.control import ControlError
from finssim.control.guidance import Guide, Station
from finssim.control.policy import read_description
from finssim.core.rotations import quat_yaw, wrap_angle
from finssim.core.system import PARENT, SEPARATE, follow_parent, interrupt
from finssim.localization.overhead_camera import Pool, load_pool
from finssim.robot.goals import HeardGoal, check_reachable, guide_of, place_of
from finssim.robot.interrupt import interruptible
from finssim.robot.links.transports import host_port
from finssim.robot.perception import Perception
from finssim.robot.pilots import Pilot, make_pilot
from finssim.robot.recorder import Recorder, recording
from finssim.robot.runtime import USED, Runtime
from finssim.robot.team import Team
from finssim.robot.wiring import POOL_ADDRESS, RobotDriver, Wiring, connected
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import numbered, vehicle_at

if TYPE_CHECKING:
    from finssim.identification.adaptation import Follower

__all__ = [
    "APART",
    "FAULT",
    "POOL_ADDRESS",
    "UNHEARD",
    "Localization",
    "Mission",
    "run",
    "run_alone",
    "run_team",
]


# Results of a run for the user: error to the goal, reasons of a stop, and timing.


LAST = 20.0
"""Time at the end of a run over which errors are evaluated [s]."""
EVERY = 0.1
"""Time between two errors [s]."""
UPDATE = 1.0
"""Time between two updates of the status line on the terminal [s]."""
AFTERWARDS = 2.0
"""Time for which the end of a trajectory is held before the run ends [s]."""
MUTE = 3.0
"""Silence of a vehicle after which it is reported [s]."""


class _Monitor:
    """Observer that checks a runtime after every step, determines when the run is over, and reports at the end.

    Note:
        Errors are those of the estimate, the only state available on a robot: relative to the guide's current pose, or
        to the path of a path task.
    """

    def __init__(self, runtime: Runtime, duration: float | None, robot: str, console: Console) -> None:
        self.state = runtime.bridge.state
        """State of the bridge, before the run is ended."""
        follows = duration is None and math.isfinite(runtime.guide.duration)
        self._end = runtime.guide.duration + AFTERWARDS if follows else math.inf
        self._robot, self._console = robot, console
        self._errors: deque[tuple[float, float]] = deque(maxlen=round(LAST / EVERY))
        self._next = self._spoken = -math.inf
        self._mute_at = math.nan
        self.status: Any = None
        """Status line on the terminal, if there is one."""

    def look(self, runtime: Runtime) -> None:
        """Store state and errors, and update the status line."""
        self.state = runtime.bridge.state
        reading = runtime.reading
        if reading is None:
            return
        now = reading.time
        located = not math.isnan(runtime.started) and reading.ready and runtime.guide is not _SEEN
        if located and now >= self._next:
            self._next = now + EVERY - 1e-6
            goal = runtime.guide.at(runtime.t)
            observer = getattr(runtime.pilot, "observer", None)
            distance, yaw = getattr(observer, "beside", None) or (
                float(np.linalg.norm(reading.position - goal.position)), float(goal.yaw)
            )  # fmt: skip
            self._errors.append((distance, float(wrap_angle(quat_yaw(reading.quaternion) - yaw))))
        self._mute_at = now + MUTE if math.isnan(self._mute_at) else self._mute_at
        if now >= self._mute_at and not runtime.counters.telemetry:
            self._mute_at = math.inf
            self._console.print(
                f"no telemetry from {self._robot} yet: is it on, and does it know this end's address?",
                markup=False,
            )
        if self.status is not None and now - self._spoken >= UPDATE:
            self._spoken = now
            reason = runtime.bridge.reason or reading.reason or runtime.refusal
            self.status.update(f"{self.state}{f' ({reason})' if reason else ''}: {self._newest}")

    def over(self, runtime: Runtime) -> bool:
        """Return whether the run is over."""
        return self.state == "fault" or runtime.t > self._end

    @property
    def _newest(self) -> str:
        """Text of the latest error."""
        if not self._errors:
            return "no error to a goal is known"
        distance, turn = self._errors[-1]
        return f"{100.0 * distance:.1f} cm and {math.degrees(turn):+.1f} deg off"

    def report(self, runtime: Runtime, duration: float) -> dict[str, Any]:
        """Return the results as plain data, after a run of a duration [s]."""
        rms = np.sqrt(np.mean(np.square(self._errors), axis=0)) if self._errors else (None, None)
        faults = [event.text for event in runtime.counters.events if event.kind == "fault"]
        return {
            "state": self.state,
            "reason": runtime.bridge.reason or runtime.refusal or _waiting(runtime),
            "duration_s": duration,
            "goal": runtime.guide.name,
            "pilot": runtime.pilot.describe(),
            "position_rms_m": None if rms[0] is None else float(rms[0]),
            "yaw_rms_deg": None if rms[1] is None else math.degrees(rms[1]),
            "faults": faults,
            "samples": runtime.perception.health().counts,
            **runtime.counters.summary(),
        }


def _waiting(runtime: Runtime) -> str:
    """Return what a run that never started was waiting for; empty for one that did start."""
    began = not math.isnan(runtime.started)
    return "" if began or runtime.reading is None else runtime.reading.reason


AIDS = {"vision": "position fixes", "velocity": "velocities", "heading": "compass headings"}
"""Streams of the filter that a site may have instead of pictures -> names of their samples."""


def _used(report: Mapping[str, Any]) -> dict[str, str]:
    """Return how many pictures, or samples of other streams, were used for the state."""
    rows = {}
    for stream, name in AIDS.items():
        verdicts = report["samples"].get(stream)
        if verdicts and not (stream == "vision" and report["pictures"]):
            used = sum(n for verdict, n in verdicts.items() if verdict in USED)
            rows[f"{name} used"] = f"{used} of {sum(verdicts.values())}"
    pictures = {"pictures used": f"{report['fixes']} of {report['pictures']}"}
    return pictures | rows if report["pictures"] else rows or pictures


def show(report: dict[str, Any], console: Console) -> None:
    """Print the result of `_Monitor.report` as a table."""
    table = Table(show_header=False, box=None)
    latency = report["latency_s"]
    position, yaw = report["position_rms_m"], report["yaw_rms_deg"]
    off = "no error to a goal is known" if position is None else f"{100.0 * position:.1f} cm, {yaw:.2f} deg"
    rows = {
        "state": report["state"] + (f": {report['reason']}" if report["reason"] else ""),
        "time": f"{report['duration_s']:.1f} s",
        f"off the goal, rms of the last {LAST:g} s": off,
        **_used(report),
        "decisions missed": f"{report['missed']} of {report['decisions'] + report['missed']}",
        "late steps": f"{report['overruns']} of {report['steps']}",
        "picture to command": "no picture"
        if latency["p50"] is None
        else f"{1e3 * latency['p50']:.0f} ms, 99 % within {1e3 * latency['p99']:.0f} ms",
        "faults": "; ".join(report["faults"]) or "none",
    }
    if "onboard" in report:
        rows["own sensors"] = ", ".join(f"{name} {count}" for name, count in report["onboard"].items())
    if "exposure_to_command_s" in report:
        figures_of_pictures, decided = report["exposure_to_command_s"], report["inference_s"]
        rows["exposure to command"] = (
            f"{1e3 * figures_of_pictures['p50']:.0f} ms, 99 % within {1e3 * figures_of_pictures['p99']:.0f} ms"
        )
        rows["inference"] = f"{1e3 * decided['p50']:.1f} ms, 99 % within {1e3 * decided['p99']:.1f} ms"
    for name, change in report.get("changes", {}).items():
        if change["identifiable"]:
            low, high = change["ci95"]
            rows[f"changed: {name}"] = f"{change['estimate']:.3g} [{low:.3g}, {high:.3g}] {change['unit']}"
    for name, value in rows.items():
        table.add_row(name, Text(value))
    console.print(table)


@dataclass(frozen=True, kw_only=True)
class Mission:
    """Controller of a run, and its goal."""

    policy: str | None = None
    """(DIR|NAME) A policy's directory, pid or pid-paper, or with --task one of the task's baselines."""
    task: str | None = None
    """(TASK) Task that the policy must have been trained for, by name (see finssim tasks) or FILE.py:CLASS; the
    policy's if not given."""
    agent: str | None = None
    """(NAME) This vehicle's agent in a task with several; the first if not given."""
    goal: str | None = None
    """(X,Y,Z,YAW|FILE) Station to keep: x,y,z [m] in the world frame (z = 0 at the surface, negative below) and heading
    [deg], or a file with goal: [x, y, z, yaw_deg]."""
    trajectory: str | None = None
    """(NAME|FILE) Trajectory to follow instead of a goal: straight, broken, ellipse, lemniscate, circle, figure_eight,
    helix, or a file."""
    team: str | None = None
    """(DIR|NAME) Policy or baseline for all agents of a task, instead of --policy, each in its own process. Their ports
    are those of --robot and --bind, plus ten for each further agent. An address is used as --messages."""
    duration: Annotated[float | None, (0.0, None)] = None
    """Duration [s]; until the end of the trajectory or Ctrl-C if not given."""


@dataclass(frozen=True, kw_only=True)
class Localization:
    """Vehicle of a run, and its localization."""

    vehicle: str = "finsrov"
    """(NAME|FILE) Vehicle in the catalogue, or path of a vehicle file."""
    pool_file: str | None = None
    """(FILE|none) Pool file: camera, water plane and frames (.yaml); none without a camera. Default: pool.yaml, with
    --team none."""
    site: str | None = None
    """(NAME) Site: pool, tank or open-water. It sets the workspace, and in open water DVL and compass, as in finssim
    pool --site. Default: pool, with --team open-water."""
    number: Annotated[int, (0, 1000)] = 0
    """This vehicle's index among several under one camera, which offsets its tag ids."""
    let_in: str | None = None
    """(X,Y) Position at the start, world frame [m], known to 5 cm: for dead reckoning by DVL and compass, without
    camera and position fixes."""
    estimator: str | None = None
    """(NAME) Estimator: error-state, which uses the IMU's accelerations (default on a vehicle with an IMU), or
    constant-velocity."""

    def pool(self) -> tuple[Path, Pool] | tuple[None, None]:
        """Return the pool file and its content; None twice without a camera.

        Raises:
            ControlError: There is no pool file.
        """
        if self.pool_file == "none":
            return None, None
        if self.pool_file is None and not Path("pool.yaml").exists():
            raise ControlError(
                "there is no pool.yaml in this folder: name the pool file that finssim pool or calibrate pool has "
                "written with --pool-file, or give --pool-file none without a camera"
            )
        file = Path(self.pool_file or "pool.yaml")
        return file, load_pool(file)


# `finssim run --team POLICY`: a separate stack for every agent of a task, each in its own process.


APART = 10
"""Distance between the ports of two consecutive vehicles of a team."""
MESSAGES = 5
"""Distance of the port of a team's messages from the first vehicle's port."""
POLL = 0.05
"""Time between two checks whether the processes have ended [s]."""


class TeamOutcome(NamedTuple):
    """Outcome of a team's run."""

    reports: dict[str, Any]
    """Agent -> result of its run; None where it did not run."""
    status: int
    """Greatest exit status of the agents' processes."""


def run_team(
    mission: Mission, wiring: Wiring, localization: Localization, *, record: Path | None, arm: bool
) -> TeamOutcome:
    """Run every agent of a task in its own process; the others continue if one ends.

    Args:
        mission: Mission, whose `team` is the policy's directory, or a baseline of the task, for all.
        wiring: Connection of the first agent; the ports of each further one are ten higher. The relay of messages is
            five ports after `robot` unless it is given.
        localization: Vehicle and its localization; open water without a camera by default.
        record: Folder for AGENT.mcap of each; nothing is recorded if None.
        arm: Arm as soon as the state is known.

    Raises:
        ControlError, PolicyError, LinkError: Policy, task, vehicle and addresses do not fit.
    """
    from finssim.tasks.observer import fitted_task

    of_one = (mission.agent, mission.trajectory, localization.let_in)
    if any(x is not None for x in of_one) or wiring.lockstep or localization.number:
        raise ControlError(
            "--team starts every agent: leave --agent, --trajectory, --lockstep, --number and --let-in out"
        )
    policy, vehicle, robot = str(mission.team), localization.vehicle, wiring.robot
    task = mission.task or (read_description(Path(policy)).task if Path(policy).is_dir() else None)
    if task is None:
        raise ControlError(f"--team {policy} is a baseline: give its task with --task")
    agents = fitted_task(task, load_vehicle(vehicle)).agents
    if len(agents) < 2:
        raise ControlError(f"task '{task}' has one agent: run it with --policy {policy}, and --messages")
    kind, _, address = (POOL_ADDRESS if robot == "pool" else robot).rpartition("//")
    if kind not in ("", "udp:"):
        raise ControlError(
            f"--robot {robot}: a team's motor controllers are at udp://HOST:PORT, ten ports from each other"
        )
    (theirs, port), (host, own_port) = host_port(address, "--robot"), host_port(wiring.bind, "--bind")
    options = {
        "--policy": policy,
        "--task": task,
        "--vehicle": vehicle,
        "--messages": wiring.messages or f"{theirs}:{port + MESSAGES}",
        "--site": localization.site or "open-water",
        "--pool-file": localization.pool_file or "none",
        "--goal": mission.goal,
        "--estimator": localization.estimator,
        "--duration": mission.duration,
    }
    alike = [word for name, x in options.items() if x is not None for word in (name, str(x))]
    alike += ["--json", *(["--arm"] if arm else [])]
    children: dict[str, subprocess.Popen[str]] = {}
    environment = {**os.environ, PARENT: str(os.getpid())}
    with interruptible() as interrupted:
        try:
            for i, agent in enumerate(agents):
                further = APART * i
                ends = [
                    "--robot",
                    f"udp://{theirs}:{port + further}",
                    "--bind",
                    f"{host}:{own_port + further}",
                ]
                context = [] if record is None else ["--record", str(record / f"{agent}.mcap")]
                children[agent] = subprocess.Popen(
                    [sys.executable, "-m", "finssim", "run", "--agent", agent, *ends, *context, *alike],
                    env=environment,
                    stdout=subprocess.PIPE,
                    encoding="utf-8",
                    **SEPARATE,  # Ctrl-C reaches only this process, which passes it on once
                )
            while not interrupted() and any(child.poll() is None for child in children.values()):
                time.sleep(POLL)
        finally:
            for child in children.values():
                if child.poll() is None:
                    interrupt(child)
            texts = {agent: child.communicate()[0] for agent, child in children.items()}
    reports = {agent: json.loads(text) if text.strip() else None for agent, text in texts.items()}
    return TeamOutcome(reports, max(abs(child.returncode) for child in children.values()))


def _print_results(report: dict[str, Any], as_json: bool) -> None:
    """Print the result of each agent."""
    if as_json:
        print(json.dumps(report))
        return
    console = Console()
    for agent, result in report.items():
        console.print(agent if result is not None else f"{agent}: did not run, see above", highlight=False)
        if result is not None:
            show(result, console)


FAULT = 3
"""Exit status of a run that ended in a fault of the vehicle."""
UNHEARD = 4
"""Exit status of a run in which the vehicle sent nothing."""
_GO = Station((0.0, 0.0, 0.0), 0.0, name="team")
"""Guide of a vehicle whose only references are the other vehicles."""
_SEEN = Station((0.0, 0.0, 0.0), 0.0, name="sight")
"""Guide of a vehicle whose only references are its pictures."""


def run(
    mission: Annotated[Mission, "options"],
    wiring: Annotated[Wiring, "options"],
    localization: Annotated[Localization, "options"],
    *,
    record: Path | None = None,
    identify: Path | None = None,
    arm: bool = False,
    as_json: bool = False,
) -> int:
    """Run a controller on a vehicle: estimate, decide, command; print a summary. Ctrl-C stops the thrusters.

    Exit status 3: the run ended in a fault of the vehicle; 4: the vehicle sent nothing.

    Example: finssim run --policy runs/hold --goal 0.5,0,-0.5,90 --pool-file pool.yaml --duration 60 --arm

    Example: finssim run --team runs/team --duration 60 --arm

    Args:
        mission: Controller and its goal.
        wiring: Connection of the robot.
        localization: Vehicle and its localization.
        record (FILE): Record everything to this file (.mcap); with --team a folder with a file for each.
        identify (FILE): Estimate during the run what has changed on the vehicle (payload, drag, thrusters), print it,
            and write the vehicle with these changes (.yaml).
        arm: Arm as soon as the state is known. Without it the thrusters never turn.
        as_json: Print one JSON object instead of tables.

    Raises:
        ControlError, PolicyError, GoalError, VehicleError, LinkError, OutputError: An input cannot be used.
    """
    follow_parent()
    if _is_address(mission.team or ""):
        mission, wiring = replace(mission, team=None), replace(wiring, messages=str(mission.team))
    if (mission.policy is None) == (mission.team is None):
        raise ControlError(
            "no controller: give --policy for this vehicle, or --team for all agents of a task"
        )
    if mission.team is not None:
        if identify is not None:
            raise ControlError("--identify is for one vehicle: run each agent with --policy and --agent")
        outcome = run_team(mission, wiring, localization, record=record, arm=arm)
        _print_results(outcome.reports, as_json)
        return outcome.status
    report = run_alone(mission, wiring, localization, record=record, identify=identify, arm=arm)
    if as_json:
        print(json.dumps(report))
    else:
        show(report, Console())
    if report["state"] == "fault":
        return FAULT
    return UNHEARD if report["steps"] and not report["telemetry"] else 0


def run_alone(
    mission: Mission,
    wiring: Wiring,
    localization: Localization,
    *,
    record: Path | None,
    arm: bool,
    identify: Path | None = None,
) -> dict[str, Any]:
    """Run one vehicle; return the result as plain data. See `run` for arguments and errors."""
    assert mission.policy is not None
    console, site = Console(stderr=True), localization.site or "pool"
    file, pool = localization.pool()
    filed = load_vehicle(localization.vehicle)
    navigation = wiring.robot.startswith("mavlink")
    ours = numbered(vehicle_at(site, filed, navigation=navigation), localization.number)
    pilot = _pilot(mission, filed)
    guide = _guide(mission, wiring, pilot, ours)
    sees = getattr(pilot, "pictures", {})
    if defaults := [name for name in ours.defaults if sees or name != "perception"]:
        console.print(
            f"{ours.name}: {', '.join(defaults)} are defaults, fit for the virtual world; give a real vehicle "
            "its own in the file",
            highlight=False,
            markup=False,
        )
    follower = None if identify is None else _follower(filed, identify)
    let_in = None if localization.let_in is None else place_of(localization.let_in)
    perception = Perception(ours, pool, mode=localization.estimator, let_in=let_in)
    team = _team(pilot, wiring)
    heard = HeardGoal(team.tracks) if team is not None and guide is _GO and _alone(pilot) else None
    guide = heard or guide
    meta = {
        "command": "finssim run",
        "site": site,
        "pilot": pilot.describe(),
        "guide": guide.name,
        "armed": arm,
    }
    meta |= {"pool_sha256": pool.sha256} if pool else {}
    context = recording(record, filed, meta, pool_file=file, lockstep=wiring.lockstep)
    with _opened(connected(wiring, ours, pool), context) as (drive, recorder):
        if not arm:
            console.print("dry run: thrusters will not turn without --arm")
        runtime = Runtime(ours, perception, pilot, guide, arm=arm, recorder=recorder, team=team)
        monitor = _Monitor(runtime, mission.duration, wiring.robot, console)

        def look(runtime: Runtime) -> None:
            if heard is not None:
                heard.started = runtime.started
            reading = runtime.reading
            if (
                follower is not None
                and reading is not None
                and reading.ready
                and runtime.bridge.state == "armed"
            ):
                follower.add(
                    reading.time, reading.nu, reading.quaternion, reading.position, runtime.bridge.force
                )
            monitor.look(runtime)

        line = console.status("waiting for the vehicle", refresh_per_second=2.0)
        with line if console.is_terminal else nullcontext() as monitor.status:
            longest = math.inf if mission.duration is None else mission.duration
            took = drive(runtime, duration=longest, show=look, until=monitor.over)
    report = monitor.report(runtime, took)
    if follower is not None and identify is not None:
        from finssim.identification.vehicle_file import write_vehicle

        adaptation = follower.finish()
        report |= adaptation.as_json()
        if adaptation.windows:
            write_vehicle(adaptation.adapted, identify)
        else:
            console.print(f"{identify}: not written, the vehicle was not armed for 10 s", highlight=False)
    return report


def _follower(vehicle: Vehicle, out: Path) -> Follower:
    """Return the estimator of changes on a vehicle, ready to start; refuse a file that cannot be written."""
    from finssim.identification.adaptation import Follower
    from finssim.identification.report import refuse_places

    refuse_places(out, None, "vehicle")
    return Follower(vehicle)


def _guide(mission: Mission, wiring: Wiring, pilot: Pilot, vehicle: Vehicle) -> Guide:
    """Return the pilot's guide: a goal, a trajectory, the others of its team, or its pictures."""
    if mission.goal is None and mission.trajectory is None:
        if wiring.messages:
            return _GO
        if getattr(pilot, "pictures", {}):
            return _SEEN
    guide = guide_of(mission.goal, mission.trajectory)
    check_reachable(guide, vehicle)
    return guide


def _is_address(text: str) -> bool:
    """Return whether a text is HOST:PORT."""
    host, _, port = text.rpartition(":")
    return bool(host) and port.isdecimal()


def _pilot(mission: Mission, vehicle: Vehicle) -> Pilot:
    """Return the pilot; a PID that follows a trajectory is that of T2."""
    policy, task = str(mission.policy), mission.task
    if task is not None:
        from finssim.tasks.observer import fitted_task

        fitted_task(task, vehicle)  # refuses an unknown task, or one that does not fit this vehicle
    if policy in CONTROLLERS:
        task = task or ("t2" if mission.trajectory is not None else None)
    return make_pilot(policy, vehicle, task=task, agent=mission.agent)


def _alone(pilot: Pilot) -> bool:
    """Return whether the pilot's task has one vehicle."""
    observer = getattr(pilot, "observer", None)
    return observer is not None and len(observer.task.vehicles) == 1


def _team(pilot: Pilot, wiring: Wiring) -> Team | None:
    """Return this vehicle's message exchange with its team; None without messages.

    Raises:
        ControlError: `--messages` is given, but the pilot's task has one vehicle and a fixed goal.
    """
    observer = getattr(pilot, "observer", None)
    names = observer.task.vehicles if observer is not None else ()
    if not wiring.messages:
        return None
    if observer is None or (_alone(pilot) and not observer.task.moving):
        raise ControlError(
            "--messages is for a policy or baseline of a task of several vehicles, or whose goal moves: give it with "
            "--task"
        )
    talk = getattr(observer.task, "communication", None)
    period = observer.task.control_step if talk is None else talk.period
    others = (*(name for name in names if name != observer.agent), *observer.targets)
    others = ("target",) if _alone(pilot) else others
    return Team(observer.agent, others, period=period, turn=period * names.index(observer.agent) / len(names))


@contextmanager
def _opened(
    link: AbstractContextManager[RobotDriver], record: AbstractContextManager[Recorder | None]
) -> Iterator[tuple[RobotDriver, Recorder | None]]:
    """Yield the connection of the robot, and a record; the record is deleted if the robot could not be connected."""
    with ExitStack() as stack:
        recorder = stack.enter_context(record)
        try:
            drive = stack.enter_context(link)
        except ValueError:
            if recorder is not None:
                recorder.close()
                recorder.path.unlink()
            raise
        yield drive, recorder
