"""Levels of programmes for vehicles that are not FinsROV."""

import numpy as np
import pytest

from finssim.control.axis_model import axis_model
from finssim.studies.demo import FULL, SHARE, STEADY, matched
from finssim.vehicles import load_vehicle
from finssim.vehicles.capability import level_speed, terminal_speed
from finssim.vehicles.defaults import room
from reference.cases import THRUSTED


@pytest.mark.parametrize("name", THRUSTED)
def test_a_vehicle_is_driven_as_fast_as_finsrov_or_as_fast_as_it_stays_upright(name):
    """Levels scale with the vehicle's length, on controlled axes, within limits; yaw has FinsROV's rate."""
    vehicle, finsrov = load_vehicle(name), load_vehicle("finsrov")
    ours, theirs, levels = axis_model(vehicle), axis_model(finsrov), matched(FULL.levels, vehicle)
    assert set(levels) == set(vehicle.controlled_axes)
    for i, axis in enumerate(("surge", "sway", "heave", "roll", "pitch", "yaw")):
        if axis not in levels or axis in ("roll", "pitch"):
            continue
        level, published = max(levels[axis]), max(FULL.levels[axis])
        assert level <= SHARE * vehicle.wrench_limits[i] * 1.01 or name == "finsrov"
        speed = terminal_speed(ours.linear_damping[i], ours.quadratic_damping[i], level)
        wanted = terminal_speed(theirs.linear_damping[i], theirs.quadratic_damping[i], published)
        wanted *= room(vehicle.body.size) if i < 3 else 1.0
        if i < 2:
            wanted = min(wanted, STEADY * level_speed(vehicle, axis=i))
        assert speed <= 1.02 * wanted
        if level < 0.98 * SHARE * vehicle.wrench_limits[i]:
            assert speed >= 0.7 * wanted


def test_finsrov_has_its_own_levels():
    """FinsROV gets the published levels unchanged, to the last digit."""
    assert matched(FULL.levels, load_vehicle("finsrov")) == FULL.levels


def test_roll_and_pitch_tilt_a_vehicle_as_far_as_they_tilt_finsrov():
    """The angle at rest is level divided by stiffness."""
    for name in ("bluerov2_heavy", "rexrov"):
        tilts = [
            np.array(matched({"roll": [1.0]}, load_vehicle(v))["roll"])
            / axis_model(load_vehicle(v)).stiffness[3]
            for v in (name, "finsrov")
        ]
        np.testing.assert_allclose(*tilts, rtol=0.01)
