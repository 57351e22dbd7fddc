"""ROS bags as streams, without a ROS installation: ROS 2 (sqlite3, MCAP) and ROS 1, with the topics of MAVROS
and of Doppler logs."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.budget import check_unpacked, limited_memory, packed_with_zstd
from finssim.core.importer import Importer
from finssim.core.mcap_files import intact_mcap, without_profile
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.importers import finssim_record
from finssim.trials.importers.ardusub import ARMED_FLAG, MANUAL, ArduPilotLog, with_inputs
from finssim.trials.importers.assemble import Stream
from finssim.trials.importers.column_map import ColumnSource, SourceMap, shipped_maps
from finssim.trials.importers.log import Request, TrialStreams
from finssim.trials.importers.table import used_columns
from finssim.trials.importers.topics import LogTopic, log_of, times_of
from finssim.trials.trial import Array
from finssim.vehicles.autopilot import FRAMES
from finssim.vehicles.part import did_you_mean

BAGS = (".mcap", ".db3", ".bag")

TEXT = "std_msgs/msg/String"

KNOWN = shipped_maps("rosbag.yaml")
"""Topics and types that are read without a map, and definitions of messages."""

INPUTS = {
    "mavros_msgs/msg/RCOut": ("SERVO_OUTPUT_RAW", "servo{}_raw"),
    "mavros_msgs/msg/RCIn": ("RC_CHANNELS", "chan{}_raw"),
    "mavros_msgs/msg/OverrideRCIn": ("RC_CHANNELS", "chan{}_raw"),
}
"""Types with the channels of a message of the autopilot, and its fields; of several types for a message, the
first is used."""

PARAMETERS = {
    "mavros_msgs/msg/Param": ("value.integer", "value.real"),
    "mavros_msgs/msg/ParamEvent": ("value.integer_value", "value.double_value"),
}
"""Types of a parameter of the autopilot, and the fields of its value, of which the unused one is 0."""

FIX = "sensor_msgs/msg/NavSatFix"
EQUATOR = 6378137.0
"""Radius of the equator [m]."""
FLATTENED = 6.69437999014e-3
"""Square of the eccentricity of the ellipsoid of WGS 84 [-]."""

COMMANDS = re.compile(r"cmd|command|setpoint|goal|target|desired|reference")
"""Parts of the names of topics whose poses and velocities are not measurements."""

_PART = re.compile(r"([^.\[\]]+)|\[([^\]]*)\]")


def number_at(message: Any, path: str, topic: str) -> float:
    """Return the number at a dotted path: `twist.twist.linear.x`, `data[3]`, `velocity[T1]` (indexed by the
    list `name` or `names`).

    Raises:
        CalibrationError: There is no such field, or it is not a number.
    """
    value = _value_at(message, path, topic)
    if isinstance(value, (bool, int, float)) or (hasattr(value, "item") and getattr(value, "ndim", 1) == 0):
        return float(value)
    if hasattr(value, "nanosec"):
        return float(value.sec) + 1e-9 * float(value.nanosec)
    raise CalibrationError(
        f"{topic}: field '{path}' is a {type(value).__name__}, expected a number{_inside(value)}"
    )


def stamp_of(message: Any) -> int | None:
    """Return the header's stamp [ns], or None if it is missing or zero."""
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
        names = finssim_record.names_of(message)
        position = int(key) if key.lstrip("-").isdigit() else names.index(key) if key in names else None
        if position is None:
            raise CalibrationError(
                f"{topic}: '{path}' needs '{key}', but the message contains {', '.join(names) or 'no names'}"
            )
        try:
            value = value[position]
        except (IndexError, TypeError):
            if hasattr(value, "__len__") and len(value) == 0:
                return math.nan  # an empty array contains no sample
            raise CalibrationError(f"{topic}: '{path}' has no element {key}") from None
    return value


def _field_names(value: Any) -> list[str]:
    return [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("_")]


def _inside(value: Any) -> str:
    inside = _field_names(value)
    return f": it contains {', '.join(inside)}" if inside else ""


