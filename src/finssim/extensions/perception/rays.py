"""Bundles of rays, one for each reading of a sensor, in the sensor's axes: x along the view, y left, z up.

Each is (rows, columns, 2, 3): the point where a ray enters the water [m], and its unit direction; a zero direction
means no ray.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from finssim.core.frames import FROM_OPTICAL
from finssim.core.optics import Camera, Interface, Layer, Lens, back_project
from finssim.vehicles.device_files import Port, RangeDevice, SonarDevice

Array = NDArray[np.float64]

WATER_INDEX = 1.333
ELEVATION_SPAN = 1.5
"""Ratio of the vertical extent of a sonar's rays to its beam width: the two-way pattern is 17 dB down at the ends."""


def camera_rays(lens: Lens, port: Port | None = None) -> Array:
    """Return the rays of a picture, row 0 at the top, (height, width, 2, 3).

    Args:
        lens: Lens, pinhole with distortion or fisheye, in direct contact with the water or behind a
            concentric dome.
        port: Flat window in front of the lens, at which the rays are refracted (Snell).
    """
    pixels = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1)
    if port is None:
        directions, valid = lens.rays(pixels)
        origins = np.zeros_like(directions)
    else:
        interface = Interface(
            np.array([0.0, 0.0, -1.0]),
            port.distance,
            index_far=WATER_INDEX,
            window=(Layer(port.thickness, port.index),),
        )
        water = back_project(Camera(lens, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])), interface, pixels)
        origins, directions, valid = water.origin, water.direction, water.status == 0
    bundle = np.stack([FROM_OPTICAL.vector(origins), FROM_OPTICAL.vector(directions)], axis=2)
    return np.where(valid[..., None, None], bundle, 0.0)


def fan(device: SonarDevice, beams: int | None = None) -> Array:
    """Return the unit rays of an imaging sonar, (elevations, beams, 2, 3): beam 0 at the left, elevation 0 at the
    bottom.

    Args:
        device: The sonar.
        beams: Number of beams over the sector, instead of the device's own.
    """
    count = beams or device.beams
    azimuth = device.sector * (0.5 - (np.arange(count) + 0.5) / count)
    if device.mode == "side_scan":
        azimuth = np.array([0.5, -0.5]) * math.pi
    elevation = ray_elevations(device)[:, None]
    directions = np.stack(
        np.broadcast_arrays(
            np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        ),
        axis=-1,
    )
    return np.stack([np.zeros_like(directions), directions], axis=2)


def ray_elevations(device: SonarDevice) -> Array:
    """Return the elevations of a beam's rays above the sonar's x-y plane [rad], (elevations,)."""
    return -device.depression + ELEVATION_SPAN * device.vertical_beam_width * (
        (np.arange(device.elevations) + 0.5) / device.elevations - 0.5
    )


def cones(device: RangeDevice) -> tuple[Array, Array]:
    """Return the rays of an altimeter or a DVL, (beams, rays, 2, 3), and the fraction of a beam's echo on
    each, (rays,).

    The rays of a beam cover its solid angle evenly, out to twice its half-power angle, with weights of its
    two-way pattern exp(-2 · 4 ln 2 (angle / width)²). Beam k of several is rotated by 2 pi (k + 1/2) / beams
    about x, from y (left) towards z.
    """
    n = device.rays if device.beam_width > 0.0 else 1
    share = (np.arange(n) + 0.5) / n if n > 1 else np.zeros(1)
    angle = np.arccos(1.0 - share * (1.0 - math.cos(device.beam_width)))
    turn = np.arange(n) * math.pi * (3.0 - math.sqrt(5.0))  # the golden angle: an even spiral
    around = np.stack([np.cos(angle), np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)], axis=-1)
    weight = np.exp(-8.0 * math.log(2.0) * (angle / max(device.beam_width, 1e-9)) ** 2)
    beam = 2.0 * math.pi * (np.arange(device.beams)[:, None] + 0.5) / device.beams
    c, s = math.cos(device.beam_angle), math.sin(device.beam_angle)
    x, out, side = c * around[:, 0] - s * around[:, 1], s * around[:, 0] + c * around[:, 1], around[:, 2]
    directions = np.stack(
        [
            np.broadcast_to(x, (device.beams, n)),
            np.cos(beam) * out - np.sin(beam) * side,
            np.sin(beam) * out + np.cos(beam) * side,
        ],
        axis=-1,
    )
    return np.stack([np.zeros_like(directions), directions], axis=2), weight / weight.sum()
