"""ROS bags as streams, without ROS: ROS 2 (sqlite3, MCAP) and ROS 1, with the topics of MAVROS and of Doppler logs."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from finssim.control.ardusub import FULL, NEUTRAL
from finssim.core.budget import check_unpacked, limited_memory, packed_with_zstd
from finssim.core.mcap_files import intact_mcap, without_profile
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.importers.ardusub_outputs import STICK_CHANNELS, STICKS, mixed_pulses, outputs_of
from finssim.trials.importers.assemble import ColumnSource, SourceMap, Stream
from finssim.trials.importers.finssim_record import (
    THRUSTERS,
    names_of,
    native_topics,
    recorded_header,
    spoken_events,
    thruster_columns,
)
from finssim.trials.importers.log import LogImporter, Request, TrialStreams
from finssim.trials.importers.table import WORST_FOM, stream_of, used_columns
from finssim.trials.trial_files import ColumnTable
from finssim.vehicles import Vehicle
from finssim.vehicles.autopilot import FRAMES
from finssim.vehicles.part import did_you_mean

BAGS = (".mcap", ".db3", ".bag")

TEXT = "std_msgs/msg/String"

OTHER_CLOCK = 5.0
"""Stamps that are farther from the times of receipt than those of other topics are of another clock [s]."""

# Fields of ROS messages by dotted path, and the columns that messages of usual types contain.


def _fields(columns: Mapping[str, str], covariance: str = "") -> dict[str, ColumnSource]:
    """Return columns of fields, invalid where the first element of a covariance is -1."""
    valid = {"column": f"{covariance}[0]", "above": -0.5} if covariance else None
    return {name: ColumnSource.model_validate({"column": at, "valid": valid}) for name, at in columns.items()}


def _axes(names: str, at: str, covariance: str = "") -> dict[str, ColumnSource]:
    """Return three columns of a vector, and a fourth of a quaternion."""
    return _fields({n: f"{at}.{c}" for n, c in zip(names.split(), "xyzw", strict=False)}, covariance)


def _pose(at: str, covariance: str = "") -> dict[str, ColumnSource]:
    position, turn = f"{at}.position", f"{at}.orientation"
    return _axes("x y z", position, covariance) | _axes("qx qy qz qw", turn, covariance)


def _twist(at: str, covariance: str = "") -> dict[str, ColumnSource]:
    return _axes("u v w", f"{at}.linear", covariance) | _axes("p q r", f"{at}.angular", covariance)


def _wrench(at: str) -> dict[str, ColumnSource]:
    dot = f"{at}." if at else ""
    return _axes("tau_x tau_y tau_z", f"{dot}force") | _axes("tau_k tau_m tau_n", f"{dot}torque")


def _map(columns: Mapping[str, ColumnSource], **keys: Any) -> SourceMap:
    return SourceMap.model_validate({"columns": dict(columns), "valid": False, **keys})


RATES = _axes("p q r", "angular_velocity", "angular_velocity_covariance")
FORCE = _axes("ax ay az", "linear_acceleration", "linear_acceleration_covariance")
TURN = _axes("qx qy qz qw", "orientation", "orientation_covariance")
ODOMETRY = _pose("pose.pose", "pose.covariance") | _twist("twist.twist", "twist.covariance")
PRESSURE, VOLTAGE = _fields({"pressure": "fluid_pressure"}), _fields({"voltage": "voltage"})
PILOT = {
    f"stick_{name}": {
        "column": f"channels[{i}]",
        "scale": 1.0 / FULL,
        "offset": -NEUTRAL / FULL,
        "valid": {"column": f"channels[{i}]", "above": 800.0, "below": 2200.0},  # 0 and 65535 are no pulse
    }
    for i, name in enumerate(STICK_CHANNELS)
}
"""Demands of the pilot in channels of pulses [µs], in ArduSub's order."""

USUAL: tuple[tuple[str, SourceMap], ...] = (
    ("sensor_msgs/msg/Imu", _map(RATES | FORCE)),
    ("nav_msgs/msg/Odometry", _map(ODOMETRY)),
    ("geometry_msgs/msg/WrenchStamped", _map(_wrench("wrench"))),
    ("geometry_msgs/msg/Wrench", _map(_wrench(""))),
    ("geometry_msgs/msg/PoseStamped", _map(_pose("pose"))),
    ("geometry_msgs/msg/PoseWithCovarianceStamped", _map(_pose("pose.pose", "pose.covariance"))),
    ("geometry_msgs/msg/TwistStamped", _map(_twist("twist"))),
    ("geometry_msgs/msg/TwistWithCovarianceStamped", _map(_twist("twist.twist", "twist.covariance"))),
    ("sensor_msgs/msg/FluidPressure", _map(PRESSURE)),
    ("sensor_msgs/msg/BatteryState", _map(VOLTAGE)),
    ("finssim_msgs/msg/HardwareTelemetry", _map(_fields({"depth": "depth"}))),
)
"""Type -> columns. An Imu's attitude is used only if a map names it, for many leave it unset. If two types contain one
column and no map chooses, the first type here is used."""

