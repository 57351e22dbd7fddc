"""The overhead camera of the virtual pool: pictures through rippling water, or the tag corners found in them."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_multiply
from finssim.localization.pool import Pool
from finssim.pool.camera_corners import CornerCamera
from finssim.pool.camera_pictures import PictureCamera
from finssim.pool.exposures import Exposure, Mail, PoseAt, Shutter
from finssim.pool.plant_spec import Basin, PlantSpecError, basin_of
from finssim.pool.site import CameraSettings
from finssim.robot.messages import Picture
from finssim.sensors.overhead_camera import Ripples
from finssim.vehicles import Vehicle

__all__ = ["PoolCamera"]

Array = npt.NDArray[np.float64]


class PoolCamera:
    """Takes pictures of a vehicle at a fixed rate and delivers them late, as a camera does."""

    def __init__(
        self,
        vehicle: Vehicle,
        site: Pool,
        *,
        mode: Literal["pictures", "corners"] = "pictures",
        settings: CameraSettings | None = None,
        basin: Basin | None = None,
        seed: int = 0,
        noise_seed: int | None = None,
    ) -> None:
        """
        Args:
            vehicle: Carries tags.
            site: The camera and the water as they are, from `camera_of`.
            mode: pictures are rendered; corners are computed by the same optics without a picture, with what the
                detector would make of ripples, pixel noise and tags that it would not find.
            settings: How it takes pictures, from `camera_of`.
            basin: What the pictures show around the vehicle; that of plants drawn around it if None.
            seed: Of ripples, noise, jitter and losses.
            noise_seed: Of the noise alone, for another vehicle in the same corners; `seed` if None.

        Raises:
            PlantSpecError: The vehicle has no tags, or there is no such mode.
        """
        s = settings or CameraSettings(latency=site.latency)
        if vehicle.tags is None:
            raise PlantSpecError(
                f"vehicle {vehicle.name} has no tags: a camera cannot find it, run without one"
            )
        if mode not in ("pictures", "corners"):
            raise PlantSpecError(f"unknown camera mode '{mode}'; available: pictures, corners")
        tags = vehicle.tags.model_copy(update={"mounts": {**vehicle.tags.mounts, **s.mounts}})
        ripples = Ripples(rms_slope=s.ripples, seed=seed) if s.ripples else None
        self._view: CornerCamera | PictureCamera
        if mode == "corners":
            self._view = CornerCamera(tags, site, ripples, pixel_noise=s.pixel_noise, seed=noise_seed or seed)
        else:
            self._view = PictureCamera(
                tags,
                site,
                ripples,
                basin=basin or basin_of(vehicle),
                exposure=s.exposure,
                seed=seed,
            )
        self._shutter = Shutter(
            rate=s.rate, exposure=s.exposure, latency=s.latency, jitter=s.jitter, dropout=s.dropout, seed=seed
        )
        self._mail = Mail()
        self._R_pw, self._t_pw = site.T_pw[:3, :3], site.T_pw[:3, 3]
        self._q_pw = np.asarray(site.world_orientation)

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Picture]:
        """Pictures that arrive in (t0, t1], oldest first.

        Args:
            t0: Where the last call ended [s].
            t1: Now [s].
            pose_at: Time in [t0, t1] -> position [m] and orientation (xyzw) of the body, world frame.
        """
        return [self.develop(exposure) for exposure in self.exposures(t0, t1, pose_at)]

    def exposures(self, t0: float, t1: float, pose_at: PoseAt) -> list[Exposure]:
        """As `advance`, before they are developed: for a process that draws them while another one goes on."""
        self._mail.post(self._shutter.advance(t0, t1, pose_at))
        return self._mail.arrived(t1)

    def develop(self, exposure: Exposure) -> Picture:
        """What the robot gets of an exposure."""
        start, end = (
            (self._R_pw @ position + self._t_pw, quat_multiply(self._q_pw, quaternion))
            for position, quaternion in (exposure.start, exposure.end)
        )
        picture = self._view.picture(start, end, exposure.middle, exposure.sequence)
        return replace(picture, time=exposure.arrival)
