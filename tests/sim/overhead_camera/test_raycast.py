"""The ray caster puts every printed edge where the closed-form optics puts it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import Camera, Interface, Layer, Lens, project
from finssim.core.rotations import matrix_to_quat
from finssim.sim.overhead_camera import ObjectPose, OverheadCamera, TagInScene, TiledBasin

LENSES = {
    "pinhole": Lens(320, 240, 200.0, 201.0, 161.3, 118.2),
    "plumb_bob": Lens(
        320, 240, 200.0, 201.0, 161.3, 118.2, "plumb_bob", (0.03, -0.06, 0.0009, 0.0018, 0.0126)
    ),
    "rational": Lens(
        320, 240, 200.0, 201.0, 161.3, 118.2, "rational", (0.3, 0.1, 0.001, -0.001, 0.02, 0.35, 0.1, 0.01)
    ),
    "fisheye": Lens(320, 240, 160.0, 160.0, 161.3, 118.2, "fisheye", (-0.02, 0.005, -0.003, 0.001)),
}
INTERFACES = {
    "level": Interface.water(1.0),
    "tilted": Interface.water(1.0, tilt_x=0.1, tilt_y=-0.15),
    "window": Interface.through([0, 0, 1.0], [0.05, 0.02, 1], window=(Layer(0.02, 1.49), Layer(0.01, 1.2))),
    "equal": Interface.water(1.0, n_air=1.0, n_water=1.0),
}


def shown(scene, tag, edge_offsets):
    """Offsets of a tag's border in a noise-free radiance image [px]."""
    image = OverheadCamera(replace(scene, tags=(tag,))).radiance()
    return edge_offsets(image, scene.camera, scene.interface, tag)


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("interface", INTERFACES)
def test_borders_lie_where_optics_puts_them(pool, square, edge_offsets, camera_at, lens, interface):
    """Through every lens and interface a black square's sides are seen within 0.015 px of their projection."""
    camera = camera_at()
    scene = pool(
        camera=Camera(LENSES[lens], camera.position, camera.orientation),
        interface=INTERFACES[interface],
        samples=4,
    )
    for tag in (square(0.15, 0.1), square(-0.6, 0.35, yaw=0.0, tilt=(0.1, -0.2)), square(0.45, -0.2, z=0.6)):
        offsets = shown(scene, tag, edge_offsets)
        # Each side as a whole: a single profile across a few pixels is itself uncertain to 0.1 px.
        assert np.abs(offsets.mean(axis=1)).max() < 0.015


def test_two_rays_per_axis_suffice(pool, square, edge_offsets):
    """A side parallel to the pixel rows, the worst case for sampling, stays within 0.02 px with 2 x 2 rays."""
    straight = Camera(LENSES["pinhole"], np.array([0.1, -0.05, 1.9]), np.array([1.0, 0.0, 0.0, 0.0]))
    for x in np.linspace(0.1, 0.1 + 1.6 / 200.0, 9):
        scene = pool(camera=straight, samples=2)
        offsets = shown(scene, square(x, 0.05, yaw=0.0), edge_offsets)
        assert np.abs(offsets.mean(axis=1)).max() < 0.02


def test_a_wall_of_glass_is_an_interface_too(pool, square, edge_offsets):
    """A camera beside a tank sees a tag through the vertical wall where optics puts it."""
    R = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # optical z along pool x
    camera = Camera(LENSES["pinhole"], np.array([-0.5, 0.0, 0.5]), matrix_to_quat(R))
    wall = Interface.through([0.0, 0.0, 0.0], [-1.0, 0.0, 0.0], window=(Layer(0.012, 1.52),))
    basin = TiledBasin(lower=(-0.01, -1.0, 0.0), upper=(1.5, 1.0, 1.0), tile=0.0)
    scene = pool(camera=camera, interface=wall, basin=basin, samples=4)
    tag = square(0.6, 0.1, 0.5, edge=0.25)
    turned = replace(tag, pose=ObjectPose(position=(0.6, 0.1, 0.5), orientation=(0.5, -0.5, -0.5, 0.5)))
    offsets = shown(scene, turned, edge_offsets)
    assert np.abs(offsets.mean(axis=1)).max() < 0.02


def test_a_dry_tag_is_seen_straight(pool, square, edge_offsets):
    """Above the water nothing bends the ray: the tag stands where a pinhole puts it."""
    scene = pool(samples=4)
    air = Interface.water(1.7, n_air=1.0, n_water=1.0)
    tag = square(0.1, 0.1, z=1.2, edge=0.2)
    image = OverheadCamera(replace(scene, tags=(tag,))).radiance()
    assert np.abs(edge_offsets(image, scene.camera, air, tag).mean(axis=1)).max() < 0.02


def test_what_is_nearer_hides_what_is_behind(pool, square):
    """A white tag over a black one hides it, one under it does not."""
    tag, centre = square(0.1, 0.0, z=0.3), (slice(110, 130), slice(150, 170))
    white = replace(square(0.1, 0.0, edge=0.9), black=0.9)
    for z, hidden in ((0.5, True), (0.1, False)):
        board = replace(white, pose=replace(white.pose, position=(0.1, 0.0, z)))
        for tags in ((tag, board), (board, tag)):
            shown = OverheadCamera(pool(tags=tags)).radiance()[centre]
            assert (shown.min() > 0.4) if hidden else (shown.max() < 0.1)


def test_a_tag_lies_on_the_floor_it_is_stuck_to(pool, square):
    """A tag in the very plane of the floor is seen."""
    scene = pool(tags=(square(0.1, 0.0, z=0.0, yaw=0.0),))
    assert OverheadCamera(scene).radiance()[110:130, 150:170].max() < 0.1


def test_the_print_reads_as_printed(pool, camera_at):
    """Row 0 of the bitmap is at the tag's +y and column 0 at its -x: an L keeps its shape seen from above."""
    bitmap = np.zeros((4, 4), bool)
    bitmap[0, 0] = bitmap[1, 0] = bitmap[2, 0] = bitmap[2, 1] = True
    tag = TagInScene(bitmap=bitmap, edge=0.4, pose=ObjectPose(position=(0.1, 0.0, 0.2)))
    scene = pool(tags=(tag,))
    image = OverheadCamera(scene).radiance()[..., 0]
    for row in range(4):
        for column in range(4):
            middle = np.array([0.1 + 0.1 * (column - 1.5), 0.1 * (1.5 - row), 0.2])
            u, v = project(scene.camera, scene.interface, middle).pixels
            assert (image[round(v), round(u)] > 0.4) == bitmap[row, column]
