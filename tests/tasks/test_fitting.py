"""What a task is for a vehicle that is longer than the paper's."""

import numpy as np
import pytest

from finssim import make
from finssim.engine import Pool
from finssim.experiments.setpoints import T1_SETPOINTS, in_room
from finssim.vehicles import load_vehicle

SIZE = 2.6 / 0.6
"""RexROV's length over that of the published pool's vehicles."""


@pytest.mark.parametrize("name", ["t1", "t2"])
def test_lengths_of_t1_and_t2_grow_with_the_vehicle_and_their_tolerance_stays(name):
    """FinsROV has the paper's pool; starts of RexROV's episodes fill one that is 4.3 times as large, under water."""
    small, large = make(name, worlds=200), make(name, worlds=200, vehicle="rexrov")
    assert small.simulator.surroundings[1] == Pool()
    assert large.simulator.surroundings[1].depth == pytest.approx(SIZE)
    assert large.parameters.tolerance == small.parameters.tolerance
    starts = [e.simulator.state.position.numpy()[:, 0] for e in (small, large)]
    np.testing.assert_allclose(starts[1], SIZE * starts[0], rtol=1e-4, atol=1e-5)
    again = large.task.fitted([load_vehicle("rexrov")])
    assert again == large.task  # fitting what is fitted changes nothing


def test_setpoints_grow_with_the_pool():
    """Places do, headings do not."""
    goal = in_room(T1_SETPOINTS["P02"], load_vehicle("rexrov"))
    np.testing.assert_allclose(goal[:3], SIZE * T1_SETPOINTS["P02"][:3])
    assert goal[3] == T1_SETPOINTS["P02"][3]
    assert np.array_equal(in_room(T1_SETPOINTS["P02"], load_vehicle("finsrov")), T1_SETPOINTS["P02"])
