"""A picture is a function of scene, time and seed: regions, devices and repetition do not change a byte."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from finssim.core.optics import Camera
from finssim.core.rotations import matrix_to_quat, quat_to_matrix
from finssim.sim.overhead_camera import (
    ImageSensor,
    ObjectPose,
    OverheadCamera,
    Ripples,
    TagInScene,
    TiledBasin,
)
from finssim.sim.sensors import SensorError


def lively(pool, square, **changes):
    """A tag that stays, rippling water, noise; and a tag that moves."""
    scene = pool(
        tags=(square(-0.5, 0.3, edge=0.2),),
        ripples=Ripples(rms_slope=0.03, seed=1),
        **{"sensor": ImageSensor(shutter=0.005), **changes},
    )
    return scene, square(0.2, 0.1, edge=0.2)


@pytest.mark.parametrize("colour", [False, True])
def test_a_region_shows_what_the_complete_picture_shows(pool, square, colour):
    """Inside it the bytes are those of the complete picture, outside they are the background's."""
    scene, tag = lively(pool, square, sensor=ImageSensor(colour=colour))
    camera = OverheadCamera(scene)
    background = camera.render(region=(0, 0, 0, 0), time=0.2, seed=1)
    complete = camera.render(tags=(tag,), time=0.4, seed=7)
    left, top, right, bottom = region = (100, 51, 180, 130)
    part = camera.render(tags=(tag,), time=0.4, seed=7, region=region)
    inside = np.zeros(complete.shape[:2], bool)
    inside[top:bottom, left:right] = True
    np.testing.assert_array_equal(part[inside], complete[inside])
    np.testing.assert_array_equal(part[~inside], background[~inside])
    assert complete.shape == (240, 320, 3) if colour else (240, 320)


def test_the_neighbourhood_holds_all_that_moving_tags_change(pool, square):
    """Without noise and ripples, drawing around the tags alone gives the complete picture."""
    scene, tag = lively(pool, square)
    camera = OverheadCamera(replace(scene, ripples=None, sensor=ImageSensor(noise=False)))
    for position in ((0.2, 0.1, 0.3), (-0.1, -0.2, 0.5)):
        tags = (replace(tag, pose=ObjectPose(position=position)),)
        np.testing.assert_array_equal(camera.render(region="tags", tags=tags), camera.render(tags=tags))


@pytest.mark.parametrize("seed", range(4))
def test_the_neighbourhood_has_room_for_ripples(pool, square, seed):
    """No ripple moves a tag out of its rectangle: outside, the picture is the same with the tag and without."""
    ripples = Ripples(rms_slope=0.08, seed=seed, wavelengths=(0.3, 1.5))
    tag = square(0.4, 0.2, z=0.05, edge=0.2)
    camera = OverheadCamera(pool(ripples=ripples, sensor=ImageSensor(noise=False)))
    differs = camera.render(tags=(tag,), time=1.0) != camera.render(time=1.0)
    for left, top, right, bottom in camera.neighbourhood((tag,)):
        differs[top:bottom, left:right] = False
    assert not differs.any()


def test_same_seed_same_bytes(pool, square):
    """Time and seed decide the noise; a second camera draws the same."""
    scene, tag = lively(pool, square)

    def draw(time, seed):
        return OverheadCamera(scene).render(tags=(tag,), time=time, seed=seed)

    first = draw(0.1, 4)
    np.testing.assert_array_equal(first, draw(0.1, 4))
    for other in (draw(0.1, 5), draw(0.1001, 4)):
        assert (first != other).mean() > 0.5


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_a_gpu_draws_the_same_picture(pool, square):
    """CPU and GPU round differently in the last bit: numbers differ by at most one, edges excepted."""
    scene, tag = lively(pool, square)
    on_cpu, on_gpu = (
        OverheadCamera(scene, device=device).render(tags=(tag,), seed=1).astype(int)
        for device in ("cpu", "cuda")
    )
    assert (np.abs(on_cpu - on_gpu) > 1).mean() < 1e-3


def moving(tag, shift):
    """The tag, moving by `shift` during the exposure, centred on where it stood."""
    at = np.asarray(tag.pose.position)
    poses = [replace(tag.pose, position=tuple(at + s * np.asarray(shift))) for s in (-0.5, 0.5)]
    return replace(tag, pose=poses[0], end=poses[1])


