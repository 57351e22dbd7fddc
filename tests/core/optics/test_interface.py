"""Interfaces and cameras: definition of planes, and refusals."""

import numpy as np
import pytest

from core.optics.scenes import INTERFACES, LENSES
from finssim.core.optics import Camera, Interface, Layer, OpticsError


def test_water_leans_where_it_is_told():
    """tilt_x tilts the normal towards +x, so that the surface falls along +x; the height applies at the origin."""
    water = Interface.water(0.96, tilt_x=0.1, tilt_y=-0.05)
    assert np.arccos(water.normal[2]) == pytest.approx(np.hypot(0.1, 0.05))
    assert water.normal[0] > 0 > water.normal[1]
    assert water.height(0.0, 0.0) == pytest.approx(0.96)
    assert water.height(1.0, 0.0) < 0.96 < water.height(0.0, 1.0)
    z = water.height([0.3, -2.0], [1.0, 0.4])
    np.testing.assert_allclose(
        water.distance(np.stack([[0.3, -2.0], [1.0, 0.4], z], axis=-1)), 0.0, atol=1e-14
    )


@pytest.mark.parametrize("interface", INTERFACES.values(), ids=INTERFACES.keys())
def test_tangents_span_the_plane(interface):
    """e1, e2 and n are right-handed unit vectors, and rotate only slightly when the plane tilts slightly."""
    e1, e2 = interface.tangents()
    np.testing.assert_allclose(np.linalg.det([e1, e2, interface.normal]), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(e1, e2), interface.normal, atol=1e-12)
    tilted = interface.tilted(1e-6, 2e-6, 0.25)
    np.testing.assert_allclose(tilted.normal, interface.normal + 1e-6 * e1 + 2e-6 * e2, atol=1e-11)
    assert tilted.offset == interface.offset + 0.25
    np.testing.assert_allclose(tilted.tangents(), (e1, e2), atol=1e-5)


def test_level_water_has_the_axes_of_the_pool():
    """For level water e1, e2 are x and y."""
    np.testing.assert_array_equal(Interface.water(1.0).tangents(), [[1, 0, 0], [0, 1, 0]])


def test_a_wall_has_no_height():
    """The height of a vertical plane is refused."""
    with pytest.raises(OpticsError, match="vertical"):
        INTERFACES["wall"].height(0.0, 0.0)


def test_thickness_adds_up():
    """The far face lies behind the near one by the sum of all layers."""
    assert INTERFACES["two layers"].thickness == pytest.approx(0.03)
    assert INTERFACES["surface"].thickness == 0.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Interface([0, 0, 0.9], 0.0), "length 0.9, expected a unit vector"),
        (lambda: Interface([0, 0], 0.0), "expected 3 finite numbers"),
        (lambda: Interface([0, 0, np.nan], 0.0), "expected 3 finite numbers"),
        (lambda: Interface([0, 0, 1], np.inf), "offset is inf"),
        (lambda: Interface([0, 0, 1], 0.0, index_far=0.0), "index_far 0.0, expected a positive number"),
        (lambda: Interface([0, 0, 1], 0.0, index_near=float("nan")), "index_near nan"),
        (lambda: Interface.through([0, 0, 0], [0, 0, 0]), "expected a direction"),
        (lambda: Layer(0.0, 1.5), "thickness 0.0, expected a positive length"),
        (lambda: Layer(0.01, -1.5), "index -1.5"),
        (lambda: Camera(LENSES["pinhole"], (0, 0), (0, 0, 0, 1)), "camera position"),
        (lambda: Camera(LENSES["pinhole"], (0, 0, 0), (0, 0, 0, 2)), "length 2, expected a unit quaternion"),
        (lambda: Camera(LENSES["pinhole"], (0, 0, np.nan), (0, 0, 0, 1)), "camera position"),
    ],
)
def test_impossible_planes_and_poses_are_refused(make, words):
    """An impossible plane or pose is refused in one sentence that states the expected values."""
    with pytest.raises(OpticsError) as refused:
        make()
    assert words in str(refused.value)


def test_a_camera_cannot_be_changed_behind_its_back():
    """Changes to its arrays or to the caller's do not change a camera or an interface."""
    position = np.zeros(3)
    eye = Camera(LENSES["pinhole"], position, (0, 0, 0, 1))
    position[0] = 1.0
    assert eye.position[0] == 0.0
    with pytest.raises(ValueError):
        eye.position[0] = 2.0
    with pytest.raises(ValueError):
        Interface.water(1.0).normal[0] = 2.0
