"""The wire as a serial line, which may be unplugged and plugged in again."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from typing import Any

from finssim.robot.link.layout import LinkError

__all__ = ["SerialTransport"]

_LOG = logging.getLogger("finssim.robot.link")
_AT_ONCE = 65536
"""Bytes taken by one call."""


class SerialTransport:
    """8N1 without flow control, opened for this program alone; a lost device is tried again every second.

    Note:
        `send_errors` counts frames that found no line, `reconnects` how often it came back.
    """

    def __init__(
        self,
        device: str,
        baud: int = 115200,
        *,
        retry: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Args:
            device: Path or name as the operating system has it.
            baud: Bits a second.
            retry: Time between attempts to open a lost device [s].
            clock: Tells the time for it [s].

        Raises:
            LinkError: The device cannot be opened now.
        """
        self.device, self.baud, self.retry = device, baud, retry
        self.send_errors, self.reconnects = 0, 0
        self._clock, self._next_try, self._closed = clock, 0.0, False
        self._port: Any = None
        try:
            self._port = _opened(device, baud)
        except LinkError:
            raise
        except _problems(ValueError) as problem:
            raise LinkError(
                f"serial:{device}: cannot be opened at {baud} baud ({problem}): check the cable, the name, "
                "your right to use it and that no other program does"
            ) from None

    def send(self, data: bytes) -> None:
        """Write one frame; without a line, or on one that is stuck, it is counted and dropped."""
        if not self._ready():
            self.send_errors += 1
            return
        try:
            if _written(self._port, data) < len(data):
                self._forget_waiting()
        except BlockingIOError:
            self._forget_waiting()
        except _problems() as problem:
            self.send_errors += 1
            self._lose(problem)

    def receive(self) -> list[bytes]:
        """What has come, as one piece or none; opens a lost device again when it is time."""
        if not self._ready():
            return []
        try:
            data = bytes(self._port.read(_AT_ONCE))
        except _problems() as problem:
            self._lose(problem)
            return []
        return [data] if data else []

    def close(self) -> None:
        """Close the device for good."""
        self._closed = True
        self._drop()

    def describe(self) -> str:
        """Device, speed and whether it is there."""
        state = "closed" if self._closed else "connected" if self._port else "not connected"
        return f"serial {self.device} at {self.baud} baud, {state}"

    def _ready(self) -> bool:
        """Whether there is a line, after an attempt to open it if one is due."""
        now = self._clock()
        if self._port is None and not self._closed and now >= self._next_try:
            self._next_try = now + self.retry
            try:
                self._port = _opened(self.device, self.baud)
            except _problems():
                return False
            self.reconnects += 1
            _LOG.warning("serial %s: is back", self.device)
        return self._port is not None

    def _forget_waiting(self) -> None:
        """Drop what a stuck line has not taken: by the time that it moves again those commands are old."""
        self.send_errors += 1
        try:
            self._port.reset_output_buffer()
        except _problems() as problem:
            self._lose(problem)

    def _lose(self, problem: BaseException) -> None:
        _LOG.warning("serial %s: lost (%s); trying again every %g s", self.device, problem, self.retry)
        self._next_try = self._clock() + self.retry
        self._drop()

    def _drop(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except _problems() as problem:
                _LOG.debug("serial %s: closing a lost device: %s", self.device, problem)


def _opened(device: str, baud: int) -> Any:
    try:
        import serial
    except ImportError:
        raise LinkError(
            f"serial:{device}: needs pyserial, which is not installed: pip install 'finssim[hardware]'"
        ) from None
    return serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)


def _problems(*more: type[Exception]) -> tuple[type[Exception], ...]:
    """What a lost device raises: `termios.error` is no OSError, and other systems have none."""
    try:
        from termios import error
    except ImportError:
        return (OSError, *more)
    return (OSError, error, *more)


def _written(port: Any, data: bytes) -> int:
    """Bytes that the line took at once; pyserial's own `write` waits on POSIX, whatever its timeout."""
    return os.write(port.fileno(), data) if os.name == "posix" else int(port.write(data))
