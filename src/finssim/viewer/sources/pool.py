"""Frames of the virtual pool with a robot in it: both in this process, in lock-step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from finssim.control.guidance import Guide, Station
from finssim.pool.onboard import OnboardSensors
from finssim.pool.plant_spec import PlantSpecError, Severity
from finssim.pool.run import make_plan
from finssim.robot.bridge import Bridge
from finssim.robot.messages import Picture as Seen
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.viewer.frame import Curve, Frame, Picture, Pose, Stage
from finssim.viewer.shapes import shown_of, world_bodies
from finssim.viewer.sources.guides import goal_pose, path_of, start_of
from finssim.viewer.sources.series import Errors
from finssim.viewer.stages import box_of, box_of_world
from finssim.viewer.tags import TagLook
from finssim.worlds import RangeBatch

RATE = 60.0
"""Steps of the robot's loop [Hz]."""
EVENTS = 8
"""That are shown."""


class PoolSource:
    """The virtual pool and the whole software of a robot, which knows of the truth as little as ever."""

    duration = math.inf

    def __init__(
        self,
        guide: Guide,
        *,
        vehicle: str = "finsrov",
        policy: str = "pid",
        task: str | None = None,
        plant: str = "1",
        severity: Severity = "realistic",
        camera: Literal["pictures", "corners"] = "corners",
        seed: int = 0,
        world: str | None = None,
    ) -> None:
        """
        Args:
            guide: Where the vehicle shall go.
            vehicle: Name or file.
            policy: Name of a PID, or a policy's directory.
            task: That the policy must have been trained for.
            plant: Seed or file.
            severity: Of a drawn plant.
            camera: What it sends; pictures cost more.
            seed: Of noises, and of the world.
            world: That the vehicle's own cameras and sonars see; it begins at its viewpoint, located by motion capture.

        Raises:
            PlantSpecError, PolicyError, ControlError, VehicleError: What cannot be made.
        """
        plan = make_plan(vehicle, plant, severity, camera="none" if world else camera, seed=seed, world=world)
        if world is not None:
            plan = replace(plan, positioning="motion-capture")
        elif plan.camera is None or plan.calibrated is None:
            raise PlantSpecError("a robot in the pool needs a camera: give corners or pictures")
        ours, basin, eye = plan.vehicle, plan.spec.basin, plan.eye()
        begin, self._own = start_of(guide), dict[str, Any]()
        if isinstance(eye, OnboardSensors):
            view = eye.batch.world.viewpoint
            begin = Station(tuple(view.position.tolist()), view.yaw)
        self._world = plan.world(eye, start=begin, seed=seed, truth=None)
        pilot = make_pilot(policy, ours, task=task)
        self._runtime = Runtime(ours, plan.calibrated, pilot, guide, arm=True, bridge=Bridge(ours))
        self._guide, self._look = guide, TagLook(ours)
        self._errors, self._sent, self._steps = Errors(), list[bytes](), 0
        self._picture: Picture | None = None
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
        self.stage = Stage(
            vehicle=ours,
            title=f"virtual pool, {plan.spec.title}: {pilot.name}, {guide.name}",
            lower=lower,
            upper=upper,
            site=plan.calibrated,
            path=path_of(guide),
            **around,
        )

    def frame(self, time: float) -> Frame:
        """Let the pool and the robot live until a time [s]."""
        while self._steps < math.floor(time * RATE + 1e-6):
            self._step()
        runtime, plant = self._runtime, self._world.plant
        return Frame(
            time=self._steps / RATE,
            truth=self._truth(),
            estimate=self._estimate(),
            goal=self._goal(),
            force=np.array(plant.thrust, float),
            trail=self._errors.trail,
            picture=self._picture,
            pictures={name: image for name, image in self._own.items() if isinstance(image, np.ndarray)},
            status=self._status(runtime),
            events=[f"{e.time:.1f} s  {e.kind}: {e.text}" for e in list(runtime.counters.events)[-EVENTS:]],
        )

    def curves(self) -> Sequence[Curve]:
        """Errors to the goal and of the estimate."""
        return self._errors.curves()

    def close(self) -> None:
        """Stop the thrusters and empty the pool."""
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
        """Keep what cameras see, with its tags; found here, they need not be sought again by the robot."""
        if picture.source:
            self._own[picture.source] = shown_of(self._world.vehicle, picture)
            return picture
        if picture.image is not None and not picture.tags:
            picture = replace(picture, tags=self._look.find(picture.image, picture.time))
        self._picture = Picture(picture.image, picture.tags, self._size)
        return picture

    def _truth(self) -> Pose:
        plant = self._world.plant
        return Pose(np.array(plant.position, float), np.array(plant.quaternion, float))

    def _estimate(self) -> Pose | None:
        reading = self._runtime.reading
        if reading is None or not np.isfinite(reading.position).all():
            return None
        return Pose(reading.position, reading.quaternion)

    def _goal(self) -> Pose:
        t = self._runtime.t
        return goal_pose(self._guide, 0.0 if math.isnan(t) else t)

    def _status(self, runtime: Runtime) -> dict[str, str]:
        bridge, reading, plant = runtime.bridge, runtime.reading, self._world.plant
        why = bridge.reason or runtime.refusal
        status: dict[str, Any] = {"bridge": bridge.state + (f" ({why})" if why else "")}
        if reading is not None:
            status["vision"] = reading.mode
            status["state"] = "ready" if reading.ready else f"not ready: {reading.reason}"
        status |= {name: text for name, text in self._own.items() if isinstance(text, str)}
        status["to the goal"] = self._errors.to_goal
        status["estimate error"] = self._errors.of_estimate
        status["battery"] = f"{float(plant.electric[0]):.2f} V"
        rpm = np.asarray(plant.shaft_speed) * 60.0 / (2.0 * math.pi)
        status["shafts [rpm]"] = " ".join(f"{r:.0f}" for r in rpm)
        return status