def test_blur_is_as_long_as_the_way_moved(pool, square):
    """A side seen across its motion is a ramp of speed x time x scale, and its middle stays where it was."""
    scene = pool(samples=8)
    straight = Camera(scene.camera.lens, np.array([0.0, 0.0, 1.9]), np.array([1.0, 0.0, 0.0, 0.0]))
    scene = replace(scene, camera=straight)
    tag = square(0.0, 0.0, yaw=0.0, edge=0.3)
    profiles = []
    for shown in (tag, moving(tag, (0.06, 0.0, 0.0))):
        image = OverheadCamera(replace(scene, tags=(shown,))).radiance()[110:126, 165:190].mean((0, 2))
        profiles.append((image - image.min()) / np.ptp(image))
    position = [len(p) - p.sum() for p in profiles]
    # A uniform ramp of length w has variance w²/12 about its middle; a pixel alone has 1/12.
    spread = [
        np.sum(np.diff(p) * (np.arange(len(p) - 1) - s + 1.0) ** 2)
        for p, s in zip(profiles, position, strict=True)
    ]
    scale = 200.0 / (0.9 + 0.7 / (1.333 / 1.0003))
    assert position[1] == pytest.approx(position[0], abs=0.05)
    assert np.sqrt(12 * (spread[1] - spread[0])) == pytest.approx(0.06 * scale, rel=0.05)


def test_blur_keeps_the_light(pool, square):
    """Motion spreads light but neither adds nor takes any."""
    tag = square(0.1, 0.0, edge=0.25)
    still = OverheadCamera(pool(tags=(tag,))).radiance()
    blurred = OverheadCamera(pool(tags=(moving(tag, (0.05, -0.02, 0.0)),), samples=4)).radiance()
    assert blurred.sum() == pytest.approx(still.sum(), rel=2e-4)
    assert np.abs(blurred - still).max() > 0.3


def test_a_turning_tag_takes_the_short_way(pool, square):
    """Half-way through a turn given by opposite quaternions the tag still faces the camera."""
    tag = square(0.1, 0.0, yaw=0.1)
    q = tag.pose.orientation
    turned = replace(tag, end=ObjectPose(position=tag.pose.position, orientation=tuple(-x for x in q)))
    pair = [OverheadCamera(pool(tags=(t,), samples=4)).radiance() for t in (tag, turned)]
    np.testing.assert_allclose(pair[0], pair[1], atol=1e-5)


def test_a_wide_spot_softens_edges_in_place(pool, square, edge_offsets):
    """A lens that spreads each point over 2 px leaves sides where they were."""
    tag = square(0.15, 0.1)
    scene = pool(tags=(tag,), samples=4, sensor=ImageSensor(spot=2.0, noise=False))
    image = OverheadCamera(scene).radiance()
    sharp = OverheadCamera(replace(scene, sensor=ImageSensor(noise=False))).radiance()
    assert np.abs(edge_offsets(image, scene.camera, scene.interface, tag).mean(axis=1)).max() < 0.015
    assert (np.diff(image[..., 1]) ** 2).sum() < 0.75 * (np.diff(sharp[..., 1]) ** 2).sum()


def test_what_cannot_be_drawn_is_refused(pool, square):
    """Cameras in the water, odd bitmaps and odd regions give one clear sentence."""
    scene = pool()
    below = replace(scene, camera=replace(scene.camera, position=np.array([0.0, 0.0, 0.5])))
    with pytest.raises(SensorError, match="behind the interface"):
        OverheadCamera(below)
    with pytest.raises(SensorError, match="bitmap has shape"):
        TagInScene(bitmap=np.zeros((4, 5), bool), edge=0.1, pose=ObjectPose(position=(0, 0, 0)))
    with pytest.raises(SensorError, match="left, top, right, bottom"):
        OverheadCamera(scene).render(region=(1, 2, 3))
    with pytest.raises(SensorError, match="unit quaternion"):
        ObjectPose(position=(0, 0, 0), orientation=(0, 0, 0, 2))


@pytest.mark.parametrize(
    "R", [np.diag([1.0, -1.0, -1.0]), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])], ids=["z down", "y up"]
)
def test_the_pool_frame_is_a_matter_of_taste(pool, square, R):
    """The same scene written in axes with z down, or y up, gives the same picture."""
    scene = pool(
        basin=TiledBasin(lower=(-0.9, -0.8, 0.0), upper=(0.9, 0.8, 1.5), tile=0.0),
        tags=(square(0.2, 0.1, edge=0.2),),
    )

    def turned(thing):
        q = tuple(matrix_to_quat(R @ quat_to_matrix(thing.pose.orientation)).tolist())
        return replace(thing, pose=ObjectPose(position=tuple(R @ thing.pose.position), orientation=q))

    camera, corners = scene.camera, R @ np.array([scene.basin.lower, scene.basin.upper]).T
    other = replace(
        scene,
        camera=replace(camera, position=R @ camera.position, orientation=matrix_to_quat(R @ camera.R_pc)),
        interface=replace(scene.interface, normal=R @ scene.interface.normal),
        basin=replace(scene.basin, lower=tuple(corners.min(axis=1)), upper=tuple(corners.max(axis=1))),
        tags=tuple(turned(tag) for tag in scene.tags),
    )
    pair = [OverheadCamera(s).radiance() for s in (scene, other)]
    assert (
        np.abs(pair[0] - pair[1]).max(axis=-1) > 1e-3
    ).mean() < 1e-3  # rounding, at edges that are not filtered
