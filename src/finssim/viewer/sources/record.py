"""Frames of a record (.mcap), with the truth beside it where its file is at hand."""

from __future__ import annotations

import math
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.files import plain_name
from finssim.localization.pool import Pool, load_pool
from finssim.pool.virtual_pool import Truth, read_truth
from finssim.robot.messages import TagCorners
from finssim.robot.pictures import picture_of
from finssim.robot.record_messages import STATES
from finssim.robot.record_reader import Record, open_record
from finssim.vehicles import Vehicle, VehicleError, catalogue_vehicle, load_vehicle
from finssim.viewer.frame import Curve, Frame, Picture, Stage, ViewError
from finssim.viewer.shapes import world_bodies
from finssim.viewer.sources.alignment import offset_between
from finssim.viewer.sources.series import HEADING, POSITION, PoseSeries, Series, errors_between
from finssim.viewer.stages import box_of, box_of_world
from finssim.viewer.tags import TagLook
from finssim.worlds.layout import WorldLayout
from finssim.yaml_file import json_value, read_mapping

Array = npt.NDArray[np.float64]

TOPICS = (
    "odom",
    "estimator_status",
    "goal",
    "thruster_state",
    "joint_states",
    "camera/image/compressed",
    "camera/tags",
    "events",
)
EVENTS = 8
"""That are shown."""
POINTS = 1500
"""Of a curve, at most."""
FRESH = 1.0
"""An older picture is not shown [s]."""


