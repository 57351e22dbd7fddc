"""The importer: which reader a file needs, which files make one trial, and the folders that are written."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np

from finssim.core.budget import check_unpacked, limited_memory, packed_with_zstd
from finssim.core.files import plain_name
from finssim.core.mcap_files import MAGIC, intact_mcap, mcap_metadata
from finssim.core.yaml_file import json_value
from finssim.trials.conversion import TIME_UNITS, factor
from finssim.trials.findings import CalibrationError, Finding, finding, listed
from finssim.trials.importers.assemble import (
    ColumnMap,
    ColumnSource,
    SourceMap,
    SplitRule,
    Stream,
    TimeColumn,
    in_our_axes,
    merge,
    moved_in_time,
    read_map,
    split_rule,
    split_table,
    trial_of,
)
from finssim.trials.trial import Array, Trial, column_of
from finssim.trials.trial_files import ColumnTable, read_table, write_trial
from finssim.vehicles import VehicleError, catalogue_vehicle, load_vehicle
from finssim.vehicles.part import did_you_mean

TABLES = (".csv", ".tsv", ".txt", ".dat", ".parquet", ".pq")
TIME_NAMES = ("t", "time", "time_s", "time_secs", "timestamp", "stamp")
"""Names of the time column without a map; seconds."""


def read_stream(path: Path, source: SourceMap | None) -> Stream:
    """One table as a stream.

    Args:
        path: Text or Parquet file.
        source: How it is read; without it the columns with canonical names are taken.

    Raises:
        CalibrationError: Unreadable, or a column that it has not.
    """
    mapping = source or SourceMap()
    table = read_table(path, skip=mapping.skip_rows, names=mapping.names, spaces=mapping.spaces)
    return table_stream(table, source, path.name)


def table_stream(table: ColumnTable, source: SourceMap | None, label: str) -> Stream:
    """Return the columns of a table as a stream.

    Args:
        table: As read.
        source: How it is read; without it the columns with canonical names are taken.
        label: Name of the table in messages.

    Raises:
        CalibrationError: The table lacks a column.
    """
    findings = tuple(item.about(label) for item in table.findings)
    if source is None:
        source = _by_names(table, label)
    if source.time is None:
        raise CalibrationError(f"{label}: no time: give 'time: COLUMN' of its columns {_column_list(table)}")
    if not source.columns and source.phase is None:
        raise CalibrationError(
            f"{label}: no columns: give 'columns: {{u: NAME, ...}}' of its columns {_column_list(table)}"
        )
    t = _time(table, source.time, label)
    numbers = {
        name: _numbers(table, spec.column, label)
        for name, spec in source.columns.items()
        if spec.column is not None
    }
    texts = {name: _text(table, column, label) for name, column in worded(source).items()}
    return _stream(label, source.columns, source, t, numbers, texts).noting(*findings)


def worded(source: SourceMap) -> dict[str, str]:
    """`phase` and `split` -> the column or field that holds their words, where the map names one."""
    phase = {"phase": source.phase.column} if source.phase is not None else {}
    return phase | ({"split": source.split} if source.split is not None else {})


def _stream(
    name: str,
    columns: Mapping[str, ColumnSource],
    source: SourceMap,
    times: Array | list[float],
    numbers: Mapping[str, Array | list[float]],
    texts: Mapping[str, list[str]],
) -> Stream:
    """A stream of raw numbers and words, by canonical column, at times of the log's clock [s]."""
    t = np.asarray(times) + source.time_offset
    channels = {}
    for column, spec in columns.items():
        # The last message of a damaged bag may lack its last fields.
        raw = np.full(len(t), np.nan if spec.value is None else spec.value)
        values = numbers.get(column, ())
        raw[: len(values)] = values
        channels[column] = spec.sign * (spec.scale * raw + spec.offset) * factor(spec.unit, column)
    translation = source.phase.words if source.phase is not None else {}
    labels = {
        key: np.array(
            [translation.get(word, "") if translation and key == "phase" else word for word in of],
            dtype=np.str_,
        )
        for key, of in texts.items()
    }
    return in_our_axes(Stream(source=name, t=t, channels=channels, words=labels), source.frame)


