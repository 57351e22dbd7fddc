"""Derivatives against central differences, for every lens and every interface."""

from dataclasses import replace

import numpy as np
import pytest

from core.optics.scenes import INTERFACES, LENSES, camera, points
from finssim.core.optics import (
    Camera,
    Interface,
    OpticsError,
    back_project,
    plane_jacobian,
    project,
    projection_jacobians,
)
from finssim.core.rotations import quat_from_rotvec, quat_multiply

every_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
every_interface = pytest.mark.parametrize("interface", INTERFACES.values(), ids=INTERFACES.keys())

STEP = 1e-5
# A central difference errs by STEP² third derivatives/6 (pixels per m³, below 1e5 here) plus 1e-13 px/STEP.
TOLERANCE = {"rtol": 1e-6, "atol": 1e-5}


def differences(pixels, count):
    """Return d pixels(x)/dx at 0 for x of `count` numbers, (..., 2, count)."""
    steps = STEP * np.eye(count)
    return np.stack([(pixels(d) - pixels(-d)) / (2.0 * STEP) for d in steps], axis=-1)


def inner_points(interface):
    """Return points at least 5 cm behind the far face, so that differences stay behind it."""
    return points(interface, 40) - 0.05 * interface.normal


@every_interface
@every_lens
def test_derivatives_of_a_pixel(lens, interface):
    """Derivatives by the point, the camera's pose, the plane, the index and the lens equal central differences."""
    eye, there = camera(lens, interface), inner_points(interface)
    found = projection_jacobians(eye, interface, there)

    def moved(d):
        turned = quat_multiply(quat_from_rotvec(d[3:]), eye.orientation)
        return project(Camera(lens, eye.position + d[:3], turned), interface, there).pixels

    def tilted(d):
        e1, e2 = interface.tangents()
        normal = interface.normal + d[0] * e1 + d[1] * e2
        other = replace(interface, normal=normal / np.linalg.norm(normal), offset=interface.offset + d[2])
        return project(eye, other, there).pixels

    def denser(d):
        return project(eye, replace(interface, index_far=interface.index_far + d[0]), there).pixels

    expected = {
        "point": differences(lambda d: project(eye, interface, there + d).pixels, 3),
        "pose": differences(moved, 6),
        "interface": differences(tilted, 3),
    }
    for name, numbers in expected.items():
        np.testing.assert_allclose(getattr(found, name), numbers, **TOLERANCE, err_msg=name)
    np.testing.assert_allclose(found.index, differences(denser, 1)[..., 0], **TOLERANCE)
    np.testing.assert_array_equal(found.projection.pixels, project(eye, interface, there).pixels)
    direction = lens.rays(project(eye, interface, there).pixels)[0]
    np.testing.assert_allclose(found.lens, lens.parameter_jacobian(direction), rtol=1e-9, atol=1e-9)


@every_interface
def test_derivatives_on_a_plane_of_any_orientation(interface):
    """Derivatives by the pixel and by a shift of the plane along its normal hold on a slanting plane."""
    eye, there = camera(LENSES["plumb_bob"], interface), inner_points(interface)
    normal = np.array([0.3, -0.2, 0.1]) + 2.0 * interface.normal
    unit = normal / np.linalg.norm(normal)
    pixels, offset = project(eye, interface, there).pixels, -(there @ normal)
    whole = plane_jacobian(eye, interface, there, normal)
    length = np.linalg.norm(normal)

    def hit(p, shift):
        return back_project(eye, interface, p).at_plane(unit, offset / length - shift)[0]

    e = 1e-3
    columns = [(hit(pixels + d, 0.0) - hit(pixels - d, 0.0)) / (2 * e) for d in e * np.eye(2)]
    np.testing.assert_allclose(whole[..., :2], np.stack(columns, -1), rtol=1e-5, atol=1e-9)
    by_shift = (hit(pixels, STEP) - hit(pixels, -STEP)) / (2 * STEP)
    np.testing.assert_allclose(whole[..., 2], by_shift, rtol=1e-6, atol=1e-8)
    with pytest.raises(OpticsError, match="expected a direction"):
        plane_jacobian(eye, interface, there, (0.0, 0.0, 0.0))


