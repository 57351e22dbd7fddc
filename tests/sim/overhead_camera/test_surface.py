"""Ripples have the slope that was asked for, move by the dispersion relation, and bend rays where they are."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from finssim.core.optics import Interface, Layer, project
from finssim.sim.overhead_camera import ImageSensor, OverheadCamera, Ripples
from finssim.sim.overhead_camera.surface import (
    SURFACE_TENSION,
    SurfaceWave,
    dispersion,
    pack_waves,
    surface_hit,
    waves_of,
)
from finssim.sim.sensors import SensorError


@given(slope=st.floats(0.001, 0.1), seed=st.integers(0, 50), waves=st.integers(1, 40))
def test_ripples_have_the_slope_asked_for(slope, seed, waves):
    """The mean square of |∇h| over a wide area is the square of `rms_slope`: Σ (a k)² / 2."""
    surface = waves_of(Ripples(rms_slope=slope, seed=seed, waves=waves))
    k = np.linalg.norm(surface.k, axis=1)
    assert math.isclose(np.sum((surface.amplitude * k) ** 2) / 2, slope**2, rel_tol=1e-9)


def test_slopes_measured_on_the_surface_agree():
    """Sampled over 200 m², the slope has the asked rms, and it is the derivative of the height."""
    surface = waves_of(Ripples(rms_slope=0.04, seed=2))
    xy = np.random.default_rng(0).uniform(-7, 7, (40_000, 2))
    slope = surface.slope(xy, 0.3)
    assert np.sqrt((slope**2).sum(-1).mean()) == pytest.approx(0.04, rel=0.02)
    step = np.array([1e-6, 0.0])
    numeric = (surface.height(xy + step, 0.3) - surface.height(xy - step, 0.3)) / 2e-6
    np.testing.assert_allclose(numeric, slope[:, 0], atol=1e-7)


def test_waves_run_at_the_speed_of_gravity_and_tension():
    """Long waves run at sqrt(g / k); the slowest, of 1.7 cm, at 0.231 m/s (Lamb, Hydrodynamics, §267)."""
    assert dispersion(1.0) == pytest.approx(math.sqrt(9.81), rel=1e-4)
    k = np.linspace(100.0, 1000.0, 10_000)
    speed = dispersion(k) / k
    assert speed.min() == pytest.approx(0.231, abs=0.001)
    assert 2 * math.pi / k[speed.argmin()] == pytest.approx(0.0171, abs=0.0003)
    assert k[speed.argmin()] == pytest.approx(math.sqrt(9.81 / SURFACE_TENSION), rel=1e-3)


@wp.kernel
def hits(
    waves: wp.array(dtype=SurfaceWave),
    height: float,
    rays: wp.array(dtype=wp.vec3),
    found: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    p = surface_hit(waves, height, rays[i])
    found[i] = wp.vec3(p.x, p.y, p.h)


def test_rays_meet_the_surface_where_it_is():
    """For views up to 55° off the vertical the point found lies on the ray to 0.1 mm."""
    surface = waves_of(Ripples(rms_slope=0.05, seed=4))
    rng = np.random.default_rng(1)
    angle, around = rng.uniform(0, math.radians(55), 500), rng.uniform(0, 2 * math.pi, 500)
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), -np.cos(angle)], axis=-1)
    waves = wp.array(pack_waves(surface, [0.4, -0.2], 0.7), dtype=SurfaceWave, device="cpu")
    found = wp.zeros(500, dtype=wp.vec3, device="cpu")
    wp.launch(
        hits, dim=500, inputs=[waves, 1.2, wp.array(rays, dtype=wp.vec3, device="cpu"), found], device="cpu"
    )
    point = found.numpy().astype(float)
    np.testing.assert_allclose(point[:, 2], surface.height(point[:, :2] + [0.4, -0.2], 0.7), atol=2e-6)
    off = np.linalg.norm(np.cross(point - [0, 0, 1.2], rays), axis=1)
    assert off.max() < 1e-4


@pytest.mark.slow
def test_ripples_leave_the_mean_picture_where_it_was(pool, square, edge_offsets):
    """Over many phases the mean of where a tag is seen tends to the flat geometry, and single pictures do not."""
    tag = square(0.2, 0.1, edge=0.25)
    means = []
    for seed in range(40):
        scene = pool(tags=(tag,), ripples=Ripples(rms_slope=0.015, seed=seed, wavelengths=(0.3, 1.0)))
        offsets = edge_offsets(
            OverheadCamera(scene).radiance(), scene.camera, scene.interface, tag, reach=5.0
        )
        top, right, bottom, left = offsets.mean(axis=1)
        means.append([right - left, top - bottom])  # twice the shift of the middle
    shift = 0.5 * np.array(means)
    error = shift.std(axis=0) / math.sqrt(len(shift))
    assert (shift.std(axis=0) > 0.1).all()
    assert (np.abs(shift.mean(axis=0)) < 3.0 * error).all()


def test_a_long_swell_acts_as_a_tilted_plane(pool, square, edge_offsets):
    """Within a wave far longer than the pool the picture is that of the plane with its height and slope."""
    swell = Ripples(rms_slope=0.02, wavelengths=(60.0, 60.0), waves=1, seed=5)
    wave = waves_of(swell)
    tag = square(0.2, 0.1, edge=0.3)
    scene = pool(tags=(tag,), ripples=swell, samples=4)
    time = 1.2
    slope, height = wave.slope([0.1, -0.05], time), wave.height([0.1, -0.05], time)
    flat = scene.interface
    normal = np.array([-slope[0], -slope[1], 1.0]) / math.hypot(*slope, 1.0)
    at = np.array([0.1, -0.05, 1.0 + height])
    plane = replace(flat, normal=normal, offset=-float(normal @ at))
    image = OverheadCamera(scene).radiance(time=time)
    assert abs(height) > 0.05  # [m]: this is no small correction
    moved = project(scene.camera, plane, tag.pose.position).pixels
    assert np.linalg.norm(moved - project(scene.camera, flat, tag.pose.position).pixels) > 1.0
    assert np.abs(edge_offsets(image, scene.camera, plane, tag).mean(axis=1)).max() < 0.05


def test_a_moving_surface_blurs(pool, square):
    """With a long exposure the ripples' motion softens the tag's sides."""
    scene = pool(tags=(square(0.2, 0.1),), ripples=Ripples(rms_slope=0.06, seed=1), samples=8)
    sharp = OverheadCamera(scene).radiance(time=0.5)[..., 1]
    slow = replace(scene, sensor=ImageSensor(shutter=0.08, noise=False))
    soft = OverheadCamera(slow).radiance(time=0.5)[..., 1]
    steepness = [(np.diff(image, axis=1) ** 2).sum() for image in (sharp, soft)]
    assert steepness[1] < 0.9 * steepness[0]
    assert soft.mean() == pytest.approx(sharp.mean(), rel=1e-3)


def test_what_cannot_ripple_is_refused(pool):
    """Waves need a positive length, and glass does not ripple."""
    with pytest.raises(SensorError, match="wavelength|shortest"):
        Ripples(rms_slope=0.01, wavelengths=(0.0, 1.0))
    glass = Interface.through([0, 0, 1], [0, 0, 1], window=(Layer(0.01, 1.5),))
    with pytest.raises(SensorError, match="window"):
        pool(interface=glass, ripples=Ripples(rms_slope=0.01))
