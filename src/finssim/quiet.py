"""Start Warp without what it prints to every user's terminal."""

from __future__ import annotations

import ctypes.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

__all__ = ["start_warp"]


@cache  # searching for the driver's library starts six processes
def start_warp() -> None:
    """Initialise Warp silently, once a process; afterwards it reports warnings and errors only.

    Its banner goes to standard output, where it would spoil JSON. Its native library warns on standard error
    where there is no NVIDIA driver: on a laptop that is no news (`finssim doctor` says it), so it is kept back there.
    """
    import warp as wp

    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    if ctypes.util.find_library("cuda") or ctypes.util.find_library("nvcuda"):
        wp.init()
        return
    with _silent_stderr():
        wp.init()


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Nothing written to the process's standard error, by native code either, while the block runs."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
