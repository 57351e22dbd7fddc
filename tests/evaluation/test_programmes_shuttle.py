"""Square waves: back and forth around their start."""

import numpy as np
import pytest

from finssim.evaluation.excitation import box_of, start_of
from finssim.pool.plant_spec import Basin
from finssim.studies.demo import PERIODS, shuttles
from finssim.vehicles import AXES, load_vehicle

VEHICLE = load_vehicle("finsrov")


@pytest.mark.parametrize("axis", PERIODS)
def test_as_much_forward_as_back_and_named_by_axis_and_level(axis):
    (programme,) = shuttles({axis: [1.0]}, VEHICLE)
    push = programme.tau_desired[:, AXES.index(axis)]
    assert programme.name == f"{axis}_shuttle_1" and programme.axes == (axis,)
    assert abs(push.sum()) <= 0.25 * PERIODS[axis] * programme.rate + 1  # half of a push remains at the end
    assert set(np.unique(push)) == {-1.0, 0.0, 1.0}
    assert (push[programme.phase != "excitation"] == 0.0).all()


@pytest.mark.parametrize(("axis", "level"), [("surge", 18.0), ("sway", 13.5), ("heave", 13.5)])
def test_the_way_fits_the_room_on_either_side_of_the_start(axis, level):
    """The distance follows from the damping of the vehicle's file; the start is the middle of the pool."""
    (programme,) = shuttles({axis: [level]}, VEHICLE)
    place = start_of(programme, VEHICLE, box_of(Basin()))
    assert place.position[:2] == pytest.approx((0.0, 0.0), abs=1e-12)
    i, model = AXES.index(axis), VEHICLE.hydrodynamics["calibrated"]
    mass, d1, d2 = (
        VEHICLE.mass_matrix("calibrated")[i, i],
        model.linear_damping[i, i],
        model.quadratic_damping[i, i],
    )
    h, v, x = 1.0 / programme.rate, 0.0, [0.0]
    for force in programme.tau_desired[:, i]:
        v = (v + h * force / mass) / (1.0 + h * (d1 + d2 * abs(v)) / mass)
        x.append(x[-1] + h * v)
    assert 0.1 * place.room < np.ptp(x) < 2.0 * place.room
