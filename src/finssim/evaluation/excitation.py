"""Implementation of `finssim excite --pool` and `--robot`: programmes run by the robot's complete software,
and their trials."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.agents.controllers import controller
from finssim.control import ControlError
from finssim.control.allocation import Allocator
from finssim.control.guidance import Goal, Guide, Measured, Station, goal_at
from finssim.core.files import atomic_directory
from finssim.core.progress import Progress, progress_bar
from finssim.core.quiet import start_warp
from finssim.core.rotations import quat_inverse_rotate, quat_rotate
from finssim.evaluation.campaign import Show, run_jobs
from finssim.evaluation.robot_trials import (
    OnRobot,
    PoolJob,
    RobotTrial,
    TrialOutcome,
    check_starts,
    noise_seed,
    open_results_folder,
    play_in_pool,
    session,
)
from finssim.identification.manoeuvres import manoeuvres, simulate_manoeuvres, write_manoeuvre
from finssim.identification.programme import Programme, programmes, read_legs, write_programme
from finssim.identification.synthetic import simulate_programme
from finssim.pool import draw_plant
from finssim.pool.drawn_plant import site_of
from finssim.pool.plant_spec import Basin
from finssim.robot.perception import Perception
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.trials.findings import CalibrationError
from finssim.trials.importers.dispatch import print_folders, read_trials
from finssim.trials.trial import Trial
from finssim.trials.trial_files import write_trial
from finssim.vehicles import AXES, Vehicle, load_vehicle
from finssim.vehicles.defaults import room

Array = NDArray[np.float64]

HELD = ("surge", "sway", "heave", "yaw")
"""Axes that are held while others are excited; roll and pitch are passively stable."""
HELD_IN_TURNS = ("heave",)
"""Axes that are held while the heading is excited: a position cannot be held in rotating axes."""


class ProgrammePilot:
    """Pilot that commands a programme open-loop on its axes. A PID holds the other axes at the guide's pose.

    Otherwise, unequal propellers would turn a vehicle around within two metres. A fit uses the applied
    wrench, whichever of the two commanded it.
    """

    needs_state = True
    name = "programme"

    def __init__(
        self,
        programme: Programme,
        vehicle: Vehicle,
        *,
        room: float | None = None,
        hold: str | None = "pid",
        period: float = 0.05,
    ) -> None:
        """
        Args:
            programme: Programme to command; rows of `excitation` may end early, see `room`, and so may a
                coast if the programme defines an ascent speed.
            vehicle: Vehicle with the thrusters; its model determines the gains of the PID.
            room: Largest distance from the start of the programme, after which the excitation ends [m].
            hold: Name of the PID; None to leave the other axes uncontrolled.
            period: Time between two decisions [s].

        Raises:
            ControlError: The numbers of rows and phases differ, or an axis or the PID is unknown.
        """
        axes, phases = programme.axes, len(programme.phase)
        unknown = [axis for axis in axes if axis not in AXES]
        if programme.tau_desired.shape != (phases, 6) or not phases or unknown:
            raise ControlError(
                f"a programme of shape {programme.tau_desired.shape} with {phases} phases on {', '.join(axes)}: "
                f"expected a wrench and a phase for every row, on axes of {', '.join(AXES)}"
            )
        self.period, self._programme, self._room = period, programme, room
        self._allocator = Allocator.from_vehicle(vehicle)
        self._limits = np.asarray(vehicle.wrench_limits, float)
        held = HELD_IN_TURNS if "yaw" in axes else HELD
        self._driven = [AXES.index(axis) for axis in axes]
        self._held = [AXES.index(a) for a in held if hold is not None and a not in axes]  # type: ignore[arg-type]
        self._hold = controller(hold, vehicle, period=period) if hold is not None else None
        self.reset()

    def reset(self) -> None:
        """Reset to the start of the programme."""
        self._memory: Any = self._hold.reset() if self._hold is not None else None
        self._skipped = 0
        self._origin: Array | None = None
        self._rising_since: float | None = None
        self._recorded = ""
        self.phase = ""
        """Phase of the last commanded row; empty before and after the programme."""
        self.fastest = 0.0
        """Highest estimated speed along the programme's first axis so far [m/s, rad/s]."""
        self.finished = False
        """True if the programme is over."""

    def describe(self) -> dict[str, Any]:
        """Return name, rate and duration."""
        length = self._programme.duration
        return {"name": self.name, "kind": "programme", "period_s": self.period, "duration_s": length}

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Return the requested thrusts in canonical order [N], (n,); zero after the end."""
        row, phases = self._row(reading, t), self._programme.phase
        self.finished = self.finished or row >= len(phases)
        if self.finished:
            self.phase = ""
            return np.zeros(self._allocator.thrusters)
        self.phase = str(phases[row])
        tau = self._programme.tau_desired[row].copy()
        if self._hold is not None:
            goal = self._beside(goal_at(guide, t), reading)
            corrected, self._memory = self._hold.command(self._memory, reading, goal)
            tau[self._held] = corrected[self._held]
        return self._allocator.allocate(np.clip(tau, -self._limits, self._limits))

    def watch(self, runtime: Runtime) -> None:
        """Record the phases and update the highest speed, after every step."""
        reading = runtime.reading
        if reading is None:
            return
        if self._recorded:
            self.fastest = max(self.fastest, abs(float(reading.nu[self._driven[0]])))
        if self.phase != self._recorded and runtime.recorder is not None:
            self._recorded = self.phase
            runtime.recorder.event(reading.time, "phase", self.phase)

    def _beside(self, goal: Goal, reading: Measured) -> Goal:
        """Return the goal shifted along the excited axes to the position of the vehicle.

        Otherwise, a distance of s metres and a heading error ψ would appear as an error s sin ψ on a held
        axis, and correcting it would turn the vehicle further.
        """
        q = np.asarray(goal.quaternion, float)
        away = quat_inverse_rotate(q, np.asarray(reading.position, float) - np.asarray(goal.position, float))
        along = np.where([axis in self._driven for axis in range(3)], away, 0.0)
        return replace(goal, position=np.asarray(goal.position, float) + quat_rotate(q, along))

    def _row(self, reading: Measured, t: float) -> int:
        """Return the row to play; completed excitations and coasts are left early."""
        phases, position = self._programme.phase, np.array(reading.position, float)
        self._origin = position if self._origin is None else self._origin
        row = int(t * self._programme.rate + 1e-6) + self._skipped
        if row >= len(phases):
            return row
        way = float(np.linalg.norm(position - self._origin))
        done = phases[row] == "excitation" and self._room is not None and way > self._room
        if done or (phases[row] == "coast" and self._risen(reading, t)):
            later = np.flatnonzero(phases[row:] != phases[row])
            skipped = int(later[0]) if len(later) else len(phases) - row
            self._skipped += skipped
            row += skipped
        return row

    def _risen(self, reading: Measured, t: float) -> bool:
        """Return whether the vehicle has risen steadily for long enough."""
        if self._programme.ascent_speed is None:
            return False
        velocity = quat_rotate(reading.quaternion, np.asarray(reading.nu)[:3])
        if float(velocity[2]) <= self._programme.ascent_speed:
            self._rising_since = None
            return False
        self._rising_since = t if self._rising_since is None else self._rising_since
        return t - self._rising_since >= self._programme.ascent_time


Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner of the water that a vehicle may use, world frame [m]."""


