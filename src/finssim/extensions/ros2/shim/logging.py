"""`rclpy.logging`: log lines on standard error in the format of ROS 2."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from enum import IntEnum
from typing import Any


class LoggingSeverity(IntEnum):
    """Severity of a line."""

    UNSET = 0
    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


SUPPORTED = ("throttle_duration_sec", "throttle_time_source_type", "skip_first", "once")
"""Supported conditions of a log call."""


@dataclass
class _Site:
    """State of one log call in the program: its first arguments, which must not change, and its history."""

    severity: LoggingSeverity
    when: dict[str, Any]
    skipped: bool = False
    shown: bool = False
    last: float = -math.inf
    """Time at which it was last due by its conditions [s]."""


_levels: dict[str, LoggingSeverity] = {"": LoggingSeverity.INFO}


class RcutilsLogger:
    """Named logger; names are dotted, and a level applies to all loggers below."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._sites: dict[tuple[str, str, int, int], _Site] = {}

    def get_child(self, name: str) -> RcutilsLogger:
        """Return the child logger with a name."""
        if not name:
            raise ValueError("the logger below this one has no name: give one")
        return get_logger(f"{self.name}.{name}" if self.name else name)

    def set_level(self, level: int) -> None:
        """Set the lowest severity that is shown."""
        set_logger_level(self.name, level)

    def get_effective_level(self) -> LoggingSeverity:
        """Return the level set here or in the nearest parent."""
        return get_logger_effective_level(self.name)

    def is_enabled_for(self, severity: int) -> bool:
        """Return whether lines of a severity are shown."""
        return severity >= self.get_effective_level()

    def log(self, message: str, severity: int, **when: Any) -> bool:
        """Write a line.

        Args:
            message: Text.
            severity: A `LoggingSeverity`.
            **when: `once`, `skip_first` or `throttle_duration_sec`, counted for each call in the program.

        Returns:
            Whether it was shown.

        Raises:
            ValueError: The same call in the program had another severity or other conditions before, as in rclpy.
            TypeError: A condition is unknown, or the message is not a str.
        """
        severity = LoggingSeverity(severity)
        if not isinstance(message, str):
            raise TypeError(f"a log line is {message!r} ({type(message).__name__}): give a str")
        site = self._site(severity, when)
        if not self.is_enabled_for(severity) or not _due(site):
            return False
        print(f"[{severity.name}] [{time.time():.9f}] [{self.name}]: {message}", file=sys.stderr, flush=True)
        return True

    def _site(self, severity: LoggingSeverity, when: dict[str, Any]) -> _Site:
        """Return the state of the calling statement; two calls on one line are distinct."""
        unknown = set(when) - set(SUPPORTED)
        if unknown:
            raise TypeError(f"a log line takes {', '.join(SUPPORTED)}, found '{min(unknown)}'")
        when = {name: value for name, value in when.items() if value}
        frame: Any = sys._getframe(2)
        while frame.f_code.co_filename == __file__:
            frame = frame.f_back
        code = frame.f_code
        here = code.co_filename, code.co_name, frame.f_lineno, frame.f_lasti
        site = self._sites.setdefault(here, _Site(severity, when))
        if site.severity != severity:
            raise ValueError("Logger severity cannot be changed between calls.")
        if site.when.keys() != when.keys():
            raise ValueError("Requested logging filters cannot be changed between calls.")
        if site.when != when:
            raise ValueError("Logging filter parameters cannot be changed between calls.")
        return site

    def debug(self, message: str, **when: Any) -> bool:
        """Log a debug message."""
        return self.log(message, LoggingSeverity.DEBUG, **when)

    def info(self, message: str, **when: Any) -> bool:
        """Log an informational message."""
        return self.log(message, LoggingSeverity.INFO, **when)

    def warning(self, message: str, **when: Any) -> bool:
        """Log a warning."""
        return self.log(message, LoggingSeverity.WARN, **when)

    warn = warning

    def error(self, message: str, **when: Any) -> bool:
        """Log an error."""
        return self.log(message, LoggingSeverity.ERROR, **when)

    def fatal(self, message: str, **when: Any) -> bool:
        """Log a fatal error."""
        return self.log(message, LoggingSeverity.FATAL, **when)


def _due(site: _Site) -> bool:
    """Return whether the conditions of a call are met this time, evaluated in the order of rclpy."""
    now = time.monotonic()
    if now < site.last + site.when.get("throttle_duration_sec", 0.0):
        return False
    site.last = now
    if "skip_first" in site.when and not site.skipped:
        site.skipped = True
        return False
    if "once" in site.when and site.shown:
        return False
    site.shown = True
    return True


def get_logger(name: str) -> RcutilsLogger:
    """Return a logger with a name; each logger counts the conditions of calls separately, as in rclpy."""
    return RcutilsLogger(name)


def set_logger_level(name: str, level: int) -> None:
    """Set the lowest severity that a logger and those below it show; "" is the root."""
    _levels[name] = LoggingSeverity(level)


def get_logger_effective_level(name: str) -> LoggingSeverity:
    """Return the level that applies to a logger."""
    while name and _levels.get(name, LoggingSeverity.UNSET) == LoggingSeverity.UNSET:
        name = name.rpartition(".")[0]
    return _levels[name]
