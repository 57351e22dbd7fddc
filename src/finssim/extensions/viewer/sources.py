"""Sources of the frames of a view: the virtual pool, the simulator, records, and runs of the engine."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.control.guidance import Guide, Station
from finssim.core.rotations import quat_from_yaw
from finssim.core.yaml_file import json_value
from finssim.evaluation.clocks import clock_offset
from finssim.extensions.perception import RangeBatch
from finssim.extensions.perception.layout import WorldLayout
from finssim.extensions.perception.onboard import OnboardSensors
from finssim.extensions.viewer.frame import (
    BodyPose,
    LatestPicture,
    PlotLine,
    ViewError,
    ViewFrame,
    ViewStage,
    box_of,
    box_of_world,
    nowhere,
)
from finssim.extensions.viewer.series import (
    HEADING,
    POSITION,
    Errors,
    PoseSeries,
    TimeSeries,
    errors_between,
)
from finssim.extensions.viewer.shapes import shown_of, world_bodies
from finssim.localization.detection.detector import RegionTracker, detector
from finssim.pool.plan import PoolPlan
from finssim.pool.virtual_pool import Truth, read_truth
from finssim.robot.bridge import Bridge
from finssim.robot.goals import check_reachable, guide_of
from finssim.robot.messages import Picture as Seen
from finssim.robot.messages import TagCorners
from finssim.robot.perception import Perception
from finssim.robot.pictures import picture_of
from finssim.robot.pilots import make_pilot
from finssim.robot.reading import Reading
from finssim.robot.record_files import pool_of, vehicle_of
from finssim.robot.record_messages import STATES, UNKNOWN
from finssim.robot.record_reader import Record, open_record
from finssim.robot.runtime import Runtime
from finssim.sim import RectangularPool as Walls
from finssim.sim import Simulator, Water
from finssim.sim.recorder import ABOUT, read_run
from finssim.vehicles import Vehicle, catalogue_vehicle, load_vehicle

Array = npt.NDArray[np.float64]

# The virtual pool with a robot in it, both in this process, in lock-step.

RATE = 60.0
"""Rate of the robot's loop [Hz]."""
EVENTS = 8
"""Number of displayed events."""


