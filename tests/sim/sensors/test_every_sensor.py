"""Laws that every sensor obeys: FinsSim's own, one of a program, one of an installed package, two of one kind."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from finssim.core.registry import SENSORS
from finssim.sim.sensors import SensorSuite
from finssim.vehicles import Vehicle, load_vehicle
from reference.examples import EXAMPLES, example
from reference.installed import install

PingerBatch = example("own/sensor/pinger").PingerBatch
MOUNT = {"rate": 5.0, "position": [0.0, 0.0, 0.0]}
STERN = {**MOUNT, "kind": "depth", "position": [0.0, 0.0, 0.25], "rate": 4.0, "noise_std": 0.01}
ADDED = {
    "dvl": {**MOUNT, "noise_std": 0.01},
    "compass": {**MOUNT, "noise_std": 0.02},
    "pinger": {**MOUNT, "noise_std": 0.2},
    "ranger": {**MOUNT, "noise_std": 0.2, "latency": 0.1},
    "stern_depth": STERN,
    "second_ranger": {**MOUNT, "kind": "ranger", "noise_std": 0.1},
}
"""Sensors that the catalogue's vehicle does not carry; `ranger` is the pinger as an installed package has it."""
NAMES = ("imu", "depth", *ADDED)
EVERY = pytest.mark.parametrize("kind", NAMES)
PLACE = (1.0, -2.0, -3.0)
WEIGHT = load_vehicle("finsrov").water.density * load_vehicle("finsrov").water.gravity
GAUGE = 3.0 - float(load_vehicle("finsrov").sensors.depth.position[2])  # type: ignore[union-attr]
TRUTH = {
    "imu": [0.0, 0.0, 0.0, 0.0, 0.0, load_vehicle("finsrov").water.gravity],
    "depth": [GAUGE, 101325.0 + WEIGHT * GAUGE],
    "stern_depth": [2.75, 101325.0 + WEIGHT * 2.75],
    "dvl": [0.0, 0.0, 0.0],
    "compass": [0.0],
    **dict.fromkeys(("pinger", "ranger", "second_ranger"), [np.sqrt(14.0)]),
}
"""Reading without errors of a vehicle that is level and at rest at `PLACE`."""


@pytest.fixture(scope="module", autouse=True)
def _package(tmp_path_factory: Any) -> Iterator[None]:
    """Install a package with a sensor of its own, under another name than that of the program."""
    source = (EXAMPLES / "own/sensor/pinger.py").read_text(encoding="utf-8")
    source = source.replace('kind = "pinger"', 'kind = "ranger"')
    with pytest.MonkeyPatch.context() as patch:
        members = {"sensors": {"ranger": "acoustics:PingerBatch"}}
        install(tmp_path_factory.mktemp("site"), patch, "acoustics", source, members)
        SENSORS["pinger"] = PingerBatch
        yield


@pytest.fixture
def equipped(kind: str) -> Vehicle:
    """Return a FinsROV with one of each."""
    return load_vehicle("finsrov").replace({f"sensors.{name}": sensor for name, sensor in ADDED.items()})


def test_each_registered_kind_is_tested() -> None:
    """A kind that is added to the registry obeys these laws too."""
    assert {ADDED.get(name, {}).get("kind", name) for name in NAMES} >= set(SENSORS)


@EVERY
def test_a_vehicle_file_keeps_it(kind: str, equipped: Vehicle, tmp_path: Path) -> None:
    """Values that are written and read again give an equal vehicle, with an equal digest."""
    plain = {"extends": "finsrov", "sensors": {"origin": "guessed", **equipped.sensors.values()}}
    (tmp_path / "again.yaml").write_text(yaml.safe_dump(plain, sort_keys=False), encoding="utf-8")
    again = load_vehicle(tmp_path / "again.yaml")
    assert again.sensors.by_name[kind] == equipped.sensors.by_name[kind]
    assert again.sensors == equipped.sensors and again.sha256 == equipped.sha256
    changed = equipped.replace({f"sensors.{kind}.rate": 3.0})
    assert changed.sensors.by_name[kind].rate == 3.0 and changed.sha256 != equipped.sha256


@EVERY
def test_without_errors_it_reads_the_truth(kind: str, equipped: Vehicle, rest: Any, ideal: Any) -> None:
    """Level and at rest, where every reading has a closed form."""
    readings, _ = played(equipped, kind, rest(2).put(position=PLACE), 3, prepare=ideal)
    np.testing.assert_allclose(readings, np.broadcast_to(TRUTH[kind], readings.shape), rtol=2e-7, atol=2e-6)


def test_two_of_one_kind_differ_in_place_and_noise(rest: Any) -> None:
    """Each has its own mount, rate and random numbers."""
    gauge = {**MOUNT, "noise_std": 0.5}
    pair = load_vehicle("finsrov").replace(
        {
            "sensors.depth": gauge,
            "sensors.stern_depth": {**gauge, "kind": "depth", "position": [0.0, 0.0, -1.0]},
        }
    )
    suite, motion = SensorSuite(pair, worlds=3000, control_step=0.1, seed=5), rest(3000).put(position=PLACE)
    suite.reset(motion)
    bow, stern = (read(suite, name)[:, 0] for name in ("depth", "stern_depth"))
    assert abs(bow.mean() - 3.0) < 0.05 and abs(stern.mean() - 4.0) < 0.05
    assert abs(np.corrcoef(bow, stern)[0, 1]) < 5.0 / np.sqrt(3000.0)


def read(suite: SensorSuite, kind: str) -> np.ndarray:
    """All readings of a kind, a row of numbers by world."""
    batch = suite.by_name[kind]
    rows = [batch.numpy()[name][:, 0].reshape(len(batch.fresh), -1) for name in batch.readings]
    return np.column_stack(rows).astype(float)


def played(
    vehicle: Vehicle, kind: str, motion: Any, steps: int = 20, prepare: Any = None, **options: Any
) -> Any:
    """Readings after a reset and every control step of 0.1 s, and how many of these were new, by world."""
    suite = SensorSuite(vehicle, worlds=len(motion.steps), control_step=0.1, **options)
    if prepare is not None:
        prepare(suite.by_name[kind])
    suite.reset(motion)
    readings, fresh = [read(suite, kind)], 0
    for _ in range(steps):
        motion.advance()
        suite.update(motion)
        readings.append(read(suite, kind))
        fresh = fresh + suite.by_name[kind].fresh.numpy()[:, 0].astype(int)
    return np.array(readings), fresh


@EVERY
def test_without_errors_it_reads_the_same_at_rest_in_every_world(
    kind: str, equipped: Vehicle, rest: Any, ideal: Any
) -> None:
    """A vehicle that does not move has one reading, at all times, in all worlds, with every seed."""
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
    rate = equipped.sensors.by_name[kind].rate
    assert (np.abs(fresh - min(2.0 * rate, 20.0)) <= 1).all()
