"""Measurements of a world by the vehicle's own cameras, sonars and altimeters, with delays and losses."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from finssim.extensions.perception import RangeBatch, WorldBatch, WorldLayout, sensor_of
from finssim.extensions.perception.description import World
from finssim.pool.positioning import ArrivalQueue, Exposure, PoseAt, Shutter
from finssim.robot.messages import Picture
from finssim.vehicles import Vehicle

SETTLING = 3
"""Number of pictures of automatic exposure before the start."""


class Shutters:
    """Measurement and arrival times of each sensor of a vehicle."""

    def __init__(self, vehicle: Vehicle, names: Sequence[str], seed: int) -> None:
        """
        Args:
            vehicle: Vehicle whose `perception` describes the sensors.
            names: Names of the sensors.
            seed: Seed of the losses.
        """
        self._shutters = {}
        for name in names:
            entry = vehicle.perception[name]
            self._shutters[name] = Shutter(
                rate=entry.rate, exposure=0.0, latency=entry.latency, jitter=0.0, dropout=entry.dropout,
                seed=(seed + zlib.crc32(name.encode())) % 2**32,
            )  # fmt: skip

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Exposure]:
        """Return the exposures of all sensors, as of `Shutter`, ordered by time; each with the sensor's name
        as source."""
        exposures = [
            replace(exposure, source=name)
            for name, shutter in self._shutters.items()
            for exposure in shutter.advance(t0, t1, pose_at)
        ]
        return sorted(exposures, key=lambda exposure: exposure.middle)


class OnboardSensors:
    """Sensors of a vehicle's `perception` in one world; a `VirtualPool` uses them as a camera.

    Attributes:
        batch: The world.
        sensors: Sensors by name.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        world: WorldBatch | World | str,
        *,
        names: Sequence[str] | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            vehicle: Vehicle that carries the sensors.
            world: Name of a site in the catalogue or a path, drawn from the seed; or one world as it is.
            names: Names of the sensors to compute; all of the vehicle if None.
            seed: Seed of the draw, noise and losses.

        Raises:
            WorldError: There is no such world, sensor or device.
        """
        if not isinstance(world, WorldBatch):
            world = WorldBatch(world)
            world.draw(seed)
        self.batch, self._seed = world, seed
        names = list(vehicle.perception) if names is None else names
        self.sensors = {name: sensor_of(world, vehicle, name) for name in names}
        self._shutters, self._arrivals = Shutters(vehicle, names, seed), ArrivalQueue()
        # Kernels are compiled before the start, and automatic exposure begins with pictures of the site.
        here = world.world.viewpoint.pose
        for name in [*names] * SETTLING:
            self.develop(Exposure(0, 0.0, 0.0, (here[:3], here[3:]), (here[:3], here[3:]), name))

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Picture]:
        """Return the readings that arrive in (t0, t1], by time of arrival.

        Args:
            t0: End of the last call [s].
            t1: Present time [s].
            pose_at: Function of a time in [t0, t1] that returns position [m] and orientation (xyzw) of the
                body, world frame.
        """
        self._arrivals.post(self._shutters.advance(t0, t1, pose_at))
        return [self.develop(exposure) for exposure in self._arrivals.arrived(t1)]

    def develop(self, exposure: Exposure) -> Picture:
        """Return the reading of the sensor that an exposure names."""
        sensor = self.sensors[exposure.source]
        pose = wp.array([np.concatenate(exposure.start)], dtype=wp.transform, device=self.batch.device)
        seed = (self._seed + zlib.crc32(exposure.source.encode())) % 2**31
        developed = sensor.update(pose, seed=seed, time=exposure.middle).numpy()[0].copy()
        picture = Picture(exposure.arrival, exposure.sequence, source=exposure.source)
        return replace(picture, **{"ranges" if isinstance(sensor, RangeBatch) else "image": developed})


@dataclass(frozen=True, kw_only=True)
class OnboardPlan:
    """Arguments of `OnboardSensors`, so that another process can make them."""

    vehicle: Vehicle
    world: World
    """Around the vehicle."""
    seed: int
    solid: bool = True
    """True if the hull collides with the world's bodies: not if the water is that of another site."""

    @property
    def name(self) -> str:
        """Name of the world."""
        return self.world.name

    def layout(self) -> WorldLayout | None:
        """Return the bodies that the hull collides with, drawn as the sensors see them."""
        if not self.solid:
            return None
        layout = self.world.layout()
        layout.draw(self.seed)
        return layout

    def camera(self) -> OnboardSensors:
        """Make them."""
        return OnboardSensors(self.vehicle, self.world, seed=self.seed)

    def shutter(self) -> Shutters:
        """When they measure."""
        return Shutters(self.vehicle, list(self.vehicle.perception), self.seed)
