"""Measurements of a world by the vehicle's own cameras, sonars and altimeters, with delays and losses."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from finssim.extensions.perception import RangeBatch, WorldBatch, WorldLayout, sensor_of
from finssim.extensions.perception.description import World
from finssim.pool.positioning import Exposure, Mail, PoseAt, Shutter
from finssim.robot.messages import Picture
from finssim.vehicles import Vehicle

SETTLING = 3
"""Pictures of automatic exposure before time begins."""


class Shutters:
    """When each sensor of a vehicle measures, and when its reading arrives."""

    def __init__(self, vehicle: Vehicle, names: Sequence[str], seed: int) -> None:
        """
        Args:
            vehicle: Its `perception` has the sensors.
            names: Of its sensors.
            seed: Of losses.
        """
        self._shutters = {}
        for name in names:
            entry = vehicle.perception[name]
            self._shutters[name] = Shutter(
                rate=entry.rate, exposure=0.0, latency=entry.latency, jitter=0.0, dropout=entry.dropout,
                seed=(seed + zlib.crc32(name.encode())) % 2**32,
            )  # fmt: skip

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Exposure]:
        """Return exposures as one `Shutter` does, by time; each with the sensor's name."""
        exposures = [
            replace(exposure, source=name)
            for name, shutter in self._shutters.items()
            for exposure in shutter.advance(t0, t1, pose_at)
        ]
        return sorted(exposures, key=lambda exposure: exposure.middle)


class OnboardSensors:
    """The sensors of a vehicle's `perception` in one world; to a `VirtualPool` they are a camera.

    Attributes:
        batch: The world.
        sensors: By name.
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
            vehicle: Carries the sensors.
            world: A site of the catalogue or a path, which is drawn from the seed; or one world as it is.
            names: Of the sensors to compute; all that the vehicle has if None.
            seed: Of the draw, of noise and losses.

        Raises:
            WorldError: There is no such world, sensor or device.
        """
        if not isinstance(world, WorldBatch):
            world = WorldBatch(world)
            world.draw(seed)
        self.batch, self._seed = world, seed
        names = list(vehicle.perception) if names is None else names
        self.sensors = {name: sensor_of(world, vehicle, name) for name in names}
        self._shutters, self._mail = Shutters(vehicle, names, seed), Mail()
        # Kernels are compiled before time begins, and automatic exposure begins with a picture of the site.
        here = world.world.viewpoint.pose
        for name in [*names] * SETTLING:
            self.develop(Exposure(0, 0.0, 0.0, (here[:3], here[3:]), (here[:3], here[3:]), name))

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Picture]:
        """Readings that arrive in (t0, t1], by time of arrival.

        Args:
            t0: Where the last call ended [s].
            t1: Now [s].
            pose_at: Time in [t0, t1] -> position [m] and orientation (xyzw) of the body, world frame.
        """
        self._mail.post(self._shutters.advance(t0, t1, pose_at))
        return [self.develop(exposure) for exposure in self._mail.arrived(t1)]

    def develop(self, exposure: Exposure) -> Picture:
        """The reading of the sensor that an exposure names."""
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