MAVROS: tuple[tuple[str, str, SourceMap], ...] = (
    ("rc/out", "mavros_msgs/msg/RCOut", SourceMap()),
    ("rc/in", "mavros_msgs/msg/RCIn", _map(PILOT)),
    ("rc/override", "mavros_msgs/msg/OverrideRCIn", _map(PILOT)),
    ("state", "mavros_msgs/msg/State", SourceMap(split="armed")),
    ("imu/data", "sensor_msgs/msg/Imu", _map(RATES | FORCE | TURN)),
    ("local_position/odom", "nav_msgs/msg/Odometry", _map(ODOMETRY)),
    ("local_position/pose", "geometry_msgs/msg/PoseStamped", _map(_pose("pose"))),
    ("local_position/velocity_body", "geometry_msgs/msg/TwistStamped", _map(_twist("twist"))),
    ("imu/data_raw", "sensor_msgs/msg/Imu", _map(RATES | FORCE)),
    (
        "global_position/rel_alt",
        "std_msgs/msg/Float64",
        _map({"depth": ColumnSource(column="data", sign=-1)}),
    ),
    ("imu/static_pressure", "sensor_msgs/msg/FluidPressure", _map(PRESSURE)),
    ("battery", "sensor_msgs/msg/BatteryState", _map(VOLTAGE)),
)
"""End of a topic of MAVROS, its type and columns, the preferred first. No other topic of MAVROS is read: many of the
usual types are commands, or velocities in the world."""

DVL = _map(
    _axes("u v w", "velocity"),
    frame="FRD",
    valid=["velocity_valid", {"column": "fom", "below": WORST_FOM}],
)
"""Messages of the drivers of Water Linked's logs, whatever their package is called: the log's own axes."""

COMMANDS = re.compile(r"cmd|command|setpoint|goal|target|desired|reference")
"""Parts of the names of topics whose poses and velocities are no measurements."""

DEFINITIONS = {
    "mavros_msgs/msg/RCOut": "std_msgs/Header header\nuint16[] channels",
    "mavros_msgs/msg/RCIn": "std_msgs/Header header\nuint8 rssi\nuint16[] channels",
    "mavros_msgs/msg/OverrideRCIn": "uint16[18] channels",
    "mavros_msgs/msg/State": "std_msgs/Header header\nbool connected\nbool armed\nbool guided\nbool manual_input\n"
    "string mode\nuint8 system_status",
    "dvl_msgs/msg/DVLBeam": "int64 id\nfloat64 velocity\nfloat64 distance\nfloat64 rssi\nfloat64 nsd\nbool valid",
    "dvl_msgs/msg/DVL": "std_msgs/Header header\nfloat64 time\ngeometry_msgs/Vector3 velocity\nfloat64 fom\n"
    "float64[9] covariance\nfloat64 altitude\ndvl_msgs/DVLBeam[4] beams\nbool velocity_valid\nint64 status\n"
    "int64 time_of_validity\nint64 time_of_transmission\nstring form",
}
"""Definitions of messages for ROS 2 bags without definitions, as recorders before ROS 2 Iron write them."""

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
                fields = _field_names(owner)
                raise CalibrationError(
                    f"{topic}: no field '{name}' of '{path}'{did_you_mean(name, fields)} fields are {', '.join(fields)}"
                )
            continue
        key = index or name
        names = names_of(message)
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


def _field_names(value: Any) -> list[str]:
    return [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("_")]


def _inside(value: Any) -> str:
    inside = _field_names(value)
    return f": it holds {', '.join(inside)}" if inside else ""


