"""The overhead camera of a virtual pool as it truly hangs, as its calibration has it, and how good its pictures are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics import Camera, Interface, Lens
from finssim.geometry.rotations import quat_from_rotvec, quat_multiply
from finssim.localization.pool import Pool
from finssim.pool.plant_spec import Basin, PlantSpecError, Severity, basin_of
from finssim.vehicles import Vehicle
from finssim.vehicles.equipment import Mount

__all__ = ["CameraSettings", "camera_of", "paper_lens", "true_site"]

Array = npt.NDArray[np.float64]

HEIGHT = 1.4
"""Of the camera above the water, for a pool of 4 m x 2 m [m]. The paper's hung at 1.21 m, from where its lens does not
see the ends of the pool. From here it sees everything that is 0.4 m under the surface, and between the walls' last
0.23 m everything from 0.1 m down."""
SWIM = 0.4
"""Where tags usually are, part of the pool's depth."""
PAPER_POOL = 4.0, 2.0
"""[m]"""
LATENCY = 0.045
"""From the middle of the exposure to the robot's computer, on average [s]: readout, compression, USB."""


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """How the camera takes its pictures, and what is on the vehicle that it looks at."""

    rate: float = 30.0
    """Pictures a second [Hz]."""
    exposure: float = 0.006
    """[s]"""
    latency: float = LATENCY
    """True mean time from the middle of the exposure to arrival [s]."""
    jitter: float = 0.0
    """Standard deviation of the latency from picture to picture [s]."""
    dropout: float = 0.0
    """Chance that a picture is lost."""
    ripples: float = 0.0
    """Root mean square of the water's slope."""
    pixel_noise: float = 0.03
    """Of corners that are made without a picture, per axis [px]; rendered pictures have the noise of their pixels."""
    mounts: Mapping[int, Mount] = field(default_factory=dict)
    """Where tags truly sit, by id; those not named as the vehicle file has them."""


@dataclass(frozen=True)
class _Errors:
    """Standard deviations of what a calibration does not know, and the pictures' faults."""

    position: float = 0.0  # of the camera, per axis [m]
    tilt: float = 0.0  # about each axis [rad]
    focal: float = 0.0  # relative
    water: float = 0.0  # height [m]
    latency: float = 0.0  # [s]
    mount_position: float = 0.0  # per axis [m]
    mount_turn: float = 0.0  # per axis [rad]
    jitter: float = 0.0  # [s]
    dropout: float = 0.0
    ripples: float = 0.0


ERRORS: Mapping[str, _Errors] = {
    "nominal": _Errors(),
    "realistic": _Errors(
        position=0.002,
        tilt=math.radians(0.1),
        focal=0.001,
        water=0.002,
        latency=0.003,
        mount_position=0.001,
        mount_turn=math.radians(0.2),
        jitter=0.002,
        dropout=0.005,
        ripples=0.01,
    ),
    "hard": _Errors(
        position=0.004,
        tilt=math.radians(0.2),
        focal=0.002,
        water=0.004,
        latency=0.006,
        mount_position=0.002,
        mount_turn=math.radians(0.4),
        jitter=0.005,
        dropout=0.02,
        ripples=0.03,
    ),
}
"""Severity -> errors."""


def paper_lens(finer: float = 1.0) -> Lens:
    """The lens of the published pool, 100° across, before 1280 x 720 pixels or `finer` times as many each way."""
    distortion = (0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862)
    f, cx, cy = finer * 540.9305, finer * (682.2341 + 0.5) - 0.5, finer * (348.6136 + 0.5) - 0.5
    return Lens(round(1280 * finer), round(720 * finer), f, f, cx, cy, "plumb_bob", distortion)