def _by_names(table: ColumnTable, label: str) -> SourceMap:
    """A map of the columns that have canonical names."""
    time = next((name for name in TIME_NAMES if name in table.numbers), None)
    recognised = [name for name in table.numbers if column_of(name) is not None]
    if time is None or not recognised:
        missing = "time" if time is None else "column with the name of a trial's column"
        raise CalibrationError(
            f"{label}: no {missing}; its columns are {_column_list(table)}: write a map file and give it with --map"
        )
    phase = "phase" if "phase" in table.words else None
    return SourceMap.model_validate(
        {"time": time, "columns": {name: name for name in recognised}, "phase": phase}
    )


def _require_column(table: ColumnTable, name: str, label: str) -> None:
    if name not in table.columns:
        raise CalibrationError(
            f"{label}: no column '{name}'{did_you_mean(name, table.columns)} its columns are {_column_list(table)}"
        )


def _numbers(table: ColumnTable, name: str, label: str) -> Array:
    _require_column(table, name, label)
    if name not in table.numbers:
        example = next((word for word in table.words[name] if word), "")
        raise CalibrationError(f"{label}: column '{name}' holds no numbers, for instance '{example}'")
    return table.numbers[name]


def _text(table: ColumnTable, name: str, label: str) -> list[str]:
    _require_column(table, name, label)
    return table.words[name] if name in table.words else [f"{x:g}" for x in table.numbers[name]]


def _time(table: ColumnTable, time: TimeColumn, label: str) -> Array:
    """Seconds on the clock of the log."""
    _require_column(table, time.column, label)
    if time.unit != "date" and time.column in table.numbers:
        return table.numbers[time.column] * TIME_UNITS[time.unit]
    try:
        dates = np.array(
            [_date(word) for word in _text(table, time.column, label)],
            dtype="datetime64[us]",
        )
    except ValueError:
        raise CalibrationError(
            f"{label}: column '{time.column}' holds neither numbers nor dates such as 2026-05-31 12:30:00.25: "
            "give a column that does"
        ) from None
    seconds = dates.astype(np.int64) * 1e-6
    return np.where(np.isnat(dates), np.nan, seconds)


def _date(word: str) -> str:
    """A date as NumPy reads it: universal time without saying so, and a day for a time without one."""
    word = re.sub(r"(Z|[+-]00:?00)$", "", word.strip())
    return f"1970-01-01T{word}" if re.match(r"\d\d:\d", word) else word or "NaT"


def _column_list(table: ColumnTable) -> str:
    return listed(table.columns, 40)


# What our own records add to a bag: thrusters by name, phases and arming from events, the vehicle they are of.

NATIVE = "finssim_msgs/msg/"
"""Prefix of the types in our own bags."""

TRIAL_TOPICS = ("odom", "imu", "joint_states", "thruster_state", "thruster_cmd", "telemetry", "pressure")
"""Last parts of the topics of a trial; the wanted wrench and the goal do not describe what happened."""

COMPASS = "/compass/imu"
"""Topic of an Imu that gives a heading alone, without rates and specific force."""

ARMING = {"armed": "armed", "disarmed": "disarmed", "fault": "disarmed"}
"""Kind of an event -> whether thrusters may turn from then on; while it holds, an armed bridge stays armed."""

THRUSTERS: dict[str, dict[str, tuple[str, str]]] = {
    "sensor_msgs/msg/JointState": {"rpm_": ("velocity", "rad/s")},
    "finssim_msgs/msg/ThrusterState": {"rpm_": ("shaft_speed", "rad/s"), "command_": ("force", "N")},
    "finssim_msgs/msg/ThrusterCommand": {"command_": ("force", "N")},
}
"""Type -> prefix of a trial's columns -> list of the message and its unit, one number a thruster."""


def native_topics(types: Mapping[str, str]) -> dict[str, SourceMap]:
    """Topics of ours that make a trial; none of a bag without a type of ours.

    Args:
        types: Topic -> type, all that the bag has.
    """
    if not any(kind.startswith(NATIVE) for kind in types.values()):
        return {}
    return {
        topic: SourceMap()
        for topic in sorted(types)
        if topic.rsplit("/", 1)[-1] in TRIAL_TOPICS and not topic.endswith(COMPASS)
    }