def read(path: Path, request: Request) -> TrialStreams:
    """Return the topics of a bag as streams.

    Args:
        path: Folder of a ROS 2 bag, `.mcap`, `.db3`, or a ROS 1 `.bag`.
        request: Map of topics; without one, each topic of a usual type or of MAVROS is read.

    Raises:
        CalibrationError: Not a bag, or topics, types or fields that it lacks.
        ModuleNotFoundError: rosbags is not installed.
    """
    recorded, remarks = recorded_header(path)
    with _opened(path) as (reader, findings):
        findings += [] if request.vehicle else remarks
        types = {c.topic: c.msgtype for c in reader.connections}
        given = request.mapped.topics
        native = {} if given else native_topics(types)
        sources: dict[str, TopicData] = {}
        for topic, source in (given or native).items():
            if topic not in types:
                raise CalibrationError(
                    f"{path.name}: no topic '{topic}'{did_you_mean(topic, list(types))} its topics are {_listed(types)}"
                )
            sources[topic] = _mapped(reader, topic, types[topic], source)
        if not given and not native:
            sources = _known(reader, types, request, findings)
        if not sources:
            raise CalibrationError(
                f"{path.name}: no topic of a usual type: write a map; its topics are {_listed(types)}"
            )
        _collect(reader, sources, findings)
        events = _events(reader) if native else []
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
    streams = _streams(sources, request, findings)
    usable = [stream for stream in streams if len(stream.t) >= 2 and (stream.channels or stream.words)]
    if not usable:
        reasons = "".join(f"; {item}" for item in findings if item.code == "topic_unusable")
        raise CalibrationError(
            f"{path.name}: {', '.join(sources)} hold fewer than two messages each{reasons}"
        )
    unread = {**{t: counts.get(t, 0) for t in types if t not in sources}}
    if native and events:
        unread = {topic: count for topic, count in unread.items() if not topic.endswith("/events")}
    if unread:
        items = (f"{t} ({types[t].replace('/msg/', '/')}, {n} messages)" for t, n in sorted(unread.items()))
        findings.append(finding("not_read", items="topics " + ", ".join(items)))
    return TrialStreams([usable[0].noting(*findings), *usable[1:], *events], recorded)


@dataclass
class TopicData:
    """A topic that is read."""

    map: SourceMap
    rank: int
    """Place in the order of sources of a column; -1 if a map names its columns."""
    kind: str
    received: list[float] = field(default_factory=list)
    """Times of receipt [s]."""
    stamps: list[float] = field(default_factory=list)
    """Stamps of the headers [s]; NaN for messages without one."""
    cells: dict[str, list[Any]] = field(default_factory=dict)
    """Field -> numbers or words."""
    broken: Counter[str] = field(default_factory=Counter)
    """Reasons for which messages cannot be read."""

    def table(self) -> ColumnTable:
        """Return the fields as columns."""
        table = ColumnTable()
        for name, cells in self.cells.items():
            if any(isinstance(cell, str) for cell in cells):
                table.words[name] = [str(cell) for cell in cells]
            else:
                table.numbers[name] = np.array(cells, dtype=float)
        return table


def _mapped(reader: Any, topic: str, kind: str, source: SourceMap) -> TopicData:
    """Return a topic of a map, with the usual columns of its type where the map names none."""
    if source.columns or source.phase is not None or source.split is not None:
        return TopicData(source, -1, kind)
    order = [*THRUSTERS, *(known for known, _ in USUAL)]
    if kind in THRUSTERS:
        columns, usual = _thruster_columns(reader, topic, kind), SourceMap()
    elif kind in order or _is_dvl(reader, kind):
        usual = dict(USUAL).get(kind, DVL)
        columns = usual.columns
    else:
        raise CalibrationError(
            f"{topic} is of type {kind}, for which no columns are usual: give 'columns: {{u: FIELD, ...}}'"
        )
    keys = {name: getattr(source, name) for name in source.model_fields_set - {"columns"}}
    return TopicData(
        usual.model_copy(update={**keys, "columns": columns}),
        order.index(kind) if kind in order else len(order),
        kind,
    )


def _known(
    reader: Any, types: Mapping[str, str], request: Request, findings: list[Finding]
) -> dict[str, TopicData]:
    """Return the topics of a bag that are read without a map."""
    ends = tuple("/" + end for end, kind, _ in MAVROS if kind.startswith("mavros_msgs"))
    roots = {
        t[: -len(e)] for t, k in types.items() for e in ends if k.startswith("mavros_msgs") and t.endswith(e)
    }
    out: dict[str, TopicData] = {}
    for topic, kind in sorted(types.items()):
        of_mavros = "mavros" in topic.split("/") or any(
            root and topic.startswith(f"{root}/") for root in roots
        )
        end = next(
            (i for i, (end, of, _) in enumerate(MAVROS) if kind == of and topic.endswith(f"/{end}")), None
        )
        if end is not None and (of_mavros or kind.startswith("mavros_msgs") or "" in roots):
            out[topic] = TopicData(MAVROS[end][2], end, kind)
        elif of_mavros:
            continue
        elif _is_dvl(reader, kind):
            out[topic] = TopicData(DVL, 0, kind)
        elif kind in dict(USUAL) and not (COMMANDS.search(topic) and re.search("Pose|Twist|Odometry", kind)):
            out[topic] = _mapped(reader, topic, kind, SourceMap())
            out[topic].rank += len(MAVROS)
    outputs = [topic for topic in out if out[topic].kind == "mavros_msgs/msg/RCOut"]
    for topic in outputs if not request.passive else ():
        try:
            out[topic].map = _outputs(reader, topic, request, findings)
        except CalibrationError as error:
            if request.mapped.ardusub.outputs:
                raise
            findings.append(finding("topic_unusable", topic=topic, messages="all", reason=str(error)))
            outputs = []
    framed = request.vehicle is not None and request.vehicle.autopilot is not None and not request.passive
    pilot = framed and not outputs
    return {
        t: s
        for t, s in out.items()
        if s.map.columns or s.map.split
        if pilot or "stick_yaw" not in s.map.columns
    }


