"""The referee: Mitsuba 3, which shares no code with our ray caster, shows tags where ours does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import Camera, Interface, Layer, Lens, project
from finssim.localization.detection.detector import detector
from finssim.localization.detection.families import bitmap
from finssim.sim.overhead_camera import ImageSensor, ObjectPose, OverheadCamera, Ripples, TagInScene
from finssim.sim.sensors import SensorError

pytest.importorskip("mitsuba")
pytest.importorskip("pupil_apriltags")

from tests.reference.mitsuba_renderer import render_with_mitsuba

PUBLISHED = (0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862)
POSITION = np.array([0.032897, -0.167178, 2.171935])
ORIENTATION = np.array([0.99876852, -0.00261252, 0.00069494, -0.04953919])
WATER = {
    "level": {"interface": Interface.water(0.96)},
    "tilted": {"interface": Interface.water(0.96, tilt_x=0.05, tilt_y=-0.08)},
    "window": {
        "interface": Interface.through([0, 0, 0.96], [0, 0, 1], window=(Layer(0.02, 1.49), Layer(0.03, 1.1)))
    },
    "rippling": {"interface": Interface.water(0.96), "ripples": Ripples(rms_slope=0.02, seed=3)},
}


def scene_of(pool, water, distortion=()):
    """The published camera above 1 m of water, with a tag at the edge of its field."""
    lens = Lens(1280, 720, 540.9305, 540.9305, 682.2341, 348.6136, "plumb_bob", distortion)
    tag = TagInScene(
        bitmap=bitmap("tag36h11", 5),
        edge=0.16,
        margin=0.03,
        pose=ObjectPose(position=(1.25, 0.75, 0.05), orientation=(0.0, 0.0, np.sin(0.2), np.cos(0.2))),
    )
    camera = Camera(lens, POSITION, ORIENTATION / np.linalg.norm(ORIENTATION))
    return pool(camera=camera, tags=(tag,), samples=4, sensor=ImageSensor(noise=False), **water)


def detected(image, rectangle):
    """Corners of the tag in a picture, (4, 2) [px]."""
    r = rectangle
    (found,) = detector("tag36h11").detect(np.ascontiguousarray(image[r.top : r.bottom, r.left : r.right]))
    assert found.tag == 5
    return found.corners + np.array([r.left, r.top])


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [(), PUBLISHED], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("water", WATER)
def test_corners_agree_with_mitsuba(pool, water, distortion):
    """Corners detected in our picture and in Mitsuba's agree to 0.3 px; a straight line of sight misses by 10 px."""
    scene = scene_of(pool, WATER[water], distortion)
    camera = OverheadCamera(scene)
    (rectangle,) = camera.neighbourhood(scene.tags)
    ours = detected(camera.render(time=0.4), rectangle)
    referee = detected(render_with_mitsuba(scene, time=0.4, region=[rectangle], rays=9), rectangle)
    assert np.linalg.norm(ours - referee, axis=1).max() < 0.3
    tag = scene.tags[0]
    straight = replace(scene.interface, index_near=1.0, index_far=1.0, window=())
    middle = project(scene.camera, straight, np.asarray(tag.pose.position)).pixels
    assert np.linalg.norm(referee.mean(axis=0) - middle) > 10.0


@pytest.mark.slow
def test_brightness_agrees_with_mitsuba(pool):
    """Paper, print and floor have the same brightness in both pictures, Fresnel's losses included."""
    tag = TagInScene(
        bitmap=np.eye(4, dtype=bool), edge=0.2, margin=0.05, pose=ObjectPose(position=(0.2, 0.1, 0.26))
    )
    scene = replace(scene_of(pool, WATER["level"]), tags=(tag,), sky=0.3)
    camera = OverheadCamera(scene)
    (r,) = camera.neighbourhood(scene.tags)
    ours = camera.render()[r.top : r.bottom, r.left : r.right].astype(float)
    referee = render_with_mitsuba(scene, region=r, rays=36)[r.top : r.bottom, r.left : r.right].astype(float)
    for share in (0.1, 0.5, 0.9):  # quantiles: edges pixels differ by noise, plains must not
        assert abs(np.quantile(ours, share) - np.quantile(referee, share)) <= 2.0
    assert abs((ours - referee).mean()) < 1.0


def test_mitsuba_draws_several_regions_and_nothing_else(pool):
    """Each rectangle is drawn where it belongs; the rest stays zero, and what moves is refused."""
    scene = scene_of(pool, WATER["level"])
    regions = [(900, 500, 904, 503), (10, 20, 13, 26)]
    image = render_with_mitsuba(scene, region=regions, rays=4)
    for left, top, right, bottom in regions:
        assert (image[top:bottom, left:right] > 100).all()
    assert (image > 0).sum() == 4 * 3 + 3 * 6
    moving = replace(scene.tags[0], end=ObjectPose(position=(1.0, 0.0, 0.1)))
    with pytest.raises(SensorError, match="at rest"):
        render_with_mitsuba(replace(scene, tags=(moving,)), region=regions[0])
