"""Starts of programmes in a pool: inside its workspace, with room for the motion."""

import numpy as np
import pytest

from finssim.core.rotations import quat_from_yaw, quat_rotate
from finssim.evaluation.excitation import STOPPING, box_of, start_of
from finssim.identification.programme import programmes
from finssim.pool.plant_spec import Basin
from finssim.trials.findings import CalibrationError
from finssim.vehicles import AXES, load_vehicle

VEHICLE, BASIN = load_vehicle("finsrov"), Basin()
PLAN = programmes("all", VEHICLE)


@pytest.mark.parametrize("programme", PLAN, ids=lambda p: p.name)
def test_way_and_stop_stay_in_the_water_and_the_workspace(programme):
    """Over the room and the stopping distance, the envelope stays off walls, floor and surface, and the body origin
    inside the bridge's inner box."""
    place = start_of(programme, VEHICLE, box_of(BASIN))
    axis = programme.axes[0]
    column = programme.tau_desired[:, AXES.index(axis)]
    way = np.zeros(3)
    if axis in STOPPING:
        way[AXES.index(axis)] = np.sign(column.sum()) * (place.room + STOPPING[axis])
    turned = quat_rotate(quat_from_yaw(place.yaw), way)
    envelope = np.abs(quat_rotate(quat_from_yaw(place.yaw), 0.5 * np.array(VEHICLE.body.size)))
    low = np.array([-BASIN.length / 2, -BASIN.width / 2, -BASIN.depth])
    high = np.array([BASIN.length / 2, BASIN.width / 2, 0.0])
    lower, upper = (np.array(getattr(VEHICLE.safety, f"workspace_{x}")) for x in ("lower", "upper"))
    for point in (np.array(place.position), np.array(place.position) + turned):
        assert (point - envelope > low + 0.1).all() and (point + envelope < high - 0.1).all()
        assert (point > lower + 0.1).all() and (point < upper - 0.1).all()


def test_surge_and_sway_go_along_the_length_of_the_pool():
    """Left in the body is -x in a world in which the vehicle heads for +y."""
    by_name = {p.name: start_of(p, VEHICLE, box_of(BASIN)) for p in PLAN}
    assert by_name["surge_plus_6"].position[0] < -1.0 and by_name["surge_plus_6"].yaw == 0.0
    assert by_name["sway_plus_9"].position[0] > 1.0
    assert by_name["sway_plus_9"].yaw == pytest.approx(np.pi / 2)
    assert by_name["heave_plus_9"].position[2] < by_name["heave_dive_9"].position[2]


def test_a_pool_without_room_is_refused():
    with pytest.raises(CalibrationError, match="has -?0.* m of room along heave"):
        start_of(next(p for p in PLAN if p.axes == ("heave",)), VEHICLE, box_of(Basin(depth=0.6)))
