"""Trials one after the other on a robot that stays where it is between them: guided, interrupted, gone on with."""

from __future__ import annotations

import math
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.status import Status

from finssim.control.guidance import Station
from finssim.experiments.on_robot.play import Attendant, Outcome, Placing, RobotTrial, play
from finssim.files import atomic_directory, refuse_unwritable
from finssim.localization.pool import Pool, load_pool
from finssim.robot.goals import check_reachable
from finssim.robot.keyboard import Keyboard
from finssim.robot.link.transports import DEFAULT_BIND
from finssim.robot.perception import Perception
from finssim.robot.recorder import Recorder
from finssim.robot.wiring import Drive, Wiring, connected
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["OnRobot", "RobotError", "Session", "check_starts", "kept_folder", "session"]

MARK = ".on-robot"
"""File by which a folder of such trials is known."""
ABORTED = "aborted"
"""Folder of the records of trials that were stopped and do not count."""


class RobotError(ValueError):
    """Trials on a robot cannot be made, or cannot go on."""


@dataclass(frozen=True, kw_only=True)
class OnRobot:
    """A robot, and how trials are made on it."""

    wiring: Wiring
    """Its wires; a virtual pool in a process of its own is another of them."""
    pool_file: Path
    """Camera, water and frames."""
    arm: bool = False
    """Thrusters may turn; trials are refused without it."""
    by_hand: bool = False
    """Somebody carries the vehicle to every start; False: the tuned PID steers it there."""
    unattended: bool = False
    """Nobody presses a key: the way to a start begins as soon as the state is known, and a fault ends it all."""

    @property
    def title(self) -> str:
        """The robot's address."""
        return f"{self.wiring.robot}{', lock-step' if self.wiring.lockstep else ''}"

    @property
    def options(self) -> str:
        """Words of a command line that name it."""
        wiring = self.wiring
        words = ["--robot", wiring.robot, "--pool-file", str(self.pool_file)]
        words += ["--bind", wiring.bind] if wiring.bind != DEFAULT_BIND else []
        words += ["--pictures", wiring.pictures] if wiring.pictures else []
        return shlex.join([*words, *(["--lockstep"] if wiring.lockstep else [])])


class _Screen:
    """A terminal: one line that changes, and keys."""

    def __init__(self, keyboard: Keyboard, status: Status) -> None:
        self._keyboard, self._status, self._newest = keyboard, status, -math.inf

    def keys(self) -> Sequence[str]:
        return self._keyboard.pressed()

    def line(self, text: str) -> None:
        now = time.monotonic()
        if now - self._newest >= 0.25:
            self._newest = now
            self._status.update(text)


