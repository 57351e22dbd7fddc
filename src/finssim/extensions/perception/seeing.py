"""Base of tasks with perception of a site, whose pose, appearance and light differ in each episode."""

import math
from dataclasses import dataclass
from typing import ClassVar

from finssim.sim import RectangularPool
from finssim.tasks.measurement import TRAINING, MeasurementNoise
from finssim.tasks.picture import ObservedPicture
from finssim.tasks.task import Task
from finssim.tasks.terms import ObservationPart, measured_depth, own_velocity, world_up

DEPTH_SCALE = 5.0
"""Scale of the depth in the observation [m]."""

OWN = (
    ObservationPart("up, body frame", 3, "1", term=world_up),
    *own_velocity(clip=2.0),
    ObservationPart("depth", 1, "m", scale=DEPTH_SCALE, term=measured_depth),
)
"""Observation from the vehicle's own sensors, independent of its position."""


@dataclass(frozen=True, kw_only=True)
class SeeingTask(Task):
    """Base of tasks with perception, by default in open water with a front camera."""

    needs: ClassVar[tuple[str, ...]] = ("surge", "sway", "heave", "yaw")
    observation: tuple[ObservationPart, ...] = OWN
    pictures: tuple[ObservedPicture, ...] = (ObservedPicture("front_camera", 48),)
    held_out: bool = False
    """True to draw only looks of the site that are held out of training."""
    tilt: float = math.radians(4.0)
    """Largest roll and pitch at the start [rad]."""
    training_noise: MeasurementNoise = TRAINING

    @property
    def placed(self) -> bool:
        """Return whether a world determines the pose of the observed object; without a world it is drawn."""
        return bool(self.world)

    def arena(self) -> RectangularPool | None:
        """Return None for open water: an episode ends before floor and walls are reached."""
        return None
