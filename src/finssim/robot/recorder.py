"""The recorder: everything the robot sees, decides and does in one MCAP of ROS 2 messages."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from finssim.provenance import provenance
from finssim.robot.mcap_writer import McapWriter
from finssim.robot.messages import CommandEcho, NavigationAid, Picture, Telemetry
from finssim.robot.record_messages import Messages
from finssim.robot.record_pictures import jpeg
from finssim.robot.record_sink import RecordSink
from finssim.robot.record_topics import TOPICS, offered_qos
from finssim.robot.record_types import METADATA, definition
from finssim.robot.robot import Reading
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["Recorder"]


class Recorder:
    """Writes a record; every method returns at once, and none raises because of the disk.

        with Recorder("run.mcap", vehicle, {"seed": 1, "command": "finssim run"}) as recorder:
            recorder.telemetry(now, telemetry)
            recorder.reading(now, reading)

    Times are the robot's clock [s]; `epoch` puts it on another, such as that of 1970, in the record. Not for several
    threads at a time.
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
        """Args:
            path: File to make; an existing one is refused.
            vehicle: Whose record it is.
            meta: Configuration, seed and what else belongs to the run: plain values, kept as JSON.
            pictures: Whether camera pictures are kept.
            chunk_seconds: How much of the record is written at a time [s].
            epoch: What the record's clock shows when the robot's shows 0 [s].
            files: Name -> file that the record keeps, such as the pool's; the vehicle's is always kept.

        Raises:
            OutputError: The file exists or cannot be made.
            OSError: One of `files` cannot be read.
        """
        texts = {name: Path(file).read_bytes() for name, file in (files or {}).items()}
        texts |= _vehicle_file(vehicle)
        self._name, self._messages = vehicle.name, Messages(vehicle)
        for (
            topic
        ) in TOPICS.values():  # compiles what packs a type: the first message of each must not wait for it
            self._messages.types.get_msgdef(topic.type)
        self._pictures, self._epoch = pictures, round(epoch * 1e9)
        self._sink = RecordSink(Path(path), self._announce, chunk_seconds=chunk_seconds)
        about = {
            "vehicle": vehicle.name,
            "vehicle_sha256": vehicle.sha256,
            "epoch": repr(float(epoch)),
            "provenance": json.dumps(provenance()),
        }
        given = {k: v if isinstance(v, str) else json.dumps(v, default=str) for k, v in (meta or {}).items()}
        self._sink.writer.metadata(METADATA, {**given, **about})
        for name, text in texts.items():
            self._sink.writer.attachment(name, "text/plain", text)
        self._sink.start()

    @property
    def path(self) -> Path:
        """The file."""
        return self._sink.path

    @property
    def problem(self) -> str:
        """Why recording stopped, in a sentence; empty while it goes on."""
        return self._sink.problem

    @property
    def dropped(self) -> int:
        """Messages that are not in the record: after it stopped, or when the disk was too slow."""
        return self._sink.dropped

    def telemetry(self, now: float, telemetry: Telemetry, time: float | None = None) -> None:
        """A snapshot of the motor controller: raw, and as Imu, FluidPressure and shaft speeds.

        Args:
            now: When it came [s].
            telemetry: The snapshot.
            time: When it was measured [s]; `now` if not known.
        """
        received, make = self._ns(now), self._messages
        stamp = received if time is None else self._ns(time)
        self._put("telemetry", received, make.telemetry(stamp, received, telemetry))
        self._put("imu", received, make.imu(stamp, telemetry))
        self._put("pressure", received, make.pressure(stamp, telemetry))
        shafts = None if telemetry.motor_rpm is None else make.shafts(stamp, telemetry.motor_rpm)
        if shafts is not None:
            self._put("shafts", received, shafts)

    def reading(self, now: float, reading: Reading, health: Mapping[str, Any] | None = None) -> None:
        """The estimate, as Odometry, transform and EstimatorStatus.

        Args:
            now: [s]
            reading: What a controller is given; the record's stamp is its time.
            health: Fields of EstimatorStatus that a reading does not tell, such as `vision_age`.
        """
        at, make = self._ns(now), self._messages
        stamp = self._ns(reading.time)
        self._put("estimator", at, make.estimator(stamp, reading, health or {}))
        if np.isfinite(reading.position).all():
            self._put("odometry", at, make.odometry(stamp, reading))
            self._put("transform", at, make.transform(stamp, reading))

    def command(self, now: float, force: npt.ArrayLike, source: str = "", wrench: Any = None) -> None:
        """Thrusts that a controller asks for, and the wrench behind them.

        Args:
            now: [s]
            force: Along the thrusters' axes, canonical order [N], (n,).
            source: Who asks.
            wrench: Body axes [N, N m], (6,); None where there is none.
        """
        at = self._ns(now)
        self._put("command", at, self._messages.command(at, force, source))
        if wrench is not None:
            self._put("wrench", at, self._messages.wrench(at, wrench))

    def thrusters(self, now: float, state: str, **values: Any) -> None:
        """What the bridge made of commands; fields of `finssim_msgs/ThrusterState`, lists in canonical order.

        Args:
            now: [s]
            state: disarmed, armed, hold or fault.
            values: reason, source, requested, force, achieved [N], normalised (per motor output), shaft_speed [rad/s].
        """
        at = self._ns(now)
        self._put("thrusters", at, self._messages.thrusters(at, state, values))

    def echo(self, now: float, echo: CommandEcho) -> None:
        """What the motor controller made of a command."""
        at = self._ns(now)
        self._put("echo", at, self._messages.echo(at, echo))

    def aid(self, now: float, aid: NavigationAid) -> None:
        """A fix, velocity or heading of a navigation instrument that came now [s], stamped with its measurement."""
        made = self._messages.aid(self._ns(now - aid.age), aid)
        if made is not None:
            self._put(made[0], self._ns(now), made[1])

    def policy(self, now: float, pilot: str, **values: Any) -> None:
        """One decision of a controller; fields of `finssim_msgs/PolicyInfo`."""
        at = self._ns(now)
        self._put("policy", at, self._messages.policy(at, pilot, values))

    def goal(self, now: float, position: npt.ArrayLike, yaw: float) -> None:
        """Where the vehicle should be now, map frame [m], (3,), and its heading [rad]."""
        at = self._ns(now)
        self._put("goal", at, self._messages.goal(at, np.asarray(position, float), yaw))

    def event(self, now: float, kind: str, text: str = "", **values: Any) -> None:
        """Something that happened, such as arm, disarm, fault, trial_start; or a `phase` of an experiment."""
        at = self._ns(now)
        self._put("event", at, self._messages.words({"time": now, "kind": kind, "text": text, **values}))

    def diagnostics(
        self, now: float, name: str, level: str, message: str, values: Mapping[str, Any] | None = None
    ) -> None:
        """The health of a part; level is ok, warn, error or stale."""
        at = self._ns(now)
        self._put("diagnostics", at, self._messages.diagnostics(at, name, level, message, values or {}))

    def picture(self, now: float, picture: Picture) -> None:
        """A picture of the camera, or the tags its own processor found."""
        at, stamp = self._ns(now), self._ns(picture.time)
        if picture.tags:
            self._put("tags", at, self._messages.tags(picture))
        if picture.image is not None and self._pictures == "jpeg":
            image = picture.image
            self._sink.put("picture", at, lambda: self._compressed(stamp, image), image.nbytes)

    def close(self) -> None:
        """Finish the file; returns when it is on disk."""
        self._sink.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _announce(self, writer: McapWriter, key: str) -> int:
        topic = TOPICS[key]
        return writer.channel(
            self._topic_name(key), topic.type, definition(topic.type), offered_qos(topic.quality)
        )

    def _topic_name(self, key: str) -> str:
        return TOPICS[key].under(self._name)

    def _put(self, key: str, at: int, message: Any) -> None:
        data = self._messages.cdr(message, TOPICS[key].type)
        self._sink.put(key, at, data, len(data))

    def _compressed(self, stamp: int, image: npt.NDArray[np.uint8]) -> bytes | None:
        """Runs on the writing thread."""
        packed = jpeg(image)
        if packed is None:
            return None
        return self._messages.cdr(self._messages.picture(stamp, packed), TOPICS["picture"].type)

    def _ns(self, seconds: float) -> int:
        # An MCAP has no time before 0: a clock that was set back further is recorded as standing there.
        return max(self._epoch + (round(seconds * 1e9) if math.isfinite(seconds) else 0), 0)


def _vehicle_file(vehicle: Vehicle) -> dict[str, bytes]:
    """The vehicle's file; its values where a program changed them after reading."""
    if vehicle.path is not None and load_vehicle(vehicle.path).sha256 == vehicle.sha256:
        return {f"{vehicle.name}.yaml": vehicle.path.read_bytes()}
    return {f"{vehicle.name}.json": json.dumps(vehicle.values(), default=str).encode()}
