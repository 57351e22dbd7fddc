"""Sizes and light that differ by world, measured by a ray and a level surface."""

import numpy as np
import pytest
import warp as wp

from finssim.extensions.perception import CameraBatch, RangeBatch, WorldBatch, WorldLayout, load_world
from finssim.sim import Simulator
from finssim.vehicles.device_files import load_device

WATER = "water: {attenuation: [0, 0, 0], veil: [0, 0, 0], daylight_attenuation: [0, 0, 0]}\n"


@pytest.fixture
def site(tmp_path):
    def make(text):
        path = tmp_path / "site.yaml"
        path.write_text(
            f"about: A site.\n{WATER}{text}\nviewpoint: {{position: [0, 0, -5]}}\n", encoding="utf-8"
        )
        return load_world(path)

    return make


BALL = """objects:
  buoy: {shape: sphere, position: [0, 0, -9], radius: 0.8, vary: {size: 2.0}}
  cap: {shape: box, frame: buoy, position: [3, 0, 0], size: [1, 1, 1]}"""


@pytest.mark.slow
def test_a_ray_meets_each_ball_where_it_was_drawn(site):
    """A ray straight down measures 4 m less the radius, which varies by up to a factor of two and uses most
    of it."""
    batch = WorldBatch(site(BALL), worlds=64)
    batch.draw(3)
    scale = batch.scales.numpy()[:, 0]
    assert scale.min() > 0.499 and scale.max() < 2.001 and scale.max() / scale.min() > 3.0
    pose = np.tile([0, 0, -5, 0, 0, 0, 1], (64, 1))
    device = load_device("ping").model_copy(update={"beam_width": 0.0, "noise": 0.0})
    ranges = (
        RangeBatch(batch, device).update(wp.array(np.float32(pose), dtype=wp.transform), seed=1).numpy()[:, 0]
    )
    np.testing.assert_allclose(ranges, 4.0 - 0.8 * scale, atol=1e-3)
    np.testing.assert_allclose(batch.poses("cap")[:, 0], 3.0 * scale, rtol=1e-6)


def test_a_vehicle_rests_on_a_ball_of_its_world(site):
    """The contact force begins at the drawn radius in each world."""
    layout = WorldLayout(site(BALL), worlds=8)
    simulator = Simulator("finsrov", worlds=8, world=layout, threads=1)
    layout.draw(5)
    radius = 0.8 * layout.scales.numpy()[:, 0].astype(float)
    half = 0.5 * float(simulator.vehicles[0].body.size[2])
    for gap, touches in ((0.02, False), (-0.02, True)):
        place = np.stack([np.zeros(8), np.zeros(8), -9.0 + radius + half + gap], axis=1)
        simulator.place(position=place[:, None])
        simulator.step()
        force = simulator.solids.force.numpy()[:, 0]
        assert np.all(force > 0.0) if touches else np.all(force == 0.0), force


@pytest.mark.slow
def test_daylight_of_each_world_is_its_own(site):
    """A level floor under a sun that turns is as bright as its world's daylight, whatever the sun's height."""
    text = "light: {diffuse: 0.5, vary: {brightness: 2.0, sun: 0.4}}\nseabed: {depth: 8, colour: [0.5, 0.5, 0.5]}"
    batch = WorldBatch(site(text), worlds=32)
    batch.draw(2)
    sun, daylight = batch.optics.sun.numpy(), batch.optics.daylight.numpy()[:, 0]
    np.testing.assert_allclose(np.linalg.norm(sun, axis=1), 1.0, atol=1e-5)
    assert np.ptp(np.arcsin(sun[:, 2])) > 0.3 and daylight.max() / daylight.min() > 3.0
    device = load_device("low_light_camera")
    device = device.model_copy(
        update={"exposure": 1.0, "read_noise": 0.0, "gamma": 1.0, "white_balance": 0.0}
    )
    camera = CameraBatch(batch, device, width=16)
    down = np.float32(np.tile([0, 0, -5, 0, np.sqrt(0.5), 0, np.sqrt(0.5)], (32, 1)))
    picture = (
        camera.update(wp.array(down, dtype=wp.transform), seed=1).numpy().astype(float).mean(axis=(1, 2, 3))
    )
    # Irradiance of a level surface is `daylight` whatever the sun's height: the file gives it so.
    expected = 255.0 * np.minimum(0.5 * daylight, 1.0)
    np.testing.assert_allclose(picture, expected, rtol=0.05, atol=2.0)


@pytest.mark.parametrize(
    ("light", "sentence"),
    [("vary: {brightness: 0.5}", "brightness"), ("vary: {sun: 4.0}", "sun"), ("vary: {moon: 1}", "moon")],
)
def test_a_variation_out_of_range_is_refused(site, light, sentence):
    with pytest.raises(ValueError, match=sentence):
        site(f"light: {{{light}}}")