class Session:
    """An open robot; made by `session`."""

    def __init__(
        self,
        robot: OnRobot,
        vehicle: Vehicle,
        site: Pool,
        drive: Drive,
        attendant: Attendant | None,
        say: Callable[[str], None],
    ) -> None:
        self.robot, self.vehicle, self.site = robot, vehicle, site
        self._drive, self._attendant, self._say = drive, attendant, say

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
    ) -> Outcome | None:
        """Play a trial until it is done, the operator skips it, or it cannot be.

        Args:
            make: The trial, anew for every attempt.
            start: Where it begins.
            record: File of its record, made once it is done; records of attempts that do not count go to `aborted/`.
            counts: Whether a trial that the bridge stopped counts as it is; it is played again if not. One that the
                operator stopped never counts.
            exact: Whether the vehicle must be at its start to the centimetre and at rest, however long that takes.
            perception: Otherwise than by default, made anew for every attempt.
            about: Metadata of the record.

        Returns:
            How it went; None if it was skipped.

        Raises:
            RobotError: It cannot be played, and nobody is there to help.
            KeyboardInterrupt: Ctrl-C, or the operator ended the session.
        """
        while True:
            trial = make()
            x, y, z = start.position
            self._say(f"{trial.name}: from {x:.2f}, {y:.2f}, {z:.2f} m, {math.degrees(start.yaw):.0f}°")
            placing = Placing(start=start, by_hand=self.robot.by_hand, exact=exact, attendant=self._attendant)
            outcome, partial = self._attempt(trial, placing, record, perception, about or {})
            stopped_by_hand = outcome.fault == "stopped by the operator"
            done = outcome.ended == "over" or (
                counts and outcome.begun and outcome.ended == "fault" and not stopped_by_hand
            )
            if done:
                record.parent.mkdir(parents=True, exist_ok=True)
                partial.replace(record)
                return outcome
            self._put_away(partial, record, outcome)
            if outcome.ended == "skipped":
                self._say(f"{trial.name}: skipped")
                return None
            if outcome.ended == "interrupted":
                raise KeyboardInterrupt
            if self._attendant is None:
                raise RobotError(
                    f"{trial.name}: {outcome.fault}: look at the vehicle, then give the command again: it goes on here"
                )
            self._say(f"{trial.name}: {outcome.fault}: once more, or s to skip it")

    def _attempt(
        self,
        trial: RobotTrial,
        placing: Placing,
        record: Path,
        perception: Callable[[], Perception] | None,
        about: Mapping[str, Any],
    ) -> tuple[Outcome, Path]:
        """One attempt and its record, which is not yet in its place."""
        partial = record.with_name(f".{record.stem}.partial.mcap")
        partial.parent.mkdir(parents=True, exist_ok=True)
        partial.unlink(missing_ok=True)
        meta = {
            "pilot": trial.pilot.describe(),
            "guide": trial.guide.name,
            "armed": True,
            "robot": self.robot.wiring.robot,
            "pool_sha256": self.site.sha256,
            **about,
        }
        epoch = 0.0 if self.robot.wiring.lockstep else time.time() - time.monotonic()
        files = {"pool.yaml": self.robot.pool_file}
        with Recorder(partial, self.vehicle, meta, pictures="none", epoch=epoch, files=files) as recorder:
            outcome = play(
                trial,
                self._drive,
                self.vehicle,
                self.site,
                perception=perception and perception(),
                recorder=recorder,
                placing=placing,
            )
        if recorder.problem and outcome.ended == "over":
            raise RobotError(f"{record}: {recorder.problem}")
        return outcome, partial

    def _put_away(self, partial: Path, record: Path, outcome: Outcome) -> None:
        """Keep what there is of a trial that was begun; nothing was recorded of one that was not."""
        if not outcome.begun:
            partial.unlink(missing_ok=True)
            return
        folder = record.parent / ABORTED
        folder.mkdir(exist_ok=True)
        number = 1 + sum(1 for _ in folder.glob(f"{record.stem}_*.mcap"))
        partial.replace(folder / f"{record.stem}_{number}.mcap")


@contextmanager
def session(
    robot: OnRobot,
    vehicle: Vehicle,
    *,
    attendant: Attendant | None = None,
    console: Console | None = None,
) -> Iterator[Session]:
    """Open a robot for trials.

    Args:
        robot: Which, and how.
        vehicle: As its file has it.
        attendant: Instead of the terminal's keyboard.
        console: Where it is told how it stands; standard error if None.

    Raises:
        RobotError: It may not be armed, or nobody is there to press keys.
        LinkError, LockstepError, LocalizationError: It cannot be reached, or its pool file cannot be used.
    """
    if not robot.arm:
        raise RobotError("trials turn thrusters: give --arm when the water is clear of people and cables")
    if robot.unattended and robot.by_hand:
        raise RobotError(
            "by hand somebody has to press enter at every start: leave --unattended or --by-hand out"
        )
    console = console or Console(stderr=True)
    site = load_pool(robot.pool_file)
    with ExitStack() as stack:
        drive = stack.enter_context(connected(robot.wiring, vehicle, site))
        if attendant is None and not robot.unattended:
            if not sys.stdin.isatty():
                raise RobotError(
                    "nobody can press enter, as standard input is no terminal: run it in one, or give --unattended"
                )
            keyboard = Keyboard()
            stack.enter_context(keyboard)
            attendant = _Screen(keyboard, stack.enter_context(console.status("waiting for the vehicle")))

        def say(text: str) -> None:
            console.print(text, highlight=False, markup=False)

        yield Session(robot, vehicle, site, drive, attendant, say)


@contextmanager
def kept_folder(out: Path) -> Iterator[Path]:
    """A folder in which trials on a robot stay as they are made: new, empty, or begun by an earlier call.

    Raises:
        OutputError: It holds somebody's files.
    """
    if out.exists() and not (out / MARK).is_file():
        refuse_unwritable(atomic_directory(out))
    out.mkdir(parents=True, exist_ok=True)
    (out / MARK).touch()
    yield out


def check_starts(starts: Mapping[str, Station], vehicle: str | Vehicle) -> None:
    """Refuse starts outside the workspace of a vehicle before anything is armed.

    Raises:
        GoalError: One is; says which.
    """
    body = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    for name, start in starts.items():
        check_reachable(Station(start.position, start.yaw, name=f"the start of {name}"), body)
