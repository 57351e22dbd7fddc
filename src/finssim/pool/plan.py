"""A virtual pool before it lives: plant, cameras and firmware."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from finssim.control.guidance import Station
from finssim.core.rotations import quat_from_yaw
from finssim.localization.overhead_camera import Pool
from finssim.pool.camera import camera_of
from finssim.pool.drawn_plant import draw_plant, positioning_of, site_of, site_of_world
from finssim.pool.pictures import CameraPlan, Cameras
from finssim.pool.plant_spec import PlantSpec, PlantSpecError, Severity, load_plant_spec
from finssim.pool.virtual_pool import VirtualPool
from finssim.sim.site import described_world
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import vehicle_at


@dataclass(frozen=True, kw_only=True)
class PoolPlan:
    """A virtual pool before it lives."""

    vehicle: Vehicle
    spec: PlantSpec
    camera: CameraPlan | None
    calibrated: Pool | None
    """Calibration of the camera that a robot may know."""
    positioning: str = "none"
    """Name of the positioning system."""
    firmware: Literal["mcu", "ardusub"] = "mcu"
    """Firmware of the vehicle."""
    onboard: Any = None
    """The vehicle's own cameras, sonars and altimeters, in the world that they see; None: there is none."""

    def eye(self) -> Any:
        """All cameras as one, made here; None where there are none."""
        cameras = [plan.camera() for plan in (self.camera, self.onboard) if plan is not None]
        return Cameras(*cameras) if len(cameras) > 1 else cameras[0] if cameras else None

    def world(self, camera: Any, *, start: Station, seed: int, truth: Path | None) -> VirtualPool:
        """The living pool.

        Args:
            camera: Of the pool; None for none.
            start: Where the vehicle begins, at rest and level.
            seed: Of instruments and wire.
            truth: File that is written.
        """
        pose = np.asarray(start.position), quat_from_yaw(start.yaw)
        return VirtualPool(
            self.vehicle,
            self.spec,
            camera=camera,
            positioning=positioning_of(self.positioning, seed),
            start=pose,
            seed=seed,
            truth=truth,
            firmware=self.firmware,
            world=None if self.onboard is None else self.onboard.layout(),
        )

    def standing(self, start: Station, *, seed: int, truth: Path | None = None) -> VirtualPool:
        """The living pool with its own camera, for lock-step; arguments as of `world`."""
        return self.world(self.eye(), start=start, seed=seed, truth=truth)


def make_plan(
    vehicle: str | Vehicle,
    plant: str,
    severity: Severity,
    *,
    camera: Literal["pictures", "corners", "none"] = "pictures",
    seed: int = 0,
    site: str | None = None,
    firmware: Literal["mcu", "ardusub"] = "mcu",
    world: str | None = None,
) -> PoolPlan:
    """Draw a plant and its camera, or read the plant from its file.

    Args:
        vehicle: A vehicle, its name or file.
        plant: Seed, or a plant file, whose own severity and seed then also make the camera.
        severity: Of a drawn plant.
        camera: What it sends.
        seed: Of ripples, noise, jitter and losses.
        site: pool, tank or open-water; a camera hangs over the pool and the tank alone. If None the pool, or the
            water of the world.
        firmware: mcu, or ardusub, with which the vehicle has a compass and a Doppler log.
        world: What the vehicle's own sensors see: a site of the catalogue of worlds, or a path; None: nothing.

    Raises:
        PlantSpecError: The plant cannot be made, or there is no such severity or camera.
    """
    ours = load_vehicle(vehicle)
    spec = draw_plant(ours, int(plant), severity) if plant.isdecimal() else load_plant_spec(plant)
    seen = None if world is None else described_world(world)
    world_is_site = seen is not None and site is None
    spec = site_of_world(seen, spec) if world_is_site else site_of(site or "pool", spec)
    site = site or ("pool" if world is None else "open-water")
    ours = vehicle_at(site, ours, navigation=firmware == "ardusub")
    if site == "open-water" and camera != "none":
        raise PlantSpecError(
            "no camera hangs over open water: give --camera none, and a positioning if there is one"
        )
    if firmware not in ("mcu", "ardusub"):
        raise PlantSpecError(f"unknown firmware '{firmware}'; available: mcu, ardusub")
    if camera not in ("pictures", "corners", "none"):
        raise PlantSpecError(f"unknown camera '{camera}'; available: pictures, corners, none")
    onboard = None if seen is None else seen.onboard(ours, seed, solid=world_is_site)
    plan = PoolPlan(vehicle=ours, spec=spec, camera=None, calibrated=None, firmware=firmware, onboard=onboard)
    if camera == "none":
        return plan
    hung, calibrated, settings = camera_of(ours, spec.seed, spec.severity, basin=spec.basin)
    eye = CameraPlan(vehicle=ours, site=hung, settings=settings, basin=spec.basin, mode=camera, seed=seed)
    return replace(plan, camera=eye, calibrated=calibrated)
