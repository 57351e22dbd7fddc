"""Vehicles of the catalogue with fins, held by their autopilots in still water, and in a current with waves."""

import math

import numpy as np
import pytest

from finssim.sim import Water, Wave
from finssim.vehicles import load_vehicle
from reference.steered import sailed

SEA = Water(depth=60.0, current=(0.1, 0.28, 0.0), waves=(Wave(amplitude=0.2, wavelength=12.0, heading=0.7),))
"""A current of 0.3 m/s and waves 0.4 m high, whose motion reaches down to the vehicle."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["remus100", "lauv", "eca_a9", "torpedo"])
@pytest.mark.parametrize(("water", "turn", "deep"), [(None, 1.0, 0.1), (SEA, 3.0, 0.3)], ids=["still", "sea"])
def test_course_and_depth_are_held(name, water, turn, deep):
    """A minute after steps of course and depth: ±1° and ±0.1 m in still water, ±3° and ±0.3 m in the sea."""
    orders = {"speed": 1.6, "course": np.array([0.0, 0.5, -1.2]), "depth": np.array([5.0, 7.0, 4.0])}
    found = sailed(load_vehicle(name), orders, 120.0, depth=5.0, water=water)
    end = found.time > 60.0
    off = np.abs(np.angle(np.exp(1j * (found.course - orders["course"]))))[end].max()
    away = np.abs(-found.position[:, :, 2] - orders["depth"])[end].max()
    assert off < math.radians(turn) and away < deep
