"""Records played: their messages one after the other, in the time in which they were recorded."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterator
from typing import Any

import numpy as np

from finssim.robot.record_reader import Entry, Record
from finssim.robot.record_types import RecordError

__all__ = ["as_json", "as_line", "play", "plain"]

SHOWN = 16
"""Elements of a longer array are counted, not shown, in lines; JSON has all but pictures."""


def play(
    record: Record,
    *,
    speed: float,
    clock: Callable[[], float],
    wait: Callable[[float], None],
    topics: Collection[str] | None = None,
    start: float | None = None,
) -> Iterator[Entry]:
    """Messages, each when its time has come.

    Args:
        record: An open one.
        speed: Times as fast as recorded [-]; infinite: at once.
        clock: [s], monotonic.
        wait: Waits so long [s].
        topics: Only these.
        start: From this time of the record on [s].

    Raises:
        RecordError: A speed that is not above zero, or no such topic.
    """
    if not speed > 0.0:
        raise RecordError(f"speed is {speed:g}, expected a number above 0")
    began: tuple[float, float] | None = None
    for entry in record.messages(topics, start):
        if began is None:
            began = clock(), entry.time
        if math.isfinite(speed):
            pause = began[0] + (entry.time - began[1]) / speed - clock()
            if pause > 0.0:
                wait(pause)
        yield entry


def plain(value: Any) -> Any:
    """A message as dictionaries, lists and numbers; pictures by their size."""
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if not name.startswith("_")]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray):
        return f"{value.size} bytes" if value.dtype == np.uint8 else [plain(x) for x in value.tolist()]
    if isinstance(value, (list, tuple)):
        return [plain(x) for x in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None  # JSON has no such numbers
    return value


def as_json(entry: Entry) -> str:
    """One line of JSON."""
    line = {"time": entry.time, "topic": entry.topic, "type": entry.kind, "message": plain(entry.message)}
    return json.dumps(line)


def as_line(entry: Entry) -> str:
    """One line to read: time, topic and the numbers and words in it, without the header."""
    return f"{entry.time:10.3f}  {entry.topic}  " + " ".join(_words(plain(entry.message)))


def _words(value: Any, name: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in ("header", "covariance") and not key.endswith("_covariance"):
                yield from _words(inner, f"{name}.{key}" if name else key)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for inner in value:
            yield from _words(inner, name)
    elif isinstance(value, list):
        numbers = " ".join(_word(x) for x in value[:SHOWN])
        yield f"{name}=[{numbers}{' ...' if len(value) > SHOWN else ''}]"
    else:
        yield f"{name}={_word(value)}"


def _word(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "nan" if value is None else str(value)
