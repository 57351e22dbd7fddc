"""Light under water in the view."""

import numpy as np
import pytest

from finssim.extensions.viewer import water

LOWER, UPPER = np.array([-2.0, -1.0, -1.0]), np.array([2.0, 1.0, 0.0])


def test_caustics_neither_add_nor_lose_light():
    """Every ray reaches the floor: the mean brightness is 1, with bright lines on a darker floor."""
    light = water.caustics(3, seed=2)
    assert light.mean() == pytest.approx(1.0, abs=1e-12)
    assert light.max() > 3.0 and np.median(light) < 0.9


def test_caustics_repeat_after_their_period():
    """Caustics move within a period and repeat after it; another seed gives another surface."""
    begin = water.caustics(0)
    # Single rays, a quarter of a pixel's light each, pass its edge by rounding.
    assert water.caustics(water.FRAMES) == pytest.approx(begin, abs=0.25)
    assert np.abs(water.caustics(1) - begin).mean() > 0.02
    assert np.abs(water.caustics(0, seed=2) - begin).mean() > 0.2


def test_a_level_surface_makes_no_caustics(monkeypatch):
    """Vertical rays go straight on: the floor is evenly bright."""
    k, amplitude, *rest = water._waves(1)
    monkeypatch.setattr(water, "_waves", lambda seed: (k, 0.0 * amplitude, *rest))
    assert water.caustics(0) == pytest.approx(1.0)


def test_depth_takes_red_first():
    """At the surface all colours are unchanged; below, all are weaker, and red is the weakest."""
    assert water.tint(0.0) == pytest.approx(1.0)
    red, green, blue = water.tint(2.0)
    assert red < green < blue < 1.0 and (water.tint(3.0) < water.tint(2.0)).all()


def test_walls_face_the_water():
    """Walls are visible only from inside, so that walls between the camera and the water vanish."""
    mesh = water.walls(LOWER, UPPER)
    inward = 0.5 * (LOWER + UPPER) - mesh.triangles_center
    assert len(mesh.faces) == 8 and (np.einsum("ij,ij->i", mesh.face_normals, inward) > 0.0).all()


def test_the_picture_of_the_floor_repeats_every_patch():
    """A floor of 4 m by 2 m repeats the given picture of 2 m twice in x and once in y."""
    image = next(water.floor_images(water.TILES, "tiles", 1.0))
    mesh = water.draped(*water.floor(LOWER, UPPER), image)
    assert np.ptp(mesh.visual.uv, axis=0) == pytest.approx([2.0, 1.0])
    drawn = np.asarray(mesh.visual.material.baseColorTexture, float)
    assert np.abs(drawn - image).mean() < 4.0  # as JPEG
