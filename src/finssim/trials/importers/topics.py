"""Conversion of a log's topics, each with its own times and fields, to the streams of a trial."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.importers.assemble import Stream
from finssim.trials.importers.column_map import SourceMap
from finssim.trials.importers.log import TrialStreams
from finssim.trials.importers.table import memory_table, stream_of
from finssim.trials.trial import Array

OTHER_CLOCK = 5.0
"""Difference of stamps from the times of receipt, relative to other topics, above which they belong to
another clock [s]."""


@dataclass
class LogTopic:
    """Topic that is read."""

    map: SourceMap
    rank: int = 0
    """Priority among the sources of a column; -1 if a map names its columns."""
    kind: str = ""
    """Type of its messages."""
    received: Any = field(default_factory=list)
    """Times of receipt [s], (n,)."""
    stamps: Any = field(default_factory=list)
    """Stamps of the headers [s], NaN for messages without one, (n,); empty if no message has a stamp."""
    cells: dict[str, Any] = field(default_factory=dict)
    """Field -> numbers or text, (n,)."""
    broken: Counter[str] = field(default_factory=Counter)
    """Reason why messages cannot be read -> their number."""


def times_of(topics: Mapping[str, LogTopic], findings: list[Finding]) -> dict[str, Array]:
    """Return the times [s] of each topic's messages on one clock: the stamps if they belong to the common clock.

    Args:
        topics: Topics by name.
        findings: List to which topics with another clock are appended.
    """
    delays = {
        name: float(np.nanmedian(np.subtract(topic.received, topic.stamps)))
        for name, topic in topics.items()
        if len(topic.stamps) and np.isfinite(topic.stamps).any()
    }
    usual = float(np.median(list(delays.values()))) if delays else 0.0
    shift = usual if abs(usual) > OTHER_CLOCK else 0.0
    times = {}
    for name, topic in topics.items():
        times[name] = np.array(topic.received, dtype=float) - shift
        if abs(delays.get(name, usual) - usual) > OTHER_CLOCK:
            findings.append(finding("other_clock", topic=name, seconds=delays[name] - usual))
        elif name in delays:
            times[name] = np.where(np.isfinite(topic.stamps), topic.stamps, times[name])
    return times


def log_of(
    label: str,
    topics: Mapping[str, LogTopic],
    times: Mapping[str, Array],
    findings: list[Finding],
    unread: Sequence[str],
    others: Sequence[Stream] = (),
    header: Mapping[str, Any] | None = None,
) -> TrialStreams:
    """Return the usable topics as streams, with findings about the others.

    Args:
        label: Name of the log in messages.
        topics: Topics by name.
        times: Topic -> times of its messages [s].
        findings: Findings about the log.
        unread: Contents of the log besides the topics.
        others: Further streams of the log.
        header: Keys of `trial.yaml`.

    Raises:
        CalibrationError: No topic can be used, or a topic whose columns a map names cannot.
    """
    streams = []
    for name, topic in topics.items():
        total, count = topic.broken.total(), len(times[name])
        if total:
            reason = topic.broken.most_common(1)[0][0]
            findings.append(finding("topic_unusable", topic=name, messages=total, reason=reason))
        if count < 2:
            findings += [] if total else [finding("topic_short", topic=name)]
            continue
        try:
            table = memory_table({name: np.asarray(cells) for name, cells in topic.cells.items()})
            streams.append(replace(stream_of(table, topic.map, times[name], name), rank=topic.rank))
        except CalibrationError as error:
            if topic.rank < 0:
                raise
            reason = str(error).removeprefix(f"{name}: ")
            findings.append(finding("topic_unusable", topic=name, messages=count, reason=reason))
    usable = [stream for stream in (*streams, *others) if stream.channels or stream.words]
    if not any(stream.channels for stream in usable) and not any(topic.rank < 0 for topic in topics.values()):
        usable = []
    if not usable:
        reasons = "".join(f"; {item}" for item in findings if item.code == "topic_unusable")
        raise CalibrationError(f"{label}: {', '.join(topics)} have fewer than two messages each{reasons}")
    findings += [finding("not_read", items=", ".join(unread))] if unread else []
    return TrialStreams([usable[0].noting(*findings), *usable[1:]], dict(header or {}))
