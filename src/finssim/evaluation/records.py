"""Motion of a vehicle from its record: demonstrations (`finssim collect RECORD.mcap`), or a trial that is
evaluated as in simulation, by the robot's own estimate or by a truth (`finssim evaluate RECORD.mcap`)."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.control.ardusub import Mixer
from finssim.control.guidance import Guide, Station, Track
from finssim.control.modes import AXES, ActionMode, action_mode, axis_dead_band, before_dead_band
from finssim.control.trajectories import PUBLISHED_NAMES, TRAJECTORIES, Trajectory, load_trajectory
from finssim.core.provenance import provenance
from finssim.core.rotations import quat_from_yaw
from finssim.core.yaml_file import json_value
from finssim.evaluation.campaign import Progress
from finssim.evaluation.clocks import ClockError, clock_offset
from finssim.evaluation.metrics import MAX_GAP, T1_SETPOINTS, in_room
from finssim.evaluation.tables import Table
from finssim.evaluation.trials import (
    DURATION,
    GoalTrial,
    VehicleMotion,
    follows,
    interpolated,
    localization_errors,
)
from finssim.learning.demonstrations import CollectSettings, Episode, about, data_sets_in, save
from finssim.learning.demonstrations import collect as collect_episodes
from finssim.pool.task_site import Referee
from finssim.pool.virtual_pool import read_truth
from finssim.robot.goals import station_of
from finssim.robot.record_messages import STATES
from finssim.robot.record_reader import Record, events_of, open_record
from finssim.tasks import Task
from finssim.tasks.observer import Observer, fitted_task
from finssim.trials.trial_files import read_table
from finssim.vehicles import Vehicle, load_vehicle

Array = NDArray[np.float64]

TOPICS = ("thruster_cmd", "odom", "policy_info", "goal", "estimator_status", "thruster_state")
"""Topics of a demonstration; `events` are optional."""
REMEDY = "record a drive with --pool-file and pictures"
LACKS = {
    "thruster_cmd": f"it contains no commands: {REMEDY}",
    "odom": f"it contains no estimate of the vehicle's position: {REMEDY}",
}
"""Topic -> message for a record without it."""
TELEOP = "finssim teleop"
PERSON = "person"
"""Mode of a teleoperated vehicle in which its operator steers, and its initial mode."""
NO_GOAL = (0.0, 0.0, 0.0, 0.0)
"""Goal in the record of a manual drive without a goal."""


class DriveError(ValueError):
    """Record or truth that cannot be used for demonstrations or evaluation."""


@dataclass(frozen=True)
class RecordedDecisions:
    """The N decisions of a record for which an estimate is available, in order."""

    path: Path
    driver: str
    """Driver: teleop, or the pilot's name."""
    pilot: dict[str, Any]
    """Pilot as described in the record; empty if it is not."""
    period: float
    """Period of the decisions [s]."""
    time: Array
    """Times on the robot's clock [s], (N,)."""
    motion: VehicleMotion
    """Estimated motion, with the thrusts and the pilot's actions, which have size 0 if the record lacks them,
    as for a human pilot; its times are NaN if the record lacks the guide's start."""
    guide: str
    """Name of the station or trajectory; empty if the record lacks it."""
    goal: Array
    """Goal of the vehicle: x, y, z [m], yaw [rad], world frame, (N, 4)."""
    stretch: NDArray[np.int64]
    """Number of the interval of each decision, (N,), in which the robot was continuously armed, the estimate
    ready and the driver steering. Negative outside all intervals."""

    @property
    def has_goal(self) -> bool:
        """Return whether the record has a goal."""
        return self.driver != "teleop" or bool(np.any(self.goal != NO_GOAL))


