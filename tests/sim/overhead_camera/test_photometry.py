"""Light is lost, mirrored and counted as the textbooks say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from finssim.core.optics import Camera, Interface, Layer
from finssim.sim.overhead_camera import ImageSensor, OverheadCamera, TiledBasin, WaterOptics
from finssim.sim.overhead_camera.photometry import fresnel, noise_key

AIR = 1.0003


def overhead(pool, **changes):
    """A scene seen straight from above: the pixel in the middle looks along the normal."""
    scene = pool(**changes)
    straight = np.array([1.0, 0.0, 0.0, 0.0])
    return replace(scene, camera=Camera(scene.camera.lens, np.array([0.0, 0.0, 1.9]), straight))


def middle(scene):
    """Radiance of the pixel that looks straight down; the lens has its axis between pixels there."""
    return OverheadCamera(scene).radiance()[118, 161].astype(float)


def test_light_decays_exponentially_along_its_way(pool):
    """On a uniform floor, L = T (L0 exp(-c s) + B (1 - exp(-c s))) with s the slanted way through the water."""
    c, veil, floor = np.array([0.4, 0.1, 0.05]), np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.6, 0.7])
    basin = TiledBasin(lower=(-9, -9, 0), upper=(9, 9, 3), tile=0.0, colour=tuple(floor))
    water = WaterOptics(attenuation=tuple(c), veil=tuple(veil))
    flat = Interface.water(1.0, n_air=1.0, n_water=1.0)  # no bending, no Fresnel: the way alone counts
    scene = pool(basin=basin, water=water, interface=flat)
    image = OverheadCamera(scene).radiance()
    pixels = np.array([[30.0, 20.0], [160.0, 118.0], [300.0, 200.0]])
    rays = scene.camera.lens.rays(pixels)[0] @ scene.camera.R_pc.T
    way = -1.0 / rays[:, 2:]  # through 1 m of depth
    kept = np.exp(-c * way)
    found = image[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    np.testing.assert_allclose(found, floor * kept + veil * (1 - kept), rtol=2e-5)


def test_a_surface_mirrors_what_fresnel_says(pool):
    """At normal incidence a black pool shows ((n1 - n2) / (n1 + n2))² of the sky."""
    black = TiledBasin(lower=(-9, -9, 0), upper=(9, 9, 3), tile=0.0, colour=(0, 0, 0))
    for n in (1.1, 1.333, 1.5):
        scene = overhead(pool, basin=black, interface=Interface.water(1.0, n_air=AIR, n_water=n), sky=1.0)
        assert middle(scene) == pytest.approx(((AIR - n) / (AIR + n)) ** 2, rel=1e-3)


def test_each_face_of_a_window_takes_its_share(pool):
    """What passes a window is the product of what each face passes."""
    glass = Interface.through([0, 0, 1], [0, 0, 1], window=(Layer(0.01, 1.52),))
    scene = overhead(pool, interface=glass)
    passed = (1 - ((AIR - 1.52) / (AIR + 1.52)) ** 2) * (1 - ((1.52 - 1.333) / (1.52 + 1.333)) ** 2)
    np.testing.assert_allclose(middle(scene), np.multiply(passed, scene.basin.colour), rtol=1e-4)


@wp.kernel
def reflectances(cosines: wp.array2d(dtype=float), found: wp.array(dtype=float)):
    i = wp.tid()
    found[i] = fresnel(cosines[i, 0], cosines[i, 1], 1.0, 1.333)


def test_fresnel_at_its_landmarks():
    """Brewster's angle leaves only s-polarised light, grazing light is mirrored, and all R lie in [0, 1]."""
    angle = np.array([0.0, math.atan(1.333), math.pi / 2])
    cosines = np.stack([np.cos(angle), np.sqrt(1 - (np.sin(angle) / 1.333) ** 2)], axis=-1)
    found = wp.zeros(3, dtype=float, device="cpu")
    wp.launch(reflectances, dim=3, inputs=[wp.array(cosines, dtype=float, device="cpu"), found], device="cpu")
    n2 = 1.333**2
    expected = [(0.333 / 2.333) ** 2, 0.5 * ((1 - n2) / (1 + n2)) ** 2, 1.0]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("gain", [0.05, 0.3, 0.9])
def test_noise_follows_the_photon_transfer_line(pool, gain):
    """The variance of the charge is its mean plus the square of the read noise, and 1/12 of a count squared."""
    sensor = ImageSensor(gain=gain, full_well=2000.0, read_noise=12.0, colour=True)
    white = TiledBasin(lower=(-9, -9, 0), upper=(9, 9, 3), tile=0.0, colour=(0.5, 0.5, 0.5))
    equal = Interface.water(1.0, n_air=1.0, n_water=1.0)
    image = OverheadCamera(pool(sensor=sensor, basin=white, interface=equal)).render(seed=3)
    mean = gain * 0.5 * 2000.0
    count = 2000.0 / 255.0
    charge = image.astype(float) * count
    assert charge.mean() == pytest.approx(mean, rel=0.01)
    assert charge.var() == pytest.approx(mean + 12.0**2 + count**2 / 12.0, rel=0.02)
    flat = (charge - charge.mean()).reshape(-1, 3)
    assert np.abs(np.corrcoef(flat.T) - np.eye(3)).max() < 0.02


def test_gamma_encodes_the_charge(pool):
    """A number is 255 (charge / full scale)^(1/gamma)."""
    plain = TiledBasin(lower=(-9, -9, 0), upper=(9, 9, 3), tile=0.0, colour=(0.4, 0.4, 0.4))
    equal = Interface.water(1.0, n_air=1.0, n_water=1.0)
    for gamma in (1.0, 2.2):
        scene = pool(
            basin=plain, interface=equal, sensor=ImageSensor(gain=0.5, gamma=gamma, noise=False, colour=True)
        )
        assert (OverheadCamera(scene).render() == round(255 * 0.2 ** (1 / gamma))).all()


def test_keys_of_noise_differ():
    """Seeds and microseconds give keys of their own; equal ones give the same."""
    keys = {noise_key(seed, t * 1e-3) for seed in range(100) for t in range(100)}
    assert len(keys) == 10_000
    assert noise_key(5, 0.25) == noise_key(5, 0.25)
