"""Randomised water is added to the given water and never replaces it."""

from __future__ import annotations

import numpy as np

from finssim.sim import Water, Wave
from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import Ranges, WaveRanges
from finssim.tasks import Environment, StationKeeping

GIVEN = Water(current=(0.3, 0.0, 0.0), waves=(Wave(amplitude=0.02, wavelength=4.0),))


def environment(ranges: Ranges) -> Environment:
    """Return sixty-four worlds of T1 in the given water."""
    return Environment(StationKeeping(), worlds=64, water=GIVEN, randomization=Randomization(ranges), seed=4)


def test_a_drawn_current_keeps_the_waves_and_adds_to_the_current() -> None:
    """Speeds of the drawn part cover 0 to 0.1 m/s, horizontally, around the given current."""
    water = environment(Ranges(name="current", current=(0.0, 0.1))).simulator.water
    drawn = water.current.numpy() - [0.3, 0.0, 0.0]
    speed = np.linalg.norm(drawn, axis=1)
    assert speed.max() <= 0.1 + 1e-6 and speed.min() < 0.02 and speed.max() > 0.08
    assert np.abs(drawn[:, 2]).max() == 0.0
    np.testing.assert_allclose(water.wave_amplitude.numpy()[:, 0], 0.02, rtol=1e-6)


def test_drawn_waves_join_the_given_one_and_keep_the_current() -> None:
    """The given wave remains first; up to two more follow it."""
    waves = WaveRanges(count=(0, 2), amplitude=(0.01, 0.03), wavelength=(3.0, 8.0))
    water = environment(Ranges(name="waves", waves=waves)).simulator.water
    amplitude = water.wave_amplitude.numpy()
    np.testing.assert_allclose(amplitude[:, 0], 0.02, rtol=1e-6)
    counts = (amplitude[:, 1:] > 0.0).sum(axis=1)
    assert amplitude.shape[1] == 3 and set(counts.tolist()) == {0, 1, 2}
    np.testing.assert_allclose(water.current.numpy(), np.tile([0.3, 0.0, 0.0], (64, 1)), rtol=1e-6)
