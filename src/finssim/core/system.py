"""Differences between Linux, macOS and Windows: signals between processes, their parents, peak memory, text streams.

The branches for Windows and macOS follow their documentation; tests run them only by removing what these
systems lack. They have not been run on such a machine.
"""

from __future__ import annotations

import _thread
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

PARENT = "FINSSIM_PARENT"
"""Environment variable: process id of the parent; this process ends when the parent does."""
COUNT = 1.0, 10.0
"""Time between two progress lines of a silent command, on a terminal and elsewhere [s]."""
ORPHANED = 0.5
"""Time between two checks that the parent is running [s]."""
AGAIN = 0.05
"""Delay before a lost KeyboardInterrupt is repeated [s]."""
SEPARATE: dict[str, Any] = (
    {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
    if os.name == "nt"
    else {"start_new_session": True}
)
"""Options of `subprocess.Popen` for a child that the terminal's Ctrl-C does not reach; see `interrupt`."""


def stop_signals() -> list[int]:
    """Return the signals that end a command: Ctrl-C, SIGTERM, and SIGHUP or Windows' SIGBREAK where it exists.

    SIGHUP is excluded if it is ignored, as under nohup.
    """
    numbers: list[int] = [signal.SIGINT, signal.SIGTERM]
    for name in ("SIGHUP", "SIGBREAK"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            numbers.append(number)
    return numbers


@contextmanager
def handled(handler: Any) -> Iterator[None]:
    """Install a handler for all stop signals within the block; only the main thread may call this."""
    before = {number: signal.signal(number, handler) for number in stop_signals()}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


@contextmanager
def lost_interrupts_repeated() -> Iterator[None]:
    """Repeat each KeyboardInterrupt that Python discarded.

    Python discards an exception in a finalizer or in a callback whose errors C code ignores. It prints
    "Exception ignored in …", and the command continues as if Ctrl-C had not been pressed.
    """
    report = sys.unraisablehook
    pending: threading.Timer | None = None

    def again() -> None:
        nonlocal pending
        pending = None
        _interrupt(signal.SIGINT)

    def repeat(lost: Any) -> None:
        nonlocal pending
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            report(lost)
        elif pending is None:
            # Delayed: a signal sent from here would be discarded again.
            pending = threading.Timer(AGAIN, again)
            pending.daemon = True
            pending.start()

    sys.unraisablehook = repeat
    try:
        yield
    finally:
        sys.unraisablehook = report
        if pending is not None:
            pending.cancel()


def caused_by_interrupt(error: BaseException | None) -> bool:
    """Return whether a KeyboardInterrupt caused an error, as when it interrupts the creation of a class
    (Python 3.11)."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def interrupt(process: subprocess.Popen[Any]) -> None:
    """Ask a child that was started with `SEPARATE` to end, as Ctrl-C does."""
    process.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))


def follow_parent() -> None:
    """End this process when the process that started it ends, even if that is killed."""
    parent = os.environ.get(PARENT, "")
    if parent.isdecimal():
        _end_with(int(parent))


def prepare_worker(parent: int) -> None:
    """Prepare a process of `multiprocessing`: it ends with `parent`, which alone handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(parent)


def _end_with(parent: int) -> None:
    threading.Thread(target=_follow, args=(parent,), name="launcher", daemon=True).start()


def _follow(parent: int) -> None:
    while parent_runs(parent):
        time.sleep(ORPHANED)
    _interrupt(signal.SIGTERM)


def _interrupt(number: signal.Signals) -> None:
    """Send a signal to this process, from any of its threads."""
    if os.name == "nt":  # where os.kill would end the process immediately
        _thread.interrupt_main(number)
    else:
        os.kill(os.getpid(), number)


def parent_runs(pid: int) -> bool:
    """Return whether the process that started this one, `pid`, is still running."""
    if os.name != "nt":
        return os.getppid() == pid
    import ctypes

    synchronize, timeout = 0x00100000, 0x102
    kernel: Any = ctypes.windll.kernel32  # type: ignore[attr-defined,unused-ignore]
    handle = kernel.OpenProcess(synchronize, False, pid)
    if not handle:
        return False
    try:
        return bool(kernel.WaitForSingleObject(handle, 0) == timeout)
    finally:
        kernel.CloseHandle(handle)


def processor_name() -> str:
    """Return the model of this machine's processor, or its architecture if the system does not report the model."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def peak_memory() -> float:
    """Return the peak memory of this process [MiB]; NaN if the system does not report it (Windows)."""
    try:
        import resource
    except ImportError:
        return float("nan")
    # Linux counts kibibytes, macOS bytes.
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / (
        2**20 if sys.platform == "darwin" else 2**10
    )


def announce(text: str, after: float = 1.0) -> Callable[[], None]:
    """Print a line with the elapsed seconds on standard error until something else is printed.

    On a terminal it is updated every second and finally erased; elsewhere it is printed again every 10 s.

    Args:
        text: The line.
        after: Delay of the first line [s].

    Returns:
        A function that stops the printing.
    """
    error, lock, printed, began = sys.stderr, threading.Lock(), threading.Event(), time.monotonic()
    own, terminal, shown = error.write, error.isatty(), False

    def end() -> None:
        with lock:
            if not printed.is_set() and terminal and shown:
                own("\r\x1b[K")
                error.flush()
            printed.set()

    def count() -> None:
        nonlocal shown
        wait = after
        while not printed.wait(wait):
            with lock:
                if printed.is_set():
                    return
                line = f"{text}, {time.monotonic() - began:.0f} s" if shown else text
                own(f"\r{line}" if terminal else f"{line}\n")
                error.flush()
                shown, wait = True, COUNT[0 if terminal else 1]

    for stream in (sys.stdout, error):

        def write(characters: str, write: Any = stream.write) -> Any:
            if not printed.is_set():
                end()
            return write(characters)

        stream.write = write  # type: ignore[method-assign]
    threading.Thread(target=count, name="announce", daemon=True).start()
    return end


def replace_unwritable(*streams: TextIO) -> None:
    """Write `?` for characters that a stream's encoding lacks, such as an arrow in a file of code page 1252."""
    for stream in streams:
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