def read(path: Path, request: Request) -> TrialStreams:
    """Return the topics of a bag as streams.

    Args:
        path: Folder of a ROS 2 bag, `.mcap`, `.db3`, or a ROS 1 `.bag`.
        request: Map of topics; without one, every topic of a known type or of MAVROS is read.

    Raises:
        CalibrationError: The path is not a bag, or topics, types or fields are missing.
        ModuleNotFoundError: rosbags is not installed.
    """
    recorded, remarks = finssim_record.recorded_header(path)
    with _opened(path) as (reader, findings):
        findings += [] if request.vehicle else remarks
        types = {c.topic: c.msgtype for c in reader.connections}
        given = request.mapped.topics
        native = {} if given else finssim_record.native_topics(types)
        sources: dict[str, LogTopic] = {}
        for topic, source in (given or native).items():
            if topic not in types:
                raise CalibrationError(
                    f"{path.name}: no topic '{topic}'{did_you_mean(topic, list(types))} its topics are {_listed(types)}"
                )
            sources[topic] = _mapped(reader, topic, types[topic], source)
        if not given and not native:
            sources = _known(reader, types)
        if not sources:
            raise CalibrationError(
                f"{path.name}: no topic of a known type: write a map; its topics are {_listed(types)}"
            )
        _collect(reader, sources, findings)
        _localise(sources, findings)
        parameter_topics = [topic for topic, source in sources.items() if source.kind in PARAMETERS]
        parameters = _parameters(sources)
        logs = [
            topic for topic, source in sources.items() if source.rank >= 0 and _is_dvl(reader, source.kind)
        ]
        findings += [finding("velocity_at_sensor", kind=topic) for topic in logs]
        events = _events(reader) if native else []
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
    times = times_of(sources, findings)
    try:
        events += _inputs(path.name, sources, times, request, parameters)
    except CalibrationError as error:
        if request.mapped.ardusub.outputs:
            raise
        findings.append(finding("topic_unusable", topic="the outputs", messages="all", reason=str(error)))
    used = {*sources, *(stream.source for stream in events), *parameter_topics}
    unread = [
        f"{topic} ({types[topic].replace('/msg/', '/')}, {counts.get(topic, 0)} messages)"
        for topic in sorted(types)
        if topic not in used and not (native and topic.endswith("/events"))
    ]
    unread[:1] = [f"topics {topic}" for topic in unread[:1]]
    return log_of(path.name, sources, times, findings, unread, events, recorded)


def _mapped(reader: Any, topic: str, kind: str, source: SourceMap) -> LogTopic:
    """Return a topic of a map, with the default columns of its type if the map names none."""
    if source.columns or source.phase is not None or source.split is not None:
        return LogTopic(source, -1, kind)
    usual = KNOWN["usual"] | KNOWN["dvl"]
    name = next(iter(KNOWN["dvl"])) if _is_dvl(reader, kind) else kind
    if kind in finssim_record.THRUSTERS:
        usual = {kind: SourceMap(columns=_thruster_columns(reader, topic, kind))}
    if name not in usual:
        raise CalibrationError(
            f"{topic} is of type {kind}, which has no default columns: give 'columns: {{u: FIELD, ...}}'"
        )
    rank = [*KNOWN["dvl"], *KNOWN["mavros"], *finssim_record.THRUSTERS, *KNOWN["usual"]].index(name)
    keys = {name: getattr(source, name) for name in source.model_fields_set - {"columns"}}
    return LogTopic(usual[name].model_copy(update=keys), rank, kind)


def _known(reader: Any, types: Mapping[str, str]) -> dict[str, LogTopic]:
    """Return the topics of a bag that are read without a map."""
    known = [(f"/{key.split()[0]}", key.split()[1], source) for key, source in KNOWN["mavros"].items()]
    own = [
        (topic, end)
        for topic, kind in types.items()
        for end, of, _ in known
        if kind == of and topic.endswith(end)
    ]
    roots = tuple({f"{topic.removesuffix(end)}/" for topic, end in own if "mavros" in types[topic]})
    out: dict[str, LogTopic] = {}
    for topic, kind in sorted(types.items()):
        inside = "mavros" in topic.split("/") or topic.startswith(
            tuple(root for root in roots if root != "/")
        )
        for rank, (end, of, source) in enumerate(known, start=len(KNOWN["dvl"])):
            if (topic, end) in own and kind == of and (inside or "/" in roots):
                out[topic] = LogTopic(source, rank, kind)
        command = COMMANDS.search(topic) and re.search("Pose|Twist|Odometry", kind)
        if not (inside or topic in out or command) and (kind in KNOWN["usual"] or _is_dvl(reader, kind)):
            out[topic] = _mapped(reader, topic, kind, SourceMap())
    return out


