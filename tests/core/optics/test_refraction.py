"""Through the interface and back: every lens with every interface, limits, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from core.optics.scenes import INTERFACES, LENSES, camera, points
from finssim.core.optics import (
    Camera,
    Interface,
    Layer,
    OpticsError,
    Status,
    back_project,
    count_rejections,
    project,
)
from finssim.core.rotations import quat_from_rotvec, quat_multiply, quat_rotate

every_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
every_interface = pytest.mark.parametrize("interface", INTERFACES.values(), ids=INTERFACES.keys())

SEEN = (Status.OK, Status.OUTSIDE_IMAGE)


@every_interface
@every_lens
def test_there_and_back_is_the_identity(lens, interface):
    """Points that are projected and traced back onto their planes return to the same place, and so do pixels,
    to 1e-9."""
    eye, there = camera(lens, interface), points(interface)
    seen = project(eye, interface, there)
    assert np.isin(seen.status, SEEN).all()
    rays = back_project(eye, interface, seen.pixels)
    assert (rays.status == Status.OK).all()
    assert np.allclose(np.linalg.norm(rays.direction, axis=-1), 1.0, atol=1e-14)
    for axis in np.eye(3):  # planes along z, and along x and y
        if np.abs(rays.direction @ axis).min() < 0.01:
            continue
        met, status = rays.at_plane(axis, -(there @ axis))
        assert (status == Status.OK).all()
        np.testing.assert_allclose(met, there, atol=1e-9)
        again = project(eye, interface, met)
        np.testing.assert_allclose(again.pixels, seen.pixels, atol=1e-9)
    # The point lies on the ray for any plane: the moment about the ray's origin is zero.
    off = np.cross(there - rays.origin, rays.direction)
    np.testing.assert_allclose(off, 0.0, atol=1e-9)


@every_lens
@pytest.mark.parametrize("window", [(), (Layer(0.02, 1.333),)])
def test_equal_indices_leave_the_ray_straight(lens, window):
    """With one index throughout, window included, the result is the pinhole camera, to 1e-12 of the scale."""
    interface = Interface.through(
        (0.1, 0.0, 0.4), (0.2, -0.1, 1.0), index_near=1.333, index_far=1.333, window=window
    )
    eye, there = camera(lens, interface), points(interface)
    straight, _ = lens.project((there - eye.position) @ eye.R_pc)
    np.testing.assert_allclose(project(eye, interface, there).pixels, straight, atol=1e-12 * 1280)
    rays = back_project(eye, interface, straight)
    np.testing.assert_allclose(rays.direction, lens.rays(straight)[0] @ eye.R_pc.T, atol=1e-12)
    np.testing.assert_allclose(np.cross(there - eye.position, rays.direction), 0.0, atol=1e-12)


@every_interface
def test_a_thin_window_is_no_window(interface):
    """Layers of a picometre change a pixel by no more than their share of the path."""
    bare = replace(interface, window=())
    thin = replace(interface, window=(Layer(1e-12, 1.49), Layer(1e-12, 1.6)))
    eye, there = camera(LENSES["plumb_bob"], bare), points(bare)
    np.testing.assert_allclose(project(eye, thin, there).pixels, project(eye, bare, there).pixels, atol=1e-8)


def test_a_window_of_water_is_deeper_water():
    """A layer with the index of the medium behind it changes nothing at all."""
    bare = Interface.water(0.96)
    with_layer = replace(bare, window=(Layer(0.1, bare.index_far),))
    eye, there = camera(LENSES["plumb_bob"], bare), points(with_layer)
    np.testing.assert_allclose(
        project(eye, with_layer, there).pixels, project(eye, bare, there).pixels, atol=1e-10
    )


@every_interface
@every_lens
def test_the_choice_of_frame_changes_no_pixel(lens, interface):
    """In a frame that is turned upside down and shifted, pixels and back-projected points are the same."""
    turn, shift = quat_from_rotvec([np.pi * 0.6, np.pi * 0.8, 0.0]), np.array([3.0, -2.0, 7.0])
    eye, there = camera(lens, interface), points(interface, 50)
    normal = quat_rotate(turn, interface.normal)
    other = replace(interface, normal=normal, offset=interface.offset - normal @ shift)
    moved = Camera(lens, quat_rotate(turn, eye.position) + shift, quat_multiply(turn, eye.orientation))
    moved_points = quat_rotate(turn, there) + shift
    seen, seen_there = project(eye, interface, there), project(moved, other, moved_points)
    np.testing.assert_allclose(seen_there.pixels, seen.pixels, atol=1e-9)
    rays, rays_there = back_project(eye, interface, seen.pixels), back_project(moved, other, seen.pixels)
    np.testing.assert_allclose(quat_rotate(turn, rays.origin) + shift, rays_there.origin, atol=1e-12)


@every_interface
def test_the_surface_point_obeys_snell(interface):
    """Where the ray crosses the near face, n sin is equal before it and in the first medium behind it."""
    eye, there = camera(LENSES["pinhole"], interface), points(interface)
    seen = project(eye, interface, there)
    before = eye.lens.rays(seen.pixels)[0] @ eye.R_pc.T
    before *= -(interface.distance(eye.position) / (before @ interface.normal))[:, None]
    surface = eye.position + before
    first = [*(layer.index for layer in interface.window), interface.index_far][0]
    thickness = interface.window[0].thickness if interface.window else None
    rays = back_project(eye, interface, seen.pixels)
    if thickness is None:
        behind = there - surface
        np.testing.assert_allclose(rays.origin, surface, atol=1e-9)
    elif len(interface.window) == 1:
        behind = rays.origin - surface
    else:
        return
    before, behind = (d / np.linalg.norm(d, axis=-1, keepdims=True) for d in (before, behind))
    sines = [np.linalg.norm(np.cross(d, interface.normal), axis=-1) for d in (before, behind)]
    np.testing.assert_allclose(interface.index_near * sines[0], first * sines[1], atol=1e-9)


@pytest.mark.parametrize("name", ["surface", "wall", "z down", "from the water"])
def test_on_the_face_itself_points_are_where_they_are(name):
    """Towards the interface the pixel tends to that of the straight line to the point on it, and equals it there."""
    interface = INTERFACES[name]
    eye = camera(LENSES["plumb_bob"], interface)
    there = points(interface, 20, spread=0.6)
    on_it = there - interface.distance(there)[:, None] * interface.normal
    straight, _ = eye.lens.project((on_it - eye.position) @ eye.R_pc)
    seen = project(eye, interface, on_it)
    assert np.isin(seen.status, SEEN).all()
    np.testing.assert_allclose(seen.pixels, straight, atol=1e-9)
    for depth in (1e-3, 1e-6, 1e-9, 1e-12, 1e-15):
        near = project(eye, interface, on_it - depth * interface.normal).pixels
        np.testing.assert_allclose(near, straight, atol=2e3 * depth + 1e-9)
    rays = back_project(eye, interface, straight)
    met, status = rays.at_plane(interface.normal, interface.offset)
    assert (status == Status.OK).all()
    np.testing.assert_allclose(met, on_it, atol=1e-12)


@every_interface
@every_lens
def test_straight_below_the_camera(lens, interface):
    """On the interface's normal through the camera the ray is straight, and around it the pixel is continuous."""
    eye = camera(lens, interface)
    below = eye.position - (interface.distance(eye.position) + interface.thickness + 0.7) * interface.normal
    straight, _ = lens.project((below - eye.position) @ eye.R_pc)
    seen = project(eye, interface, below)
    np.testing.assert_allclose(seen.pixels, straight, atol=1e-9)
    e1, _ = interface.tangents()
    for r in (1e-300, 1e-160, 1e-12, 1e-8):
        np.testing.assert_allclose(
            project(eye, interface, below + r * e1).pixels, seen.pixels, atol=1e3 * r + 1e-9
        )