class RecordSource:
    """A record, read whole; `frame` looks things up."""

    def __init__(
        self,
        path: Path | str,
        *,
        truth: Path | None = None,
        offset: float | None = None,
        basin: tuple[float, float, float] | None = None,
        vehicle: str | None = None,
        world: str | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            path: Of the record.
            truth: The pool's truth file.
            offset: The robot's clock when the pool's showed 0 [s]; found by laying the motions over each other if None.
            basin: Length, width and depth of the pool [m]; the vehicle's workspace is drawn if None.
            vehicle: Name or file; as the record has it if None.
            world: Site of the catalogue of worlds, or a path, that is drawn around it; none if None.
            seed: That the world was drawn with.

        Raises:
            RecordError, TruthError, VehicleError: A file that cannot be read.
            ViewError: Nothing in it that could be shown.
        """
        with open_record(path) as record:
            self._vehicle = load_vehicle(vehicle) if vehicle else _vehicle_of(record)
            self._read(record)
            site, self._record = _pool_of(record), record.metadata
        if not len(self._odom):
            raise ViewError(f"{path}: no estimate of a pose in it, on a topic odom: nothing to show")
        self._truth: PoseSeries | None = None
        if truth is not None:
            self._add_truth(read_truth(truth), offset)
        positions, around = np.concatenate([self._odom.position, self._goal.position]), {}
        lower, upper = box_of(self._vehicle, basin, positions)
        if world is not None:
            layout = WorldLayout(world)
            layout.draw(seed)
            lower, upper = box_of_world(layout.world)
            around["bodies"] = world_bodies(layout)
        self.stage = Stage(
            vehicle=self._vehicle,
            title=f"{Path(path).name}: {self._vehicle.name}",
            lower=lower,
            upper=upper,
            walls=basin is not None,
            site=site,
            path=_thinned(self._goal.position),
            eyes=list(self._eyes),
            **around,
        )
        self._size = (site.camera.lens.height, site.camera.lens.width) if site is not None else (720, 1280)
        self._look = TagLook(self._vehicle)
        self._shown: tuple[int, Picture] | None = None
        self._developed_own: dict[str, tuple[Any, Any]] = {}
        self._curves = self._all_curves()

    def frame(self, time: float) -> Frame:
        """The moment at a time since the record's beginning [s]."""
        at = self.begin + time
        thrusters = self._thrusters.at(at)
        force = np.zeros(0) if thrusters is None else np.asarray(thrusters.force, float)
        shown = self._truth if self._truth is not None else self._odom
        return Frame(
            time=time,
            truth=None if self._truth is None else self._truth.at(at),
            estimate=self._odom.at(at),
            goal=self._goal.at(at),
            force=force,
            trail=shown.trail(at),
            picture=self._picture(at),
            pictures={name: image for name in self._eyes if (image := self._own(name, at)) is not None},
            status=self._status(at, thrusters),
            events=[
                f"{t - self.begin:.1f} s  {text}"
                for t, text in zip(self._events.time, self._events.values, strict=True)
                if t <= at
            ][-EVENTS:],
        )

    def curves(self) -> Sequence[Curve]:
        """Errors of the whole record."""
        return self._curves

    def close(self) -> None:
        """Nothing is open."""

    def _read(self, record: Record) -> None:
        """Sort the record's messages by what they are."""
        own = [
            f"{name}/{kind}" for name in self._vehicle.perception for kind in ("image/compressed", "range")
        ]
        known = {record.topic(name): name for name in (*TOPICS, *own) if record.topic(name) in record.topics}
        if not known:
            raise ViewError(f"{record.path}: no topic to show; one of {', '.join(TOPICS)} is needed")
        times: defaultdict[str, list[float]] = defaultdict(list)
        found: defaultdict[str, list[Any]] = defaultdict(list)
        for entry in record.messages(known):
            times[known[entry.topic]].append(entry.time)
            found[known[entry.topic]].append(entry.message)
        self.begin = min(t[0] for t in times.values())
        self.duration = max(t[-1] for t in times.values()) - self.begin
        self._odom = _poses(times["odom"], [m.pose.pose for m in found["odom"]])
        self._goal = _poses(times["goal"], [m.pose for m in found["goal"]])
        self._health = Series(times["estimator_status"], found["estimator_status"])
        self._thrusters = Series(times["thruster_state"], found["thruster_state"])
        self._shafts = Series(times["joint_states"], found["joint_states"])
        self._pictures = Series(times["camera/image/compressed"], found["camera/image/compressed"])
        self._tags = Series(times["camera/tags"], found["camera/tags"])
        self._eyes, self._ranges = (
            {
                name.removesuffix(kind): Series(times[name], found[name])
                for name in own
                if name.endswith(kind) and found[name]
            }
            for kind in ("/image/compressed", "/range")
        )
        self._events = Series(times["events"], [_event(m.data) for m in found["events"]])

    def _add_truth(self, truth: Truth, offset: float | None) -> None:
        if offset is None:
            lockstep = float(self._record.get("epoch", "nan")) == 0.0
            offset = 0.0 if lockstep else offset_between(self._odom, truth.time, truth.position)
        self._truth = PoseSeries(truth.time + offset, truth.position, truth.quaternion)

    def _picture(self, at: float) -> Picture | None:
        tags = self._tags.at(at) if _age(self._tags, at) < FRESH else None
        found = _tags_in(tags.data) if tags is not None else ()
        if _age(self._pictures, at) >= FRESH:
            return Picture(None, found, self._size) if found else None
        i = int(np.searchsorted(self._pictures.time, at, side="right")) - 1
        if self._shown is None or self._shown[0] != i:
            self._shown = i, self._developed(i, at, found)
        return self._shown[1]

    def _own(self, name: str, at: float) -> Any:
        """The latest picture of an own camera or sonar; None where it is old or none."""
        message = self._eyes[name].at(at) if _age(self._eyes[name], at) < FRESH else None
        if message is None:
            return None
        if self._developed_own.get(name, (None,))[0] is not message:
            colour = message.header.frame_id.endswith("_optical")
            self._developed_own[name] = message, picture_of(message.data, colour=colour)
        return self._developed_own[name][1]

    def _developed(self, i: int, at: float, found: tuple[TagCorners, ...]) -> Picture:
        image = picture_of(self._pictures.values[i].data)
        # The tags of a record came with pictures of their own: those of another picture are not this one's.
        if image is not None and abs(_age(self._tags, at) - _age(self._pictures, at)) > 1e-3:
            found = self._look.find(image, at)
        return Picture(image, found, self._size)

    def _status(self, at: float, thrusters: Any) -> dict[str, str]:
        health, shafts = self._health.at(at), self._shafts.at(at)
        status = {}
        if thrusters is not None:
            status["bridge"] = STATES[thrusters.state] + (
                f" ({thrusters.reason})" if thrusters.reason else ""
            )
            status["commander"] = thrusters.source or "nobody"
        if health is not None:
            status["vision"] = health.mode
            status["state"] = "ready" if health.ready else f"not ready: {health.reason}"
            status["position std"] = f"{100.0 * float(np.max(health.position_std)):.1f} cm"
        if shafts is not None:
            rpm = np.asarray(shafts.velocity) * 60.0 / (2.0 * math.pi)
            status["shafts [rpm]"] = " ".join(f"{r:.0f}" for r in rpm)
        for name, series in self._ranges.items():
            if _age(series, at) < FRESH:
                status[name] = f"{series.at(at).range:.2f} m"
        return status

    def _all_curves(self) -> list[Curve]:
        every = max(1, len(self._odom) // POINTS)
        time = self._odom.time[::every]
        estimate, goal = self._odom.on(time), self._goal.on(time)
        truth = None if self._truth is None else self._truth.on(time)
        pairs = {"to the goal": (truth or estimate, goal)}
        if truth is not None:
            pairs["of the estimate"] = (estimate, truth)
        curves = []
        for label, (a, b) in pairs.items():
            distance, turn = errors_between(a, b)
            curves += [Curve(POSITION, label, time - self.begin, distance)]
            curves += [Curve(HEADING, label, time - self.begin, turn)]
        return [curve for curve in curves if np.isfinite(curve.value).any()]


def _age(series: Series, at: float) -> float:
    i = int(np.searchsorted(series.time, at, side="right")) - 1
    return math.inf if i < 0 else at - float(series.time[i])


def _poses(times: list[float], poses: list[Any]) -> PoseSeries:
    position = [(p.position.x, p.position.y, p.position.z) for p in poses]
    turn = [(p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in poses]
    return PoseSeries(times, np.array(position), np.array(turn))


def _thinned(path: Array) -> Array:
    """Where the goal has been, without the times at which it stood still."""
    if len(path) < 2:
        return path[:0]
    moved = np.flatnonzero(np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-6) + 1
    return path[np.concatenate([[0], moved])] if moved.size else path[:0]


def _event(text: str) -> str:
    try:
        event = json_value(text, ViewError, "event")
    except ValueError:
        return text
    return f"{event.get('kind', '')}: {event.get('text', '')}" if isinstance(event, dict) else text


def _tags_in(text: str) -> tuple[TagCorners, ...]:
    try:
        tags = json_value(text, ViewError, "tags")["tags"]
        return tuple(
            TagCorners(int(tag["id"]), np.asarray(tag["corners"], float).reshape(4, 2)) for tag in tags
        )
    except (ValueError, KeyError, TypeError, OverflowError):
        return ()  # somebody else's words


def _pool_of(record: Record) -> Pool | None:
    if "pool.yaml" not in record.files:
        return None
    with _kept_file(record, "pool.yaml", ("camera", "lens")) as file:
        return load_pool(file)


def _vehicle_of(record: Record) -> Vehicle:
    """The vehicle that the record names, from the file that it keeps where the catalogue has another one now."""
    name = record.metadata.get("vehicle")
    if name is None:
        raise ViewError(f"{record.path}: does not say whose it is: give --vehicle")
    file_name = f"{plain_name(name, f'{record.path}: vehicle', ViewError)}.yaml"
    try:
        vehicle = catalogue_vehicle(name, str(record.path))
        if vehicle.sha256 == record.metadata.get("vehicle_sha256") or file_name not in record.files:
            return vehicle
    except VehicleError:
        if file_name not in record.files:
            raise
    with _kept_file(record, file_name, ("extends",), ("hull", "file")) as file:
        return load_vehicle(file)


@contextmanager
def _kept_file(record: Record, name: str, *references: tuple[str, ...]) -> Iterator[Path]:
    """A file that the record keeps, in a folder of its own; `references` are its keys that may name other files.

    So may the devices of a vehicle's `perception`.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        file.write_text(record.files[name], encoding="utf-8")
        tree: Any = read_mapping(file, ViewError, such_as="name: value")
        for keys in references:
            value = tree
            for key in keys:
                value = value.get(key) if isinstance(value, dict) else None
            if isinstance(value, str):
                plain_name(value, f"{record.path}: {name}: {': '.join(keys)}", ViewError)
        entries = tree.get("perception")
        for entry in entries.values() if isinstance(entries, dict) else ():
            if isinstance(entry, dict) and isinstance(entry.get("device"), str):
                plain_name(entry["device"], f"{record.path}: {name}: perception: device", ViewError)
        yield file
