"""The recorder: all inputs, decisions and outputs of the robot in one MCAP file of ROS 2 messages."""

from __future__ import annotations

import json
import logging
import math
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from finssim.core import realtime
from finssim.core.files import OutputError, atomic_write, refuse_unwritable
from finssim.core.mcap_files import END
from finssim.core.provenance import provenance
from finssim.core.yaml_file import read_mapping
from finssim.robot.messages import CommandEcho, NavigationAid, Picture, Telemetry
from finssim.robot.pictures import jpeg
from finssim.robot.reading import Reading
from finssim.robot.record_messages import METADATA, TOPICS, Messages, definition, offered_qos, own_topics
from finssim.vehicles import Vehicle, load_vehicle


class _Whole:
    """An unbuffered file as a stream that writes every piece completely or raises an exception."""

    def __init__(self, file: Any) -> None:
        self._file, self.written = file, 0

    def write(self, data: bytes) -> None:
        """Write all of the data; they are counted only once the system has written them completely."""
        view = memoryview(data)
        while view:
            view = view[self._file.write(view) or 0 :]
        self.written += len(data)

    def tell(self) -> int:
        """Return the number of bytes of the complete records in the file."""
        return self.written

    def flush(self) -> None:
        """Return once the written data are on disk."""
        os.fsync(self._file.fileno())


# The thread that writes a record to disk: the control loop never waits for it, and a full disk never stops it.


Payload = bytes | Callable[[], "bytes | None"]

LOG = logging.getLogger(__name__)

LARGEST_CHUNK = 1 << 20
"""Size at which a chunk is closed [bytes]."""

DISORDER = 1_000_000_000
"""Delay below which a late message is recorded at the time of the previous one; a larger one is a clock step back
[ns]."""

POLLS = 5
"""Number of checks of the queue per chunk."""