def true_site(basin: Basin | None = None, *, finer: float = 1.0) -> Pool:
    """The camera above the middle of a pool. Pool frame: x and y as the world's, z = 0 on the floor.

    Args:
        basin: 4 m x 2 m, 1 m deep if not given; the camera hangs higher over a larger one.
        finer: How many times as many pixels as the paper's it has each way.
    """
    basin = basin or Basin()
    lens, height = paper_lens(finer), _height(basin)
    # So far beside the middle that both ends of the pool are as far from the edges of the picture.
    middle = 0.5 * (lens.width - 1), 0.5 * (lens.height - 1)
    edges = [[0.0, middle[1]], [2.0 * middle[0], middle[1]], [middle[0], 0.0], [middle[0], 2.0 * middle[1]]]
    left, right, top, bottom = lens.rays(edges)[0]
    distance = height + SWIM * basin.depth / Interface.water(0.0).index_far
    x = -0.5 * distance * float(left[0] / left[2] + right[0] / right[2])
    y = 0.5 * distance * float(top[1] / top[2] + bottom[1] / bottom[2])
    camera = Camera(lens, np.array([x, y, basin.depth + height]), np.array([1.0, 0.0, 0.0, 0.0]))
    return Pool(camera, Interface.water(basin.depth), LATENCY)


def _height(basin: Basin) -> float:
    """Of the camera above the water, from where it sees all of a pool [m]."""
    return HEIGHT * max(basin.length / PAPER_POOL[0], basin.width / PAPER_POOL[1])


def camera_of(
    vehicle: Vehicle, seed: int, severity: Severity = "realistic", *, basin: Basin | None = None
) -> tuple[Pool, Pool, CameraSettings]:
    """Draw the camera of a plant.

    Args:
        vehicle: Has tags.
        seed: Of all errors; equal seeds give equal cameras.
        severity: How large they are: nominal has none.
        basin: Of the plant; that of plants drawn around the vehicle if None. Over a larger one the camera has as many
            more pixels as it hangs higher, so that it finds the vehicle's tags there too.

    Returns:
        The pool as it is, the pool as its calibration has it, and the settings for `PoolCamera`.

    Raises:
        PlantSpecError: The vehicle has no tags, or there is no such severity.
    """
    if severity not in ERRORS:
        raise PlantSpecError(f"unknown severity '{severity}'; available: {', '.join(ERRORS)}")
    if vehicle.tags is None:
        raise PlantSpecError(f"vehicle {vehicle.name} has no tags: a camera cannot find it, run without one")
    errors, random = ERRORS[severity], np.random.default_rng([seed, 0x517E])
    own = basin_of(vehicle)
    true = true_site(basin or own, finer=max(_height(basin or own) / _height(own), 1.0))
    late = float(random.normal(0.0, errors.latency))
    settings = CameraSettings(
        latency=max(LATENCY + late, 0.01),
        jitter=errors.jitter,
        dropout=errors.dropout,
        ripples=errors.ripples,
        mounts={tag: _moved(mount, errors, random) for tag, mount in vehicle.tags.mounts.items()},
    )
    return replace(true, latency=settings.latency), _calibrated(true, errors, random, severity), settings


def _calibrated(true: Pool, errors: _Errors, random: np.random.Generator, severity: str) -> Pool:
    """What a survey with these errors finds of a camera."""
    lens, focal = true.camera.lens, 1.0 + errors.focal * random.normal(0.0, 1.0)
    lens = replace(lens, fx=lens.fx * focal, fy=lens.fy * focal)
    turn = quat_from_rotvec(random.normal(0.0, errors.tilt, 3))
    camera = Camera(
        lens,
        true.camera.position + random.normal(0.0, errors.position, 3),
        np.asarray(quat_multiply(turn, true.camera.orientation)),
    )
    height = float(true.interface.height(0.0, 0.0)) + random.normal(0.0, errors.water)
    return Pool(
        camera, Interface.water(height), true.latency, record={"made_by": f"virtual pool, {severity}"}
    )


def _moved(mount: Mount, errors: _Errors, random: np.random.Generator) -> Mount:
    turn = quat_from_rotvec(random.normal(0.0, errors.mount_turn, 3))
    return Mount(
        position=np.asarray(mount.position) + random.normal(0.0, errors.mount_position, 3),
        orientation=np.asarray(quat_multiply(turn, mount.orientation)),
    )