def _is_dvl(reader: Any, kind: str) -> bool:
    """Return whether a type is a report of a Water Linked DVL, by its fields."""
    fields = dict(reader.typestore.fielddefs.get(kind, ((), ()))[1])
    return {"velocity", "velocity_valid", "fom"} <= set(fields)


def _inputs(
    label: str,
    sources: dict[str, LogTopic],
    times: Mapping[str, Array],
    request: Request,
    parameters: dict[str, float],
) -> list[Stream]:
    """Return the streams of the outputs of an ArduSub autopilot, or of the pilot's channels through its mixer.

    The topics of outputs and channels are removed from the sources.

    Raises:
        CalibrationError: The outputs do not match the vehicle.
    """
    log, vehicle, named = ArduPilotLog(label, telemetry=True), request.vehicle, {}
    for topic, source in sorted(sources.items(), key=lambda item: item[1].rank):
        if source.rank < 0 or len(times[topic]) < 2:
            continue
        kind, name = INPUTS.get(source.kind, ("HEARTBEAT" if "mode" in source.cells else "", ""))
        if name:
            del sources[topic]
            rows = [enumerate(cells, start=1) for cells in source.cells["channels"]]
            messages = [{name.format(i): int(pulse) for i, pulse in row} for row in rows]
        elif kind:
            modes = [MANUAL if mode == "MANUAL" else -1 for mode in source.cells["mode"]]
            arming = [ARMED_FLAG * int(armed) for armed in source.cells["armed"]]
            messages = [{"base_mode": a, "custom_mode": m} for a, m in zip(arming, modes, strict=True)]
        if kind and kind not in log.messages:
            log.messages[kind], log.times[kind], named[f"{label} {kind}"] = messages, times[topic], topic
    if vehicle is not None and vehicle.autopilot is not None:
        signs = enumerate(vehicle.autopilot.signs(len(vehicle.thrusters)), start=1)
        frame = next((n for n, (name, _) in FRAMES.items() if name == vehicle.autopilot.name), -1)
        assumed = {"FRAME_CONFIG": frame, **{f"MOT_{i}_DIRECTION": sign for i, sign in signs}}
        log.parameters.update(assumed | parameters)
    streams = with_inputs(log, request, [])
    directions_known = vehicle is None or all(
        f"MOT_{i + 1}_DIRECTION" in parameters for i in range(len(vehicle.thrusters))
    )
    if streams and not directions_known and not request.mapped.ardusub.outputs:
        streams[0] = streams[0].noting(finding("directions_assumed"))
    return [replace(stream, source=named[stream.source], rank=0) for stream in streams]


def _parameters(sources: dict[str, LogTopic]) -> dict[str, float]:
    """Return the last value of each parameter of the autopilot, in its units; their topics are removed."""
    found: dict[str, float] = {}
    for topic in [
        topic for topic, source in sources.items() if source.kind in PARAMETERS and source.rank >= 0
    ]:
        names, *numbers = sources.pop(topic).cells.values()
        found.update(zip(names, (whole or real for whole, real in zip(*numbers, strict=True)), strict=True))
    return found


def _localise(sources: Mapping[str, LogTopic], findings: list[Finding]) -> None:
    """Convert degrees of fixes to metres east and north of the first valid fix, on the WGS 84 ellipsoid."""
    for topic, source in sources.items():
        cells = source.cells
        if source.kind != FIX or not {"latitude", "longitude"} <= set(cells):
            continue
        latitude, longitude = (np.radians(np.array(cells[name], float)) for name in ("latitude", "longitude"))
        seen = np.array(cells.get("status.status", np.zeros(len(latitude)))) > -0.5
        seen &= np.isfinite(latitude) & np.isfinite(longitude)
        if not seen.any():
            continue
        first = int(np.argmax(seen))
        bend = 1.0 - FLATTENED * math.sin(latitude[first]) ** 2
        east = EQUATOR / math.sqrt(bend) * math.cos(latitude[first])
        north = EQUATOR * (1.0 - FLATTENED) / bend**1.5
        turn = (longitude - longitude[first] + math.pi) % (2.0 * math.pi) - math.pi
        cells["longitude"], cells["latitude"] = east * turn, north * (latitude - latitude[first])
        origin = np.degrees([latitude[first], longitude[first]])
        findings.append(finding("fix_origin", topic=topic, latitude=origin[0], longitude=origin[1]))