class RecordSink:
    """A file with a queue of messages that a thread writes.

    A chunk is written and flushed to disk when its messages span `chunk_seconds`, or have waited that long: a process
    that is killed loses at most that time and a fifth of it. If the system refuses to write, the file is closed after
    its last complete chunk, `problem` states the reason in a sentence, and later messages are dropped and counted.
    """

    def __init__(
        self,
        path: Path,
        announce: Callable[[Any, str], int],
        *,
        chunk_seconds: float = 0.5,
        longest_queue: int = 64 << 20,
    ) -> None:
        """
        Args:
            path: File to create; an existing one is refused.
            announce: Registers the channel of a key with an `mcap.writer.Writer` when its first message is written, and
                returns its number.
            chunk_seconds: Longest time span of a chunk [s].
            longest_queue: Greatest number of waiting bytes; further messages are dropped.

        Raises:
            OutputError: The file exists or cannot be created.
        """
        if os.path.lexists(path):
            raise OutputError(
                f"cannot write {path}: it exists, and records are never replaced: give a new name"
            )
        from mcap.writer import CompressionType, Writer

        refuse_unwritable(atomic_write(path))
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.problem = ""
        """Reason why recording stopped; empty while it continues."""
        self.dropped = 0
        """Number of messages that were not recorded."""
        self._file = open(path, "xb", buffering=0)
        self._stream: Any = _Whole(self._file)
        self.writer = Writer(self._stream, chunk_size=LARGEST_CHUNK, compression=CompressionType.LZ4)
        """Writer for metadata and attachments, before `start`."""
        self.writer.start(profile="ros2", library="finssim")
        self._announce = announce
        self._channels: dict[str, int] = {}
        self._counts: Counter[str] = Counter()
        self._chunk_seconds, self._longest_queue = chunk_seconds, longest_queue
        self._queue: deque[tuple[str, int, Payload, int]] = deque()
        self._put_bytes = self._taken_bytes = 0  # each written by one thread only
        self._newest = 0
        self._opened: int | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"recorder {path.name}", daemon=True)

    def start(self) -> None:
        """Start the writing thread."""
        self._stream.flush()
        self._thread.start()

    def put(self, key: str, time: int, payload: Payload, size: int) -> None:
        """Queue a message.

        Args:
            key: Key of its channel.
            time: [ns]
            payload: Its bytes, or a function that creates them in the writing thread; None if that fails.
            size: Approximate number of waiting bytes.
        """
        if self.problem or self._put_bytes - self._taken_bytes > self._longest_queue:
            self.dropped += 1
            return
        # Readers of a file without an index need messages in order; the original times are in the messages' own stamps.
        if 0 < self._newest - time < DISORDER:
            time = self._newest
        self._newest = time
        self._put_bytes += size
        self._queue.append((key, time, payload, size))

    def close(self) -> None:
        """Write the waiting messages and the summary; return once they are on disk."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        try:
            idle = 0
            while not self._closing.wait(self._chunk_seconds / POLLS):
                self._drain()
                idle = idle + 1 if self._opened is not None else 0
                if idle >= POLLS:
                    self._close_chunk()
                    idle = 0
            self._drain()
            self.writer.finish()
            self._stream.flush()
        except Exception as error:  # any error must be reported, and must not stop the vehicle's control
            self._stop(error)
        finally:
            self._file.close()

    def _drain(self) -> None:
        while self._queue:
            key, time, payload, size = self._queue.popleft()
            self._taken_bytes += size
            data = payload() if callable(payload) else payload
            if data is None:
                self.dropped += 1
                continue
            if key not in self._channels:
                self._channels[key] = self._announce(self.writer, key)
            self._opened = time if self._opened is None else self._opened
            sequence = self._counts[key] & 0xFFFFFFFF
            self.writer.add_message(self._channels[key], time, data, time, sequence)
            self._counts[key] += 1
            if time - self._opened >= self._chunk_seconds * 1e9:
                self._close_chunk()

    def _close_chunk(self) -> None:
        self.writer.flush()
        self._opened = None

    def _stop(self, error: Exception) -> None:
        """Stop recording: the file ends after its last complete record, if the system permits it."""
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
        self.problem = (
            f"{self.path}: recording stopped: {reason}: the record up to then is kept; free some "
            "space or record elsewhere"
        )
        self.dropped += len(self._queue)
        self._queue.clear()
        LOG.warning(self.problem)
        try:
            self._file.truncate(self._stream.written)
            self._file.seek(0, os.SEEK_END)
            self._file.write(END)
        except OSError:
            # No space even for that: readers find the last complete record themselves.
            LOG.warning("%s: ends without a summary: `finssim record repair` writes one", self.path)


class Recorder:
    """Writer of a record; every method returns immediately, and no disk error raises an exception.

        with Recorder("run.mcap", vehicle, {"seed": 1, "command": "finssim run"}) as recorder:
            recorder.telemetry(now, telemetry)
            recorder.reading(now, reading)

    Times are the robot's clock [s]; in the record they are offset by `epoch`, for example to Unix time. Methods must
    not be called by several threads at a time.
    """

    def __init__(
        self,
        path: Path | str,
        vehicle: Vehicle,
        meta: Mapping[str, Any] | None = None,
        *,
        pictures: Literal["jpeg", "none"] = "jpeg",
        chunk_seconds: float = 0.5,
        epoch: float = 0.0,
        files: Mapping[str, Path | str] | None = None,
    ) -> None:
        """
        Args:
            path: File to create; an existing one is refused.
            vehicle: Vehicle of the record.
            meta: Configuration, seed and other facts on the run: plain values, stored as JSON.
            pictures: Format of camera pictures; none omits them.
            chunk_seconds: Time span of the record that is written at a time [s].
            epoch: Time of the record at time 0 of the robot's clock [s].
            files: Name -> file to attach, such as the pool's; the vehicle's is always attached.

        Raises:
            OutputError: The file exists or cannot be created.
            OSError: One of `files` cannot be read.
        """
        texts = {name: Path(file).read_bytes() for name, file in (files or {}).items()}
        texts |= _vehicle_files(vehicle)
        self._name, self._vehicle, self._messages = vehicle.name, vehicle, Messages(vehicle)
        self._topics = TOPICS | own_topics(vehicle)
        self._schemas: dict[str, int] = {}
        # Compiles the serialisation of each type, so that its first message does not wait for it.
        for topic in self._topics.values():
            self._messages.types.get_msgdef(topic.type)
        self._pictures, self._epoch = pictures, round(epoch * 1e9)
        self._sink = RecordSink(Path(path), self._announce, chunk_seconds=chunk_seconds)
        about = {
            "vehicle": vehicle.name,
            "vehicle_sha256": vehicle.sha256,
            "epoch": repr(float(epoch)),
            "provenance": json.dumps(provenance()),
        }
        meta_texts = {
            k: v if isinstance(v, str) else json.dumps(v, default=str) for k, v in (meta or {}).items()
        }
        self._sink.writer.add_metadata(METADATA, {**meta_texts, **about})
        for name, text in texts.items():
            self._sink.writer.add_attachment(0, 0, name, "text/plain", text)
        self._sink.start()

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._sink.path

    @property
    def problem(self) -> str:
        """Reason in a sentence why recording stopped; empty while it continues."""
        return self._sink.problem

    @property
    def dropped(self) -> int:
        """Number of messages that are not in the record: after it stopped, or when the disk was too slow."""
        return self._sink.dropped

    def telemetry(self, now: float, telemetry: Telemetry, time: float | None = None) -> None:
        """Record telemetry: raw, and as Imu, FluidPressure, shaft speeds and other actuators' values.

        Args:
            now: Time of arrival [s].
            telemetry: The message.
            time: Time of measurement [s]; `now` if unknown.
        """
        received, make = self._ns(now), self._messages
        stamp = received if time is None else self._ns(time)
        self._put("telemetry", received, make.telemetry(stamp, received, telemetry))
        self._put("imu", received, make.imu(stamp, telemetry))
        self._put("pressure", received, make.pressure(stamp, telemetry))
        shafts = None if telemetry.motor_rpm is None else make.shafts(stamp, telemetry.motor_rpm)
        if shafts is not None:
            self._put("shafts", received, shafts)
        if telemetry.actuators:
            self._put("actuators", received, make.actuators(stamp, telemetry.actuators))

    def reading(self, now: float, reading: Reading) -> None:
        """Record an estimate, as Odometry, transform and EstimatorStatus.

        Args:
            now: [s]
            reading: Reading for the controller; the record's stamp is its time.
        """
        at, make = self._ns(now), self._messages
        stamp = self._ns(reading.time)
        self._put("estimator", at, make.estimator(stamp, reading, {}))
        if np.isfinite(reading.position).all():
            self._put("odometry", at, make.odometry(stamp, reading))
            self._put("transform", at, make.transform(stamp, reading))

    def command(self, now: float, force: npt.ArrayLike, source: str = "", wrench: Any = None) -> None:
        """Record requested thrusts of a controller, values of other actuators, and the wrench of the thrusts.

        Args:
            now: [s]
            force: Along the thrusters' axes, canonical order [N], (n,), or these and the values of the other actuators
                [rad, m³ or m], (n + m,).
            source: Source of the command.
            wrench: Body axes [N, N m], (6,); None if there is none.
        """
        at = self._ns(now)
        channels, n = np.asarray(force, float), len(self._vehicle.thrusters)
        self._put("command", at, self._messages.command(at, channels[:n], source))
        if channels.size > n:
            self._put("setpoints", at, self._messages.actuators(at, channels[n:]))
        if wrench is not None:
            self._put("wrench", at, self._messages.wrench(at, wrench))

    def thrusters(self, now: float, state: str, **values: Any) -> None:
        """Record the state of the bridge; fields of `finssim_msgs/ThrusterState`, lists in canonical order.

        Args:
            now: [s]
            state: disarmed, armed, hold or fault.
            values: reason, source, requested, force, achieved [N], normalised (per motor output), shaft_speed [rad/s].
        """
        at = self._ns(now)
        self._put("thrusters", at, self._messages.thrusters(at, state, values))

    def echo(self, now: float, echo: CommandEcho) -> None:
        """Record the motor controller's echo of a command. `now` is the time [s]."""
        at = self._ns(now)
        self._put("echo", at, self._messages.echo(at, echo))

    def aid(self, now: float, aid: NavigationAid) -> None:
        """Record a reading of a navigation instrument that arrived now [s], stamped with the time of its
        measurement."""
        message = self._messages.aid(self._ns(now - aid.age), aid)
        if message is not None:
            self._put(message[0], self._ns(now), message[1])

    def policy(self, now: float, pilot: str, **values: Any) -> None:
        """Record one decision of a controller; fields of `finssim_msgs/PolicyInfo`. `now` is the time [s]."""
        at = self._ns(now)
        self._put("policy", at, self._messages.policy(at, pilot, values))

    def goal(self, now: float, position: npt.ArrayLike, yaw: float) -> None:
        """Record the current goal of the vehicle, map frame [m], (3,), and its heading [rad]."""
        at = self._ns(now)
        self._put("goal", at, self._messages.goal(at, np.asarray(position, float), yaw))

    def event(self, now: float, kind: str, text: str = "", **values: Any) -> None:
        """Record an event, such as arm, disarm, fault, trial_start; or a `phase` of an experiment.

        `now` is the time [s].
        """
        at = self._ns(now)
        self._put("event", at, self._messages.words({"time": now, "kind": kind, "text": text, **values}))

    def diagnostics(
        self, now: float, name: str, level: str, message: str, values: Mapping[str, Any] | None = None
    ) -> None:
        """Record the health of a component; level is ok, warn, error or stale. `now` is the time [s]."""
        at = self._ns(now)
        self._put("diagnostics", at, self._messages.diagnostics(at, name, level, message, values or {}))

    def picture(self, now: float, picture: Picture) -> None:
        """Record a picture of the camera, the tags that its own processor detected, or a reading of the vehicle's
        own sensors."""
        if picture.source:
            self._own(now, picture)
            return
        at, stamp = self._ns(now), self._ns(picture.time)
        if picture.tags:
            self._put("tags", at, self._messages.tags(picture))
        if picture.image is not None and self._pictures == "jpeg":
            image = picture.image
            compressed = partial(self._made, "picture", lambda: self._messages.picture(stamp, jpeg(image)))
            self._sink.put("picture", at, compressed, image.nbytes)

    def _own(self, now: float, picture: Picture) -> None:
        """Record the messages of a reading, except raw pictures; the writing thread creates them."""
        if picture.source not in self._vehicle.perception:
            return
        stamp = self._ns(picture.time - self._vehicle.perception[picture.source].latency)
        size = 0 if picture.image is None else picture.image.nbytes
        for key, make in self._messages.of_own(stamp, picture).items():
            if not key.endswith("/image") and (picture.image is None or self._pictures == "jpeg"):
                self._sink.put(key, self._ns(now), partial(self._made, key, make), size)

    def _made(self, key: str, make: Callable[[], Any]) -> bytes | None:
        """Return a serialised message; called in the writing thread."""
        message = make()
        return None if message is None else self._messages.cdr(message, self._topics[key].type)

    def close(self) -> None:
        """Finish the file; return once it is on disk."""
        self._sink.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _announce(self, writer: Any, key: str) -> int:
        kind = self._topics[key].type
        if kind not in self._schemas:
            self._schemas[kind] = writer.register_schema(kind, "ros2msg", definition(kind).encode())
        quality = {"offered_qos_profiles": offered_qos(self._topics[key].quality)}
        topic = self._topics[key].under(self._name)
        return int(writer.register_channel(topic, "cdr", self._schemas[kind], quality))

    def _put(self, key: str, at: int, message: Any) -> None:
        data = self._messages.cdr(message, self._topics[key].type)
        self._sink.put(key, at, data, len(data))

    def _ns(self, seconds: float) -> int:
        # An MCAP file has no times before 0: a clock that was set back further is recorded as constant.
        return max(self._epoch + (round(seconds * 1e9) if math.isfinite(seconds) else 0), 0)


