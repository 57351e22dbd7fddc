"""kill -9 of the robot and of the pool: real processes, on their real wires, in real time."""

from __future__ import annotations

import json
import math
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from finssim.experiments.reliability.job import FaultJob
from finssim.experiments.reliability.processes import (
    Process,
    ReliabilityError,
    await_flush,
    await_thrust,
    free_ports,
    start,
    until,
)
from finssim.experiments.reliability.record_check import first_stop, newest_message
from finssim.experiments.reliability.verdict import QUIET, STILL, inset, measured, passed
from finssim.experiments.reliability.wire import Course
from finssim.pool.truth import read_truth
from finssim.provenance import provenance
from finssim.robot.link.decoder import MCU, Decoder
from finssim.vehicles import load_vehicle

__all__ = ["KILLS", "play_kill"]

DRIVING = {
    "station": ("0,0,-0.5,0", "0,0,-0.5,0", 4.0),
    "moving": ("-1.2,-0.3,-0.5,0", "1.2,0.3,-0.5,60", 1.5),
}
"""Motion -> start, goal, and how long after the first thrust the kill comes [s]."""
ATTEMPTS = 3
WATCHED = 8.0
"""How long the one that lives on is watched [s]."""


@dataclass(frozen=True)
class _Pair:
    """A robot in a pool, each in a process of its own."""

    pool: Process
    robot: Process
    truth: Path
    record: Path
    port: int
    """Of the motor controller."""
    peer: int
    """Of the robot."""


def play_kill(job: FaultJob) -> dict[str, Any]:
    """Play a job whose scenario is one of `KILLS`; returns what `lockstep_trial.play` does.

    Raises:
        ReliabilityError: The vehicle never drove, in three attempts: a machine with too much to do stops it
            before it is to be killed.
    """
    for attempt in range(ATTEMPTS):
        try:
            with tempfile.TemporaryDirectory() as folder, _pair(job, Path(folder)) as pair:
                result = KILLS[job.scenario][1](job, pair)
                break
        except ReliabilityError:
            if attempt == ATTEMPTS - 1:
                raise
    result["provenance"] = provenance()
    return {**result, "ok": passed(result)}


@contextmanager
def _pair(job: FaultJob, folder: Path) -> Iterator[_Pair]:
    """Both at work, the vehicle driving."""
    port, peer = free_ports()
    begin, goal, _ = DRIVING[job.motion]
    truth, record, known = folder / "truth", folder / "run.mcap", folder / "pool.yaml"
    world = [
        "--plant",
        str(job.plant),
        "--severity",
        job.severity,
        "--seed",
        str(job.seed),
        "--camera",
        "corners",
    ]
    wires = ["--port", str(port), "--robot", f"127.0.0.1:{peer}", "--start", begin]
    files = ["--pool-file", str(known), "--truth", str(truth)]
    ours = [
        "--policy",
        "pid",
        "--goal",
        goal,
        "--pool-file",
        str(known),
        "--record",
        str(record),
        "--arm",
        "--json",
    ]
    ends = ["--robot", f"udp://127.0.0.1:{port}", "--bind", f"127.0.0.1:{peer}"]
    ends += ["--pictures", f"udp://127.0.0.1:{port + 1}", "--vehicle", job.vehicle]
    with start(["pool", "--vehicle", job.vehicle, *world, *wires, *files], folder, "pool") as pool:
        until("pictures: ", pool)
        with start(["run", *ours, *ends], folder, "robot") as robot:
            await_thrust(truth, STILL, robot)
            yield _Pair(pool, robot, truth, record, port, peer)


def _kill_robot(job: FaultJob, pair: _Pair) -> dict[str, Any]:
    """The motor controller is left alone: its own timeout has to stop the motors."""
    time.sleep(DRIVING[job.motion][2])
    began, killed = await_flush(pair.truth), time.monotonic()
    pair.robot.kill()
    time.sleep(WATCHED)
    pair.pool.end()
    truth, safety = read_truth(pair.truth), load_vehicle(job.vehicle).safety
    course = Course(truth.time, truth.position, truth.thrust, np.full(len(truth.time), math.nan))
    box = inset(safety.workspace_lower, safety.workspace_upper)
    return {
        **measured(course, began, float(truth.time[-1]), box),
        "frames_off_s": 0.0,
        "state": "gone",
        "reason": "the motor controller stops by itself",
        "raised": pair.pool.broke(),
        **_lost(pair.record, killed),
    }


def _kill_pool(job: FaultJob, pair: _Pair) -> dict[str, Any]:
    """Vehicle and camera fall silent: the robot has to stop commanding.

    What it sends is heard at the pool's port, as soon as the system has given that free, and its bridge has put into
    the record when it stopped: the later of the two counts.
    """
    time.sleep(DRIVING[job.motion][2])
    began, killed = await_flush(pair.truth), time.monotonic()
    pair.pool.kill()
    heard = _last_enabled(pair, killed)
    pair.robot.end()
    ended, truth = time.monotonic(), read_truth(pair.truth)
    stopped = first_stop(pair.record, killed)
    off = None if heard is None or stopped is None else max(heard, stopped - killed)
    told = json.loads(pair.robot.said or "{}")
    course = Course(truth.time, truth.position, truth.thrust, np.ones(len(truth.time)))
    before = measured(course, began, began, None)
    return {
        **before,
        # Of the vehicle nothing is left: the last frame that would turn a motor counts in place of its thrust.
        "thrust_gone_s": off,
        "frames_off_s": off,
        "state": told.get("state", "no answer"),
        "reason": told.get("reason", ""),
        "raised": pair.robot.broke(),
        **_lost(pair.record, ended),
    }


def _last_enabled(pair: _Pair, killed: float) -> float | None:
    """When the last frame that enables motors came after the kill [s]; None if they never ended."""
    decoder, last = Decoder(MCU), killed
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", pair.port))
        end.settimeout(0.1)
        while pair.robot.running and time.monotonic() < killed + WATCHED:
            try:
                data = end.recv(2048)
            except TimeoutError:
                continue
            if any(command.enable for command in decoder.feed(data)):
                last = time.monotonic()
    # A process that has ended sends nothing more.
    return last - killed if not pair.robot.running or time.monotonic() - last > QUIET else None


def _lost(record: Path, cut: float) -> dict[str, Any]:
    """How much the record lacks at its end if that was cut [s]; the robot's clock is this machine's."""
    newest, problem = newest_message(record)
    return {"record_lost_s": None if newest is None else max(cut - newest, 0.0), "record_problem": problem}


KILLS: dict[str, tuple[str, Callable[[FaultJob, _Pair], dict[str, Any]]]] = {
    "kill-robot": ("kill -9 of the robot's process", _kill_robot),
    "kill-pool": ("kill -9 of the pool's process", _kill_pool),
}
"""Name -> title and what plays it."""
