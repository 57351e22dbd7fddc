"""Apparent positions of points through ripples, against Snell's law and the detector on rendered pictures."""

import numpy as np
import pytest

from finssim.core.optics import Camera, Interface, project
from finssim.pool.camera import RippledView, paper_lens
from finssim.sim.overhead_camera import Ripples
from finssim.sim.overhead_camera.surface import waves_of

RANDOM = np.random.default_rng(2)
CAMERA = Camera(paper_lens(), [0.2, 0.1, 2.4], [1.0, 0.0, 0.0, 0.0])
WATER = Interface.water(1.0)
POINTS = np.stack(
    [RANDOM.uniform(-1.8, 1.8, 300), RANDOM.uniform(-0.9, 0.9, 300), RANDOM.uniform(0.1, 0.7, 300)], axis=1
)


def landing(view, pixels, ripples, z, time):
    """Return where each pixel's ray reaches heights z, traced through the waves by Snell's law."""
    waves = waves_of(ripples)
    rays, _ = CAMERA.lens.rays(pixels)
    found = []
    for ray, height in zip(rays @ CAMERA.R_pc.T, z, strict=True):
        s = -1.4 / ray[2]
        for _ in range(50):  # to the surface
            xy = CAMERA.position[:2] + s * ray[:2]
            s = (1.0 + float(waves.height(xy, time)) - CAMERA.position[2]) / ray[2]
        at = CAMERA.position + s * ray
        slope = waves.slope(at[:2], time)
        n = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1.0 + slope @ slope)
        sideways = (1.0003 / 1.333) * (ray - (ray @ n) * n)
        bent = sideways - np.sqrt(1.0 - sideways @ sideways) * n
        found.append(at + (height - at[2]) / bent[2] * bent)
    return np.array(found)


def test_still_water_is_that_of_the_optics():
    """Without ripples the pixels equal those of `core.optics.project`, to 1e-4 px."""
    pixels, ok = RippledView(CAMERA, WATER).pixels(POINTS, 0.0)
    assert ok.all()
    assert np.abs(pixels - project(CAMERA, WATER, POINTS).pixels).max() < 1e-4


@pytest.mark.parametrize(("slope", "most"), [(0.003, 1e-5), (0.01, 1e-4)])
def test_a_ray_through_ripples_ends_at_its_point(slope, most):
    """A pixel's ray, traced forward through the waves, meets the point that the pixel was computed for: 1 mm
    is 0.3 px."""
    ripples = Ripples(rms_slope=slope, seed=4)
    view = RippledView(CAMERA, WATER, ripples)
    pixels, ok = view.pixels(POINTS, 1.7)
    assert ok.all()
    miss = np.linalg.norm(landing(view, pixels, ripples, POINTS[:, 2], 1.7) - POINTS, axis=1)
    assert np.median(miss) < 0.1 * most and miss.max() < most


def test_ripples_move_with_time_and_vanish_with_their_slope():
    """Pixels vary with time, and by less than a hundredth when the slope is a thousandth."""
    still = RippledView(CAMERA, WATER).pixels(POINTS, 0.0)[0]
    view = RippledView(CAMERA, WATER, Ripples(rms_slope=0.01, seed=4))
    assert np.abs(view.pixels(POINTS, 0.0)[0] - view.pixels(POINTS, 0.2)[0]).std() > 0.1
    little = RippledView(CAMERA, WATER, Ripples(rms_slope=1e-5, seed=4))
    assert np.abs(little.pixels(POINTS, 0.0)[0] - still).max() < 0.01


def test_points_above_the_water_have_no_pixel():
    """A point in the air is not seen through the surface."""
    for ripples in (None, Ripples(rms_slope=0.01)):
        _, ok = RippledView(CAMERA, WATER, ripples).pixels(np.array([[0.0, 0.0, 1.2], [0.0, 0.0, 0.8]]), 0.0)
        assert ok.tolist() == [False, True]