def thruster_columns(kind: str, message: Any) -> dict[str, ColumnSource]:
    """Columns that a message holds by the names of thrusters; lists that it leaves empty hold none."""
    names = _names(message)
    return {
        f"{prefix}{name}": ColumnSource(column=f"{field}[{name}]", unit=unit)
        for prefix, (field, unit) in THRUSTERS.get(kind, {}).items()
        if len(getattr(message, field)) == len(names)
        for name in names
    }


def _names(message: Any) -> list[str]:
    return [str(name) for name in getattr(message, "names", getattr(message, "name", ()))]


def spoken_events(topic: str, events: Iterable[tuple[float, str]], start: float) -> Stream | None:
    """Return phases and arming from the events of a record; None if they contain neither.

    Args:
        topic: Of the events.
        events: Time [s] and JSON of each, in order.
        start: Of the record [s]; before the first event there is no phase, and the vehicle is disarmed.
    """
    times, phase, arming = [start], [""], ["disarmed"]
    for time, text in events:
        try:
            event = json_value(text, CalibrationError, topic)
            kind, word = str(event["kind"]), str(event.get("text", ""))
        except (ValueError, KeyError, TypeError, AttributeError):
            continue  # words of other programs
        if kind != "phase" and kind not in ARMING:
            continue
        times.append(time)
        phase.append(word if kind == "phase" else phase[-1])
        arming.append(ARMING.get(kind, arming[-1]))
    labels = {"phase": phase, "arming": arming}
    spoken = {name: np.array(list_, dtype=np.str_) for name, list_ in labels.items() if len(set(list_)) > 1}
    return Stream(source=topic, t=np.array(times), words=spoken) if spoken else None


def recorded_header(path: Path) -> tuple[dict[str, Any], list[Finding]]:
    """Return the keys of a record for `trial.yaml`, and findings about it; nothing of a foreign file.

    Raises:
        CalibrationError: The record's own words for the header are broken.
    """
    about = mcap_metadata(path, "finssim")
    try:
        header = dict(json_value(about.get("trial", "{}"), CalibrationError, path.name))
    except (ValueError, TypeError):
        raise CalibrationError(
            f"{path.name}: the record's 'trial' is {about['trial']!r}, expected a mapping"
        ) from None
    name = header.pop("vehicle", about.get("vehicle"))
    if name is None:
        return header, []
    plain_name(str(name), f"{path.name}: vehicle", CalibrationError)
    try:
        vehicle = catalogue_vehicle(str(name), path.name)
    except VehicleError:
        return header, [finding("vehicle_unknown", path.name, vehicle=name)]
    changed = name == about.get("vehicle") and vehicle.sha256 != about.get("vehicle_sha256")
    remarks = [finding("vehicle_changed", path.name, vehicle=name)] if changed else []
    return {"vehicle": name, **header}, remarks


# ROS 2 bags, sqlite3 or MCAP, and ROS 1 bags, without ROS: topics as streams.

# Fields of ROS messages by dotted path, and the columns that messages of usual types hold.


def _pose(at: str) -> dict[str, str]:
    return {c: f"{at}.position.{c}" for c in "xyz"} | {f"q{c}": f"{at}.orientation.{c}" for c in "xyzw"}


def _twist(at: str) -> dict[str, str]:
    linear = {name: f"{at}.linear.{c}" for name, c in zip("uvw", "xyz", strict=True)}
    return linear | {name: f"{at}.angular.{c}" for name, c in zip("pqr", "xyz", strict=True)}


def _wrench(at: str) -> dict[str, str]:
    force = {f"tau_{c}": f"{at}.force.{c}" for c in "xyz"}
    return force | {
        name: f"{at}.torque.{c}" for name, c in zip(("tau_k", "tau_m", "tau_n"), "xyz", strict=True)
    }


