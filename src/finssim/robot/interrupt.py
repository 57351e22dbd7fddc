"""Interruption of a loop between two steps by Ctrl-C or a closed terminal, so that thrusters are stopped properly."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from finssim.core.system import caused_by_interrupt, handled


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether a stop signal was received; a second signal interrupts immediately."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    requested = False

    def end(number: int, frame: object) -> None:
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True

    with handled(end):
        yield lambda: requested


@contextmanager
def interrupting() -> Iterator[None]:
    """Raise KeyboardInterrupt for every stop signal, even if Ctrl-C was ignored at the start."""
    with handled(signal.default_int_handler):
        try:
            yield
        except Exception as error:
            if caused_by_interrupt(error):
                raise KeyboardInterrupt from error
            raise