def read_drive(path: Path, vehicle: Vehicle) -> RecordedDecisions:
    """Read a record of `finssim teleop` or `finssim run`; a truncated record is read up to its end.

    Args:
        path: MCAP file.
        vehicle: Vehicle, which must be exactly the recorded one.

    Raises:
        RecordError: The file is not a record.
        DriveError: The record is of another vehicle, or contains no estimate or no commands.
    """
    with open_record(path) as record:
        _check(record, vehicle)
        pilot = _mapping(record, "pilot")
        teleop = record.metadata.get("command") == TELEOP
        columns = {name: {e.time: e.message for e in record.messages((name,))} for name in TOPICS}
        events = [(event["time"], event) for event in events_of(record)]
    steps = np.array(sorted(columns["thruster_state"]))
    numbers = dict(zip(steps.tolist(), _stretches(steps, columns, _helm(steps, events, teleop)), strict=True))
    complete = [t for t in sorted(columns["thruster_cmd"]) if all(t in columns[name] for name in TOPICS)]
    if not complete:
        raise DriveError(f"{path}: no decision with an estimate, so there is no demonstration")
    rows, time = {name: [columns[name][t] for t in complete] for name in TOPICS}, np.array(complete)
    stretch = np.array([numbers[t] for t in complete])
    first = rows["policy_info"][int(np.argmax(stretch >= 0))]
    began, guide = next(
        ((t, str(event["text"])) for t, event in events if event["kind"] == "trial_start"), (math.nan, "")
    )
    goals = [message.pose for message in rows["goal"]]
    actions = [np.asarray(message.action, dtype=float) for message in rows["policy_info"]]
    alike = len({len(action) for action in actions}) == 1
    motion = VehicleMotion(
        t=time - began,
        **_states(rows["odom"]),
        thrust=np.array([message.force for message in rows["thruster_cmd"]], dtype=float),
        action=np.array(actions) if alike else np.zeros((len(complete), 0)),
    )
    return RecordedDecisions(
        path=path,
        driver="teleop" if teleop else str(first.pilot),
        pilot=pilot,
        period=float(first.period),
        time=time,
        motion=motion,
        guide=guide,
        # The goal is level: its quaternion is a rotation about z alone.
        goal=np.array(
            [(*_xyz(g.position), 2.0 * math.atan2(g.orientation.z, g.orientation.w)) for g in goals]
        ),
        stretch=stretch,
    )


def _check(record: Record, vehicle: Vehicle) -> None:
    about = record.metadata
    if "vehicle_sha256" not in about:
        raise DriveError(f"{record.path}: does not name its vehicle: not a record of FinsSim")
    if about["vehicle_sha256"] != vehicle.sha256:
        raise DriveError(
            f"{record.path}: is of the vehicle {about['vehicle']} {about['vehicle_sha256'][:12]}, expected "
            f"{vehicle.name} {vehicle.sha256[:12]}: give the file of the recorded vehicle with --vehicle"
        )
    for name in TOPICS:
        if record.topic(name) not in record.topics:
            lacks = f"has no topic {name}: not a record of finssim teleop or run"
            raise DriveError(f"{record.path}: {LACKS.get(name, lacks)}")


def _mapping(record: Record, key: str) -> dict[str, Any]:
    """Return a mapping from a record's metadata; empty if it is missing."""
    text = record.metadata.get(key, "{}")
    try:
        return dict(json_value(text, DriveError, str(record.path)))
    except (ValueError, TypeError):
        raise DriveError(
            f"{record.path}: its '{key}' is '{text[:60]}', expected a mapping: not a record of ours"
        ) from None


def _helm(steps: Array, events: list[tuple[float, Any]], teleop: bool) -> NDArray[np.bool_]:
    """Return whether the demonstrator steers at each step: in a manual drive the human pilot."""
    if not teleop:
        return np.ones(len(steps), dtype=np.bool_)
    changes = [(t, event["text"] == PERSON) for t, event in events if event["kind"] == "mode"]
    times = np.array([-math.inf, *(t for t, _ in changes)])
    # A key press changes the mode from the next step on.
    index = np.searchsorted(times, steps, side="left") - 1
    return np.array([True, *(person for _, person in changes)])[np.maximum(index, 0)]


def _stretches(
    steps: Array, columns: Mapping[str, Mapping[float, Any]], helm: NDArray[np.bool_]
) -> list[int]:
    """Return the number of each step's interval; a step that cannot be used ends an interval and is negative."""
    states, ready, poses = columns["thruster_state"], columns["estimator_status"], columns["odom"]
    armed = STATES.index("armed")
    fit = helm & np.array(
        [
            states[t].state == armed and t in poses and t in ready and bool(ready[t].ready)
            for t in steps.tolist()
        ],
        dtype=np.bool_,
    )
    return [int(n) for n in np.where(fit, np.cumsum(~fit), -1)]