@contextmanager
def recording(
    path: Path | None,
    vehicle: Vehicle,
    meta: Mapping[str, Any],
    *,
    pool_file: Path | None = None,
    lockstep: bool = False,
    pictures: Literal["jpeg", "none"] = "jpeg",
) -> Iterator[Recorder | None]:
    """Yield a recorder for the duration of a run, with the pool's file attached; None without a path.

    Args:
        path: See `Recorder`; nothing is recorded if None.
        vehicle: See `Recorder`.
        meta: See `Recorder`.
        pool_file: Attached to the record as `pool.yaml`.
        lockstep: True if the robot's clock starts at 0; otherwise it is this machine's, and the record has Unix time.
        pictures: See `Recorder`.
    """
    if path is None:
        yield None
        return
    epoch = 0.0 if lockstep else time.time() - realtime.now()
    files = {"pool.yaml": pool_file} if pool_file else {}
    with Recorder(path, vehicle, meta, pictures=pictures, epoch=epoch, files=files) as recorder:
        yield recorder


def _vehicle_files(vehicle: Vehicle) -> dict[str, bytes]:
    """Return the vehicle's file and those of its folder that it extends; its values if a program changed them."""
    path = vehicle.path
    if path is None or path.suffix not in (".yaml", ".yml") or load_vehicle(path).sha256 != vehicle.sha256:
        return {f"{vehicle.name}.json": json.dumps(vehicle.values(), default=str).encode()}
    texts = {f"{vehicle.name}.yaml": path.read_bytes()}
    while True:
        parent = str(read_mapping(path, OutputError, such_as="name: value").get("extends") or "")
        path = path.parent / (parent if parent.endswith((".yaml", ".yml")) else f"{parent}.yaml")
        if Path(parent).name != parent or path.name in texts or not path.is_file():
            return texts
        texts[path.name] = path.read_bytes()