@every_interface
@every_lens
def test_straight_below_the_camera_nothing_is_singular(lens, interface):
    """At rho = 0 all derivatives are finite and continuous, also 1 nm below the face."""
    eye = camera(lens, interface)
    e1, _ = interface.tangents()
    for depth in (0.5, 1e-9):
        below = (
            eye.position - (interface.distance(eye.position) + interface.thickness + depth) * interface.normal
        )
        at = projection_jacobians(eye, interface, below)
        beside = projection_jacobians(eye, interface, below + 1e-7 * e1)
        for name in ("point", "pose", "interface", "index", "lens"):
            assert np.isfinite(getattr(at, name)).all()
            np.testing.assert_allclose(getattr(at, name), getattr(beside, name), atol=5e-3, err_msg=name)


def test_straight_down_the_derivative_is_that_of_the_apparent_depth():
    """Below a camera that looks straight down, du/dx = f/(h + d n_air/n_water), the paraxial limit."""
    interface = Interface.water(0.0)
    eye = Camera(LENSES["pinhole"], (0.0, 0.0, 1.2), (1.0, 0.0, 0.0, 0.0))
    jacobian = projection_jacobians(eye, interface, (0.0, 0.0, -0.8)).point
    f = LENSES["pinhole"].fx / (1.2 + 0.8 * 1.0003 / 1.333)
    assert jacobian[0, 0] == pytest.approx(f, rel=1e-12)


def test_moving_everything_together_moves_nothing():
    """When point, camera and plane shift alike, the derivatives of the pixel cancel."""
    interface = INTERFACES["tilted 20 degrees"]
    eye, there = camera(LENSES["plumb_bob"], interface), inner_points(interface)
    found = projection_jacobians(eye, interface, there)
    # A shift by s changes b by -n . s.
    plane = -found.interface[..., 2:] * interface.normal
    np.testing.assert_allclose(found.point + found.pose[..., :3] + plane, 0.0, atol=1e-9)


def test_a_point_that_is_not_seen_has_no_derivative():
    """Above the surface, the derivatives of back-projection are NaN."""
    interface = INTERFACES["surface"]
    eye = camera(LENSES["pinhole"], interface)
    there, _ = back_project(eye, interface, [640.0, 360.0]).at_z(2.0)
    assert np.isnan(plane_jacobian(eye, interface, there, (0.0, 0.0, 1.0))).all()


@pytest.mark.parametrize("name", ["surface", "from the water", "window"])
def test_derivatives_on_the_far_face_are_those_just_behind_it(name):
    """For points on the face itself, the inward derivative equals a one-sided difference of second order."""
    interface = INTERFACES[name]
    eye, there = camera(LENSES["plumb_bob"], interface), points(interface, 20, spread=0.6)
    there = there - (interface.distance(there) + interface.thickness)[:, None] * interface.normal
    e = 1e-6
    at, once, twice = (project(eye, interface, there - k * e * interface.normal).pixels for k in (0, 1, 2))
    inwards = -projection_jacobians(eye, interface, there).point @ interface.normal
    np.testing.assert_allclose(inwards, (-1.5 * at + 2.0 * once - 0.5 * twice) / e, atol=1e-5)


@pytest.mark.parametrize("height", [1e-3, 1e-6, 1e-9, 1e-12, 0.0])
def test_derivatives_of_a_camera_that_touches_the_water(height):
    """Derivatives hold inside and outside of Snell's window, down to zero height."""
    interface = Interface.water(0.0)
    eye = camera(LENSES["wide"], interface, height)
    there = eye.position + np.array([[0.3, 0.0, -0.5], [3.0, 0.0, -1.0], [0.0, 0.0, -1.0]])
    found, e = projection_jacobians(eye, interface, there), 1e-7
    steps = e * np.eye(3)
    numeric = [
        project(eye, interface, there + d).pixels - project(eye, interface, there - d).pixels for d in steps
    ]
    np.testing.assert_allclose(
        found.point, np.stack(numeric, -1) / (2 * e), atol=1e-4
    )  # 1e-12 px of rounding / e
    for name in ("pose", "interface", "index", "lens"):
        assert np.isfinite(getattr(found, name)).all()