class PoolSource:
    """The virtual pool and the complete software of a robot, which does not know the truth."""

    duration = math.inf

    def __init__(
        self,
        guide: Guide,
        plan: PoolPlan,
        *,
        policy: str = "pid",
        task: str | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            guide: Goal or trajectory of the vehicle.
            plan: Pool; a vehicle with its own cameras and sonars starts at the viewpoint of their world.
            policy: Name of a PID, or a policy's directory.
            task: Task that the policy must have been trained for.
            seed: Seed of the noises.

        Raises:
            PlantSpecError, PolicyError, ControlError, VehicleError: The pool, policy or goal is invalid.
        """
        ours, basin, eye = plan.vehicle, plan.spec.basin, plan.eye()
        begin, self._own = start_of(guide), dict[str, Any]()
        if isinstance(eye, OnboardSensors):
            view = eye.batch.world.viewpoint
            begin = Station(tuple(view.position.tolist()), view.yaw)
        self._world = plan.world(eye, start=begin, seed=seed, truth=None)
        pilot = make_pilot(policy, ours, task=task)
        self._runtime = Runtime(
            ours, Perception(ours, plan.calibrated), pilot, guide, arm=True, bridge=Bridge(ours)
        )
        self._guide, self._look = guide, TagLook(ours)
        self._errors, self._sent, self._steps = Errors(), list[bytes](), 0
        self._picture: LatestPicture | None = None
        lens = None if plan.calibrated is None else plan.calibrated.camera.lens
        self._size = (0, 0) if lens is None else (lens.height, lens.width)
        size = (basin.length, basin.width, basin.depth)
        around: dict[str, Any] = {}
        if isinstance(eye, OnboardSensors):
            lower, upper = box_of_world(eye.batch.world)
            names = [name for name, sensor in eye.sensors.items() if not isinstance(sensor, RangeBatch)]
            around = {
                "bodies": world_bodies(eye.batch), "eyes": names, "walls": eye.batch.world.basin is not None
            }  # fmt: skip
        else:
            lower, upper = box_of(ours, size, np.zeros((0, 3)))
        self.stage = ViewStage(
            vehicle=ours,
            title=f"virtual pool, {plan.spec.title}: {pilot.name}, {guide.name}",
            lower=lower,
            upper=upper,
            site=plan.calibrated,
            path=path_of(guide),
            **around,
        )

    def frame(self, time: float) -> ViewFrame:
        """Run the pool and the robot up to a time [s]."""
        while self._steps < math.floor(time * RATE + 1e-6):
            self._step()
        runtime, plant = self._runtime, self._world.plant
        return ViewFrame(
            time=self._steps / RATE,
            truth=self._truth(),
            estimate=self._estimate(),
            covariance=self._covariance(),
            goal=self._goal(),
            force=np.array(plant.thrust, float),
            values=np.array(plant.values, float),
            trail=self._errors.trail,
            picture=self._picture,
            pictures={name: image for name, image in self._own.items() if isinstance(image, np.ndarray)},
            status=self._status(runtime),
            events=[f"{e.time:.1f} s  {e.kind}: {e.text}" for e in list(runtime.counters.events)[-EVENTS:]],
        )

    def curves(self) -> Sequence[PlotLine]:
        """Return the errors to the goal and of the estimate."""
        return self._errors.curves()

    def close(self) -> None:
        """Stop the thrusters and close the pool."""
        self._runtime.stop(self._steps / RATE)
        self._world.close()

    def _step(self) -> None:
        self._steps += 1
        runtime = self._runtime
        delivery = self._world.exchange(self._steps / RATE, self._sent)
        pictures = [self._seen(picture) for picture in delivery.pictures]
        self._sent = runtime.step(delivery.time, delivery.frames, pictures)
        runtime.sent(delivery.time)
        self._errors.add(delivery.time, self._truth(), self._estimate(), self._goal())

    def _seen(self, picture: Seen) -> Seen:
        """Store a camera's picture with its tags; with these, the robot need not detect them again."""
        if picture.source:
            self._own[picture.source] = shown_of(self._world.vehicle, picture)
            return picture
        if picture.image is not None and not picture.tags:
            picture = replace(picture, tags=self._look.find(picture.image, picture.time))
        self._picture = LatestPicture(picture.image, picture.tags, self._size)
        return picture

    def _truth(self) -> BodyPose:
        plant = self._world.plant
        return BodyPose(np.array(plant.position, float), np.array(plant.quaternion, float))

    def _estimate(self) -> BodyPose | None:
        reading = self._runtime.reading
        if reading is None or not np.isfinite(reading.position).all():
            return None
        return BodyPose(reading.position, reading.quaternion)

    def _covariance(self) -> Array | None:
        reading = self._runtime.reading
        return None if reading is None else known_covariance(np.diag(np.square(reading.std[:3])))

    def _goal(self) -> BodyPose:
        t = self._runtime.t
        return goal_pose(self._guide, 0.0 if math.isnan(t) else t)

    def _status(self, runtime: Runtime) -> dict[str, str]:
        bridge, reading, plant = runtime.bridge, runtime.reading, self._world.plant
        reason = bridge.reason or runtime.refusal
        status: dict[str, Any] = {"bridge": bridge.state + (f" ({reason})" if reason else "")}
        if reading is not None:
            status["vision"] = reading.mode
            status["state"] = "ready" if reading.ready else f"not ready: {reading.reason}"
        status |= {name: text for name, text in self._own.items() if isinstance(text, str)}
        status["to the goal"] = self._errors.to_goal
        status["estimate error"] = self._errors.of_estimate
        status["battery"] = f"{float(plant.electric[0]):.2f} V"
        rpm = np.asarray(plant.shaft_speed) * 60.0 / (2.0 * math.pi)
        status["shafts"] = listed(rpm, "rpm")
        return status


def listed(values: npt.ArrayLike, unit: str, digits: int = 0) -> str:
    """Return numbers, (n,), as a text with their unit and a number of decimals, in the order of the vehicle's
    thrusters."""
    return (
        ", ".join(f"{x:.{digits}f}" for x in np.asarray(values)).replace("-", "\N{MINUS SIGN}") + f" {unit}"
    )


# Frames of the simulator with a controller that knows the state exactly.

STEP = 0.02
"""Longest time between two frames [s]; the physics step is half of it."""


class SimulatorSource:
    """One vehicle in the engine, in still water."""

    duration = math.inf

    def __init__(
        self,
        vehicle: Vehicle,
        guide: Guide,
        *,
        policy: str = "pid",
        task: str | None = None,
        hydrodynamics: str = "calibrated",
        seed: int = 0,
    ) -> None:
        """
        Args:
            vehicle: Vehicle to simulate.
            guide: Goal or trajectory of the vehicle.
            policy: Name of a PID, or a policy's directory.
            task: Task that the policy must have been trained for.
            hydrodynamics: Model: calibrated, mesh or simplified.
            seed: Seed of the engine.

        Raises:
            PolicyError, ControlError, SimulatorError: Vehicle, policy and goal are not compatible.
        """
        self._pilot, self._guide = make_pilot(policy, vehicle, task=task), guide
        way = path_of(guide) if math.isfinite(guide.duration) else guide.at(np.zeros(1)).position
        start = start_of(guide)
        if not math.isfinite(guide.duration):  # completely under water, however large the vehicle is
            start = replace(start, position=(0.0, 0.0, min(-0.5, -float(vehicle.body.size[2]))))
        size = _basin(np.concatenate([way, [start.position]]), float(np.max(vehicle.body.size)))
        self._simulator = Simulator(
            vehicle,
            hydrodynamics=hydrodynamics,
            control_step=STEP,
            substeps=2,
            water=Water(depth=size[2]),
            pool=Walls(length=size[0], width=size[1], depth=size[2]),
            seed=seed,
            threads=1,
        )
        self._simulator.place(position=start.position, quaternion=quat_from_yaw(start.yaw))
        self._n, self._steps, self._decided = len(vehicle.thruster_names), 0, -math.inf
        self._errors = Errors()
        lower, upper = box_of(vehicle, size, np.zeros((0, 3)))
        title = f"simulator, {hydrodynamics}: {self._pilot.name}, {guide.name}"
        self.stage = ViewStage(vehicle=vehicle, title=title, lower=lower, upper=upper, path=path_of(guide))
        self._pilot.reset()

    def frame(self, time: float) -> ViewFrame:
        """Simulate up to a time [s]."""
        while self._steps < math.floor(time / STEP + 1e-6):
            self._step()
        now, pose = self._steps * STEP, self._pose()
        goal = goal_pose(self._guide, now)
        return ViewFrame(
            time=now,
            truth=pose,
            goal=goal,
            force=self._channels()[: self._n],
            values=self._channels()[self._n :],
            trail=self._errors.trail,
            status={
                "controller": self._pilot.name,
                "to the goal": self._errors.to_goal,
                "progress": f"{100.0 * float(self._guide.at(now).progress):.0f} %",
                "thrusts": listed(self._channels()[: self._n], "N", 1),
            },
        )

    def curves(self) -> Sequence[PlotLine]:
        """Return the errors to the goal."""
        return self._errors.curves()

    def close(self) -> None:
        """Do nothing, because nothing is open."""

    def _step(self) -> None:
        now, s = self._steps * STEP, self._simulator
        if now >= self._decided + self._pilot.period - 1e-6:
            pose = self._pose()
            nu = s.numpy("velocity")[0, 0].astype(float)
            reading = Reading(now, pose.position, pose.quaternion, nu, ready=True)
            asked = self._pilot.act(reading, self._guide, now)
            (s.set_thrust if len(asked) == self._n else s.set_actuators)(asked)
            self._decided = now
        s.step()
        self._steps += 1
        self._errors.add(self._steps * STEP, self._pose(), None, goal_pose(self._guide, self._steps * STEP))

    def _pose(self) -> BodyPose:
        s = self._simulator
        return BodyPose(s.numpy("position")[0, 0].astype(float), s.numpy("quaternion")[0, 0].astype(float))

    def _channels(self) -> np.ndarray:
        channels = self._simulator.vehicles[0].channel_names
        return np.asarray(self._simulator.numpy("thrust")[0, 0, : len(channels)], float)


def _basin(way: np.ndarray, length: float) -> tuple[float, float, float]:
    """Return the size of a pool with enough space for a motion of a vehicle of some length: the paper's or
    larger [m]."""
    half, depth = np.abs(way).max(axis=0) + 1.5 * length, length - float(way[:, 2].min())
    return max(4.0, 2.0 * float(half[0])), max(2.0, 2.0 * float(half[1])), max(1.0, depth)


# Frames of a record (.mcap), with the truth if its file is available.


TOPICS = (
    "odom",
    "estimator_status",
    "goal",
    "thruster_state",
    "joint_states",
    "actuator_states",
    "camera/image/compressed",
    "camera/tags",
    "events",
)
POINTS = 1500
"""Largest number of points of a curve."""
FRESH = 1.0
"""Age above which a picture is not shown [s]."""


class RecordSource:
    """Record that is read completely at the start."""

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
            path: Record file (.mcap).
            truth: Truth file of the pool.
            offset: Time of the robot's clock when the pool's is 0 [s]; None estimates it from both motions.
            basin: Length, width and depth of the pool [m]; None draws the vehicle's workspace.
            vehicle: Name or file; None uses that of the record.
            world: Site of the catalogue of worlds, or a world file, that is drawn around it; None draws none.
            seed: Seed with which the world was drawn.

        Raises:
            RecordError, TruthError, VehicleError: A file that cannot be read.
            ViewError: The record contains nothing that can be shown.
        """
        with open_record(path) as record:
            self._vehicle = load_vehicle(vehicle) if vehicle else vehicle_of(record)
            self._read(record)
            site, self._record = pool_of(record), record.metadata
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
        self.stage = ViewStage(
            vehicle=self._vehicle,
            title=f"{Path(path).name}: {self._vehicle.name}",
            lower=lower,
            upper=upper,
            walls=basin is not None,
            site=site,
            path=_thinned(self._goal.position),
            events=[(t - self.begin, text) for t, text in self._happened],
            eyes=list(self._eyes),
            **around,
        )
        self._size = (site.camera.lens.height, site.camera.lens.width) if site is not None else (720, 1280)
        self._look = TagLook(self._vehicle)
        self._shown: tuple[int, LatestPicture] | None = None
        self._developed_own: dict[str, tuple[Any, Any]] = {}
        self._curves = self._all_curves()

    def frame(self, time: float) -> ViewFrame:
        """Return the frame at a time since the start of the record [s]."""
        at = self.begin + time
        thrusters = self._thrusters.at(at)
        force = np.zeros(0) if thrusters is None else np.asarray(thrusters.force, float)
        values = self._values.at(at)
        poses = self._truth if self._truth is not None else self._odom
        return ViewFrame(
            time=time,
            truth=None if self._truth is None else self._truth.at(at),
            estimate=self._odom.at(at),
            covariance=self._covariance(at),
            goal=self._goal.at(at),
            force=force,
            values=np.zeros(0) if values is None else np.asarray(values.position, float),
            trail=poses.trail(at),
            picture=self._picture(at),
            pictures={name: image for name in self._eyes if (image := self._own(name, at)) is not None},
            status=self._status(at, thrusters),
            events=[f"{t - self.begin:.1f} s  {text}" for t, text in self._happened if t <= at][-EVENTS:],
        )

    def curves(self) -> Sequence[PlotLine]:
        """Return the errors over the complete record."""
        return self._curves

    def close(self) -> None:
        """Do nothing, because nothing is open."""

    def _read(self, record: Record) -> None:
        """Sort the record's messages by topic."""
        perceived = [
            f"{name}/{kind}" for name in self._vehicle.perception for kind in ("image/compressed", "range")
        ]
        topics = {
            record.topic(name): name for name in (*TOPICS, *perceived) if record.topic(name) in record.topics
        }
        if not topics:
            raise ViewError(f"{record.path}: no topic to show; one of {', '.join(TOPICS)} is needed")
        times: defaultdict[str, list[float]] = defaultdict(list)
        by_name: defaultdict[str, list[Any]] = defaultdict(list)
        for entry in record.messages(topics):
            times[topics[entry.topic]].append(entry.time)
            by_name[topics[entry.topic]].append(entry.message)
        self.begin = min(t[0] for t in times.values())
        self.duration = max(t[-1] for t in times.values()) - self.begin
        self._odom = _poses(times["odom"], [m.pose.pose for m in by_name["odom"]])
        self._covariances = TimeSeries(times["odom"], [m.pose.covariance for m in by_name["odom"]])
        self._goal = _poses(times["goal"], [m.pose for m in by_name["goal"]])
        self._health = TimeSeries(times["estimator_status"], by_name["estimator_status"])
        self._thrusters = TimeSeries(times["thruster_state"], by_name["thruster_state"])
        self._shafts = TimeSeries(times["joint_states"], by_name["joint_states"])
        self._values = TimeSeries(times["actuator_states"], by_name["actuator_states"])
        self._pictures = TimeSeries(times["camera/image/compressed"], by_name["camera/image/compressed"])
        self._tags = TimeSeries(times["camera/tags"], by_name["camera/tags"])
        self._eyes, self._ranges = (
            {
                name.removesuffix(kind): TimeSeries(times[name], by_name[name])
                for name in perceived
                if name.endswith(kind) and by_name[name]
            }
            for kind in ("/image/compressed", "/range")
        )
        self._happened = sorted(
            [
                *zip(times["events"], (_event(m.data) for m in by_name["events"]), strict=True),
                *_vision(times["estimator_status"], by_name["estimator_status"]),
            ]
        )

    def _covariance(self, at: float) -> Array | None:
        """Return the covariance of the estimated position; None if the estimator has none."""
        covariance = self._covariances.at(at)
        return None if covariance is None else known_covariance(np.reshape(covariance, (6, 6))[:3, :3])

    def _add_truth(self, truth: Truth, offset: float | None) -> None:
        if offset is None:
            lockstep = float(self._record.get("epoch", "nan")) == 0.0
            offset = (
                0.0
                if lockstep
                else clock_offset(self._odom.time, self._odom.position, truth.time, truth.position)
            )
        self._truth = PoseSeries(truth.time + offset, truth.position, truth.quaternion)

    def _picture(self, at: float) -> LatestPicture | None:
        tags = self._tags.at(at) if _age(self._tags, at) < FRESH else None
        tags_of_picture = _tags_in(tags.data) if tags is not None else ()
        if _age(self._pictures, at) >= FRESH:
            return LatestPicture(None, tags_of_picture, self._size) if tags_of_picture else None
        i = int(np.searchsorted(self._pictures.time, at, side="right")) - 1
        if self._shown is None or self._shown[0] != i:
            self._shown = i, self._developed(i, at, tags_of_picture)
        return self._shown[1]

    def _own(self, name: str, at: float) -> Any:
        """Return the latest picture of an own camera or sonar; None if it is too old or missing."""
        message = self._eyes[name].at(at) if _age(self._eyes[name], at) < FRESH else None
        if message is None:
            return None
        if self._developed_own.get(name, (None,))[0] is not message:
            colour = message.header.frame_id.endswith("_optical")
            self._developed_own[name] = message, picture_of(message.data, colour=colour)
        return self._developed_own[name][1]

    def _developed(self, i: int, at: float, tags: tuple[TagCorners, ...]) -> LatestPicture:
        image = picture_of(self._pictures.values[i].data)
        # A record's tags belong to pictures that may be missing in it; tags of another picture are not used.
        if image is not None and abs(_age(self._tags, at) - _age(self._pictures, at)) > 1e-3:
            tags = self._look.find(image, at)
        return LatestPicture(image, tags, self._size)

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
            status["shafts"] = listed(rpm, "rpm")
        for name, series in self._ranges.items():
            if _age(series, at) < FRESH:
                status[name] = f"{series.at(at).range:.2f} m"
        return status

    def _all_curves(self) -> list[PlotLine]:
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
            curves += [PlotLine(POSITION, label, time - self.begin, distance)]
            curves += [PlotLine(HEADING, label, time - self.begin, turn)]
        return [curve for curve in curves if np.isfinite(curve.value).any()]


def known_covariance(covariance: npt.ArrayLike) -> Array | None:
    """Return a covariance of a position [m²], (3, 3), or None if the variance of an axis is unknown."""
    known = np.asarray(covariance, float)
    variance = np.diag(known)
    return known if (variance > 0.0).all() and (variance < UNKNOWN).all() else None


def _vision(times: Sequence[float], statuses: Sequence[Any]) -> list[tuple[float, str]]:
    """Return the times and names of changes of the vision's mode; coasting between two pictures is not counted."""
    modes = [(t, status.mode) for t, status in zip(times, statuses, strict=True) if status.mode != "coast"]
    return [(t, f"vision: {mode}") for (_, last), (t, mode) in pairwise(modes) if mode != last]


def _age(series: TimeSeries, at: float) -> float:
    i = int(np.searchsorted(series.time, at, side="right")) - 1
    return math.inf if i < 0 else at - float(series.time[i])


def _poses(times: list[float], poses: list[Any]) -> PoseSeries:
    position = [(p.position.x, p.position.y, p.position.z) for p in poses]
    turn = [(p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in poses]
    return PoseSeries(times, np.array(position), np.array(turn))


def _thinned(path: Array) -> Array:
    """Return the positions of the goal without those at which it did not move."""
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
        return ()  # texts of other programs


# Frames of a run that was written by the engine's recorder.


class RunSource:
    """One vehicle in one world of a recorded run."""

    def __init__(self, folder: Path | str, *, world: int | None = None, vehicle: str | None = None) -> None:
        """
        Args:
            folder: Folder of the run.
            world: Index of the world; None is the first recorded one.
            vehicle: Name or file; None uses that of the run.

        Raises:
            SimulatorError: The folder contains no run.
            ViewError: The run does not contain that world.
            VehicleError: The vehicle of the run is not in the catalogue.
        """
        table = read_run(folder)
        worlds = sorted(table["world"].unique().tolist())
        chosen = worlds[0] if world is None else world
        if chosen not in worlds:
            raise ViewError(
                f"{folder}: world {chosen} was not recorded; it has {', '.join(map(str, worlds))}"
            )
        named = table.attrs["vehicles"][0]["name"]
        ours = load_vehicle(vehicle) if vehicle else catalogue_vehicle(named, f"{folder}: {ABOUT}")
        rows = table[(table["world"] == chosen) & (table["vehicle"] == 0)]
        time = rows["t"].to_numpy(float)
        self._poses = PoseSeries(
            time - time[0],
            rows[["x", "y", "z"]].to_numpy(float),
            rows[["qx", "qy", "qz", "qw"]].to_numpy(float),
        )
        names = [f"thrust_{name}" for name in ours.thrusters]
        names += [f"actuator_{name}" for name in ours.actuators]
        missing = sorted(set(names) - set(rows.columns))
        if missing:
            raise ViewError(
                f"{folder}: has no {missing[0]}: it was not recorded of {ours.name}; give --vehicle"
            )
        self._n = len(ours.thrusters)
        self._channels = TimeSeries(time - time[0], rows[names].to_numpy(float))
        speed = np.linalg.norm(rows[["u", "v", "w"]].to_numpy(float), axis=1)
        self._curves = [PlotLine("speed [m/s]", "through the water", time - time[0], speed)]
        self.duration = float(time[-1] - time[0])
        lower, upper = box_of(ours, None, self._poses.position)
        title = f"{Path(folder).name}: {ours.name}, world {chosen}"
        self.stage = ViewStage(vehicle=ours, title=title, lower=lower, upper=upper, walls=False)

    def frame(self, time: float) -> ViewFrame:
        """Return the frame at a time since the start of the run [s]."""
        channels = self._channels.at(time)
        channels = np.zeros(0) if channels is None else channels
        force = channels[: self._n]
        status = {"thrusts": listed(force, "N", 1)} if len(force) else {}
        return ViewFrame(
            time=time,
            truth=self._poses.at(time),
            force=force,
            values=channels[self._n :],
            trail=self._poses.trail(time),
            status=status,
        )

    def curves(self) -> Sequence[PlotLine]:
        """Return its speed."""
        return self._curves

    def close(self) -> None:
        """Do nothing, because nothing is open."""


# The target motion, as poses and lines to draw.

PATH_POINTS = 240
"""Number of points of a trajectory's line."""
STATION, TRAJECTORY = "0.8,0.3,-0.6,45", "ellipse"
"""Default goals."""


def guide_for(goal: str | None, trajectory: str | None, task: str | None, vehicle: Vehicle) -> Guide:
    """Return the goal or the trajectory of a command line, or the default of the task if neither is given.

    Raises:
        GoalError, ControlError: It cannot be read, or the vehicle may not reach it.
    """
    if goal is None and trajectory is None:
        goal, trajectory = (None, TRAJECTORY) if task == "t2" else (STATION, None)
    guide = guide_of(goal, trajectory)
    check_reachable(guide, vehicle)
    return guide


def goal_pose(guide: Guide, t: float) -> BodyPose:
    """Return the goal at a time since the start [s]."""
    reference = guide.at(t)
    return BodyPose(np.asarray(reference.position, float), np.asarray(quat_from_yaw(float(reference.yaw))))


def path_of(guide: Guide) -> npt.NDArray[np.float64]:
    """Return the line of a trajectory, (k, 3) [m]; no points for a constant goal."""
    if not math.isfinite(guide.duration):
        return nowhere()
    return np.asarray(guide.at(np.linspace(0.0, guide.duration, PATH_POINTS)).position)


def start_of(guide: Guide) -> Station:
    """Return the start of a vehicle: that of a trajectory, or for a constant goal the centre, 0.5 m deep."""
    if not math.isfinite(guide.duration):
        return Station((0.0, 0.0, -0.5), 0.0)
    first = guide.at(0.0)
    x, y, z = first.position.tolist()
    return Station((x, y, z), float(first.yaw))


# Tags detected for the viewer, if no other process has reported them.

LONGEST_STEP = 0.5
"""Longest time between two pictures after which only a part is searched [s]; otherwise the complete picture is."""


class TagLook:
    """Detector that is created when first needed; without its library it detects nothing."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._tags = vehicle.tags
        self._tracker: RegionTracker | None = None
        self._last = -np.inf

    def find(self, image: npt.NDArray[np.uint8], time: float) -> tuple[TagCorners, ...]:
        """Return the vehicle's tags in a grey picture of a time [s]."""
        if self._tags is None:
            return ()
        if self._tracker is None or not 0.0 <= time - self._last <= LONGEST_STEP:
            self._tracker = RegionTracker(detector(self._tags.family), set(self._tags.mounts))
        self._last = time
        try:
            detections = self._tracker.detect(image, time)
        except ImportError:  # a view without the extra `vision` shows only the picture
            self._tags = None
            return ()
        return tuple(TagCorners(d.tag, d.corners) for d in detections)
