"""Messages of ArduPilot logs: DataFlash `.BIN` and telemetry `.tlog`, through pymavlink."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.trial import Array

__all__ = ["DATAFLASH", "Log", "read_log"]

DATAFLASH = b"\xa3\x95"
"""First bytes of a DataFlash log."""

AUTOPILOT = 1
"""MAVLink component of the autopilot."""

NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID, in the heartbeats of ground stations and cameras."""

WRONG_CLOCK = 5.0
"""A stamp farther than this from the time of receipt is of another clock [s]."""


@dataclass(frozen=True)
class Log:
    """What a log holds, by kind of message."""

    shown: str
    telemetry: bool
    """Whether it is a `.tlog`."""
    times: dict[str, Array] = field(default_factory=dict)
    """Kind -> times [s], (n,)."""
    messages: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    """Kind -> fields of each message, n of them."""
    parameters: dict[str, float] = field(default_factory=dict)
    """The autopilot's parameters, as last said."""

    def has(self, kind: str) -> bool:
        """Whether there are two such messages at least."""
        return len(self.messages.get(kind, ())) >= 2

    def numbers(self, kind: str, name: str) -> Array:
        """A field of every message of a kind, NaN where it has none, (n,)."""
        return np.array([_number(message.get(name)) for message in self.messages[kind]], dtype=float)

    def some(self, kind: str, name: str, value: int) -> Log:
        """The log with only those messages of a kind whose field has that value; all where none has the field."""
        if not any(name in message for message in self.messages.get(kind, ())):
            return self
        keep = [i for i, message in enumerate(self.messages[kind]) if message.get(name) == value]
        return Log(
            self.shown,
            self.telemetry,
            {**self.times, kind: self.times[kind][keep]},
            {**self.messages, kind: [self.messages[kind][i] for i in keep]},
            self.parameters,
        )


def read_log(path: Path, kinds: frozenset[str], *, received: bool = False) -> Log:
    """The messages of some kinds; a log that was cut short is read up to the cut.

    Args:
        path: `.BIN` or `.tlog`.
        kinds: Names of messages.
        received: Whether telemetry is timed by its receipt, not by the stamps of the autopilot.

    Raises:
        CalibrationError: No such messages: it is no log, or an empty one.
        ModuleNotFoundError: pymavlink is not installed.
    """
    try:
        with path.open("rb") as file:
            dataflash = file.read(2) == DATAFLASH
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror or error}") from None
    log = Log(path.name, not dataflash)
    clock = _Clock(received)
    for kind, message, receipt in _messages(path, dataflash, kinds | {"PARM", "PARAM_VALUE", "HEARTBEAT"}):
        if kind == "PARM":
            log.parameters[message["Name"]] = float(message["Value"])
        elif kind == "PARAM_VALUE":
            log.parameters[message["param_id"]] = float(message["param_value"])
        if kind in kinds:
            log.messages.setdefault(kind, []).append(message)
            clock.add(kind, message, receipt)
    log.times.update(clock.times() if log.telemetry else clock.boot_times())
    if not log.messages:
        raise CalibrationError(
            f"{path}: holds no messages that a trial could use: expected an ArduSub log, .BIN or .tlog"
        )
    return log


class _Clock:
    """Times of messages: the autopilot's stamps, laid on the times of receipt."""

    def __init__(self, received: bool) -> None:
        self.received = received
        self.receipts: dict[str, list[float]] = {}
        self.stamps: dict[str, list[float]] = {}
        self.boots: dict[str, list[int]] = {}
        self.offsets = [math.inf]
        self.last = -math.inf

    def add(self, kind: str, message: dict[str, Any], receipt: float) -> None:
        stamp = _stamp(message)
        if math.isfinite(stamp) and "VISION" not in kind:
            if stamp < self.last - 1.0:  # the autopilot started again
                self.offsets.append(math.inf)
            self.last = stamp
            # The message that travelled fastest tells the difference of the clocks.
            self.offsets[-1] = min(self.offsets[-1], receipt - stamp)
        self.receipts.setdefault(kind, []).append(receipt)
        self.stamps.setdefault(kind, []).append(stamp)
        self.boots.setdefault(kind, []).append(len(self.offsets) - 1)

    def boot_times(self) -> dict[str, Array]:
        """Stamps as they are, of a log that the autopilot wrote itself."""
        return {kind: np.array(stamps) for kind, stamps in self.stamps.items()}

    def times(self) -> dict[str, Array]:
        found = {}
        for kind, receipts in self.receipts.items():
            receipt = np.array(receipts)
            stamped = np.array(self.stamps[kind]) + np.array(self.offsets)[self.boots[kind]]
            ours = np.isfinite(stamped) & (np.abs(stamped - receipt) < WRONG_CLOCK) & (not self.received)
            found[kind] = np.where(ours, stamped, receipt)
        return found


def _stamp(message: dict[str, Any]) -> float:
    """Seconds since the autopilot started; NaN where the message does not say."""
    for name, unit in (("TimeUS", 1e-6), ("time_boot_ms", 1e-3), ("time_usec", 1e-6), ("usec", 1e-6)):
        if message.get(name):
            return float(message[name]) * unit
    return math.nan


def _messages(
    path: Path, dataflash: bool, kinds: frozenset[str]
) -> Iterator[tuple[str, dict[str, Any], float]]:
    """Kind, fields and time of receipt [s] of each message of the autopilot."""
    from pymavlink import DFReader, mavutil

    complaints = io.StringIO()  # pymavlink prints what it skips at a cut
    with contextlib.redirect_stderr(complaints), contextlib.redirect_stdout(complaints):
        try:
            log = (
                DFReader.DFReader_binary(str(path))
                if dataflash
                else mavutil.mavlogfile(str(path), robust_parsing=True)
            )
        except Exception as error:  # pymavlink raises whatever it stumbles over
            raise CalibrationError(f"{path}: not an ArduPilot log: {error}") from None
        systems: set[int] = set()
        try:
            while True:
                try:
                    message = log.recv_match(type=sorted(kinds))
                except Exception:  # the same, at the cut of a log
                    break
                if message is None:
                    break
                kind = message.get_type()
                if not dataflash and not _of_autopilot(message, kind, systems):
                    continue
                yield kind, message.to_dict(), float(message._timestamp)
        finally:
            close = getattr(log, "close", None)
            if close is not None:
                close()


def _of_autopilot(message: Any, kind: str, systems: set[int]) -> bool:
    """Whether the vehicle's autopilot sent it; position sensors speak for themselves."""
    if kind == "HEARTBEAT":
        if message.autopilot == NO_AUTOPILOT:
            return False
        systems.add(message.get_srcSystem())
    if kind.startswith("VISION"):
        return True
    return message.get_srcComponent() == AUTOPILOT and (not systems or message.get_srcSystem() in systems)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan
