"""`rclpy.duration`: spans of time."""

from __future__ import annotations

from functools import total_ordering
from typing import Any

from finssim.ros2.codec import codec_of

__all__ = ["Duration", "Infinite"]


@total_ordering
class Duration:
    """A span of time, kept in nanoseconds."""

    def __init__(self, *, seconds: float = 0, nanoseconds: int = 0) -> None:
        self.nanoseconds = int(seconds * 10**9) + int(nanoseconds)
        if not -(2**63) <= self.nanoseconds < 2**63:
            raise OverflowError(f"a duration of {self.nanoseconds} ns: expected less than 2^63")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Duration) and self.nanoseconds == other.nanoseconds

    def __lt__(self, other: Duration) -> bool:
        return self.nanoseconds < other.nanoseconds

    def __hash__(self) -> int:
        return hash(self.nanoseconds)

    def __repr__(self) -> str:
        return f"Duration(nanoseconds={self.nanoseconds})"

    def to_msg(self) -> Any:
        """As builtin_interfaces/Duration."""
        seconds, nanoseconds = divmod(self.nanoseconds, 10**9)
        return codec_of().message("builtin_interfaces/msg/Duration")(sec=seconds, nanosec=nanoseconds)

    @classmethod
    def from_msg(cls, message: Any) -> Duration:
        """From builtin_interfaces/Duration."""
        return cls(nanoseconds=message.sec * 10**9 + message.nanosec)


Infinite = Duration(nanoseconds=2**63 - 1)
