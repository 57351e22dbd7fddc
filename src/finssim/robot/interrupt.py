"""Ctrl-C, or a terminal that closes, ends a loop between two steps, so that thrusters are stopped in good order."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

PARENT = "FINSSIM_PARENT"
"""Environment of a process: the one without which it ends too."""
ORPHANED = 0.5
"""Between looks whether it is there [s]."""


def follow_parent() -> None:
    """End with the process that started this one, even if that was killed."""
    parent = os.environ.get(PARENT, "")
    if not parent.isdecimal():
        return

    def watch() -> None:
        while os.getppid() == int(parent):
            time.sleep(ORPHANED)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="launcher", daemon=True).start()


def _stopping() -> list[int]:
    """Return the signals that end a command: Ctrl-C, SIGTERM and, where the system has it, SIGHUP.

    SIGHUP stays ignored where it is, as under nohup.
    """
    hangup = getattr(signal, "SIGHUP", None)
    heard = hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN
    return [signal.SIGINT, signal.SIGTERM, *([hangup] if heard else [])]


@contextmanager
def _handled(handler: Any) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in _stopping()}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Give a function that answers whether Ctrl-C, SIGTERM or SIGHUP has come; a second one interrupts at once."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    requested = False

    def end(number: int, frame: object) -> None:
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True

    with _handled(end):
        yield lambda: requested


@contextmanager
def interrupting() -> Iterator[None]:
    """Raise KeyboardInterrupt for Ctrl-C, SIGTERM and SIGHUP, also where Ctrl-C was ignored at the start."""
    with _handled(signal.default_int_handler):
        yield
