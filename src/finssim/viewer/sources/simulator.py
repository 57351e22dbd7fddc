"""Frames of the simulator with a controller that knows the state exactly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from finssim.control.guidance import Guide
from finssim.engine import Pool as Walls
from finssim.engine import Simulator, Water
from finssim.geometry.rotations import quat_from_yaw
from finssim.robot.pilots import make_pilot
from finssim.robot.reading import Reading
from finssim.vehicles import Vehicle
from finssim.viewer.frame import Curve, Frame, Pose, Stage
from finssim.viewer.sources.guides import goal_pose, path_of, start_of
from finssim.viewer.sources.series import Errors
from finssim.viewer.stages import box_of

STEP = 0.02
"""Between frames at most [s]; the physics step is half of it."""


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
            vehicle: Any one.
            guide: Where it shall go.
            policy: Name of a PID, or a policy's directory.
            task: That the policy must have been trained for.
            hydrodynamics: Model: calibrated, mesh or simplified.
            seed: Of the engine.

        Raises:
            PolicyError, ControlError, SimulatorError: What does not fit.
        """
        self._pilot, self._guide = make_pilot(policy, vehicle, task=task), guide
        way = path_of(guide) if math.isfinite(guide.duration) else guide.at(np.zeros(1)).position
        start = start_of(guide)
        if not math.isfinite(guide.duration):  # wholly under water, however large the vehicle is
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
        self.stage = Stage(vehicle=vehicle, title=title, lower=lower, upper=upper, path=path_of(guide))
        self._pilot.reset()

    def frame(self, time: float) -> Frame:
        """Simulate up to a time [s]."""
        while self._steps < math.floor(time / STEP + 1e-6):
            self._step()
        now, pose = self._steps * STEP, self._pose()
        goal = goal_pose(self._guide, now)
        return Frame(
            time=now,
            truth=pose,
            goal=goal,
            force=self._thrust(),
            trail=self._errors.trail,
            status={
                "controller": self._pilot.name,
                "to the goal": self._errors.to_goal,
                "progress": f"{100.0 * float(self._guide.at(now).progress):.0f} %",
                "thrust [N]": " ".join(f"{f:.1f}" for f in self._thrust()),
            },
        )

    def curves(self) -> Sequence[Curve]:
        """Errors to the goal."""
        return self._errors.curves()

    def close(self) -> None:
        """Nothing is open."""

    def _step(self) -> None:
        now, s = self._steps * STEP, self._simulator
        if now >= self._decided + self._pilot.period - 1e-6:
            pose = self._pose()
            nu = s.numpy("velocity")[0, 0].astype(float)
            reading = Reading(now, pose.position, pose.quaternion, nu, ready=True)
            s.set_thrust(self._pilot.act(reading, self._guide, now))
            self._decided = now
        s.step()
        self._steps += 1
        self._errors.add(self._steps * STEP, self._pose(), None, goal_pose(self._guide, self._steps * STEP))

    def _pose(self) -> Pose:
        s = self._simulator
        return Pose(s.numpy("position")[0, 0].astype(float), s.numpy("quaternion")[0, 0].astype(float))

    def _thrust(self) -> np.ndarray:
        return np.asarray(self._simulator.numpy("thrust")[0, 0, : self._n], float)


def _basin(way: np.ndarray, length: float) -> tuple[float, float, float]:
    """A pool in which a motion of a vehicle of some length has room: the paper's, or a larger one [m]."""
    half, depth = np.abs(way).max(axis=0) + 1.5 * length, length - float(way[:, 2].min())
    return max(4.0, 2.0 * float(half[0])), max(2.0, 2.0 * float(half[1])), max(1.0, depth)
