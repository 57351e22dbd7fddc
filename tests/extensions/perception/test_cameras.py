"""Cameras: image positions of points, and radiance after water, daylight, lamps and pixel noise."""

import math

import numpy as np
import pytest
import warp as wp
from scipy.integrate import quad

from finssim.core.frames import TO_OPTICAL
from finssim.core.optics import Camera, Interface, Layer, project
from finssim.extensions.perception import CameraBatch, Headlight, RangeBatch, SonarBatch, WorldBatch
from finssim.vehicles.device_files import CameraDevice, DeviceMount, Port, load_device

pytestmark = pytest.mark.slow


def camera(**changes):
    values = {"about": "-", "source": "-", "width": 320, "height": 240, "focal_length": 240.0, "rate": 10.0}
    return CameraDevice(**{**values, "exposure": 1.0, **changes})


@pytest.mark.parametrize(
    "device",
    [
        camera(),
        camera(distortion=(-0.2, 0.05, 0.001, -0.002)),
        camera(model="fisheye", focal_length=150.0, distortion=(0.05, -0.01, 0.0, 0.0)),
        camera(port=Port(distance=0.02, thickness=0.006), focal_length=200.0),
    ],
    ids=["pinhole", "distorted", "fisheye", "flat port"],
)
def test_balls_appear_where_their_middles_project(device, scenes, level):
    """Balls appear within 0.3 px of the lens's projection; behind a flat port, of the refracting one of
    `geometry`."""
    batch = scenes("targets")
    sensor = CameraBatch(batch, device)
    sensor.update(level(0, 0, -5))
    index = sensor.shape_index.numpy()[0]
    centres = batch.model.shape_transform.numpy()[:, :3] - [0, 0, -5]
    optical = TO_OPTICAL.vector(centres)
    if device.port is None:
        expected, visible = sensor.lens.project(optical)
    else:
        interface = Interface(np.array([0.0, 0.0, -1.0]), 0.02, index_far=1.333, window=(Layer(0.006, 1.49),))
        seen = project(Camera(sensor.lens, np.zeros(3), np.array([0.0, 0, 0, 1])), interface, optical)
        expected, visible = seen.pixels, seen.status == 0
    compared = 0
    for k in np.flatnonzero(visible):
        v, u = np.nonzero(index == k)
        if len(u) and 0 < u.min() and u.max() < 319 and 0 < v.min() and v.max() < 239:
            assert np.hypot(u.mean() - expected[k, 0], v.mean() - expected[k, 1]) < 0.3
            compared += 1
    assert compared >= 5


def looking_at(scenes, level, position, **options):
    sensor = CameraBatch(
        scenes("wall"), camera(width=40, height=30, focal_length=20.0), linear=True, **options
    )
    sensor.update(level(*position))
    return sensor, sensor.radiance.numpy()[0].astype(float)


def test_radiance_is_the_integral_of_what_the_water_adds_and_takes(scenes, level):
    """Pixels that look up, down and sideways show the wall and the veil before it, integrated along the ray.

    L = rho E e^(-K h_p) e^(-c s) + integral of c B e^(-K h(t)) e^(-c t) dt, with the wall upright: E = 1/2 + B/2.
    """
    sensor, radiance = looking_at(scenes, level, (5, 0, -5))
    rays = sensor.rays.numpy()[:, :, 0, 1].astype(float)
    c, B, K, rho = (
        np.array(x) for x in ((0.5, 0.2, 0.3), (0.1, 0.3, 0.2), (0.4, 0.1, 0.15), (0.6, 0.5, 0.4))
    )
    for i, j in ((15, 20), (0, 0), (29, 39), (9, 30), (25, 2)):
        ray = rays[i, j]
        s = 3.0 / ray[0]
        if -5.0 + s * ray[2] > 0.0:
            continue  # the ray meets the surface first
        for k in range(3):

            def veil(t, k=k, u=ray[2]):
                return c[k] * B[k] * math.exp(-K[k] * (5.0 - t * u) - c[k] * t)

            start = rho[k] * (0.5 + 0.5 * B[k]) * math.exp(-K[k] * (5.0 - s * ray[2]) - c[k] * s)
            assert radiance[i, j, k] == pytest.approx(start + quad(veil, 0.0, s)[0], rel=2e-5)


def test_snells_window_is_as_wide_as_total_reflection_begins(scenes, poses):
    """A camera that looks up sees the sky within asin(1/1.333) = 48.6° of the vertical, and the water outside."""
    device = camera(width=80, height=80, focal_length=30.0, mount=DeviceMount(pitch=-math.pi / 2))
    sensor = CameraBatch(scenes("wall"), device, linear=True)
    sensor.update(poses(((-20, 0, -0.01), (0, 0, 0, 1))))
    radiance, rays = sensor.radiance.numpy()[0], sensor.rays.numpy()[:, :, 0, 1]
    angle = np.degrees(np.arccos(rays[..., 0]))
    assert np.all(radiance[angle < 47.5][:, 2] > 0.5)
    np.testing.assert_allclose(
        radiance[angle > 49.5], np.broadcast_to([0.1, 0.3, 0.2], (np.sum(angle > 49.5), 3)), rtol=0.06
    )


