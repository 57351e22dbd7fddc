"""Trials by the robot's complete software, on a robot or in the virtual pool: waiting, approach to the start,
trial, record and evaluation."""

from __future__ import annotations

import math
import shlex
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from rich.console import Console
from rich.status import Status

from finssim.control.guidance import Guide, Station
from finssim.control.modes import action_mode
from finssim.core.files import atomic_write
from finssim.core.provenance import provenance
from finssim.core.quiet import start_warp
from finssim.core.rotations import quat_yaw, wrap_angle
from finssim.core.yaml_file import yaml_text
from finssim.evaluation import campaign
from finssim.evaluation.metrics import SITE_SIZES, T1_SETPOINTS, T1_START, in_room
from finssim.evaluation.records import DriveError, read_record
from finssim.evaluation.trials import PERIOD, GoalTrial, VehicleMotion, guide_of, localization_errors
from finssim.localization.overhead_camera import Pool, load_pool
from finssim.pool import read_truth
from finssim.pool.plan import PoolPlan, make_plan
from finssim.pool.plant_spec import HOME
from finssim.robot.goals import check_reachable, place_of
from finssim.robot.links.transports import DEFAULT_BIND
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.pilots import Pilot, WrenchPilot, make_pilot
from finssim.robot.reading import Reading
from finssim.robot.recorder import Recorder, recording
from finssim.robot.runtime import Runtime
from finssim.robot.teleop import Keyboard
from finssim.robot.wiring import RobotDriver, Wiring, connected, link_of
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import room, vehicle_at

GETTING_READY = 10.0
"""Longest time until the estimator is ready and the vehicle is armed [s]."""
NEAR, TURNED = 0.10, math.radians(10.0)
EXACTLY = (NEAR, TURNED, 0.05, math.radians(5.0), 2.0)
"""Bounds within which a vehicle is at its start: position and heading error [m, rad], speeds [m/s, rad/s],
and duration [s]."""
ROUGHLY = (0.15, math.radians(20.0), 0.1, math.inf, 10.0)
"""Bounds if the start need not be exact: a PID tuned with guessed parameters may circle its goal forever."""
AFLOAT = (0.30, math.radians(20.0), 0.4, math.inf, 2.0)
"""Bounds in open water, where waves prevent the vehicle from being at rest."""
APPROACH = 60.0
"""Longest travel time to a start, and longest wait for the vehicle without an attendant [s]."""


def start_bounds(site: str, exact: bool) -> tuple[tuple[float, ...], ...]:
    """Return the alternative bounds [m, rad, m/s, rad/s] within which a vehicle is close enough to its start.

    They are `EXACTLY`, in open water `AFLOAT`; if not `exact`, also `ROUGHLY`.
    """
    near = AFLOAT if site == "open-water" else EXACTLY
    return (near,) if exact else (near, ROUGHLY)


Ended = Literal["over", "fault", "skipped", "interrupted", "not there"]
"""End of a trial: regular, by the bridge, by the operator, by Ctrl-C, or before its start was reached."""


class Attendant(Protocol):
    """Operator beside the water."""

    def keys(self) -> Sequence[str]:
        """Return the keys pressed since the last call, without waiting: enter continues, x or space stops the
        thrusters, s skips, q ends."""

    def line(self, text: str) -> None:
        """Show the current state; called at every step."""


@dataclass(frozen=True, kw_only=True)
class RobotTrial:
    """Trial to play, created anew for every attempt, since pilots have memory."""

    name: str
    pilot: Pilot
    guide: Guide
    duration: float
    """Longest duration, from arming [s]."""
    over: Callable[[Runtime], bool]
    """Function that returns whether the trial has reached its end."""
    watch: Callable[[Runtime], None] = lambda runtime: None
    """Function that is called after every step of the trial itself."""


@dataclass(frozen=True, kw_only=True)
class TrialOutcome:
    """Result of a trial."""

    trial: RobotTrial
    runtime: Runtime
    fault: str
    """Reason why it ended early, or never started; empty if neither happened."""
    ended: Ended = "over"
    begun: bool = True
    """True if the trial itself was started, not only the approach to its start."""


def fault_of(trial: RobotTrial, runtime: Runtime) -> str:
    """Return the reason why a started trial ended early; empty if it did not."""
    if runtime.bridge.state == "fault":
        return runtime.bridge.reason
    if math.isnan(runtime.started):
        return f"never armed: {runtime.refusal or 'no state'}"
    return "" if trial.over(runtime) else "not finished"