def _collect(reader: Any, sources: dict[str, LogTopic], findings: list[Finding]) -> None:
    """Read the messages of the topics; messages that cannot be read are counted."""
    needed = {topic: used_columns(source.map) for topic, source in sources.items()}
    for topic, names in needed.items():
        if sources[topic].rank >= 0:
            names += ["channels"] if sources[topic].kind in INPUTS else []
            names += (
                ["param_id", *PARAMETERS[sources[topic].kind]] if sources[topic].kind in PARAMETERS else []
            )
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
            except Exception as error:  # any error of rosbags at a damaged or unknown message
                if isinstance(error, CalibrationError) and source.rank < 0:
                    raise  # an error in a field chosen by the user
                source.broken[" ".join(str(error).split())[:120] or type(error).__name__] += 1
                continue
            stamp = stamp_of(message) if source.map.stamps == "header" else None
            source.received.append(received * 1e-9)
            source.stamps.append(math.nan if stamp is None else stamp * 1e-9)
            for name, cell in cells.items():
                source.cells[name].append(cell)
    except CalibrationError:
        raise
    except Exception as error:  # depending on the damage, any layer of the reader may raise
        if not any(len(source.received) >= 2 for source in sources.values()):
            raise CalibrationError(f"the bag is damaged at its first messages: {error}") from None
        findings.append(
            finding("bag_damaged", reason=str(error).partition("\n")[0][:120] or type(error).__name__)
        )


def _cell(message: Any, path: str, topic: str) -> Any:
    value = _value_at(message, path, topic)
    return value if isinstance(value, str) or path == "channels" else number_at(message, path, topic)


def bag_files(path: Path) -> list[Path]:
    """Return a bag itself, or the storage files of a folder without metadata; none if it is not a bag."""
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
            remedy = "unpack its files with 'zstd -d' and give these one by one"
            check_unpacked(packed, CalibrationError, str(path), remedy)
        stack.enter_context(limited_memory())  # in case a small bag decompresses to a large size
        try:
            reader = AnyReader(parts, default_typestore=_typestore())
            reader.open()
        except Exception as error:  # depending on the damage, any layer of rosbags may raise
            raise CalibrationError(
                f"{path}: cannot be opened as a bag: {error or 'damaged'}: for a damaged .db3 try sqlite3's .recover"
            ) from None
        try:
            yield reader, findings
        finally:
            reader.close()


def _typestore() -> Any:
    """Return the types of ROS 2, with some types of MAVROS and of a Doppler log."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    for name, text in KNOWN["definitions"].items():
        store.register(get_types_from_msg(text, name))
    return store


def _thruster_columns(reader: Any, topic: str, kind: str) -> dict[str, ColumnSource]:
    """Return the columns named by the first message of a topic."""
    connections = [c for c in reader.connections if c.topic == topic]
    for _, message in _messages(reader, connections):
        return finssim_record.thruster_columns(topic, kind, message)
    return {}


def _messages(reader: Any, connections: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    """Yield times of receipt [ns] and contents of messages; damage in a bag is reported as one error."""
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
    """Return the streams of the events in our own records."""
    connections = [c for c in reader.connections if c.topic.endswith("/events") and c.msgtype == TEXT]
    texts = ((time * 1e-9, message.data) for time, message in _messages(reader, connections))
    stream = finssim_record.spoken_events("events", texts, reader.start_time * 1e-9) if connections else None
    return [] if stream is None else [stream]


def _listed(types: Mapping[str, str]) -> str:
    return ", ".join(f"{topic} ({kind.replace('/msg/', '/')})" for topic, kind in sorted(types.items()))


def _recognises(path: Path, head: bytes) -> bool:
    """Return whether a path is a bag; an MCAP file without a profile is from BlueOS' recorder instead."""
    return bool(bag_files(path)) and not without_profile(head)


ROSBAG = Importer(
    "trial",
    title="a ROS bag (.mcap, .db3, .bag, the folder of a ROS 2 bag)",
    recognises=_recognises,
    read=read,
)