WALL, SURFACE, FLOOR = 0.35, 0.15, 0.12
"""Clearance between the vehicle's envelope and these at the ends of a run [m]; all three are scaled by `room`."""
STOPPING = {"surge": 0.35, "sway": 0.3, "heave": 0.06}
"""Fraction of the room that is reserved for the coast after an excitation [-]."""
LEAST_ROOM = 0.15
"""Shortest usable distance [m]."""


@dataclass(frozen=True)
class ProgrammeStart:
    """Start of a programme."""

    position: tuple[float, float, float]
    """Position of the body origin, world frame [m]."""
    yaw: float
    """Heading [rad]."""
    room: float | None
    """Distance after which the excitation ends [m]; None if the programme does not move the vehicle away."""


def box_of(surroundings: Basin | Vehicle) -> Box:
    """Return the water of a basin, or the workspace of a vehicle, which is treated as walls [m]."""
    if isinstance(surroundings, Basin):
        half = 0.5 * surroundings.length, 0.5 * surroundings.width
        return (-half[0], -half[1], -surroundings.depth), (*half, 0.0)
    lower, upper = surroundings.safety.workspace_lower, surroundings.safety.workspace_upper
    return tuple(map(float, lower)), tuple(map(float, upper))  # type: ignore[return-value]


def start_of(programme: Programme, vehicle: Vehicle, box: Box) -> ProgrammeStart:
    """Return the start of a programme, such that its path is centred in the water, with surge and sway along x.

    A programme in both directions starts at the centre, with half of the length on either side.

    Args:
        programme: Programme on one axis; programmes on several axes start at the centre.
        vehicle: Vehicle whose envelope must stay clear of the walls.
        box: Lower and upper corner of the water [m].

    Raises:
        CalibrationError: The water is too small for the programme.
    """
    (x0, y0, z0), (x1, y1, z1) = box
    length, width, height = vehicle.body.size
    scale = room(vehicle.body.size)
    top, bottom = z1 - 0.5 * height - scale * SURFACE, z0 + 0.5 * height + scale * FLOOR
    x, y, z = 0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (top + bottom)
    axis = programme.axes[0]
    if len(programme.axes) != 1 or axis in ("roll", "pitch", "yaw"):
        return ProgrammeStart((x, y, z), 0.0, 0.5 * (y1 - y0) - 0.5 * math.hypot(length, width))
    column = programme.tau_desired[:, AXES.index(axis)]
    sign = float(column.max() > 0.0) - float(column.min() < 0.0)  # 0 for both directions
    # Heading along x for surge; across it for sway, so that its left is towards decreasing x.
    yaw = 0.5 * math.pi if axis == "sway" else 0.0
    if axis == "heave":
        half = 0.5 * (top - bottom)
        z -= sign * half
    else:
        half = 0.5 * (x1 - x0) - 0.5 * (length if axis == "surge" else width) - scale * WALL
        x -= sign * half * (1.0 if axis == "surge" else -1.0)
    way = half * (2.0 if sign else 1.0) - scale * STOPPING[axis]
    if not way >= LEAST_ROOM:
        raise CalibrationError(
            f"{programme.name}: the pool has {way:.2f} m of room along {axis}, expected {LEAST_ROOM} m or more: use a "
            "larger pool"
        )
    return ProgrammeStart((x, y, z), yaw, way)