class TrialStages:
    """Stages of a trial: wait for the vehicle and its attendant, approach the start, run the trial, and end it."""

    def __init__(
        self,
        trial: RobotTrial,
        vehicle: Vehicle,
        start: Station,
        bounds: Sequence[tuple[float, ...]],
        *,
        by_hand: bool = False,
        attendant: Attendant | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        """
        Args:
            trial: Trial to play.
            vehicle: Vehicle in the robot's model.
            start: Start of the trial.
            bounds: Alternative bounds that are close enough, as of `start_bounds`.
            by_hand: True if the operator carries the vehicle to the start and presses enter; False: the tuned PID
                steers it there.
            attendant: Operator; None to start the approach as soon as the state is known, without confirmation.
            recorder: Recorder of the trial itself, without the approach.
        """
        self._trial, self._vehicle, self._start, self._bounds = trial, vehicle, start, bounds
        self._by_hand, self._attendant, self._recorder = by_hand, attendant, recorder
        self._stage: Callable[[Runtime, Reading, float], bool] = self._wait
        self._since = math.nan
        """Start time of the stage [s]."""
        self._near_since: dict[tuple[float, ...], float] = {}
        self._ended: Ended = "interrupted"
        self._reason = ""
        self._begun = False

    def play(self, drive: RobotDriver, perception: Perception) -> TrialOutcome:
        """Play the trial.

        Args:
            drive: Driver that runs the robot's software on its wires, or in lock-step with a world.
            perception: Estimator of the vehicle's state.
        """
        idle = WrenchPilot(lambda: np.zeros(6), self._vehicle, name="idle")
        runtime = Runtime(self._vehicle, perception, idle, self._start, arm=False)
        drive(runtime, duration=math.inf, show=self._look, until=self._over)
        fault = self._reason or (fault_of(self._trial, runtime) if self._begun else runtime.bridge.reason)
        fault = fault or ("" if self._ended == "over" else "not finished")
        return TrialOutcome(
            trial=self._trial, runtime=runtime, fault=fault, ended=self._ended, begun=self._begun
        )

    def _look(self, runtime: Runtime) -> None:
        """Call the trial's `watch` after every step."""
        if self._begun:
            self._trial.watch(runtime)

    def _over(self, runtime: Runtime) -> bool:
        """Return whether to end, and switch between stages."""
        assert runtime.reading is not None  # a step has been executed
        now = runtime.reading.time
        self._since = now if math.isnan(self._since) else self._since
        if runtime.bridge.state == "fault":
            return self._end("fault")
        return self._stage(runtime, runtime.reading, now)

    def _end(self, kind: Ended, reason: str = "") -> bool:
        self._ended, self._reason = kind, reason
        return True

    def _keys(self) -> Sequence[str]:
        return self._attendant.keys() if self._attendant else ()

    def _stopped(self, runtime: Runtime, now: float) -> bool:
        """Return whether the operator stops the thrusters now."""
        if not {"x", " "} & set(self._keys()):
            return False
        runtime.bridge.stop(now, "stopped by the operator")
        return self._end("fault")

    def _line(self, text: str) -> None:
        if self._attendant is not None:
            self._attendant.line(text)

    def _wait(self, runtime: Runtime, reading: Reading, now: float) -> bool:
        """Wait with disabled thrusters until the state is known and the attendant starts the trial."""
        keys = self._keys()
        if now == self._since:
            return False  # keys pressed before the prompt are ignored
        if "s" in keys:
            return self._end("skipped", "skipped by the operator")
        if "q" in keys:
            return self._end("interrupted")
        if not reading.ready:
            self._line(f"waiting for the vehicle: {reading.reason}")
            if self._attendant is None and now - self._since > APPROACH:
                return self._end("not there", f"its state is unknown after {APPROACH:g} s: {reading.reason}")
        elif not self.there(reading, now) and self._by_hand:
            self._line(f"bring it to its start: {self._way(reading)}")
        elif self._attendant is not None and not {"\r", "\n"} & set(keys):
            action = "play" if self._by_hand else "drive it to its start and play"
            self._line(f"enter: {action}; s: skip; q: end; {self._way(reading)}")
        elif self._by_hand:
            self._begin(runtime, now)
        else:
            runtime.hand_over(now, make_pilot("pid", self._vehicle), self._start, arm=True)
            self._stage, self._since = self._approach, now
            self._near_since.clear()
        return False

    def _approach(self, runtime: Runtime, reading: Reading, now: float) -> bool:
        """Steer to the start with the PID."""
        if self._stopped(runtime, now):
            return True
        self._line(f"on the way to its start: {self._way(reading)}; x: stop")
        if self.there(reading, now):
            self._begin(runtime, now)
        elif now - self._since > APPROACH:
            reason = runtime.refusal or self._way(reading)
            return self._end(
                "not there",
                f"not at its start after {APPROACH:g} s: {reason}; is it obstructed, or was its initial position "
                "elsewhere?",
            )
        return False

    def _begin(self, runtime: Runtime, now: float) -> None:
        """Hand over to the trial: disarm, and arm again for its pilot."""
        runtime.hand_over(now, self._trial.pilot, self._trial.guide, arm=True, recorder=self._recorder)
        self._stage, self._since, self._begun = self._play, now, True

    def _play(self, runtime: Runtime, reading: Reading, now: float) -> bool:
        if self._stopped(runtime, now):
            return True
        if self._trial.over(runtime):
            return self._end("over")
        t = 0.0 if math.isnan(runtime.t) else runtime.t
        self._line(f"{t:.0f} s of {self._trial.duration:.0f} s; x: stop")
        late = math.isnan(runtime.started) and now - self._since > GETTING_READY
        return (late or t > self._trial.duration + GETTING_READY) and self._end("not there")

    def there(self, reading: Reading, now: float) -> bool:
        """Return whether the vehicle has been at rest at its start for long enough. `now` is the time [s]."""
        off = (
            float(np.abs(reading.position - self._start.position).max()),
            abs(self._turn(reading)),
            float(np.linalg.norm(reading.nu[:3])),
            float(np.linalg.norm(reading.nu[3:])),
        )
        for bounds in self._bounds:
            if not reading.ready or any(x > limit for x, limit in zip(off, bounds[:4], strict=True)):
                self._near_since.pop(bounds, None)
            elif now - self._near_since.setdefault(bounds, now) >= bounds[4]:
                return True
        return False

    def _turn(self, reading: Reading) -> float:
        return float(wrap_angle(self._start.yaw - quat_yaw(reading.quaternion)))

    def _way(self, reading: Reading) -> str:
        """Return the remaining distance as text."""
        x, y, z = self._start.position - reading.position
        return f"({x:+.2f}, {y:+.2f}, {z:+.2f}) m and {math.degrees(self._turn(reading)):+.0f}° to go"


ABORTED = "aborted"
"""Folder of the records of trials that were stopped and do not count."""


class RobotError(ValueError):
    """Trials on a robot cannot be started or continued."""


@dataclass(frozen=True, kw_only=True)
class OnRobot:
    """Robot, and the options of trials on it."""

    wiring: Wiring
    """Connection of the robot; a virtual pool in a separate process is one, too."""
    pool_file: Path | None
    """Pool file with camera, water and frames; None without a camera, if position fixes arrive over the link."""
    site: str = "pool"
    """Site that determines its equipment: pool, tank or open-water."""
    arm: bool = False
    """True if thrusters may turn; trials are refused without it."""
    by_hand: bool = False
    """True if the operator carries the vehicle to every start; False: the tuned PID steers it there."""
    unattended: bool = False
    """True without an attendant: trials start as soon as the state is known, and a fault ends the session."""
    attendant: Attendant | None = None
    """Operator; None: the person at the terminal's keyboard."""
    let_in: tuple[float, float] | None = None
    """Initial position of the vehicle in the session, x and y, world frame [m]: dead reckoning continues from
    there through all trials. None: a camera or position fixes locate it."""

    @property
    def title(self) -> str:
        """The robot's address."""
        return f"{self.wiring.robot}{', lock-step' if self.wiring.lockstep else ''}"

    def equipped(self, vehicle: Vehicle) -> Vehicle:
        """Return the vehicle with the equipment of the site, unless its file defines more."""
        return vehicle_at(self.site, vehicle, navigation=self.wiring.robot.startswith("mavlink"))

    @property
    def options(self) -> str:
        """Options of a command line that select it."""
        wiring = self.wiring
        tokens = ["--robot", wiring.robot, "--pool-file", str(self.pool_file or "none")]
        tokens += ["--site", self.site] if self.site != "pool" else []
        tokens += ["--let-in", ",".join(f"{x:g}" for x in self.let_in)] if self.let_in is not None else []
        tokens += ["--bind", wiring.bind] if wiring.bind != DEFAULT_BIND else []
        tokens += ["--pictures", wiring.pictures] if wiring.pictures else []
        return shlex.join([*tokens, *(["--lockstep"] if wiring.lockstep else [])])


def robot_or_none(
    *,
    robot: str | None = None,
    pool_file: str | None = None,
    site: str | None = None,
    bind: str = "127.0.0.1:54321",
    pictures: str | None = None,
    lockstep: bool = False,
    arm: bool = False,
    by_hand: bool = False,
    unattended: bool = False,
    let_in: str | None = None,
) -> OnRobot | None:
    """Return the robot that options select; None without a robot and without options for one.

    Args:
        robot (ADDRESS): Run on this robot: its motor controller's udp://HOST:PORT or serial:DEVICE, its autopilot's
            --lockstep: pool, mavlink, or HOST:PORT.
        pool_file (FILE|none): Pool file of that robot: camera, water plane and frames (.yaml); none if position
            fixes arrive over the link.
        site (NAME): Site of that robot, which sets its sensors: pool (default), tank or open-water.
        bind (ADDRESS:PORT): Local address and port for udp; images arrive at the next port. Loopback if not given.
        pictures (ADDRESS): Overhead camera: udp://HOST:PORT or none; the virtual pool's with --robot pool,
            otherwise none, if not given.
        lockstep: Run in lock-step with finssim pool --lockstep, as fast as possible.
        arm: Arm, as soon as the state is known. Without it the thrusters never turn.
        by_hand: The vehicle is carried to the start of each trial by hand; by default the tuned PID steers it
            there.
        unattended: Start each trial without waiting for enter; a fault ends the session.
        let_in (X,Y): Position of the vehicle at the start of the command, world frame [m], known to 5 cm:
            start of dead reckoning by DVL and compass through all trials. Requires --pool-file none.

    Raises:
        GoalError: --let-in is not a position.
        RobotError: Options for a robot are given without one, or it has no pool file.
    """
    if robot is None:
        stated = (arm, by_hand, unattended, lockstep, pool_file, pictures, site, let_in)
        if any(x is not None and x is not False for x in stated):
            raise RobotError(
                "--arm, --by-hand, --unattended, --lockstep, --pool-file, --site, --let-in and "
                "--pictures need a robot: give --robot"
            )
        return None
    if pool_file is None:
        raise RobotError(
            "a robot needs its pool file: give --pool-file, or none if position fixes arrive over the link"
        )
    wiring = Wiring(robot=robot, bind=bind, pictures=pictures, lockstep=lockstep)
    file = None if pool_file == "none" else Path(pool_file)
    if let_in is not None and file is not None:
        raise RobotError(
            "--let-in is for dead reckoning, but a camera locates the vehicle: give --pool-file none"
        )
    return OnRobot(
        wiring=wiring, pool_file=file, site=site or "pool", arm=arm, by_hand=by_hand, unattended=unattended,
        let_in=None if let_in is None else place_of(let_in),
    )  # fmt: skip


class _Screen:
    """Terminal with a status line and keys."""

    def __init__(self, keyboard: Keyboard, status: Status) -> None:
        self._keyboard, self._status, self._newest = keyboard, status, -math.inf

    def keys(self) -> Sequence[str]:
        return self._keyboard.pressed()

    def line(self, text: str) -> None:
        now = time.monotonic()
        if now - self._newest >= 0.25:
            self._newest = now
            self._status.update(text)


@dataclass(frozen=True)
class Session:
    """Open robot, created by `session`."""

    robot: OnRobot
    vehicle: Vehicle
    site: Pool | None
    drive: RobotDriver
    attendant: Attendant | None
    console: Console

    @property
    def equipped(self) -> Vehicle:
        """Vehicle as equipped for the site."""
        return self.robot.equipped(self.vehicle)

    @cached_property
    def _reckoning(self) -> Perception:
        """Return the perception of a robot with dead reckoning: one for all trials, so that its state is kept
        from trial to trial."""
        return Perception(self.equipped, None, mode="error-state", let_in=self.robot.let_in)

    def notify(self, text: str) -> None:
        """Print a message for the attendant."""
        self.console.print(text, highlight=False, markup=False)

    def trial(
        self,
        make: Callable[[], RobotTrial],
        start: Station,
        record: Path,
        *,
        counts: bool,
        exact: bool = True,
        perception: Callable[[], Perception] | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> TrialOutcome | None:
        """Play a trial until it is complete, the operator skips it, or it fails.

        Args:
            make: Function that creates the trial anew for every attempt.
            start: Start of the trial.
            record: File of its record, written once it is complete; records of attempts that do not count go
                to `aborted/`.
            counts: True if a trial that the bridge stopped counts; otherwise it is repeated. A trial that the
                operator stopped never counts.
            exact: True if the vehicle must be at rest at its start, however long that takes: within 10 cm, in
                open water within 30 cm and at a speed of waves.
            perception: Function that creates another perception for every attempt; not for a robot with dead
                reckoning.
            about: Metadata of the record.

        Returns:
            The outcome; None if the trial was skipped.

        Raises:
            RobotError: The trial cannot be played, and no attendant is present.
            KeyboardInterrupt: Ctrl-C, or the operator ended the session.
        """
        while True:
            trial = make()
            x, y, z = start.position
            self.notify(f"{trial.name}: from {x:.2f}, {y:.2f}, {z:.2f} m, {round(math.degrees(start.yaw))}°")
            partial = record.with_name(f".{record.stem}.partial.mcap")
            partial.parent.mkdir(parents=True, exist_ok=True)
            partial.unlink(missing_ok=True)
            wiring = self.robot.wiring
            meta = {
                "pilot": trial.pilot.describe(), "guide": trial.guide.name, "armed": True, "robot": wiring.robot,
                "site": self.robot.site, **({"pool_sha256": self.site.sha256} if self.site else {}), **(about or {}),
            }  # fmt: skip
            context = recording(
                partial, self.vehicle, meta, pool_file=self.robot.pool_file, lockstep=wiring.lockstep, pictures="none"
            )  # fmt: skip
            with context as recorder:
                stages = TrialStages(
                    trial, self.equipped, start, start_bounds(self.robot.site, exact), by_hand=self.robot.by_hand,
                    attendant=self.attendant, recorder=recorder,
                )  # fmt: skip
                if self.robot.let_in is not None:
                    estimates = self._reckoning
                else:
                    estimates = perception() if perception else Perception(self.equipped, self.site)
                outcome = stages.play(self.drive, estimates)
            if recorder is not None and recorder.problem and outcome.ended == "over":
                raise RobotError(f"{record}: {recorder.problem}")
            stopped = (
                outcome.begun and outcome.ended == "fault" and outcome.fault != "stopped by the operator"
            )
            if outcome.ended == "over" or (counts and stopped):
                partial.replace(record)
                return outcome
            self._put_away(partial, record, outcome)
            if outcome.ended == "skipped":
                self.notify(f"{trial.name}: skipped")
                return None
            if outcome.ended == "interrupted":
                raise KeyboardInterrupt
            if self.attendant is None:
                raise RobotError(
                    f"{trial.name}: {outcome.fault}: check the vehicle, then repeat the command, which continues here"
                )
            self.notify(f"{trial.name}: {outcome.fault}: repeat it, or press s to skip it")

    def _put_away(self, partial: Path, record: Path, outcome: TrialOutcome) -> None:
        """Keep the record of a started trial; delete that of a trial that did not start."""
        if not outcome.begun:
            partial.unlink(missing_ok=True)
            return
        folder = record.parent / ABORTED
        folder.mkdir(exist_ok=True)
        number = 1 + sum(1 for _ in folder.glob(f"{record.stem}_*.mcap"))
        partial.replace(folder / f"{record.stem}_{number}.mcap")


@contextmanager
def session(robot: OnRobot, vehicle: Vehicle, *, console: Console | None = None) -> Iterator[Session]:
    """Open a robot for trials.

    Args:
        robot: Robot and its options.
        vehicle: Vehicle as in its file.
        console: Console for the state; standard error if None.

    Raises:
        RobotError: The robot may not be armed, or keys cannot be read.
        LinkError, LockstepError, LocalizationError: The robot cannot be reached, or its pool file cannot be used.
        VehicleError: There is no such site.
    """
    if not robot.arm:
        raise RobotError("trials turn thrusters: give --arm when the water is clear of people and cables")
    if robot.unattended and robot.by_hand:
        raise RobotError("--by-hand waits for enter at every start: omit --unattended or --by-hand")
    console = console or Console(stderr=True)
    site = None if robot.pool_file is None else load_pool(robot.pool_file)
    with ExitStack() as stack:
        drive = stack.enter_context(connected(robot.wiring, robot.equipped(vehicle), site))
        attendant = robot.attendant
        if attendant is None and not robot.unattended:
            if not sys.stdin.isatty():
                raise RobotError(
                    "standard input is not a terminal, so enter cannot be pressed: use one, or give --unattended"
                )
            keyboard = Keyboard()
            stack.enter_context(keyboard)
            attendant = _Screen(keyboard, stack.enter_context(console.status("waiting for the vehicle")))
        yield Session(robot, vehicle, site, drive, attendant, console)


def open_results_folder(file: Path, about: Mapping[str, Any]) -> None:
    """Start a folder in which results are stored as they are completed, or continue one with equal settings.

    Args:
        file: File of the settings, in a folder that may be new.
        about: Settings as plain data.

    Raises:
        RobotError: The folder contains foreign files, or belongs to other settings.
    """
    text, out = yaml_text(dict(about)), file.parent
    if not out.exists() or not any(out.iterdir()):
        with atomic_write(file) as temporary:
            temporary.write_text(text, encoding="utf-8")
    elif not file.is_file() or file.read_text(encoding="utf-8") != text:
        raise RobotError(
            f"{out}: holds other files, or results of other settings: give a new --out, or the same "
            "settings, such as vehicle and seed, to continue"
        )


def check_starts(starts: Mapping[str, Station], vehicle: str | Vehicle) -> None:
    """Refuse starts outside the workspace of a vehicle before anything is armed.

    Raises:
        GoalError: A start is outside; the message names it.
    """
    body = load_vehicle(vehicle)
    for name, start in starts.items():
        check_reachable(Station(start.position, start.yaw, name=f"the start of {name}"), body)


# Jobs of experiments: a controller from the start to the goal, in a pool or on a robot.


HARDWARE = "hardware"
"""Replacement for the severity of a pool and for its camera's mode, on a robot."""


class FirmwareTrials(NamedTuple):
    """Trials of a vehicle with a kind of firmware."""

    action: str | None
    """Action mode of policies; the task's own if None."""
    site: str
    camera: str


FIRMWARES = {
    "mcu": FirmwareTrials(None, "pool", "corners"),
    "ardusub": FirmwareTrials("pilot6", "tank", "none"),
    "ardusub-own": FirmwareTrials("pilot6", "tank", "none"),
}
"""Firmwares: a controller that accepts shaft speeds, in the pool under a camera; an autopilot that accepts
axis commands, in a tank with Doppler log, depth and compass; or one whose log is not shared, with its own
position estimate."""


def firmware_of(name: str, vehicle: Vehicle, robot: OnRobot | None = None) -> str:
    """Return the name of the firmware, or that for a robot's address.

    Raises:
        ValueError: There is no such firmware.
        ControlError: The vehicle has no autopilot.
    """
    campaign.check_choices([name], FIRMWARES, "firmware", ValueError)
    name = "ardusub" if robot is not None and robot.wiring.robot.startswith("mavlink") else name
    action = FIRMWARES[name].action
    if action is not None:
        action_mode(action, vehicle)
    return name


@dataclass(frozen=True, kw_only=True)
class PoolJob(campaign.Job):
    """Trial of the robot's complete software in a pool, with a vehicle that it knows only approximately."""

    vehicle: str | Vehicle = "finsrov"
    """Vehicle, its name or file, in the model of controller and localization."""
    pool_vehicle: str | Vehicle = "finsrov"
    """Vehicle, its name or file, around which the pool's own is drawn."""
    severity: str = "realistic"
    """Severity: nominal, realistic or hard."""
    camera: str = "pictures"
    """Output of the camera: pictures (rendered and searched for tags) or corners (of the tags, with noise)."""
    site: str = "pool"
    """Site: pool, tank or open-water."""
    firmware: str = "mcu"
    """Firmware: mcu, ardusub or ardusub-own: an autopilot, on whose vehicle a Doppler log and a compass
    replace the camera."""

    def plan(self, seed: int) -> PoolPlan:
        """Return the plan of its pool, with a seed for noise.

        An autopilot has an origin; one with its own position estimate has received its Doppler log for half a minute.
        """
        camera: Any = "none" if self.aided else self.camera
        plan = make_plan(
            self.pool_vehicle, str(self.plant), self.severity, camera=camera, seed=seed, site=self.site,
            firmware="ardusub" if self.aided else "mcu",
        )  # type: ignore[arg-type]  # fmt: skip
        if not self.aided:
            return plan
        own = {"aiding_delay": 0.0, "log_shared": False} if self.firmware == "ardusub-own" else {}
        firmware = plan.spec.firmware.model_copy(update={"origin": HOME, **own})
        return replace(plan, spec=plan.spec.model_copy(update={"firmware": firmware}))

    @property
    def aided(self) -> bool:
        """Return whether an autopilot drives the motors."""
        return self.firmware != "mcu"

    def equipped(self) -> Vehicle:
        """Return the vehicle in the robot's model, as equipped for the site."""
        return vehicle_at(self.site, load_vehicle(self.vehicle), navigation=self.aided)


@dataclass(frozen=True, kw_only=True)
class RobotJob(PoolJob):
    """Controller and its goal: a setpoint of T1 or a trajectory of T2."""

    controller: str
    """Policy directory, or the name of a PID."""
    fusion: bool = True
    """True if the controller observes the fused state, False if it observes the latest reading of each sensor."""
    position_noise: float = 0.0
    """Noise added to the controller's observation, per axis [m]."""
    yaw_noise: float = 0.0
    """Noise added to the controller's observation [rad]."""
    estimator: str = "error-state"
    """Model of the filter: error-state, with the IMU's accelerations, or constant-velocity, as in the paper."""
    duration: float = 60.0
    """Duration [s]; for T2 that of the trajectory."""

    @property
    def task(self) -> str:
        """Name of the task, t1 or t2."""
        return "t1" if self.target in T1_SETPOINTS else "t2"


def noise_seed(*labels: Any) -> int:
    """Return a seed from the labels of a trial: trials with other labels never share noise."""
    return zlib.crc32(" ".join(map(str, labels)).encode()) & 0x7FFFFFFF


def play_in_pool(
    trial: RobotTrial,
    start: Station,
    vehicle: Vehicle,
    plan: PoolPlan,
    *,
    seed: int,
    truth: Path | None = None,
    recorder: Recorder | None = None,
    **estimator: Any,
) -> TrialOutcome:
    """Play a trial with the robot's complete software in lock-step with a pool.

    Args:
        trial: Trial to play.
        start: Initial pose of the vehicle, at rest.
        vehicle: Vehicle in the robot's model.
        plan: Plan of the pool and the vehicle in it.
        seed: Seed of the noise.
        truth: File for the truth; none if None.
        recorder: Recorder of every message.
        estimator: Options of `Perception`.
    """
    world = plan.standing(start, seed=seed, truth=truth)
    if plan.firmware == "ardusub":
        # Dead reckoning starts at the start, whose position is exact.
        estimator = {"mode": "error-state", "let_in": start.position[:2], **estimator}
    perception = Perception(vehicle, plan.calibrated, **estimator)
    runtime = Runtime(vehicle, perception, trial.pilot, trial.guide, arm=True, recorder=recorder)
    runtime.attach(link_of("mavlink" if plan.firmware == "ardusub" else "pool", vehicle))
    longest = GETTING_READY + trial.duration
    with closing(world):
        run_lockstep(
            runtime, world, longest, show=trial.watch, until=lambda r: r.bridge.state == "fault" or trial.over(r)
        )  # fmt: skip
    return TrialOutcome(trial=trial, runtime=runtime, fault=fault_of(trial, runtime))


def job_trial(job: RobotJob, vehicle: Vehicle, *, seed: int = 0) -> tuple[RobotTrial, Station]:
    """Return the trial of a job, which ends after its duration, and its start.

    Args:
        job: Job with the controller and its goal.
        vehicle: Vehicle in the robot's model.
        seed: Seed of noise on the pilot's observation.

    Raises:
        PolicyError, ControlError: The controller does not match the vehicle or the task.
    """
    standing = load_vehicle(job.pool_vehicle)
    guide = guide_of(job.target, standing, site=job.site)
    first = guide.at(0.0)
    *position, yaw = (
        in_room(T1_START, standing, job.site) if job.task == "t1" else (*first.position, float(first.yaw))
    )
    duration = guide.duration if math.isfinite(guide.duration) else job.duration
    pilot = make_pilot(job.controller, vehicle, task=job.task)
    if job.position_noise or job.yaw_noise:
        pilot.disturb_input(position_std=job.position_noise, yaw_std=job.yaw_noise, seed=seed)
    trial = RobotTrial(
        name=f"{job.row}, {job.target}",
        pilot=pilot,
        guide=guide,
        duration=duration,
        over=lambda runtime: runtime.t >= duration,
        watch=_Estimates(),
    )
    return trial, Station(tuple(map(float, position)), float(yaw))  # type: ignore[arg-type]


class _Estimates:
    """Estimates of the robot, at the period of the time series."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, Any, Any]] = []

    def __call__(self, runtime: Runtime) -> None:
        reading, t = runtime.reading, runtime.t
        if reading is None or math.isnan(t) or (self._rows and t < self._rows[-1][0] + PERIOD - 1e-6):
            return
        self._rows.append((t, reading.position, reading.quaternion))

    def motion(self) -> VehicleMotion:
        """Return the complete motion."""
        t, position, quaternion = zip(*self._rows, strict=True) if self._rows else ((), (), ())
        columns = (np.reshape(x, (-1, n)) for x, n in ((position, 3), (quaternion, 4)))
        return VehicleMotion(t=np.array(t), **dict(zip(("position", "quaternion"), columns, strict=True)))


def play(job: RobotJob, path: Path) -> dict[str, Any]:
    """Play a job in its pool.

    Args:
        job: Job to play.
        path: Path of the true motion, without the suffix .npz.

    Returns:
        The measures, as from `play_trial`.
    """
    result, trial = play_trial(job)
    trial.motion.write(path)
    return result


def play_trial(job: RobotJob) -> tuple[dict[str, Any], GoalTrial]:
    """Play a job in its pool and evaluate it by the true motion.

    Args:
        job: Job to play.

    Returns:
        The measures of its task, `fault` (why the bridge stopped it, or empty), `localization` (errors of the
        estimate relative to the truth, rms) and the timing of the robot's loop; and the trial with its motion.
    """
    start_warp()
    began, seed = time.perf_counter(), noise_seed(job.seed, job.target)
    trial, start = job_trial(job, load_vehicle(job.vehicle), seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "truth"
        outcome = play_in_pool(
            trial,
            start,
            job.equipped(),
            job.plan(seed),
            seed=seed,
            truth=file,
            fusion=job.fusion,
            mode=job.estimator,
        )
        truth = read_truth(file)
    t = truth.time - outcome.runtime.started
    rows = np.flatnonzero((t >= 0.0) & (t <= trial.duration + 1e-6))
    rows = rows[:: max(1, round(PERIOD / np.median(np.diff(t))))]
    states = {name: getattr(truth, name) for name in ("position", "quaternion", "nu", "thrust")}
    motion = VehicleMotion(t=t, **states).between(rows)
    assert isinstance(trial.watch, _Estimates)
    localization = localization_errors(motion, trial.watch.motion())
    result, played = _measured(job, motion, outcome, began)
    return result | {"localization": localization}, played


def _measured(
    job: RobotJob, motion: VehicleMotion, outcome: TrialOutcome, began: float
) -> tuple[dict[str, Any], GoalTrial]:
    """Return the measures of a trial, and the trial with its motion."""
    trial = GoalTrial(name=job.target, guide=outcome.trial.guide, motion=motion)
    limits = load_vehicle(job.vehicle).force_limits
    result = {
        **trial.measures(job.task, limits, stopped=bool(outcome.fault)),
        "fault": outcome.fault,
        "room": room(load_vehicle(job.pool_vehicle).body.size) * SITE_SIZES[job.site],
        "localization": None,
        "missed_decisions": outcome.runtime.counters.missed,
        "seconds": time.perf_counter() - began,
        "provenance": provenance(),
    }
    return result, trial


def played_trial(result: Mapping[str, Any], folder: Path) -> GoalTrial:
    """Return the trial of a result, with its motion.

    Args:
        result: Result from `run_jobs`.
        folder: Folder in which `run_jobs` stored the motions.
    """
    target = result["job"]["target"]
    guide = guide_of(target, size=result.get("room", 1.0))
    return GoalTrial(name=target, guide=guide, motion=VehicleMotion.read(folder / result["key"]))


def play_jobs(
    jobs: Sequence[RobotJob],
    folder: Path,
    robot: OnRobot | None = None,
    *,
    console: Console | None = None,
    **options: Any,
) -> list[dict[str, Any]]:
    """Play the jobs without a result, in their pools or on a robot, scored by the truth or by the robot's own
    estimate.

    On a robot, a trial that the bridge stopped counts; without an attendant, nothing is played after it.
    Skipped trials are omitted.

    Args:
        jobs: Jobs; on a robot, of one vehicle, with plant 0, and severity and camera `HARDWARE`.
        folder: Folder for KEY.json, KEY.npz and, on a robot, KEY.mcap of each job, created if missing.
        robot: Robot and its options; it is not opened if no job remains. None for pools.
        console: Console for the state; standard error if None.
        options: Options of `run_jobs`, for pools.

    Raises:
        RobotError: A trial was stopped, and no attendant is present to check the vehicle; the next call
            continues. Or every trial was skipped.
        GoalError: A start or a goal is outside the workspace.
        PolicyError, ControlError: A controller does not match the vehicle.
        KeyboardInterrupt: Ctrl-C, or the operator ended the session.
    """
    if robot is None:
        return campaign.run_jobs(jobs, folder, play, **options)
    vehicle, console = load_vehicle(jobs[0].vehicle), console or Console(stderr=True)
    trials = {job.target: job_trial(job, vehicle) for job in jobs}
    equipped = robot.equipped(vehicle)
    check_starts({target: start for target, (_, start) in trials.items()}, equipped)
    for trial, _ in trials.values():
        check_reachable(trial.guide, equipped)

    def show(job: RobotJob, result: Mapping[str, Any]) -> None:
        held = "done" if result["success"] else result["fault"] or "not held"
        console.print(f"  {held}", highlight=False, markup=False)
        if result["fault"] and robot.unattended:
            raise RobotError(
                f"{job.row}, {job.target}: stopped (the trial counts): {result['fault']}: check the "
                "vehicle, then repeat the command, which continues with the next trial"
            )

    with ExitStack() as stack:
        opened: list[Session] = []

        def play_next(job: RobotJob, path: Path) -> dict[str, Any] | None:
            if not opened:
                opened.append(stack.enter_context(session(robot, vehicle, console=console)))
            return _play_on_robot(job, path, opened[0])

        results = campaign.run_jobs(jobs, folder, play_next, processes=1, show=show)
    if not results:
        raise RobotError("every trial was skipped: there is nothing to report")
    return results


def _play_on_robot(job: RobotJob, path: Path, opened: Session) -> dict[str, Any] | None:
    """Play one job; PATH.mcap is the record, PATH.npz the estimated motion. Return None if it was skipped."""
    began, vehicle, record = time.perf_counter(), opened.vehicle, path.with_name(f"{path.name}.mcap")
    trial, start = job_trial(job, vehicle, seed=job.seed)
    outcome = opened.trial(
        lambda: job_trial(job, vehicle, seed=job.seed)[0],
        start,
        record,
        counts=True,
        perception=lambda: Perception(opened.equipped, opened.site, mode=job.estimator, fusion=job.fusion),
        about={"command": f"finssim experiment {job.task}", "row": job.row},
    )
    if outcome is None:
        return None
    try:
        motion = read_record(record, job.task, vehicle, guide=trial.guide, duration=trial.duration).estimate
    except DriveError:  # stopped before its first decision
        nowhere = np.full((2, 4), np.nan)
        motion = VehicleMotion(t=np.array([0.0, 0.1]), position=nowhere[:, :3], quaternion=nowhere)
    origin = {"robot": opened.robot.title, "record": record.name}
    result, played = _measured(job, motion, outcome, began)
    played.motion.write(path)
    return result | origin
