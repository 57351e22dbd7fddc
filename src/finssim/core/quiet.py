"""Start Warp without its usual output, and report when kernels are compiled."""

from __future__ import annotations

import ctypes.util
import multiprocessing
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

_COMPILED = re.compile(r"Module (?P<name>\S+) .* took (?P<ms>[\d.]+) ms +\(compiled\)")


@cache  # searching for the driver's library starts six processes
def start_warp() -> None:
    """Initialise Warp silently, once per process; afterwards it reports warnings and errors, and compilations
    on standard error.

    Its banner goes to standard output, where it would corrupt JSON. Its native library warns on standard error if
    there is no NVIDIA driver: this is expected on a laptop (`finssim doctor` reports it), so it is suppressed.
    """
    import warp as wp

    start: Any = wp.init
    wp.config.log_level = max(wp.config.log_level, wp.LOG_INFO)
    wp.set_logger(_Compilations(wp.get_logger()))
    if ctypes.util.find_library("cuda") or ctypes.util.find_library("nvcuda"):
        start()
    else:
        with _silent_stderr():
            start()
    kernels = Path(str(wp.config.kernel_cache_dir))
    if not (kernels.is_dir() and any(kernels.iterdir())):
        _print_line(f"compiling kernels when they are first used, once on this machine, into {kernels}:")


class _Compilations:
    """Warp's logger without its notes; each compiled module of kernels is reported in one line."""

    def __init__(self, log: Any) -> None:
        self.debug, self.warning, self.error = log.debug, log.warning, log.error

    def info(self, message: str) -> None:
        compiled = _COMPILED.search(message)
        if compiled is not None:
            name = compiled["name"].split("__locals__")[0].removeprefix("finssim.")
            _print_line(f"compiled the kernels of {name} in {float(compiled['ms']) / 1000:.1f} s")


def _print_line(line: str) -> None:
    """Print a line on standard error, only in the command's main process: lines of child processes would
    interleave."""
    if multiprocessing.parent_process() is None:
        print(line, file=sys.stderr, flush=True)


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discard output on the process's standard error, also by native code, within the block."""
    saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)