ESTIMATOR = "error-state"
"""Mode of the estimator: it predicts with the accelerometer, so that its velocity does not lag behind the motion."""


def programme_trial(
    programme: Programme, vehicle: Vehicle, start: ProgrammeStart, *, hold: str | None = "pid"
) -> RobotTrial:
    """Return the trial that plays a programme, and ends with it; its record contains the phases.

    Args:
        programme: Programme to play.
        vehicle: Vehicle in the robot's model.
        start: Start of the programme, and the distance that is available.
        hold: PID that holds the other axes; None to leave them uncontrolled.
    """
    pilot = ProgrammePilot(programme, vehicle, room=start.room, hold=hold)
    return RobotTrial(
        name=programme.name,
        pilot=pilot,
        guide=Station(start.position, start.yaw, name=programme.name),
        duration=programme.duration,
        over=lambda runtime: pilot.finished,
        watch=pilot.watch,
    )


def about_programme(programme: Programme, label: str) -> dict[str, Any]:
    """Return a record's description of the programme's trial."""
    return {"trial": {"axis": list(programme.axes), "description": f"{label}: {programme.name}"}}


def write_trial_of(record: Path, folder: Path, role: str) -> Trial:
    """Write the trial of a record, from the start of its programme, to a folder with its name.

    Args:
        record: MCAP file of one programme.
        folder: Folder of the trial.
        role: fit or held-out.
    """
    trial = read_trials([record], split="phase")[0]
    header = trial.header.model_copy(update={"role": role})
    trial = replace(trial, name=folder.name, header=header)
    write_trial(trial, folder)
    return trial


RECORDS = "records"
"""Folder of the MCAP files beside the trials."""
PLAN_FILE = "programmes.yaml"


@dataclass(frozen=True, kw_only=True)
class PoolRun(PoolJob):
    """Programme with the robot and pool that play it; the row is the role of its trial: fit or held-out."""

    programme: Programme
    camera: str = "corners"
    hold: str | None = "pid"
    """PID that holds the other axes."""

    @property
    def water(self) -> Box:
        """Return the water of the pool: lower and upper corner [m]."""
        standing = load_vehicle(self.pool_vehicle)
        return box_of(site_of(self.site, draw_plant(standing, self.plant, self.severity)).basin)  # type: ignore[arg-type]