def _xyz(v: Any) -> tuple[float, float, float]:
    return float(v.x), float(v.y), float(v.z)


NEAR_WRENCH = 0.05
"""Largest difference of a wrench from that of an action, per axis, relative to the wrench limits, for a valid
action."""
FEW = 0.05
"""Fraction of the decisions that may exceed it: those at the limits of the thrusters."""


def actions_of(force: ArrayLike, mode: ActionMode, vehicle: Vehicle) -> NDArray[np.float32]:
    """Return the actions that correspond to the commands, in [-1, 1], (N, size).

    Args:
        force: Commanded thrusts, along the thrusters' axes, canonical order [N], (N, n).
        mode: Action mode for that vehicle.
        vehicle: Vehicle whose control matrix maps thrusts to a wrench.

    Raises:
        DriveError: Too many of the commands cannot be expressed as actions of the mode.
    """
    f = np.asarray(force, float)
    if mode.wrench:
        parts = f @ vehicle.control_matrix.T
    elif mode.pilot:
        mixer = Mixer.of(vehicle)
        parts = np.array([mixer.demands(thrusts) for thrusts in f])
    else:
        lower, upper = vehicle.force_limits
        full = np.where(f >= 0.0, upper, -lower)
        parts = np.divide(f, full, out=np.zeros_like(f), where=full > 0.0)
    action = parts @ np.linalg.pinv(mode.columns)
    if mode.pilot:
        action = before_dead_band(action, axis_dead_band(vehicle, mode.scale))
    action = np.clip(action, -1.0, 1.0)
    # Compare the wrench of the actions with the commanded one.
    limits = np.asarray(vehicle.wrench_limits, float)
    off = np.abs((mode.to_thrusters(action) - f) @ vehicle.control_matrix.T)
    off = np.divide(off, limits, out=np.zeros_like(off), where=limits > 0.0)
    wrong = float(np.mean(off.max(axis=1) > NEAR_WRENCH))
    if wrong > FEW:
        worst = int(np.argmax(off.max(axis=0)))
        raise DriveError(
            f"{mode.name} cannot express the commands in {100.0 * wrong:.0f} % of the decisions ({AXES[worst]} "
            f"is off by up to {off[:, worst].max():.2f} of its limit): give another --action"
        )
    return action.astype(np.float32)


Indices = NDArray[np.int64]

END = "end"
"""Marker for the pose at the end of an interval, instead of a goal."""
NEAR = 0.25
"""Largest distance of a decision from the task's time grid, relative to its period."""
SAME_GOAL = 1.0e-3
"""Largest difference of recorded goals that count as equal, or as on the trajectory [m, rad]."""


def episodes_of(
    drive: RecordedDecisions, observer: Observer, mode: ActionMode, vehicle: Vehicle, *,
    goal: Station | str | None = None,
) -> list[Episode]:  # fmt: skip
    """Return demonstrations from a drive; empty if it has no interval of two decisions.

    Rewards are unknown, therefore NaN. An episode is never `terminated`; its metrics are its `length` in
    steps and `began`, the robot's time of its first decision [s].

    Args:
        drive: Recorded decisions.
        observer: Observer of the task.
        mode: Action mode.
        vehicle: Vehicle that was driven.
        goal: Goal instead of the recorded one: a station, or `END`; for a task with a trajectory, its name or file.

    Raises:
        DriveError: Decisions are further apart than the task's, there is no goal, or the mode cannot express
            the commands.
    """
    task, period = observer.task, observer.task.control_step
    if drive.period > period * (1.0 + 1e-6):
        raise DriveError(
            f"{drive.path}: {drive.driver} decided every {drive.period:g} s, expected at most {period:g} s, the period "
            f"of {task.name}"
        )
    guide_of = _guides(drive, vehicle, task.moving, goal)
    stretches = indices_of(drive, period, split_goals=not task.moving and goal is None)
    if not stretches:
        return []
    motion = drive.motion
    try:
        assert motion.thrust is not None and motion.nu is not None
        actions = actions_of(motion.thrust[np.concatenate(stretches)], mode, vehicle)
    except DriveError as error:
        raise DriveError(f"{drive.path}: {error}") from None
    episodes, first = [], 0
    for rows in stretches:
        guide = guide_of(rows)
        observer.restart()
        tracks = [Track(motion.position[i], motion.quaternion[i], motion.nu[i]) for i in rows]
        times = np.nan_to_num(motion.t[rows])
        observation = [observer.observe(s, guide, float(t)) for s, t in zip(tracks, times, strict=True)]
        episodes.append(
            Episode(
                observation=np.array(observation, dtype=np.float32),
                action=actions[first : first + len(rows) - 1],
                reward=np.full(len(rows) - 1, np.nan, dtype=np.float32),
                terminated=False,
                metrics={"length": float(len(rows) - 1), "began": float(drive.time[rows[0]])},
            )
        )
        first += len(rows)
    return episodes


