"""Laws that every kind of sensor obeys: those of the package, and one from outside."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from finssim.sim.sensors import SensorSuite, add_sensor
from finssim.sim.sensors.suite import KINDS
from finssim.vehicles import Vehicle, load_vehicle
from reference.pinger import PingerBatch

EVERY = pytest.mark.parametrize("kind", sorted({*KINDS, PingerBatch.kind}))
MOUNT = {"rate": 5.0, "position": [0.0, 0.0, 0.0]}
NOISY = {
    "dvl": {**MOUNT, "noise_std": 0.01},
    "compass": {**MOUNT, "noise_std": 0.02},
    "pinger": {**MOUNT, "noise_std": 0.2},
}
"""Kinds that the catalogue's vehicle does not carry."""


@pytest.fixture
def equipped(kind: str) -> Vehicle:
    """A FinsROV with one of each."""
    add_sensor(PingerBatch)
    return load_vehicle("finsrov").replace({f"sensors.{name}": sensor for name, sensor in NOISY.items()})


def read(suite: SensorSuite, kind: str) -> np.ndarray:
    """All readings of a kind, a row of numbers by world."""
    batch = suite.by_kind[kind]
    rows = [batch.numpy()[name][:, 0].reshape(len(batch.fresh), -1) for name in batch.readings]
    return np.column_stack(rows).astype(float)


def played(
    vehicle: Vehicle, kind: str, motion: Any, steps: int = 20, prepare: Any = None, **options: Any
) -> Any:
    """Readings after a reset and every control step of 0.1 s, and how many of these were new, by world."""
    suite = SensorSuite(vehicle, worlds=len(motion.steps), control_step=0.1, **options)
    if prepare is not None:
        prepare(suite.by_kind[kind])
    suite.reset(motion)
    readings, fresh = [read(suite, kind)], 0
    for _ in range(steps):
        motion.advance()
        suite.update(motion)
        readings.append(read(suite, kind))
        fresh = fresh + suite.by_kind[kind].fresh.numpy()[:, 0].astype(int)
    return np.array(readings), fresh


@EVERY
def test_without_errors_it_reads_the_same_at_rest_in_every_world(
    kind: str, equipped: Vehicle, rest: Any, ideal: Any
) -> None:
    """A vehicle that does not move: one reading, at all times, in all worlds, whatever the seed."""
    motions = [rest(3).put(position=(1.0, -2.0, -3.0)) for _ in range(2)]
    first, second = (played(equipped, kind, m, prepare=ideal, seed=k)[0] for k, m in enumerate(motions))
    np.testing.assert_allclose(first, np.broadcast_to(first[0, 0], first.shape), rtol=0, atol=1e-5)
    np.testing.assert_array_equal(first, second)
    assert np.isfinite(first).all()


@EVERY
def test_its_errors_are_those_of_its_seed_and_average_out(
    kind: str, equipped: Vehicle, rest: Any, ideal: Any
) -> None:
    """Equal seeds, equal readings; another seed or world, others; their mean is the reading without errors.

    Of 2000 worlds, within five standard errors and half a count.
    """
    exact = played(equipped, kind, rest(1), prepare=ideal)[0][0, 0]
    (one, _), (again, _), (other, _) = (played(equipped, kind, rest(2000), 2, seed=s) for s in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    noisy = one[0].std(0) > 0.0
    assert noisy.any() and (one[0] != other[0])[:, noisy].any(0).all()
    standard_error = one[0].std(0) / np.sqrt(2000.0)
    assert (np.abs(one[0].mean(0) - exact)[noisy] <= 5.0 * standard_error[noisy] + 1e-3).all()


@EVERY
def test_it_samples_at_its_rate(kind: str, equipped: Vehicle, rest: Any, ideal: Any) -> None:
    """In 2 s of control steps of 0.1 s: as many new readings as the rate gives, one per step at most."""
    _, fresh = played(equipped, kind, rest(2), prepare=ideal)
    rate = getattr(equipped.sensors, kind).rate
    assert (np.abs(fresh - min(2.0 * rate, 20.0)) <= 1).all()