def play_programme(run: PoolRun, path: Path) -> dict[str, Any]:
    """Play a programme in its pool.

    Args:
        run: Job with the programme; the target is the name of the programme.
        path: Folder for TARGET, the trial, and TARGET.mcap, the record.

    Returns:
        `fault` (why the bridge ended it early, or empty), `text` (from `fastest_text`) and the `notes` of the import.
    """
    start_warp()
    record = path / f"{run.target}.mcap"
    record.parent.mkdir(parents=True, exist_ok=True)
    record.unlink(missing_ok=True)
    vehicle, seed = load_vehicle(run.vehicle), noise_seed(run.seed, run.row, run.target)
    start = start_of(run.programme, vehicle, run.water)
    trial = programme_trial(run.programme, vehicle, start, hold=run.hold)
    about = {**about_programme(run.programme, "virtual pool"), "seed": run.seed}
    with Recorder(record, vehicle, about, pictures="none") as recorder:
        outcome = play_in_pool(
            trial, Station(start.position, start.yaw), run.equipped(), run.plan(seed), seed=seed, recorder=recorder,
            mode=ESTIMATOR,
        )  # fmt: skip
    return {
        "fault": outcome.fault,
        "text": fastest_text(run.programme, outcome),
        "notes": list(map(str, write_trial_of(record, path / run.target, run.row).findings)),
    }


Plans = Mapping[str, Sequence[Programme]]
"""Role of the trials (fit, held-out) -> programmes."""


def record_programmes(
    plans: Plans,
    folders: Mapping[str, Path],
    vehicle: str,
    robot: OnRobot | None = None,
    *,
    console: Console | None = None,
    **pool: Any,
) -> dict[str, list[Path]]:
    """Record trials of programmes, played by the robot's complete software from the start that `start_of` returns.

    Args:
        plans: Programmes to play.
        folders: Folders by role, for NAME, the trials, and records/NAME.mcap.
        vehicle: Name or file of the vehicle in the robot's model.
        robot: Robot that plays the programmes without a trial in their folder, within the workspace; it is
            not opened if none remains. None for a virtual pool.
        console: Console for the robot's state; standard error if None.
        pool: Arguments of `_in_pool`.

    Returns:
        Folders of the trials by role, in the order of the programmes, without skipped or omitted ones.

    Raises:
        RobotError: The robot may not be armed, or it stopped and no attendant is present.
        KeyboardInterrupt: Ctrl-C; for a robot the same call continues.
        CalibrationError: The water is too small for a programme, or the bridge stopped all trials of a role.
        GoalError, LinkError, VehicleError, OutputError: See these classes.
    """
    if robot is None:
        _in_pool(plans, folders, vehicle, **pool)
    else:
        _on_robot(plans, folders, load_vehicle(vehicle), robot, console)
    planned = {role: [folders[role] / programme.name for programme in plan] for role, plan in plans.items()}
    return {role: [path for path in paths if path.is_dir()] for role, paths in planned.items()}


def _on_robot(
    plans: Plans,
    folders: Mapping[str, Path],
    vehicle: Vehicle,
    robot: OnRobot,
    console: Console | None,
) -> None:
    remaining = [
        (role, programme, folders[role] / programme.name)
        for role, plan in plans.items()
        for programme in plan
        if not (folders[role] / programme.name).is_dir()
    ]
    places = {path: start_of(programme, vehicle, box_of(vehicle)) for _, programme, path in remaining}
    starts = {path: Station(start.position, start.yaw) for path, start in places.items()}
    check_starts({path.name: start for path, start in starts.items()}, vehicle)
    if not remaining:
        return
    with session(robot, vehicle, console=console) as opened:
        for role, programme, path in remaining:
            record = folders[role] / RECORDS / f"{programme.name}.mcap"
            if not record.is_file():
                outcome = opened.trial(
                    lambda programme=programme, path=path: programme_trial(programme, vehicle, places[path]),
                    starts[path],
                    record,
                    counts=False,
                    exact=False,
                    perception=lambda: Perception(opened.equipped, opened.site, mode=ESTIMATOR),
                    about={"command": "finssim excite", **about_programme(programme, robot.title)},
                )
                if outcome is None:
                    continue
                opened.notify(f"  {fastest_text(programme, outcome)}")
            write_trial_of(record, path, role)


def fastest_text(programme: Programme, outcome: TrialOutcome) -> str:
    """Return the highest speed of a programme, and its duration, as text."""
    pilot, t = outcome.trial.pilot, outcome.runtime.t
    assert isinstance(pilot, ProgrammePilot)
    unit = "m/s" if programme.axes[0] in AXES[:3] else "rad/s"
    return f"up to {pilot.fastest:.2f} {unit} in {0.0 if math.isnan(t) else t:.0f} s"