def _is_dvl(reader: Any, kind: str) -> bool:
    """Return whether a type is a report of a Water Linked log, by its fields."""
    fields = dict(reader.typestore.fielddefs.get(kind, ((), ()))[1])
    return {"velocity", "velocity_valid", "fom"} <= set(fields)


def _parameters(vehicle: Vehicle) -> dict[str, float]:
    """Return the autopilot's parameters of frame and motors that a vehicle file gives."""
    if vehicle.autopilot is None:
        return {}
    signs = enumerate(vehicle.autopilot.signs(len(vehicle.thrusters)), start=1)
    frame = next((n for n, (name, _) in FRAMES.items() if name == vehicle.autopilot.name), -1)
    return {"FRAME_CONFIG": float(frame), **{f"MOT_{i}_DIRECTION": float(sign) for i, sign in signs}}


def _outputs(reader: Any, topic: str, request: Request, findings: list[Finding]) -> SourceMap:
    """Return the columns of the outputs of an ArduSub autopilot, by the vehicle's frame where no map assigns them."""
    connections = [c for c in reader.connections if c.topic == topic]
    first = next((message for _, message in _messages(reader, connections)), None)
    width = 0 if first is None else len(first.channels)
    stated = request.mapped.ardusub.outputs
    if request.vehicle is None:
        outputs = {i + 1: (f"C{i + 1}", 1) for i in range(width) if first.channels[i]}
        findings.append(finding("pulses_unnamed"))
    else:
        outputs, mapped = outputs_of(request.vehicle, _parameters(request.vehicle), stated)
        findings += [mapped, *([] if stated else [finding("directions_assumed")])]
    columns = {}
    for number, (name, sign) in outputs.items():
        if number <= width:
            at = f"channels[{number - 1}]"
            turned = {"sign": -1, "offset": -2.0 * NEUTRAL} if sign < 0 else {}
            columns[f"pwm_{name}"] = {
                "column": at,
                "valid": {"column": at, "above": 0.0, "below": 65535.0},
                **turned,
            }
    return _map(columns)


def _collect(reader: Any, sources: dict[str, TopicData], findings: list[Finding]) -> None:
    """Read the messages of the topics; a message that cannot be read is counted."""
    needed = {topic: used_columns(source.map) for topic, source in sources.items()}
    for topic, names in needed.items():
        if sources[topic].kind == "mavros_msgs/msg/State":
            names.append("mode")
        sources[topic].cells = {name: [] for name in names}
    connections = [c for c in reader.connections if c.topic in sources]
    try:
        for connection, received, raw in reader.messages(connections=connections):
            source = sources[connection.topic]
            if not source.received and source.broken.total() >= 3:
                source.broken[next(iter(source.broken))] += 1
                continue
            try:
                message = reader.deserialize(raw, connection.msgtype)
                cells = {name: _cell(message, name, connection.topic) for name in source.cells}
            except (MemoryError, KeyboardInterrupt):
                raise
            except Exception as error:  # whatever rosbags meets in a damaged or unknown message
                if isinstance(error, CalibrationError) and source.rank < 0:
                    raise  # the user's field
                source.broken[" ".join(str(error).split())[:120] or type(error).__name__] += 1
                continue
            stamp = stamp_of(message) if source.map.stamps == "header" else None
            source.received.append(received * 1e-9)
            source.stamps.append(math.nan if stamp is None else stamp * 1e-9)
            for name, cell in cells.items():
                source.cells[name].append(cell)
    except CalibrationError:
        raise
    except Exception as error:  # a damaged bag breaks in whatever layer reads it
        if not any(len(source.received) >= 2 for source in sources.values()):
            raise CalibrationError(f"the bag breaks at its first messages: {error}") from None
        findings.append(
            finding("bag_damaged", reason=str(error).partition("\n")[0][:120] or type(error).__name__)
        )


