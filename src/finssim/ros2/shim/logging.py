"""`rclpy.logging`: lines on standard error in the form of ROS 2."""

from __future__ import annotations

import sys
import time
from enum import IntEnum
from typing import Any

__all__ = ["LoggingSeverity", "RcutilsLogger", "get_logger", "get_logger_effective_level", "set_logger_level"]


class LoggingSeverity(IntEnum):
    """How grave a line is."""

    UNSET = 0
    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


_levels: dict[str, LoggingSeverity] = {"": LoggingSeverity.INFO}


class RcutilsLogger:
    """A named logger; names are dotted, and a level holds for all below it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._seen: dict[tuple[str, int], float] = {}

    def get_child(self, name: str) -> RcutilsLogger:
        """The logger below this one."""
        return get_logger(f"{self.name}.{name}" if self.name else name)

    def set_level(self, level: int) -> None:
        """The least grave lines shown."""
        set_logger_level(self.name, level)

    def get_effective_level(self) -> LoggingSeverity:
        """The level set here or above."""
        return get_logger_effective_level(self.name)

    def is_enabled_for(self, severity: int) -> bool:
        """Whether lines of a severity are shown."""
        return severity >= self.get_effective_level()

    def log(self, message: Any, severity: int, **when: Any) -> bool:
        """Write a line.

        Args:
            message: What happened.
            severity: A `LoggingSeverity`.
            **when: `once`, `skip_first` or `throttle_duration_sec`, each counted per line of code.

        Returns:
            Whether it was shown.
        """
        if not self.is_enabled_for(severity) or (when and not self._wanted(when)):
            return False
        now, word = time.time(), LoggingSeverity(severity).name
        print(f"[{word}] [{now:.9f}] [{self.name}]: {message}", file=sys.stderr, flush=True)
        return True

    def _wanted(self, when: dict[str, Any]) -> bool:
        """Whether a line with conditions is due; it is known by where the program calls from."""
        frame: Any = sys._getframe(2)
        while frame.f_code.co_filename == __file__:
            frame = frame.f_back
        place, now = (frame.f_code.co_filename, frame.f_lineno), time.monotonic()
        last = self._seen.get(place)
        unknown = set(when) - {"once", "skip_first", "throttle_duration_sec", "throttle_time_source_type"}
        if unknown:
            raise TypeError(
                f"a log line takes once, skip_first and throttle_duration_sec, found '{min(unknown)}'"
            )
        if last is None:
            self._seen[place] = -1e18 if when.get("skip_first") else now
            return not when.get("skip_first")
        if when.get("once") and last > 0.0 or now - last < when.get("throttle_duration_sec", 0.0):
            return False
        self._seen[place] = now
        return True

    def debug(self, message: Any, **when: Any) -> bool:
        """For whoever looks for a fault."""
        return self.log(message, LoggingSeverity.DEBUG, **when)

    def info(self, message: Any, **when: Any) -> bool:
        """As it should be."""
        return self.log(message, LoggingSeverity.INFO, **when)

    def warning(self, message: Any, **when: Any) -> bool:
        """Worth a look."""
        return self.log(message, LoggingSeverity.WARN, **when)

    warn = warning

    def error(self, message: Any, **when: Any) -> bool:
        """Something does not work."""
        return self.log(message, LoggingSeverity.ERROR, **when)

    def fatal(self, message: Any, **when: Any) -> bool:
        """Nothing works."""
        return self.log(message, LoggingSeverity.FATAL, **when)


_loggers: dict[str, RcutilsLogger] = {}


def get_logger(name: str) -> RcutilsLogger:
    """The logger of a name."""
    return _loggers.setdefault(name, RcutilsLogger(name))


def set_logger_level(name: str, level: int) -> None:
    """The least grave lines that a logger and those below it show; "" is all."""
    _levels[name] = LoggingSeverity(level)


def get_logger_effective_level(name: str) -> LoggingSeverity:
    """The level that holds for a logger."""
    while name and _levels.get(name, LoggingSeverity.UNSET) == LoggingSeverity.UNSET:
        name = name.rpartition(".")[0]
    return _levels[name]