def indices_of(drive: RecordedDecisions, period: float, *, split_goals: bool) -> list[Indices]:
    """Return decisions at a fixed period, for each interval that has at least two.

    Args:
        drive: Recorded decisions.
        period: Period of the decisions [s].
        split_goals: True if a change of goal starts a new interval.
    """
    number = drive.stretch
    changed = np.diff(number) != 0
    if split_goals:
        changed = changed | (np.abs(np.diff(drive.goal, axis=0)) > SAME_GOAL).any(axis=1)
    runs = np.split(np.arange(len(number)), np.flatnonzero(changed) + 1)
    pieces = [piece for run in runs if number[run[0]] >= 0 for piece in _on_grid(run, drive.time, period)]
    return [piece for piece in pieces if len(piece) >= 2]


def _on_grid(run: Indices, time: Array, period: float) -> list[Indices]:
    """Return the decisions nearest to a time grid that starts at the first one; a new grid starts after every gap."""
    t = time[run]
    pieces, piece = [], [0]
    while (due := t[piece[0]] + len(piece) * period) <= t[-1] + 1e-6:
        after = int(np.searchsorted(t, due))
        near = max(after - 1, 0) if after == len(t) or due - t[after - 1] < t[after] - due else after
        if abs(t[near] - due) <= NEAR * period:
            piece.append(near)
        else:
            pieces.append(piece)
            piece = [after]
    return [run[p] for p in (*pieces, piece)]


def _guides(
    drive: RecordedDecisions, vehicle: Vehicle, moving: bool, goal: Station | str | None
) -> Callable[[Indices], Guide]:
    """Return a function from the indices of decisions to the guide of an interval."""
    if moving:
        trajectory = trajectory_of(drive, vehicle, None if goal is None else str(goal))
        return lambda rows: trajectory
    if isinstance(goal, Station):
        return lambda rows: goal
    if goal == END:
        between = drive.motion.between
        return lambda rows: station_at((*between(rows).position[-1], float(between(rows).yaw[-1])))
    if not drive.has_goal:
        raise DriveError(
            f"{drive.path}: was driven by hand without a goal: give --goal x,y,z,yaw_deg, or --goal {END} for the pose "
            "at the end of each interval"
        )
    return lambda rows: station_at(drive.goal[rows[0]])


GIVE = "give the name or the file of the trajectory (evaluate --trajectory, collect --goal)"


def station_at(goal: Sequence[float] | Array) -> Station:
    """Return the station at a goal: x, y, z [m], yaw [rad], world frame, (4,)."""
    x, y, z, yaw = map(float, goal)
    return Station((x, y, z), yaw)


def trajectory_of(drive: RecordedDecisions, vehicle: Vehicle, name: str | None = None) -> Guide:
    """Return the trajectory that was followed, after checking it against the recorded goals.

    Args:
        drive: Recorded decisions.
        vehicle: Vehicle that followed it: a published trajectory is scaled to its room.
        name: Name or file; the recorded name if None.

    Raises:
        DriveError: The record does not contain the trajectory, or its goals are not on it.
    """
    name = name or drive.guide
    named = name in TRAJECTORIES or name in PUBLISHED_NAMES
    if name == drive.guide and not named:  # a name from a record is never a path
        raise DriveError(
            f"{drive.path}: followed '{drive.guide}', expected one of {', '.join(TRAJECTORIES)}: {GIVE}"
        )
    if np.isnan(drive.motion.t).any():
        raise DriveError(f"{drive.path}: has no start time of its trajectory: not a record of finssim run")
    guide = load_trajectory(name, vehicle=vehicle)
    off = float(np.linalg.norm(guide.at(drive.motion.t).position - drive.goal[:, :3], axis=1).max())
    if off > SAME_GOAL:
        raise DriveError(f"{drive.path}: its goals are up to {off:.3g} m off the trajectory '{name}': {GIVE}")
    return guide


