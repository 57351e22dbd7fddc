"""Plan of a virtual pool before its simulation: plant, cameras and firmware."""

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
    """Plan of a virtual pool, from which its simulation is created."""

    vehicle: Vehicle
    spec: PlantSpec
    camera: CameraPlan | None
    calibrated: Pool | None
    """Calibration of the camera as it is available to a robot."""
    positioning: str = "none"
    """Name of the positioning system."""
    firmware: Literal["mcu", "ardusub"] = "mcu"
    """Firmware of the vehicle."""
    onboard: Any = None
    """The vehicle's own cameras, sonars and altimeters in their world; None if there are none."""

    def eye(self) -> Any:
        """Return all cameras as one, created in this process; None if there are none."""
        cameras = [plan.camera() for plan in (self.camera, self.onboard) if plan is not None]
        return Cameras(*cameras) if len(cameras) > 1 else cameras[0] if cameras else None

    def world(self, camera: Any, *, start: Station, seed: int, truth: Path | None) -> VirtualPool:
        """Return the simulated pool.

        Args:
            camera: Camera of the pool; None for none.
            start: Initial position and yaw of the vehicle, at rest and level.
            seed: Seed of instruments and link.
            truth: Truth file to write.
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
        """Return the simulated pool with its camera in this process, for lock-step; arguments as for `world`."""
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
        plant: Seed, or a plant file, whose severity and seed then also determine the camera.
        severity: Severity of a drawn plant.
        camera: Output of the camera.
        seed: Seed of ripples, noise, jitter and losses.
        site: pool, tank or open-water; only the pool and the tank have an overhead camera. None is the pool, or the
            water of the world.
        firmware: mcu, or ardusub, which gives the vehicle a compass and a Doppler log.
        world: World for the vehicle's own sensors: a site of the catalogue of worlds, or a path; None: no world.

    Raises:
        PlantSpecError: The plant cannot be created, or the severity or camera does not exist.
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
            "open water has no overhead camera: give --camera none, and a positioning if there is one"
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