def _cell(message: Any, path: str, topic: str) -> float | str:
    value = _value_at(message, path, topic)
    return value if isinstance(value, str) else number_at(message, path, topic)


def _streams(sources: dict[str, TopicData], request: Request, findings: list[Finding]) -> list[Stream]:
    """Return the streams of the topics that can be used, on one clock; the others are findings."""
    stamped = {topic: source for topic, source in sources.items() if np.isfinite(source.stamps).any()}
    delays = {t: float(np.nanmedian(np.subtract(s.received, s.stamps))) for t, s in stamped.items()}
    usual = float(np.median(list(delays.values()))) if delays else 0.0
    streams = []
    for topic, source in sources.items():
        if source.broken:
            reason, total = source.broken.most_common(1)[0][0], source.broken.total()
            findings.append(finding("topic_unusable", topic=topic, messages=total, reason=reason))
        if len(source.received) < 2:
            findings += [] if source.broken else [finding("topic_short", topic=topic)]
            continue
        received, stamps = np.array(source.received), np.array(source.stamps)
        on_clock = abs(delays.get(topic, usual) - usual) <= OTHER_CLOCK
        if not on_clock:
            findings.append(finding("other_clock", topic=topic, seconds=delays[topic] - usual))
        shift = usual if abs(usual) > OTHER_CLOCK else 0.0
        t = np.where(np.isfinite(stamps) & on_clock, stamps, received - shift)
        table = source.table()
        try:
            if source.kind == "mavros_msgs/msg/State" and source.rank >= 0:
                labels = np.where(table.numbers["armed"] > 0.0, "armed", "disarmed")
                streams.append(
                    Stream(source=topic, t=t, words={"arming": labels.astype(np.str_)}, rank=source.rank)
                )
            else:
                streams.append(replace(stream_of(table, source.map, t, topic), rank=source.rank))
        except CalibrationError as error:
            if source.rank < 0:
                raise
            reason = str(error).removeprefix(f"{topic}: ")
            findings.append(finding("topic_unusable", topic=topic, messages=len(t), reason=reason))
    return [_mixed(stream, sources, request) for stream in streams]


def _mixed(stream: Stream, sources: dict[str, TopicData], request: Request) -> Stream:
    """Return a stream with the pulses that ArduSub's mixer makes of the pilot's demands, in MANUAL and while armed."""
    vehicle = request.vehicle
    if stream.rank < 0 or vehicle is None or not all(name in stream.channels for name in STICKS):
        return stream
    demands = np.stack([stream.channels[name] for name in STICKS], axis=-1)
    state = next((s for s in sources.values() if s.kind == "mavros_msgs/msg/State" and s.received), None)
    notes = [finding("sticks_mixed", frame=vehicle.autopilot.name, gain=1.0), finding("directions_assumed")]
    if state is not None:
        held = np.maximum(np.searchsorted(state.received, stream.t, side="right") - 1, 0)
        armed = np.array([bool(cell) for cell in state.cells["armed"]])[held]
        other = armed & (np.array(state.cells["mode"], dtype=np.str_)[held] != "MANUAL")
        demands = np.where(other[:, None], np.nan, np.where(armed[:, None], demands, 0.0))
        notes += [finding("other_modes_left_out", share=other.mean())] if other.any() else []
    pulses, mapped = mixed_pulses(vehicle, demands, _parameters(vehicle), (), request.mapped.ardusub.outputs)
    return replace(stream, channels=pulses).noting(*notes, mapped)


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
            reader = AnyReader(parts, default_typestore=_typestore())
            reader.open()
        except Exception as error:  # what is damaged shows in whatever layer of rosbags meets it
            raise CalibrationError(
                f"{path}: cannot be opened as a bag: {error or 'damaged'}: for a damaged .db3 try sqlite3's .recover"
            ) from None
        try:
            yield reader, findings
        finally:
            reader.close()


def _typestore() -> Any:
    """Return the types of ROS 2, with some of MAVROS and of a Doppler log."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


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


def _listed(types: Mapping[str, str]) -> str:
    return ", ".join(f"{topic} ({kind.replace('/msg/', '/')})" for topic, kind in sorted(types.items()))


def _recognises(path: Path, head: bytes) -> bool:
    """Return whether a path is a bag; an MCAP file without a profile is of BlueOS' recorder."""
    return bool(bag_files(path)) and not without_profile(head)


ROSBAG = LogImporter(
    title="a ROS bag (.mcap, .db3, .bag, the folder of a ROS 2 bag)", recognises=_recognises, read=read
)