USUAL: dict[str, dict[str, str]] = {
    "sensor_msgs/msg/Imu": {
        **{name: f"angular_velocity.{c}" for name, c in zip("pqr", "xyz", strict=True)},
        **{f"a{c}": f"linear_acceleration.{c}" for c in "xyz"},
    },
    "nav_msgs/msg/Odometry": _pose("pose.pose") | _twist("twist.twist"),
    "geometry_msgs/msg/WrenchStamped": _wrench("wrench"),
    "geometry_msgs/msg/Wrench": _wrench(""),
    "geometry_msgs/msg/PoseStamped": _pose("pose"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose("pose.pose"),
    "geometry_msgs/msg/TwistStamped": _twist("twist"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist("twist.twist"),
    "sensor_msgs/msg/FluidPressure": {"pressure": "fluid_pressure"},
    "sensor_msgs/msg/BatteryState": {"voltage": "voltage"},
    "finssim_msgs/msg/HardwareTelemetry": {"depth": "depth"},
}
"""Type -> canonical column -> field. An Imu's attitude is used only if a map names it, for many leave it unset. If two
types hold one column and no map chooses, the first type here is used."""

_PART = re.compile(r"([^.\[\]]+)|\[([^\]]*)\]")


def number_at(message: Any, path: str, topic: str) -> float:
    """The number at a dotted path: `twist.twist.linear.x`, `data[3]`, `velocity[T1]` (by the list `name` or `names`).

    Raises:
        CalibrationError: No such field, or no number there.
    """
    value = _value_at(message, path, topic)
    if isinstance(value, (bool, int, float)) or (hasattr(value, "item") and getattr(value, "ndim", 1) == 0):
        return float(value)
    if hasattr(value, "nanosec"):
        return float(value.sec) + 1e-9 * float(value.nanosec)
    raise CalibrationError(
        f"{topic}: field '{path}' is a {type(value).__name__}, expected a number{_inside(value)}"
    )


def word_at(message: Any, path: str, topic: str) -> str:
    """The text at a dotted path; numbers become text."""
    value = _value_at(message, path, topic)
    return value if isinstance(value, str) else f"{number_at(message, path, topic):g}"


def stamp_of(message: Any) -> int | None:
    """The header's stamp [ns], or None where there is none or it was left at zero."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None:
        return None
    nanoseconds = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return nanoseconds or None


def _value_at(message: Any, path: str, topic: str) -> Any:
    value: Any = message
    for name, index in _PART.findall(path):
        owner = value
        if name and not name.isdigit():
            value = getattr(value, name, None)
            if value is None:
                fields = _fields(owner)
                raise CalibrationError(
                    f"{topic}: no field '{name}' of '{path}'{did_you_mean(name, fields)} fields are {', '.join(fields)}"
                )
            continue
        key = index or name
        names = _names(message)
        position = int(key) if key.lstrip("-").isdigit() else names.index(key) if key in names else None
        if position is None:
            raise CalibrationError(
                f"{topic}: '{path}' asks for '{key}', and the message names {', '.join(names) or 'none'}"
            )
        try:
            value = value[position]
        except (IndexError, TypeError):
            if hasattr(value, "__len__") and len(value) == 0:
                return math.nan  # an array left empty holds no sample
            raise CalibrationError(f"{topic}: '{path}' has no element {key}") from None
    return value


def _fields(value: Any) -> list[str]:
    return [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("_")]


def _inside(value: Any) -> str:
    inside = _fields(value)
    return f": it holds {', '.join(inside)}" if inside else ""


BAGS = (".mcap", ".db3", ".bag")

TEXT = "std_msgs/msg/String"


def read_bag(path: Path, topics: Mapping[str, SourceMap]) -> list[Stream]:
    """The topics of a bag as streams.

    Args:
        path: Folder of a ROS 2 bag, `.mcap`, `.db3`, or a ROS 1 `.bag`.
        topics: How topics are read; without any, each of a usual type is.

    Raises:
        CalibrationError: Not a bag, or topics, types or fields that it has not.
        ModuleNotFoundError: rosbags is not installed.
    """
    with _opened(path) as (reader, findings):
        types = {c.topic: c.msgtype for c in reader.connections}
        native = {} if topics else native_topics(types)
        topics = topics or native
        if not topics:
            topics = {topic: SourceMap() for topic, kind in sorted(types.items()) if kind in USUAL}
        if not topics:
            raise CalibrationError(
                f"{path.name}: no topic of a usual type: write a map; its topics are {_listed(types)}"
            )
        sources = {}
        for topic, source in topics.items():
            if topic not in types:
                raise CalibrationError(
                    f"{path.name}: no topic '{topic}'{did_you_mean(topic, list(types))} its topics are {_listed(types)}"
                )
            sources[topic] = _columns(reader, topic, types[topic], source)
        _choose(sources, types, [topic for topic in topics if not topics[topic].columns], findings)
        collected = _collect(reader, sources, topics, findings)
        events = _events(reader) if native else []
    streams = [_stream(topic, sources[topic], topics[topic], *collected[topic]) for topic in topics]
    usable = [stream for stream in streams if len(stream.t) >= 2 and (stream.channels or stream.words)]
    if not usable:
        raise CalibrationError(f"{path.name}: {', '.join(topics)} hold fewer than two messages each")
    findings += [finding("topic_short", topic=t) for t in topics if len(collected[t][0]) < 2]
    usable[0] = usable[0].noting(*findings)
    return usable + events


def bag_files(path: Path) -> list[Path]:
    """A bag itself, or the storage files of a folder that lost its metadata; none if it is no bag."""
    if not path.is_dir():
        return [path] if path.suffix.lower() in BAGS else []
    if (path / "metadata.yaml").is_file():
        return [path]
    return sorted(part for part in path.iterdir() if part.suffix.lower() in (".mcap", ".db3"))


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, list[Finding]]]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    repairs: list[str] = []
    with ExitStack() as stack:
        parts = [stack.enter_context(intact_mcap(part, repairs)) for part in bag_files(path) or [path]]
        findings = [finding("as_read", remark=repair) for repair in repairs]
        if parts != [path] and path.is_dir():
            findings.append(finding("no_metadata", bag=path.name, files=len(parts)))
        if path.is_dir():
            packed = [file for file in sorted(path.iterdir()) if file.is_file() and packed_with_zstd(file)]
            remedy = "unpack its files with 'zstd -d' and give these, each by itself"
            check_unpacked(packed, CalibrationError, str(path), remedy)
        stack.enter_context(limited_memory())  # whatever a small bag may unpack to
        try:
            reader = AnyReader(parts, default_typestore=get_typestore(Stores.LATEST))
            reader.open()
        except Exception as error:  # what is damaged shows in whatever layer of rosbags meets it
            raise CalibrationError(
                f"{path}: cannot be opened as a bag: {error or 'damaged'}: for a damaged .db3 try sqlite3's .recover"
            ) from None
        try:
            yield reader, findings
        finally:
            reader.close()


def _columns(reader: Any, topic: str, kind: str, source: SourceMap) -> dict[str, ColumnSource]:
    """Columns of a topic: the map's, or the usual ones of its type."""
    if source.columns or source.phase is not None or source.split is not None:
        return source.columns
    if kind in THRUSTERS:
        return _thruster_columns(reader, topic, kind)
    if kind not in USUAL:
        raise CalibrationError(
            f"{topic} is of type {kind}, for which no columns are usual: give 'columns: {{u: FIELD, ...}}'"
        )
    return {name: ColumnSource(column=path) for name, path in USUAL[kind].items()}


def _thruster_columns(reader: Any, topic: str, kind: str) -> dict[str, ColumnSource]:
    """Columns that the first message of a topic names."""
    connections = [c for c in reader.connections if c.topic == topic]
    for _, message in _messages(reader, connections):
        return thruster_columns(kind, message)
    return {}


def _messages(reader: Any, connections: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    """When messages were received [ns], and what they hold; a damaged bag breaks in whatever layer reads it."""
    raws = iter(reader.messages(connections=connections))
    while True:
        try:
            connection, received, raw = next(raws)
            message = reader.deserialize(raw, connection.msgtype)
        except StopIteration:
            return
        except Exception as error:
            raise CalibrationError(f"{connections[0].topic}: the bag is damaged: {error}") from None
        yield received, message


def _events(reader: Any) -> list[Stream]:
    """Return the streams of the events of our own records."""
    connections = [c for c in reader.connections if c.topic.endswith("/events") and c.msgtype == TEXT]
    texts = ((time * 1e-9, message.data) for time, message in _messages(reader, connections))
    stream = spoken_events("events", texts, reader.start_time * 1e-9) if connections else None
    return [] if stream is None else [stream]


def _choose(
    sources: dict[str, dict[str, ColumnSource]],
    types: Mapping[str, str],
    usual: list[str],
    findings: list[Finding],
) -> None:
    """Leave a column that several topics of usual types hold to the type that comes first; in place.

    Two topics of one type keep it, and are refused where the streams are put together.
    """
    order = [*THRUSTERS, *USUAL]
    rank = {topic: order.index(types[topic]) for topic in usual if types[topic] in order}
    if any("depth" in columns for columns in sources.values()):
        for topic in rank:
            if sources[topic].pop("pressure", None) is not None:
                findings.append(finding("pressure_left_out", topic=topic))
    for topic in sorted(rank, key=lambda topic: rank[topic], reverse=True):
        better = {
            name: other for other in sources for name in sources[other] if rank.get(other, -1) < rank[topic]
        }
        excluded = [name for name in sources[topic] if name in better]
        for name in excluded:
            del sources[topic][name]
        if excluded:
            findings.append(
                finding("columns_left_out", columns=tuple(excluded), topic=topic, better=better[excluded[0]])
            )


def _collect(
    reader: Any,
    sources: dict[str, dict[str, ColumnSource]],
    topics: Mapping[str, SourceMap],
    findings: list[Finding],
) -> dict[str, tuple[list[float], dict[str, list[float]], dict[str, list[str]]]]:
    """Per topic: times, numbers by canonical column, and words."""
    collected: dict[str, Any] = {
        topic: ([], {name: [] for name in columns}, {name: [] for name in worded(topics[topic])})
        for topic, columns in sources.items()
    }
    connections = [c for c in reader.connections if c.topic in sources]
    try:
        for connection, received, raw in reader.messages(connections=connections):
            message = reader.deserialize(raw, connection.msgtype)
            topic = connection.topic
            times, numbers, texts = collected[topic]
            stamp = stamp_of(message) if topics[topic].stamps == "header" else None
            times.append((received if stamp is None else stamp) * 1e-9)
            for name, spec in sources[topic].items():
                if spec.column is not None:
                    numbers[name].append(number_at(message, spec.column, topic))
            for name, labels in texts.items():
                labels.append(word_at(message, worded(topics[topic])[name], topic))
    except CalibrationError:
        raise
    except Exception as error:  # a damaged bag breaks in whatever layer reads it
        if not any(len(times) >= 2 for times, _, _ in collected.values()):
            raise CalibrationError(f"the bag breaks at its first messages: {error}") from None
        findings.append(
            finding("bag_damaged", reason=str(error).partition("\n")[0][:120] or type(error).__name__)
        )
    return collected


def _listed(types: Mapping[str, str]) -> str:
    return ", ".join(f"{topic} ({kind.replace('/msg/', '/')})" for topic, kind in sorted(types.items()))


Format = Literal["auto", "csv", "ardupilot", "rosbag"]
FORMATS: tuple[Format, ...] = get_args(Format)

Group = tuple[str, list[Stream], dict[str, Any]]

ARDUPILOT = (".bin", ".tlog")


def print_folders(folders: Sequence[Path], as_json: bool) -> None:
    """Print where trials were written, a line each or as one JSON object."""
    names = [str(folder) for folder in folders]
    print(json.dumps({"trials": names}) if as_json else "\n".join(names))


def import_trials(
    logs: Sequence[Path],
    *,
    out: Path,
    column_map: Annotated[Path | None, "--map"] = None,
    format: Format = "auto",
    vehicle: str | None = None,
    split: str | None = None,
    as_json: bool = False,
) -> list[Path]:
    """Convert logs to trial folders, in SI units and the body frame x forward, y left, z up.

    Example: finssim trials import dive.BIN --vehicle bluerov2 --split arming --out trials

    Args:
        logs (LOG): Tables (.csv, .parquet), ArduSub logs (.BIN, .tlog, .mcap of BlueOS), ROS 2 bags (.mcap, .db3,
            folder). Tables and bags that belong together form one trial.
        out (DIR): Folder for the trial folders.
        column_map (FILE): Map of the log's columns or topics, with units and frames (.yaml).
        format (FORMAT): auto (by suffix), csv, ardupilot or rosbag.
        vehicle (NAME|FILE): Vehicle of the logs; overrides the map's.
        split (RULE): Split a log into trials: by phase, gaps, gaps=SECONDS, arming or column; overrides the map's.
        as_json: Print one JSON object instead of one line per trial.

    Returns:
        The folders, in the order of their trials; what was repaired or left out is told on standard error.

    Raises:
        CalibrationError: A log or map that cannot be used; nothing is written then.
        OutputError: A folder that holds other files, or cannot be written.
    """
    folders = []
    for trial in read_trials(logs, column_map=column_map, format=format, vehicle=vehicle, split=split):
        folders.append(Path(out) / trial.name)
        write_trial(trial, folders[-1])
        for item in trial.findings:
            print(item.about(trial.name), file=sys.stderr)
    print_folders(folders, as_json)
    return folders


def read_trials(
    paths: Sequence[Path],
    *,
    column_map: Path | None = None,
    format: Format = "auto",
    vehicle: str | None = None,
    split: str | SplitRule | None = None,
) -> list[Trial]:
    """The trials that logs hold; see `import_trials`."""
    if format not in FORMATS:
        raise CalibrationError(f"format is '{format}', expected one of {', '.join(FORMATS)}")
    mapped = read_map(Path(column_map)) if column_map is not None else ColumnMap.model_validate({})
    for name in (
        vehicle or mapped.header.get("vehicle"),
        *(keys.get("vehicle") for keys in mapped.trials.values()),
    ):
        if name is not None:
            load_vehicle(name)  # an unknown one is refused before any log is read
    rule = split_rule(split) if isinstance(split, str) else split or mapped.split
    trials: list[Trial] = []
    for name, streams, recorded in _groups(
        [Path(path) for path in paths], mapped, format, vehicle, column_map is not None
    ):
        for piece, table in split_table(
            name, merge(moved_in_time(streams, mapped.time_offsets)), rule
        ).items():
            header = mapped.header_of(piece if piece in mapped.trials else name, vehicle, recorded)
            trials.append(trial_of(piece, table, header, mapped))
    unknown = [name for name in mapped.trials if name not in {trial.name for trial in trials}]
    if unknown and not any(trial.name.startswith(tuple(unknown)) for trial in trials):
        names = ", ".join(trial.name for trial in trials)
        raise CalibrationError(f"{column_map}: trials.{unknown[0]}: no such trial; the logs make {names}")
    _check_names(trials)
    return trials


def _groups(
    paths: list[Path], mapped: ColumnMap, format: Format, vehicle: str | None, has_map: bool
) -> list[Group]:
    """Return trial, streams and the log's keys for the header, for each log or set of tables."""
    if not paths:
        raise CalibrationError("no logs given: give at least one file")
    groups: list[Group] = []
    tables = []
    for path in paths:
        if not path.exists():
            raise CalibrationError(f"{path}: no such file")
        kind = _kind(path) if format == "auto" else format
        if kind == "ardupilot":
            from finssim.trials.importers.ardusub import read_ardusub

            name = vehicle or mapped.header.get("vehicle")
            pulses = not mapped.header.get("passive", False)
            body = load_vehicle(name) if name else None
            groups.append((path.stem, read_ardusub(path, mapped.ardusub, body, pulses=pulses), {}))
        elif kind == "rosbag":
            recorded, remarks = recorded_header(path)
            remarks = [] if vehicle or mapped.header.get("vehicle") else remarks
            first, *others = read_bag(path, mapped.topics)
            groups.append((path.stem, [first.noting(*remarks), *others], recorded))
        else:
            tables.append(path)
    return groups + _table_groups(tables, mapped, has_map)


def _kind(path: Path) -> Format:
    suffix = path.suffix.lower()
    if suffix in ARDUPILOT or (suffix == ".mcap" and _without_profile(path)):
        return "ardupilot"
    if bag_files(path):
        return "rosbag"
    if suffix in TABLES:
        return "csv"
    raise CalibrationError(
        f"{path}: unknown kind of log: expected {', '.join((*TABLES, *ARDUPILOT, *BAGS))} or the folder of a ROS 2 "
        "bag, or give --format"
    )


def _without_profile(path: Path) -> bool:
    """Return whether an MCAP's header names no profile, unlike one of ROS 2: BlueOS' recorder writes such files."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(len(MAGIC) + 13)
    return head.startswith(MAGIC + b"\x01") and len(head) == len(MAGIC) + 13 and head[-4:] == bytes(4)


def _table_groups(paths: list[Path], mapped: ColumnMap, has_map: bool) -> list[Group]:
    """Return tables by trial: those for which `{trial}` or the first `*` of their patterns matches the same text."""
    if paths and has_map and not mapped.files:
        raise CalibrationError(
            f"the map has no entry for files such as {paths[0].name}: give 'files:' or 'columns:'"
        )
    by_trial: dict[str, list[tuple[str, Path, SourceMap | None]]] = {}
    unread = []
    for path in paths:
        hits = [
            (pattern, trial) for pattern in mapped.files if (trial := _trial_name(pattern, path)) is not None
        ]
        if not hits and mapped.files:
            unread.append(path.name)
        elif len(hits) > 1:
            raise CalibrationError(
                f"{path.name} fits {hits[0][0]} and {hits[1][0]} of the map: make them differ"
            )
        else:
            pattern, trial = hits[0] if hits else ("", path.stem)
            by_trial.setdefault(trial, []).append((pattern, path, mapped.files.get(pattern)))
    if not by_trial and unread:
        raise CalibrationError(f"{unread[0]} fits none of the files of the map: {', '.join(mapped.files)}")
    groups: list[Group] = []
    for trial, sources in by_trial.items():
        if len(paths) == 1 and sources[0][0] in mapped.files and not set("*{") & set(sources[0][0]):
            trial = paths[0].stem  # a single file gives its name
        patterns = [pattern for pattern, _, _ in sources]
        for pattern in patterns:
            if patterns.count(pattern) > 1:
                twice = ", ".join(path.name for p, path, _ in sources if p == pattern)
                raise CalibrationError(
                    f"{twice} all fit {pattern} of the map for one trial: use {{trial}} in it"
                )
        missing = [pattern for pattern in mapped.files if pattern not in patterns]
        streams = [read_stream(path, source) for _, path, source in sources]
        streams[0] = streams[0].noting(*(finding("file_missing", pattern=p) for p in missing))
        excluded = [name for name in unread if len(by_trial) == 1 or name.startswith(trial)]
        streams[0] = streams[0].noting(*(finding("file_left_out", file=name) for name in excluded))
        groups.append((trial, streams, {}))
    return groups


def _trial_name(pattern: str, path: Path) -> str | None:
    """The trial that a file belongs to, or None where the pattern does not fit."""
    # Without {trial} the first * gives the trial's name; without either, the folder does.
    before, mark, after = pattern.partition("{trial}" if "{trial}" in pattern else "*")
    hit = re.fullmatch(
        _expression(before) + ("(?P<trial>.+?)" if mark else "") + _expression(after), path.name
    )
    if hit is None:
        return None
    return hit["trial"].removesuffix(path.suffix) if mark else path.parent.resolve().name


def _expression(pattern: str) -> str:
    """A pattern with * and ? as a regular expression."""
    return "".join(".*" if c == "*" else "." if c == "?" else re.escape(c) for c in pattern)


def _check_names(trials: list[Trial]) -> None:
    """Each name is a folder's, and no other trial's: maps and patterns make them as well as names of logs."""
    names = set()
    for trial in trials:
        plain_name(trial.name, "trial", CalibrationError)
        if trial.name in names:
            raise CalibrationError(
                f"two logs make a trial '{trial.name}': import them one by one, or rename a file"
            )
        names.add(trial.name)