@pytest.mark.parametrize("height", [1.0, 1e-3, 1e-6, 1e-9, 1e-12])
def test_a_camera_close_to_the_water(height):
    """Down to a picometre above the surface, rays inside Snell's window enter at their angle, those outside
    graze it."""
    interface = Interface.water(0.0)
    eye = camera(LENSES["wide"], interface, height)
    there = eye.position + np.array([[0.3, 0.0, -0.5], [0.0, 0.9, -1.0], [3.0, 0.0, -1.0], [0.0, 50.0, -0.1]])
    there[:, 2] = [-0.5, -1.0, -1.0, -0.1]
    seen = project(eye, interface, there)
    assert np.isfinite(seen.pixels).all()
    rays = back_project(eye, interface, seen.pixels[:2])
    np.testing.assert_allclose(rays.at_z(there[:2, 2])[0], there[:2], atol=1e-9)
    if height < 1e-6:
        before = eye.lens.rays(seen.pixels)[0] @ eye.R_pc.T
        inside = np.hypot(*there[:2, :2].T - eye.position[:2, None]) / np.linalg.norm(
            there[:2] - eye.position, axis=-1
        )
        sine = 1.333 / 1.0003 * inside
        np.testing.assert_allclose(np.hypot(*before[:2, :2].T), sine, atol=1e-5)
        np.testing.assert_allclose(before[2:, 2], 0.0, atol=1e-5)


def test_five_metres_of_water_at_a_grazing_view():
    """A point 5 m deep and 40 m away, seen from 0.3 m above, is projected and traced back to a micrometre."""
    interface = Interface.water(0.0)
    eye = camera(LENSES["wide"], interface, 0.3)
    there = np.array([[40.0, 0.0, -5.0], [0.0, -40.0, -5.0]])
    seen = project(eye, interface, there)
    assert np.isin(seen.status, SEEN).all()
    np.testing.assert_allclose(back_project(eye, interface, seen.pixels).at_z(-5.0)[0], there, atol=1e-6)


