"""Random streams: normal, and independent between worlds, steps, axes and streams."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from finssim.sim.sensors import SensorSuite
from finssim.sim.sensors.sampling import digitised


@pytest.fixture
def white(vehicle: Any, rest: Any, ideal: Any) -> np.ndarray:
    """Unit white noise of gyroscope and accelerometer: (steps, W, 6)."""
    worlds, steps = 300, 300
    suite, state = SensorSuite(vehicle, worlds=worlds, control_step=0.01, seed=1), rest(worlds)
    ideal(suite.imu).set(gravity=0.0, gyro_noise=1.0, accel_noise=1.0)
    suite.reset(state)
    log = []
    for _ in range(steps):
        state.advance()
        suite.update(state)
        log.append(np.concatenate([suite.imu.gyro.numpy()[:, 0], suite.imu.accel.numpy()[:, 0]], axis=-1))
    return np.array(log)


def test_white_noise_is_standard_normal(white: np.ndarray) -> None:
    """The first four moments and the whole distribution, each axis by itself."""
    for x in white.reshape(-1, 6).T:
        n = len(x)
        assert abs(x.mean()) < 4.5 / np.sqrt(n)
        assert abs(x.var() - 1.0) < 4.5 * np.sqrt(2 / n)
        assert abs(stats.skew(x)) < 4.5 * np.sqrt(6 / n)
        assert abs(stats.kurtosis(x)) < 4.5 * np.sqrt(24 / n)
        assert stats.kstest(x, stats.norm.cdf).pvalue > 1e-4


def test_white_noise_is_white(white: np.ndarray) -> None:
    """Products of different samples average to zero: neighbours in time, in world and in axis."""
    pairs = [(white[:-lag], white[lag:]) for lag in (1, 2, 10)]
    pairs += [(white[:, :-lag], white[:, lag:]) for lag in (1, 2, 64)]
    pairs += [(white[:-1, :-1], white[1:, 1:]), (white[:-1, 1:], white[1:, :-1])]
    pairs += [(white[..., :-lag], white[..., lag:]) for lag in (1, 2, 3, 5)]
    for a, b in pairs:
        assert abs(np.mean(a * b)) < 4.5 / np.sqrt(a.size)
    # No sample comes twice: float32 normals from 24-bit uniforms still rarely tie by chance.
    values, counts = np.unique(white, return_counts=True)
    assert counts.max() <= 8 and len(values) > 0.9 * white.size


@pytest.mark.parametrize(
    ("x", "expected"), [(0.26, 0.3), (0.24, 0.2), (-0.26, -0.3), (7.0, 2.0), (-7.0, -2.0)]
)
def test_digits_are_the_nearest_count_within_the_range(x: float, expected: float) -> None:
    """Counts of 0.1 between -2 and 2."""
    assert digitised(x, 0.1, 2.0) == pytest.approx(expected, rel=1e-6)


def test_without_a_quantum_nothing_is_rounded() -> None:
    """q = 0 stands for a converter finer than float32."""
    assert digitised(0.123456, 0.0, 1.0) == pytest.approx(0.123456, rel=1e-7)