BALLASTED = 0.25
"""Weight minus buoyancy up to which the thrusters need not compensate it [N]."""


def trimmed(programme: Programme, vehicle: Vehicle) -> Programme:
    """Return the programme with the vehicle's net buoyancy compensated by the thrusters, unless it is ballasted.

    A BlueROV2 with 2 N of net buoyancy would surface in a shallow pool before its first step; the fit uses
    the applied wrench.

    Args:
        programme: Programme on any axis.
        vehicle: Vehicle with known weight and displaced volume.
    """
    net = vehicle.weight - vehicle.buoyancy
    if abs(net) < BALLASTED or "heave" not in vehicle.controlled_axes:
        return programme
    tau = programme.tau_desired.copy()
    tau[:, 2] += net
    return replace(programme, tau_desired=tau)


def _in_pool(
    plans: Plans,
    folders: Mapping[str, Path],
    vehicle: str,
    *,
    processes: int | None = None,
    progress: Progress = lambda part, text: None,
    show: Show = lambda job, result: None,
    **settings: Any,
) -> None:
    """Record trials of programmes in a pool; those that the bridge stopped are omitted, and `show` receives
    their fault.

    Args:
        plans, folders, vehicle: As for `record_programmes`.
        processes: Number of processes; the number of processors if None.
        progress: Function that is called with the completed fraction and the number of remaining runs.
        show: Function that is called with each run and its result, from `play_programme`, as soon as it is available.
        settings: Settings of every `PoolRun`.
    """
    runs = [
        PoolRun(row=role, target=programme.name, programme=programme, vehicle=vehicle, **settings)
        for role, plan in plans.items()
        for programme in plan
        if not (folders[role] / programme.name).is_dir()
    ]
    body = load_vehicle(vehicle)
    for run in runs:  # refuse impossible runs before anything is played
        start_of(run.programme, body, runs[0].water)
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    beside = next(iter(folders.values()))  # on the same file system, moving a trial is atomic
    with tempfile.TemporaryDirectory(prefix=".recording-", dir=beside) as scratch:

        def keep(run: PoolRun, result: Mapping[str, Any]) -> None:
            """Move a trial to its folder as soon as it is complete: an interruption then loses no other trial."""
            if not result["fault"]:
                source, folder = Path(scratch) / result["key"], folders[run.row]
                (folder / RECORDS).mkdir(parents=True, exist_ok=True)
                shutil.move(source / f"{run.target}.mcap", folder / RECORDS)
                shutil.move(source / run.target, folder / run.target)
            show(run, result)

        results = run_jobs(
            runs, Path(scratch), play_programme, processes=processes, progress=progress, show=keep
        )
    for role, plan in plans.items():
        if not any((folders[role] / programme.name).is_dir() for programme in plan):
            raise CalibrationError(
                f"the bridge stopped every {role} trial in the virtual pool: {results[0]['fault']}: give lower levels"
            )


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """Settings of the programmes that are played."""

    kind: str = "published"
    """(KIND) published (steps, dive-and-coast, pulses), validation, multisine, or manoeuvres (speed runs,
    zig-zags, circles, dives) of a vehicle that must move to steer, for which axes is all."""
    levels: Sequence[str] | None = None
    """(LEVELS) Magnitudes [N, N m]: "5,10" for every axis or "surge=5,10"; may be given several times."""
    from_fit: Annotated[Path | None, "--from"] = None
    """(FILE|DIR) Report of a calibration, or its fit.json: plays the dive that it recommends."""
    repeats: Annotated[int, (1, 100)] = 1
    """Repeats of every programme."""
    coast: float = 30.0
    """Longest coast after a dive [s]."""
    duration: float = 60.0
    """Duration of a multi-sine [s]."""

    def __post_init__(self) -> None:
        """Refuse settings that exclude each other.

        Raises:
            CalibrationError: Two settings exclude each other.
        """
        if self.from_fit is not None and (self.levels or self.kind != "published"):
            raise CalibrationError("--from excludes --kind and --levels: the fit determines them")

    def programmes(self, axes: str, vehicle: Vehicle, seed: int) -> list[Programme]:
        """Return the programmes, in the order in which to run them; axes and seed as for `programmes`.

        Raises:
            CalibrationError: A programme is impossible.
        """
        return programmes(
            axes, vehicle, kind=self.kind, levels=_levels(self.levels or ()), repeats=self.repeats, seed=seed,
            coast=self.coast, duration=self.duration,
            legs=() if self.from_fit is None else read_legs(self.from_fit),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SimulationSettings:
    """Settings of the simulation that plays the programmes, instead of a robot."""

    simulate: bool = False
    """Run them in the simulator and write the trials."""
    pool: Annotated[int | None, (0, None)] = None
    """(SEED) Seed of a virtual pool, in which the robot's software plays them, records, and writes trials."""
    severity: str | None = None
    """(NAME) Severity of that pool: nominal, realistic or hard; realistic if not given."""
    pool_vehicle: str | None = None
    """(NAME|FILE) Vehicle around which that pool's plant is drawn; the robot's if not given."""
    inputs: Annotated[Sequence[str], ","] = ("rpm", "wrench")
    """(NAMES) Inputs logged in simulated trials, of wrench,rpm,force,pwm,command."""

    def check(self, robot: OnRobot | None) -> None:
        """Refuse settings that exclude each other.

        Raises:
            CalibrationError: Two settings exclude each other.
        """
        of_pool = self.severity is not None or self.pool_vehicle is not None
        if robot is not None and (self.simulate or self.pool is not None or of_pool):
            raise CalibrationError("--robot excludes --simulate, --pool and their options")
        if self.pool is not None and self.simulate:
            raise CalibrationError("--pool excludes --simulate: give one of them")
        if self.pool is None and of_pool:
            raise CalibrationError("--severity and --pool-vehicle need a virtual pool: give --pool SEED")


def excite(
    axes: str,
    *,
    vehicle: str,
    out: Path,
    plan: Annotated[PlanSettings, "options"] = PlanSettings(),
    simulation: Annotated[SimulationSettings, "options"] = SimulationSettings(),
    robot: OnRobot | None = None,
    seed: int = 1,
    as_json: bool = False,
) -> list[Path]:
    """Play excitation programmes on a robot or in simulation, or write them as tables (wrench [N, N m], 50 Hz).

    Example: finssim excite surge,yaw --vehicle finsrov --pool 1 --out trials

    Example: finssim excite all --vehicle finsrov --robot udp://10.0.0.2:58766 --pool-file pool.yaml --arm --out trials

    Args:
        axes (AXES): all, or of surge,sway,heave,roll,pitch,yaw separated by commas.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        out (DIR): Directory of the programmes or trials.
        plan: Programmes to play.
        simulation: Simulation that plays them; without one they are written as tables.
        robot: Robot that plays them, instead of a simulation.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The folders of the trials or programmes.

    Raises:
        CalibrationError, RobotError, VehicleError, OutputError: See these classes.
    """
    simulation.check(robot)
    if robot is not None:
        folders = excite_on_robot(axes, vehicle=vehicle, out=out, robot=robot, plan=plan, seed=seed)
    elif plan.kind == MANOEUVRES:
        start_warp()
        if axes != "all" or plan.levels or plan.repeats > 1 or simulation.pool is not None:
            raise CalibrationError(
                f"--kind {MANOEUVRES} requires axes all, without --levels, --repeats and --pool"
            )
        folders = _excite_by_course(load_vehicle(vehicle), Path(out), simulate=simulation.simulate, seed=seed)
    else:
        start_warp()
        folders = _excite_in_simulation(axes, vehicle, out, plan, simulation, seed)
    print_folders(folders, as_json)
    return folders


def _excite_in_simulation(
    axes: str, vehicle: str, out: Path, plan: PlanSettings, simulation: SimulationSettings, seed: int
) -> list[Path]:
    """Play programmes in a pool or the simulator, or write them as tables; arguments as for `excite`."""
    body, pool, simulate = load_vehicle(vehicle), simulation.pool, simulation.simulate
    played = plan.programmes(axes, body, seed)
    if pool is not None:
        played = [trimmed(programme, body) for programme in played]
    with atomic_directory(out, replaces=PLAN_FILE) as folder:
        if pool is not None:
            drawn_around, severity = simulation.pool_vehicle or vehicle, simulation.severity or "realistic"
            about = {"vehicle": load_vehicle(drawn_around).name, "plant": pool, "severity": severity}
            open_results_folder(folder / PLAN_FILE, _about(body, played, seed, plan.kind, {"pool": about}))
            with progress_bar("playing programmes") as progress:
                record_programmes(
                    {"fit": played}, {"fit": folder}, vehicle, pool_vehicle=drawn_around, plant=pool,
                    severity=severity, seed=seed, progress=progress, show=_show_left_out,
                )  # fmt: skip
        else:
            open_results_folder(
                folder / PLAN_FILE, _about(body, played, seed, plan.kind, {"simulated": simulate})
            )
            trials = simulate_programme(played, body, seed=seed, inputs=simulation.inputs) if simulate else ()
            for trial in trials:
                write_trial(trial, folder / trial.name)
            for programme in () if simulate else played:
                write_programme(programme, body, folder / programme.name)
    return [path for programme in played if (path := Path(out) / programme.name).is_dir()]


def _show_left_out(run: PoolRun, result: Mapping[str, Any]) -> None:
    """Report on standard error which trial is omitted, and why."""
    if result["fault"]:
        text = f"{run.target}: left out: {result['fault']}"
        Console(stderr=True).print(text, highlight=False, markup=False, soft_wrap=True)


MANOEUVRES = "manoeuvres"
"""Kind of excitation for vehicles with fins."""


def _excite_by_course(vehicle: Vehicle, out: Path, *, simulate: bool, seed: int) -> list[Path]:
    """Write the manoeuvres of a vehicle as tables of references, or run them in the simulator and write the
    trials."""
    chosen = manoeuvres(vehicle)
    trials = simulate_manoeuvres(chosen, vehicle, seed=seed) if simulate else []
    with atomic_directory(out, replaces=PLAN_FILE) as folder:
        about: dict[str, Any] = {
            "vehicle": {"name": vehicle.name, "sha256": vehicle.sha256},
            "kind": MANOEUVRES,
            "manoeuvres": [one.name for one in chosen],
            "simulated": simulate,
        }
        open_results_folder(folder / PLAN_FILE, about)
        for trial in trials:
            write_trial(trial, folder / trial.name)
        for one in () if simulate else chosen:
            write_manoeuvre(one, folder / one.name)
    return [out / one.name for one in chosen]


def _levels(texts: Sequence[str]) -> dict[str, list[float]] | list[float] | None:
    """Return levels by axis from `surge=5,10`, or for every axis from `5,10`."""
    named: dict[str, list[float]] = {}
    for word in texts:
        axis, _, numbers = word.rpartition("=")
        try:
            values = [float(number) for number in numbers.split(",")]
        except ValueError:
            values = [math.nan]
        if not all(map(math.isfinite, values)):
            raise CalibrationError(f"levels are '{word}', expected numbers such as 5,10 or surge=5,10")
        named.setdefault(axis.strip(), []).extend(values)
    if "" in named and len(named) > 1:
        raise CalibrationError("levels are given for every axis and for single ones: give one of the two")
    return named.get("", named) or None


def excite_on_robot(
    axes: str,
    *,
    vehicle: str,
    out: Path,
    robot: OnRobot,
    plan: PlanSettings,
    seed: int = 0,
    console: Console | None = None,
) -> list[Path]:
    """Play programmes on a robot, one after the other; those with a trial in the folder are not repeated.

    Args:
        axes: Axes as for `programmes`.
        vehicle: Name or file of the vehicle; programmes stay within its workspace.
        out: Folder for a trial of each programme, `records/NAME.mcap`, and `programmes.yaml`.
        robot: Robot and its options.
        plan: Programmes to play.
        seed: Seed of a multi-sine's phases.
        console: Console for the state; standard error if None.

    Returns:
        The folders of the trials, without those that were skipped.

    Raises:
        RobotError: The folder belongs to another plan; also as for `record_programmes`.
    """
    start_warp()
    body = load_vehicle(vehicle)
    played = plan.programmes(axes, body, seed)
    open_results_folder(Path(out) / PLAN_FILE, _about(body, played, seed, plan.kind, {"robot": True}))
    return record_programmes({"fit": played}, {"fit": Path(out)}, vehicle, robot, console=console)["fit"]


def _about(
    vehicle: Vehicle, played: Sequence[Programme], seed: int, kind: str, place_values: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the description of the folder."""
    return {
        "vehicle": {"name": vehicle.name, "sha256": vehicle.sha256},
        "kind": kind,
        **place_values,
        "seed": seed,
        "programmes": [programme.name for programme in played],
        "sha256": [programme.sha256 for programme in played],
    }
