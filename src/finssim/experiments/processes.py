"""The processes of a robot and its virtual pool: started as a person starts them, watched, and killed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from finssim.pool import TruthError, read_truth

__all__ = ["Pair", "Process", "ReliabilityError", "await_flush", "await_thrust", "pair"]

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

    def broke(self) -> str:
        """What broke through to the person who started it; nothing if it ended as it should."""
        lines = self.complained.splitlines()
        if any(line.startswith("Traceback") for line in lines) or self._process.returncode == 1:
            return f"{self.name}: {lines[-1] if lines else 'exit status 1'}"
        return ""


@contextmanager
def start(words: Sequence[str], folder: Path, name: str) -> Iterator[Process]:
    """A process that does not outlive the block; arguments as of `Process`."""
    process = Process(words, folder, name)
    try:
        yield process
    finally:
        if process.running:
            process.kill()


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
    with start(world, folder, "pool") as first:
        await_line("pictures: ", first)
        with start([*ours, *wires], folder, "robot") as second:
            yield Pair(first, second, port)


def await_line(text: str, process: Process) -> None:
    """Wait until a process has said something.

    Raises:
        ReliabilityError: It ended, or took too long.
    """
    deadline = time.monotonic() + STARTING
    while text not in process.said:
        if not process.running or time.monotonic() > deadline:
            raise ReliabilityError(
                f"{process.name} never said '{text}': {process.complained.strip()[-300:] or 'no error'}"
            )
        time.sleep(10.0 * POLL)


def await_thrust(truth: Path, bound: float, process: Process) -> None:
    """Wait until the thrusters of a pool turn, as its truth file tells.

    Raises:
        ReliabilityError: They never do, or the process that should turn them has ended.
    """
    deadline = time.monotonic() + STARTING
    while True:
        try:
            if abs(read_truth(truth).thrust[-50:]).max(initial=0.0) > bound:
                return
        except TruthError:
            pass  # not begun yet
        if not process.running or time.monotonic() > deadline:
            why = (process.complained + process.said).strip()[-300:] or "it said nothing"
            raise ReliabilityError(f"no thruster ever turned: {process.name}: {why}")
        time.sleep(20.0 * POLL)


def await_flush(truth: Path) -> float:
    """Wait for the next piece of a truth file that grows; returns the pool's clock then [s].

    The pool writes half a second at a time, so that the last record is as old as one look takes.
    """
    size, deadline = truth.stat().st_size, time.monotonic() + STARTING
    while truth.stat().st_size == size:
        if time.monotonic() > deadline:
            raise ReliabilityError(f"{truth} does not grow: the pool stands still")
        time.sleep(POLL)
    return float(read_truth(truth).time[-1])


def free_ports() -> tuple[int, int]:
    """Ports of the pool's and of the robot's end; the two after the first and the one after the second are free too."""
    for _ in range(100):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            first = probe.getsockname()[1]
        wanted = [first + k for k in range(6)]
        if wanted[-1] < 65536 and all(map(_free, wanted)):
            return first, first + 4
    raise ReliabilityError("no six free ports in a row on this machine: end some programs")


def _free(port: int) -> bool:
    try:
        for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
            with socket.socket(socket.AF_INET, kind) as probe:
                probe.bind(("127.0.0.1", port))
    except OSError:
        return False
    return True