def test_every_refusal_says_why():
    """Each reason occurs where its physics applies, gives NaN, and is counted by name."""
    water, dry = Interface.water(0.0), INTERFACES["from the water"]
    eye, diver = camera(LENSES["wide"], water), camera(LENSES["wide"], dry)
    assert back_project(eye, water, [1e5, 0.0]).status == Status.NO_RAY  # past the field of view
    cases = [
        ([0.0, 0.9, 0.2], Status.AWAY),
        ([0.0, 1.0, 0.0], Status.PARALLEL),
        ([0.0, 0.3, -1.0], Status.OK),
    ]
    for ray, reason in cases:
        rays = back_project(eye, water, eye.lens.project(np.array(ray) @ eye.R_pc)[0])
        assert rays.status == reason
        assert np.isnan(rays.origin).any() == np.isnan(rays.direction).any() == (reason != Status.OK)
    critical = np.arcsin(1.0003 / 1.333)
    angle = critical + np.array([-1e-6, 1e-6])
    looks = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)  # from the water up into the air
    rays = back_project(diver, dry, diver.lens.project(looks @ diver.R_pc)[0])
    assert rays.status.tolist() == [Status.OK, Status.TOTAL_REFLECTION]
    assert count_rejections(rays.status) == {"TOTAL_REFLECTION": 1}

    pin = camera(LENSES["pinhole"], water)
    there = [[0.0, 0.0, -1.0], [0.0, 0.0, 0.2], [30.0, 0.0, -1.0], [np.nan, 0.0, -1.0]]
    seen = project(pin, water, there)
    assert seen.status.tolist()[:3] == [Status.OK, Status.WRONG_SIDE, Status.OUTSIDE_IMAGE]
    assert seen.status[3] not in SEEN
    assert np.isfinite(seen.pixels).all(axis=-1).tolist() == [True, False, True, False]
    sideways = Camera(pin.lens, pin.position, quat_from_rotvec([-np.pi / 2, 0.0, 0.0]))  # looks along +y
    seen = project(sideways, water, [[0.0, -3.0, -1.0], [0.0, 3.0, -1.0]])
    assert seen.status[0] == Status.BEHIND_CAMERA
    assert np.isfinite(seen.pixels[1]).all()
    folded = Camera(replace(pin.lens, distortion=(-0.4, 0.0, 0.0, 0.0)), pin.position, pin.orientation)
    assert project(folded, water, [5.0, 0.0, -0.1]).status == Status.NO_RAY


def test_a_drowned_camera_is_told_so():
    """A camera on the far side of its own interface gets no pixel rather than a wrong one."""
    water = Interface.water(0.96)
    eye = camera(LENSES["pinhole"], water, -0.2)
    assert back_project(eye, water, [640.0, 360.0]).status == Status.AWAY
    assert project(eye, water, [0.0, 0.0, 0.0]).status == Status.WRONG_SIDE


def test_planes_that_a_ray_does_not_meet():
    """A plane above the surface gives AWAY, one along the ray PARALLEL; a plane without a direction is refused."""
    water = Interface.water(0.96)
    eye = camera(LENSES["pinhole"], water)
    rays = back_project(eye, water, [[600.0, 300.0], [700.0, 400.0]])
    points_, status = rays.at_z([1.5, 0.2])
    assert status.tolist() == [Status.AWAY, Status.OK]
    assert np.isnan(points_[0]).all() and points_[1, 2] == 0.2
    along = np.cross(rays.direction[0], [1.0, 0.0, 0.0])
    assert rays.at_plane(along, -1.0)[1][0] == Status.PARALLEL
    level, _ = rays.at_plane([0.0, 0.0, -2.0], 0.4)  # a normal of any length: z = 0.2
    np.testing.assert_allclose(level, rays.at_z(0.2)[0], atol=1e-12)
    with pytest.raises(OpticsError, match="expected a direction"):
        rays.at_plane([0.0, 0.0, 0.0], 1.0)


def test_batches_of_any_shape():
    """A batch equals single calls; one pixel with many heights broadcasts; the empty batch is empty."""
    interface = INTERFACES["window"]
    eye = camera(LENSES["plumb_bob"], interface)
    there = points(interface, 12).reshape(2, 3, 2, 3)
    seen = project(eye, interface, there)
    assert seen.pixels.shape == (2, 3, 2, 2) and seen.status.shape == (2, 3, 2)
    one = project(eye, interface, there[1, 2, 0])
    np.testing.assert_allclose(one.pixels, seen.pixels[1, 2, 0], atol=1e-10)
    assert one.status.shape == ()
    rays = back_project(eye, interface, seen.pixels)
    np.testing.assert_allclose(
        rays.origin[1, 2, 0], back_project(eye, interface, one.pixels).origin, atol=1e-12
    )
    level = back_project(
        camera(LENSES["pinhole"], INTERFACES["surface"]), INTERFACES["surface"], [640.0, 360.0]
    )
    assert level.at_z(np.array([0.1, 0.2, 0.9]))[0].shape == (3, 3)
    assert project(eye, interface, np.empty((0, 3))).pixels.shape == (0, 2)
    assert back_project(eye, interface, np.empty((0, 2))).at_z(0.0)[0].shape == (0, 3)


def test_status_names_count():
    """Reasons are counted by name; OK is not a reason."""
    assert count_rejections([0, 0, 3, 3, 7]) == {"TOTAL_REFLECTION": 2, "OUTSIDE_IMAGE": 1}
    assert count_rejections([]) == {}
