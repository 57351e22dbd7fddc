"""Copies of a world: quantities that a draw changes, and quantities that it leaves."""

import numpy as np
import pytest

from finssim.core.rotations import quat_inverse_rotate
from finssim.extensions.perception import WorldBatch

pytestmark = pytest.mark.slow


def test_a_world_is_drawn_from_the_seed_and_its_number_alone(dock):
    """The first of three docks equals a single dock; another seed draws another dock."""
    single = WorldBatch("dock")
    rest = single.poses("back").copy()
    single.draw(1)
    np.testing.assert_array_equal(single.poses("back")[0], dock.poses("back")[0])
    assert np.abs(single.poses("back")[0] - rest[0]).max() > 0.01
    first = single.optics.attenuation.numpy()[0].copy()
    single.draw(2)
    assert np.abs(single.poses("back")[0] - dock.poses("back")[0]).max() > 0.01
    assert not np.array_equal(first, single.optics.attenuation.numpy()[0])


def test_worlds_outside_the_mask_stay(dock):
    """Only the second of three docks is redrawn, and a redraw with the first seed restores it."""
    before = dock.poses("back").copy()
    dock.draw(7, mask=[False, True, False])
    changed = np.any(dock.poses("back") != before, axis=1)
    dock.draw(1, mask=[False, True, False])
    np.testing.assert_array_equal(changed, [False, True, False])
    np.testing.assert_array_equal(dock.poses("back"), before)


def test_things_in_a_frame_move_with_it(dock):
    """The throat of the funnel stays 0.95 m before the plate, in the plate's axes, for every draw of the
    dock."""
    back, rail = dock.poses("back"), dock.poses("rails_upper")
    offset = quat_inverse_rotate(back[:, 3:], rail[:, :3] - back[:, :3])
    np.testing.assert_allclose(offset, np.tile([0.48 - 0.95, -0.24, 0.27], (3, 1)), atol=1e-5)
    np.testing.assert_allclose(dock.poses("quay")[0], dock.poses("quay")[2])


def test_draws_stay_within_what_the_file_says():
    """In 256 pools the marker stays within its shifts and the water within a factor of 2; both use most of
    the range."""
    batch = WorldBatch("pool", worlds=256)
    batch.draw(3)
    item, water = batch.world.objects["marker"], batch.world.water
    shift = np.abs(batch.poses("marker")[:, :3] - item.position)
    assert np.all(shift <= item.vary.position + 1e-6) and np.all(shift.max(axis=0) > 0.9 * item.vary.position)
    factor = batch.optics.attenuation.numpy() / water.attenuation
    assert factor.min() >= 0.499 and factor.max() <= 2.001 and factor.max() / factor.min() > 3.5
    np.testing.assert_allclose(factor[:, 0], factor[:, 2], rtol=1e-5)