def test_a_lamp_falls_off_as_the_square_and_by_both_ways(scenes, level):
    """A lamp at the camera adds rho I e^(-2 c s)/s² to a wall seen head-on at 2 and 4 m, and a veil.

    The veil is the integral of c B I e^(-2 c t)/t², from the least distance of 0.15 m.
    """
    light = (Headlight(position=(0.0, 0.0, 0.0), intensity=0.8, half_angle=1.0),)
    for distance in (2.0, 4.0):
        _, with_lamp = looking_at(scenes, level, (8.0 - distance, 0, -5), lamps=light)
        _, without = looking_at(scenes, level, (8.0 - distance, 0, -5))
        for k, (c, B, rho) in enumerate(((0.5, 0.1, 0.6), (0.2, 0.3, 0.5), (0.3, 0.2, 0.4))):
            surface = rho * 0.8 * math.exp(-2 * c * distance) / distance**2
            veil = quad(lambda t: c * B * 0.8 * math.exp(-2 * c * t) / t**2, 0.15, distance)[0]  # noqa: B023
            added = with_lamp[14:16, 19:21, k].mean() - without[14:16, 19:21, k].mean()
            assert added == pytest.approx(surface + veil, rel=0.06)  # eight steps of the midpoint rule


def test_noise_is_that_of_photons_and_reading(scenes, poses):
    """Over water of even radiance, the variance is charge + read² in digital numbers, plus 1/12 for
    quantisation."""
    device = camera(exposure=2.0, gamma=1.0, full_well=800.0, read_noise=6.0, width=200, height=200)
    sensor = CameraBatch(scenes("floor"), device)
    sensor.batch.optics.veil.fill_(wp.vec3(0.1, 0.2, 0.3))
    try:
        sensor.batch.optics.attenuation.fill_(5.0)
        picture = sensor.update(poses(((0, 0, -5), (0, 0, 0, 1))), seed=1).numpy()[0, :90].astype(float)
    finally:
        sensor.batch.optics.veil.fill_(wp.vec3(*sensor.batch.world.water.veil))
        sensor.batch.optics.attenuation.fill_(0.0)
    for k, veil in enumerate((0.1, 0.2, 0.3)):
        charge = 2.0 * veil * 800.0
        assert picture[..., k].mean() == pytest.approx(255.0 * 2.0 * veil, abs=0.3)
        expected = 255.0 / 800.0 * math.sqrt(charge + 36.0)
        assert picture[..., k].std() == pytest.approx(math.hypot(expected, math.sqrt(1 / 12)), rel=0.03)


def test_equal_seeds_give_equal_pictures(dock, poses):
    """Equal seeds give bit-identical pictures, for one world as for three; another seed or time gives another
    one."""
    place = ((0.2, -0.7, -3.3), (0, 0, 0, 1))
    device = camera(width=64, height=48, focal_length=40.0)
    sensor = CameraBatch(dock, device)
    first = sensor.update(poses(place, place, place), seed=4).numpy().copy()
    second = sensor.update(poses(place, place, place), seed=4).numpy().copy()
    np.testing.assert_array_equal(first, second)
    for other in ({"seed": 5}, {"seed": 4, "time": 0.1}):
        assert not np.array_equal(first, sensor.update(poses(place, place, place), **other).numpy())
    assert not np.array_equal(first[0], first[1])  # the docks differ, as each was drawn separately
    alone = WorldBatch("dock")
    alone.draw(1)
    np.testing.assert_array_equal(
        CameraBatch(alone, device).update(poses(place), seed=4).numpy()[0], first[0]
    )


def test_vehicles_outside_the_mask_keep_their_pictures(dock, poses):
    """When only the second of three vehicles is measured, the readings of the others stay bit-identical."""
    far, near = ((0.2, -0.7, -3.3), (0, 0, 0, 1)), ((0.9, -0.3, -3.0), (0, 0, 0, 1))
    mask = wp.array([0, 1, 0], dtype=int)
    for sensor in (
        CameraBatch(dock, camera(width=32, height=24, focal_length=20.0, exposure="auto")),
        SonarBatch(dock, load_device("gemini_720is"), beams=16, bins=32),
        RangeBatch(dock, load_device("ping")),
    ):
        first = sensor.update(poses(far, far, far), seed=1).numpy().copy()
        second = sensor.update(poses(near, near, near), seed=2, mask=mask).numpy().copy()
        changed = [not np.array_equal(a, b) for a, b in zip(first, second, strict=True)]
        assert changed == [False, True, False]
        everyone = sensor.update(poses(near, near, near), seed=2).numpy()
        if not isinstance(sensor, CameraBatch):  # its exposure has changed since
            np.testing.assert_array_equal(everyone[1], second[1])


def test_exposure_settles_on_its_aim(dock, poses):
    """Within a dozen pictures the mean reaches the target of automatic exposure."""
    place = ((0.2, -0.7, -3.3), (0, 0, 0, 1))
    sensor = CameraBatch(
        dock, camera(width=64, height=48, focal_length=40.0, exposure="auto", white_balance=0.5)
    )
    for _ in range(12):
        picture = sensor.update(poses(place, place, place))
    np.testing.assert_allclose(picture.numpy().mean(axis=(1, 2, 3)) / 255.0, 0.42, atol=0.04)


def test_another_number_of_vehicles_is_refused(dock, level):
    """One pose for three worlds is refused."""
    with pytest.raises(ValueError, match="1 poses for 3 vehicles"):
        CameraBatch(dock, camera(width=32, height=24, focal_length=20.0)).update(level(0, 0, -1))
