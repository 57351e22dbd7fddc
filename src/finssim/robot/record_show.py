"""Records on a terminal: `finssim record info` and `finssim play`."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from finssim.robot.record_info import describe_record
from finssim.robot.record_play import as_json as json_line
from finssim.robot.record_play import as_line, play
from finssim.robot.record_reader import open_record

__all__ = ["info", "play_record"]

EVENTS_SHOWN = 20


def info(
    path: Path,
    *,
    as_json: bool = False,
) -> None:
    """Tell what a record holds: vehicle, duration [s], topics with rates [Hz] and gaps [s], events, damage.

    Example: finssim record info run.mcap

    Args:
        path (FILE): Record of a run (.mcap).
        as_json: Print one JSON object instead of tables.

    Raises:
        RecordError: Not a record.
    """
    with open_record(path) as record:
        found = describe_record(record)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    for line in _lines(found):
        print(line)


def play_record(
    path: Path,
    *,
    speed: float = 1.0,
    fast: bool = False,
    topics: Annotated[Sequence[str] | None, ","] = None,
    start: Annotated[float, (0.0, None)] = 0.0,
    as_json: bool = False,
) -> None:
    """Print the messages of a record as they came, a line each [s, SI units]; pictures by their size.

    Example: finssim play run.mcap --topics odom,events --speed 4

    Args:
        path (FILE): Record of a run (.mcap).
        speed (FACTOR): Times as fast as it was recorded [-].
        fast: Without waiting.
        topics (NAMES): Only these, with commas between: odom,thruster_cmd.
        start: Begin so long after the start of the record [s].
        as_json: Print one JSON object a line instead of text.

    Raises:
        RecordError: Not a record, no such topic, or a speed that is not above zero.
    """
    with open_record(path) as record:
        for note in record.notes:
            print(note, file=sys.stderr)
        first = next((at for at, _, _ in record.sizes()), 0.0) + start if start else None
        pace = math.inf if fast else speed
        played = play(record, speed=pace, clock=time.monotonic, wait=time.sleep, topics=topics, start=first)
        for entry in played:
            print(json_line(entry) if as_json else as_line(entry), flush=True)


def _lines(found: dict[str, Any]) -> list[str]:
    about = found["metadata"]
    lines = [
        f"{found['file']}: {found['duration_s']:.2f} s, {found['messages']} messages"
        + (f", vehicle {about['vehicle']} ({about['vehicle_sha256'][:12]})" if "vehicle" in about else "")
    ]
    lines += [f"  {note}" for note in found["notes"]]
    told = {k: v for k, v in about.items() if k not in ("vehicle", "vehicle_sha256", "provenance")}
    lines += [f"  {key}: {value if len(value) <= 90 else value[:90] + ' ...'}" for key, value in told.items()]
    lines += [f"  keeps {', '.join(found['files'])}"] if found["files"] else []
    lines.append(f"{'topic':36}{'messages':>9}{'rate [Hz]':>11}{'gaps':>6}{'longest [s]':>13}  type")
    for topic, told_of in found["topics"].items():
        lines.append(
            f"{topic:36}{told_of['messages']:9}{told_of['rate_hz']:11.2f}{told_of['gaps']:6}"
            f"{told_of['longest_gap_s']:13.2f}  {told_of['type']}"
        )
    events = found["events"]
    start = found["start_s"]
    lines += [f"{e['time'] - start:10.3f} s  {e['kind']}: {e['text']}" for e in events[:EVENTS_SHOWN]]
    if len(events) > EVENTS_SHOWN:
        lines.append(
            f"and {len(events) - EVENTS_SHOWN} more events: finssim play FILE --topics events --fast"
        )
    return lines
