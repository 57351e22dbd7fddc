"""The model's derivatives agree with its prediction, and a step back and forth returns to the start."""

import numpy as np
import pytest

from finssim.core.optics import Interface
from finssim.survey.pool_model import NAMES, PoolModel, extended_lens

from .surveyed_pools import (
    FISHEYE,
    FLOOR,
    PLUMB_BOB,
    RATIONAL,
    TANK,
    before_tank,
    overhead,
    survey,
    window,
)

STEPS = np.array([1e-5] * 9 + [1e-6, 1e-6, 1e-3, 1e-3] + [1e-6] * 5)


def scenes():
    for lens in (PLUMB_BOB, FISHEYE, RATIONAL):
        yield pytest.param(overhead(lens), Interface.water(1.0, tilt_x=0.02), FLOOR, id=lens.model)
    yield pytest.param(before_tank(30.0), window(), TANK, id="window")


@pytest.mark.parametrize("dry", [False, True], ids=["wet", "dry"])
@pytest.mark.parametrize(("camera", "plane", "box"), list(scenes()))
def test_derivatives_are_those_of_the_prediction(camera, plane, box, dry):
    """Central differences of every parameter and of the point, to their own truncation error."""
    seen = survey(camera, plane, box, 20, pixel=0.0, error=0.0)
    model, above = PoolModel(camera, plane, seen.points.mean(axis=0)), np.full(20, dry)
    J, J_point = model.jacobians(seen.points, above)
    for k in range(len(NAMES)):
        step = np.zeros(len(NAMES))
        step[k] = STEPS[k]
        ahead, back = (model.moved(s).predict(seen.points, above) for s in (step, -step))
        np.testing.assert_allclose(
            (ahead - back) / (2 * STEPS[k]), J[..., k], rtol=2e-5, atol=2e-3, err_msg=NAMES[k]
        )
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        ahead, back = (model.predict(seen.points + s, above) for s in (step, -step))
        np.testing.assert_allclose((ahead - back) / 2e-6, J_point[..., k], rtol=1e-5, atol=1e-3)


def test_a_plane_turns_about_the_reference_point():
    """Tilting leaves the distance between the plane and the reference point."""
    camera, water = overhead(), Interface.water(1.0)
    model = PoolModel(camera, water, np.array([0.4, -0.3, 0.1]))
    step = np.zeros(len(NAMES))
    step[6:8] = 0.03, -0.02
    assert model.moved(step).depth == pytest.approx(model.depth, abs=1e-12)


def test_a_lens_without_distortion_gets_room_for_it():
    bare = extended_lens(type(PLUMB_BOB)(640, 480, 500.0, 500.0, 320.0, 240.0, "plumb_bob", ()))
    assert bare.distortion == (0.0,) * 5