def collect(
    experts: Sequence[str],
    *,
    task: str,
    out: Path,
    episodes: Annotated[int | None, (1, 1_000_000)] = None,
    settings: Annotated[CollectSettings, "options"],
    goal: str | None = None,
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Store episodes of a task as a Minari data set, from an expert or from records of a driven vehicle.

    Example: finssim collect pid --task t1 --episodes 200 --out demonstrations/hold

    Args:
        experts (DIR|NAME|RECORD...): A policy's directory or a baseline of the task; or records of driven vehicles
            (.mcap).
        task (TASK): Task of the demonstrations; finssim tasks lists them.
        out (DATASET): Folder of the data set.
        episodes: Number of episodes, counted per agent. Not for records.
        settings: Vehicle, actions, observations, noise and seed.
        goal (GOAL): Goal for records, instead of the recorded one: x,y,z,yaw_deg [m, deg], or end for the
            final pose of each interval; for t2 the trajectory.
        progress: Function that is called with the completed fraction.
    """
    records = [Path(word) for word in experts if word.endswith(".mcap")]
    if records and (len(records) < len(experts) or episodes or settings.randomize or settings.disturb):
        raise DriveError(
            "records cannot be combined with other experts, --episodes, --randomize and --disturb"
        )
    if records:
        return collect_records(
            records, task, out=out, vehicle=settings.vehicle, action=settings.action, goal=goal
        )
    if len(experts) > 1 or episodes is None or goal is not None:
        raise DriveError("give one expert and --episodes, but no --goal, which is for records")
    return collect_episodes(experts[0], task, episodes=episodes, out=out, settings=settings, show=progress)


def datasets(places: Sequence[Path]) -> dict[str, Any]:
    """List demonstrations: task, vehicle, expert, episodes, steps.

    Example: finssim datasets demonstrations

    Args:
        places (PATH...): Data sets, or folders of them.
    """
    return {str(path): about(path) for location in places for path in data_sets_in(location)}


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return a table of the collected demonstrations; or a row for each data set."""
    if "task" in result:
        means = {name: x for name, x in result.get("metrics", {}).items() if x is not None}
        text = f"{result['episodes']} episodes, {result['steps']:,} steps{'; means: ' * bool(means)}"
        sources = [
            f"{record['file']}: {record['driver']}, {record['episodes']} episodes, {record['steps']:,} steps"
            for record in result.get("records", ())
        ]
        title = text + ", ".join(f"{name} {x:.4g}" for name, x in means.items())
        return [Table(title=title, sentences=sources)]
    rows = [
        [name, row["task"], row["vehicle"]["name"], row["expert"], row["observe"], str(row["episodes"]),
         f"{row['steps']:,}"]
        for name, row in result.items()
    ]  # fmt: skip
    heads = ("data set", "task", "vehicle", "expert", "observes", "episodes", "steps")
    return [Table(title="", heads=heads, rows=rows, left=range(5))]


def collect_records(
    records: Sequence[Path],
    task: str,
    *,
    out: Path,
    vehicle: str = "finsrov",
    action: str | None = None,
    goal: str | None = None,
) -> dict[str, Any]:
    """Convert records to demonstrations and write them.

    Args:
        records: MCAP files of `finssim teleop` or `finssim run`.
        task: Name of the task, or FILE.py:CLASS of your own.
        out: Folder of the data set; an earlier one there is replaced.
        vehicle: Name or file of the vehicle; exactly the recorded one.
        action: Action mode; the task's own if None.
        goal: Goal instead of the recorded one: "x,y,z,yaw_deg" or a file, "end" (the pose at which each
            interval ended); for t2 the trajectory, by name or file.

    Returns:
        The description of the data set, with `episodes` and `steps`.

    Raises:
        DriveError: A record does not match, or contains no usable demonstration.
        RecordError, ControlError, GoalError, VehicleError, OutputError: See these classes.
    """
    body = load_vehicle(vehicle)
    watch = Observer(task, body)
    the_task = watch.task
    mode = action_mode(action or the_task.action, body)
    to = station_of(goal) if goal is not None and not the_task.moving and goal != END else goal
    demonstrations, sources = [], []
    for path in records:
        drive = read_drive(path, body)
        episodes = episodes_of(drive, watch, mode, body, goal=to)
        demonstrations += episodes
        steps = sum(len(e.action) for e in episodes)
        sources.append(
            {
                "file": path.name,
                "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
                "driver": drive.driver,
                "episodes": len(episodes),
                "steps": steps,
            }  # fmt: skip
        )
    if not demonstrations:
        names = ", ".join(str(path) for path in records)
        raise DriveError(
            f"{names}: the robot was never armed, its estimate ready and its driver active for two decisions "
            f"{the_task.control_step:g} s apart towards one goal, so there is no demonstration"
        )
    described = {
        "task": the_task.name,
        "title": the_task.title,
        "period": the_task.control_step,
        "expert": " and ".join(dict.fromkeys(str(source["driver"]) for source in sources)),
        "observation": the_task.schema.model_dump(mode="json"),
        "action": mode.describe(),
        "vehicle": {"name": body.name, "sha256": body.sha256},
        "observe": "record",
        "goal": goal,
        "records": sources,
        "provenance": provenance(),
    }
    save(out, demonstrations, described)
    return {**described, "episodes": len(demonstrations), "steps": sum(len(e.action) for e in demonstrations)}


# Records as trials, with their scores.


PUBLISHED = ("t1", "t2")
"""Tasks that are evaluated as in the paper; every other task provides its own metrics."""
EARLY = 0.5
"""Missing time at the end of a trial above which it counts as stopped [s]."""


@dataclass(frozen=True, kw_only=True)
class RecordedTrial(GoalTrial):
    """Trial in a record."""

    path: Path
    pilot: dict[str, Any]
    """Pilot as described in the record."""
    estimate: VehicleMotion
    """Robot's estimate at its decisions; `motion` is the truth if available, otherwise the estimate."""
    stopped: bool
    """True if it ended early."""
    duration: float
    """End of the evaluated time [s]."""
    offset: float | None
    """Offset added to the truth's times to convert them to the robot's clock [s]; None without a truth."""

    def scores(self, task: str, vehicle: Vehicle) -> dict[str, Any]:
        """Return `measures` for T1 and T2, otherwise the task's own metrics, and the error of the estimate.

        Raises:
            ControlError: The task cannot score trials that were recorded elsewhere.
        """
        if task in PUBLISHED:
            fault = "ended early" if self.stopped else ""
            row = self.measures(task, vehicle.force_limits, stopped=self.stopped)
        else:
            row, fault = self._scored(fitted_task(task, vehicle), vehicle)
        return {
            **row,
            "fault": fault,
            "localization": None if self.offset is None else localization_errors(self.motion, self.estimate),
            "clock_offset_s": self.offset,
        }

    def _scored(self, task: Task, vehicle: Vehicle) -> tuple[dict[str, float | None], str]:
        """Return the task's metrics of an episode of one vehicle that was recorded elsewhere.

        Returns:
            The metrics, None if undefined; and a sentence with the reason if they are, which counts as no success.
        """
        motion, actions = self.motion, self.estimate.action
        size = 0 if actions is None else actions.shape[1]
        referee = Referee(task, [vehicle], guide=self.guide, start=motion.at(0.0), action_size=size or None)
        (name,), fault = task.agents, ""
        times = np.concatenate([[0.0], motion.t, [self.duration]])
        widest = int(np.argmax(np.diff(times)))
        if times[widest + 1] - times[widest] > MAX_GAP:
            fault = f"no position from {times[widest]:.1f} to {times[widest + 1]:.1f} s"
        for k in range(round(self.duration / task.control_step) if not fault else 0):
            action = {name: self.estimate.action_at(k * task.control_step)}
            referee.look({name: motion.at((k + 1) * task.control_step)}, action)
            if referee.over:
                break
        if not referee.over:
            unknown: dict[str, float | None] = dict.fromkeys(referee.metrics())
            return unknown | ({"success": 0.0} if "success" in unknown else {}), fault or "ended early"
        return {key: x if math.isfinite(x) else None for key, x in referee.metrics().items()}, ""


def read_record(
    path: Path,
    task: str,
    vehicle: Vehicle,
    *,
    guide: Guide | None = None,
    truth: Path | None = None,
    duration: float = DURATION,
) -> RecordedTrial:
    """Return the trial in a record, from the start of its guide's time.

    Args:
        path: MCAP file of `finssim run`, `experiment --robot` or the ROS 2 graph.
        task: Task of one vehicle: its name, or FILE.py:CLASS of your own.
        vehicle: Vehicle; exactly the recorded one.
        guide: Reference of a task that follows one; that named in the record if None.
        truth: Truth file of a virtual pool, record of `finssim ardusub-sitl --truth` (.mcap), or a table
            (.csv, .parquet) of motion capture, world frame: columns t [s], x, y, z of the body origin [m],
            and qx, qy, qz, qw or yaw [rad]. Its clock is arbitrary: it is aligned with the robot's such that
            the distance between the two motions is least.
        duration: Duration of a trial of t1 [s].

    Raises:
        DriveError: The task has several vehicles, the record is of a manual drive, has several goals or lacks
            data that the task requires, or the truth is of another run.
        RecordError, ControlError: The record or the task cannot be used.
        CalibrationError, TruthError: The truth cannot be read.
    """
    fitted = fitted_task(task, vehicle)
    if len(fitted.vehicles) > 1:
        raise DriveError(
            f"task '{task}' has {len(fitted.vehicles)} vehicles but {path} contains one: finssim pool --task and "
            "python -m studies.stack score it during the run"
        )
    drive = read_drive(path, vehicle)
    steered = drive.stretch >= 0
    t = drive.motion.t
    if not (steered & (t >= 0.0)).any():
        raise DriveError(f"{path}: the robot was never armed with a known state, so it contains no trial")
    if task not in PUBLISHED and not np.size(drive.motion.action):
        raise DriveError(
            f"{path}: lacks the pilot's actions in [-1, 1], which '{task}' scores: record a run of this version"
        )
    longest = {"t1": duration, "t2": math.inf}.get(task, fitted.time_limit)
    if follows(fitted):
        the_guide = guide or trajectory_of(drive, vehicle)
    else:
        the_guide = (
            _goal_history(drive, steered, longest) if fitted.moving else _station(drive, steered, task)
        )
    full = min(the_guide.duration, longest)
    estimate = drive.motion.between(steered & (t >= 0.0) & (t <= full + 1e-6))
    stopped = float(estimate.t[-1]) < full - EARLY
    until = float(estimate.t[-1]) if stopped else full
    motion, offset = (estimate, None) if truth is None else _truth(truth, drive, until)
    return RecordedTrial(
        name=_setpoint(the_guide, vehicle) if task == "t1" else the_guide.name,
        guide=the_guide,
        motion=motion,
        path=path,
        pilot=drive.pilot or {"name": drive.driver},
        estimate=estimate,
        stopped=stopped,
        duration=until,
        offset=offset,
    )


def _goal_history(drive: RecordedDecisions, steered: NDArray[np.bool_], duration: float) -> Trajectory:
    """Return the recorded course of a moving goal, held constant after its end, up to a given time [s].

    Raises:
        DriveError: There was no goal.
    """
    goals, t = _goals(drive, steered), drive.motion.t[steered & (drive.motion.t >= 0.0)]
    position, yaw = goals[:, :3], np.unwrap(goals[:, 3])
    rates = np.gradient(position, t, axis=0) if len(t) > 1 else np.zeros_like(position)
    return Trajectory(
        name="recorded",
        duration=duration,
        motion=lambda at: (interpolated(at, t, position), interpolated(at, t, rates)),
        turning=lambda at: np.interp(at, t, yaw),
    )


def _goals(drive: RecordedDecisions, steered: NDArray[np.bool_]) -> Array:
    """Return the goals of the vehicle, by decision."""
    if not drive.has_goal:
        raise DriveError(f"{drive.path}: was driven by hand without a goal: a record of finssim run has one")
    return drive.goal[steered & (drive.motion.t >= 0.0)]


def _station(drive: RecordedDecisions, steered: NDArray[np.bool_], task: str) -> Guide:
    """Return the single goal that was held, or the dock."""
    goals = _goals(drive, steered)
    if float(np.abs(goals - goals[0]).max()) > SAME_GOAL:
        raise DriveError(
            f"{drive.path}: the recorded goal moves, but '{task}' expects a fixed goal: use --task t2 or t3, or record "
            "each station separately"
        )
    return station_at(goals[0])


def _setpoint(guide: Guide, vehicle: Vehicle) -> str:
    """Return the name of the published setpoint that a station equals, otherwise its numbers."""
    start = guide.at(0.0)
    goal = np.array([*start.position, float(start.yaw)])
    published = {name: in_room(pose, vehicle) for name, pose in T1_SETPOINTS.items()}
    near = (name for name, pose in published.items() if np.abs(pose - goal).max() <= SAME_GOAL)
    return next(near, ",".join(f"{x:.3g}" for x in (*goal[:3], math.degrees(goal[3]))))


def _states(odometry: Sequence[Any]) -> dict[str, Array]:
    """Return position, quaternion and nu from odometry messages, in the form of `VehicleMotion`."""
    poses, twists = ([getattr(m, k) for m in odometry] for k in ("pose", "twist"))
    return {
        "position": np.array([_xyz(p.pose.position) for p in poses]),
        "quaternion": np.array([(*_xyz(p.pose.orientation), p.pose.orientation.w) for p in poses]),
        "nu": np.array([(*_xyz(t.twist.linear), *_xyz(t.twist.angular)) for t in twists]),
    }


def _truth(path: Path, drive: RecordedDecisions, until: float) -> tuple[VehicleMotion, float]:
    """Return the true motion from the guide's start to a time after it [s], and the offset added to its times."""
    motion = _table(path)
    try:
        offset = clock_offset(drive.time, drive.motion.position, motion.t, motion.position)
    except ClockError as error:
        raise DriveError(f"{path}: {error}") from None
    t = motion.t + offset - (drive.time[0] - drive.motion.t[0])
    return replace(motion, t=t).between((t >= 0.0) & (t <= until + 1e-6)), offset


def _table(path: Path) -> VehicleMotion:
    """Return a truth, on its own clock."""
    if path.suffix.lower() == ".mcap":
        with open_record(path) as record:
            entries = list(record.messages(("odom",)))
        if len(entries) < 2:
            raise DriveError(
                f"{path}: contains no motion: give the file that finssim ardusub-sitl --truth wrote"
            )
        return VehicleMotion(t=np.array([e.time for e in entries]), **_states([e.message for e in entries]))
    if path.suffix.lower() not in (".csv", ".txt", ".tsv", ".parquet"):
        truth = read_truth(path)
        return VehicleMotion(t=truth.time, position=truth.position, quaternion=truth.quaternion, nu=truth.nu)
    columns = read_table(path).numbers
    attitude = ("qx", "qy", "qz", "qw")
    turned = set(attitude) <= set(columns)
    if not {"t", "x", "y", "z"} <= set(columns) or not (turned or "yaw" in columns):
        raise DriveError(
            f"{path}: columns {', '.join(columns)[:80]}, expected t [s], x, y, z [m] (world frame, body origin) and "
            "qx, qy, qz, qw or yaw [rad]"
        )
    names = ("t", "x", "y", "z", *(attitude if turned else ("yaw",)))
    rows = np.stack([columns[name] for name in names], axis=1)
    rows = rows[np.isfinite(rows).all(axis=1)]  # a body that the cameras lost has empty cells
    if len(rows) < 2 or np.any(np.diff(rows[:, 0]) <= 0.0):
        raise DriveError(f"{path}: {len(rows)} rows with all numbers, expected 2 or more with t increasing")
    quaternion = rows[:, 4:8] if turned else quat_from_yaw(rows[:, 4])
    return VehicleMotion(t=rows[:, 0], position=rows[:, 1:4], quaternion=quaternion, heading_only=not turned)
