"""A value that becomes non-finite freezes its world, is reported with the last states, and never spreads."""

import csv

import numpy as np
import pytest

from finssim.sim import Simulator, Water, Wave
from reference.cases import ONE_VEHICLE_PER_MODEL, random_states

FIELDS = ("position", "quaternion", "velocity", "acceleration", "thrust")


def simulation(model="calibrated", vehicles="finsrov", worlds=5, **keywords):
    """Return worlds with different starts in waves, with working thrusters."""
    keywords = {"water": Water(waves=(Wave(amplitude=0.02, wavelength=3.0),), depth=5.0)} | keywords
    simulator = Simulator(vehicles, worlds=worlds, hydrodynamics=model, **keywords)
    n = len(simulator.vehicles)
    states = random_states(np.random.default_rng(1), worlds * n, speed=0.3, turn=0.3)
    simulator.place(*(x.reshape(worlds, n, -1) for x in states))
    simulator.set_thrust(np.random.default_rng(2).uniform(-4, 4, (worlds, n, 8)))
    return simulator


def spoil(simulator, world, vehicle=0, value=np.nan, where="thrust"):
    """Write a bad number directly into a command, bypassing the check that would refuse it."""
    command = getattr(simulator.command, where).numpy().copy()
    command[world, vehicle, 3] = value
    getattr(simulator.command, where).assign(command)


@pytest.mark.parametrize("where", ["thrust", "disturbance"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@ONE_VEHICLE_PER_MODEL
def test_a_bad_command_freezes_its_world_and_no_other(model, value, where):
    """World 2 stays at its last finite state; the others continue bit-identically to an undisturbed run."""
    free, spoiled = simulation(model), simulation(model)
    for _ in range(3):
        free.step()
        spoiled.step()
    last = {name: spoiled.numpy(name)[2].copy() for name in FIELDS}
    spoil(spoiled, 2, value=value, where=where)
    for _ in range(5):
        free.step()
        spoiled.step()
    assert spoiled.frozen_worlds().tolist() == [2]
    assert free.frozen_worlds().tolist() == []
    for name in FIELDS:
        assert np.array_equal(spoiled.numpy(name)[[0, 1, 3, 4]], free.numpy(name)[[0, 1, 3, 4]])
        assert np.array_equal(spoiled.numpy(name)[2], last[name])


def test_a_state_that_runs_away_freezes_before_it_is_written():
    """A wrench of 1e18 N overflows float32 in a step: the world keeps its last finite state."""
    simulator = simulation(worlds=2)
    spoil(simulator, 1, value=1e18, where="disturbance")
    for _ in range(5):
        simulator.step()
    assert simulator.frozen_worlds().tolist() == [1]
    assert all(np.isfinite(simulator.numpy(name)).all() for name in FIELDS)


def test_a_bad_parameter_freezes_its_world():
    """NaN in plant.mass of one world freezes that world in its first step."""
    simulator = simulation()
    mass = simulator.plant.mass.numpy().copy()
    mass[4] = np.nan
    simulator.plant.mass.assign(mass)
    simulator.refresh()
    simulator.step()
    assert simulator.frozen_worlds().tolist() == [4]


def test_one_vehicle_freezes_the_whole_world_that_holds_it():
    """With two vehicles, the other vehicle of the world stops too, and the other worlds do not."""
    simulator = simulation(vehicles=["finsrov", "finsrov"], worlds=3)
    spoil(simulator, 1, vehicle=1)
    simulator.step()
    assert simulator.frozen_worlds().tolist() == [1]
    at = simulator.numpy("position").copy()
    simulator.step()
    moved = (simulator.numpy("position") != at).any(axis=-1)
    assert moved.tolist() == [[True, True], [False, False], [True, True]]


def rows(path):
    with open(path) as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


@pytest.mark.parametrize("steps", [3, 130])
def test_the_report_holds_the_last_states(tmp_path, steps):
    """Up to 50 rows per vehicle end at the step of the failure; each equals the state after its step."""
    simulator = simulation(vehicles=["finsrov", "finsrov"], worlds=2)
    seen = []
    for _ in range(steps):
        simulator.step()
        seen.append(np.concatenate([simulator.numpy(x)[1] for x in FIELDS[:3]], axis=-1))
    spoil(simulator, 1, vehicle=0)
    simulator.step()
    (path,) = simulator.report_frozen(tmp_path / "reports")
    table = rows(path)
    kept = min(50, steps + 1)
    assert [row["vehicle"] for row in table] == [0.0] * kept + [1.0] * kept
    first = steps + 1 - kept
    for v in (0, 1):
        mine = table[v * kept : (v + 1) * kept]
        assert [row["step"] for row in mine] == list(range(first, steps + 1))
        assert [row["t"] for row in mine] == pytest.approx([0.1 * (k + 1) for k in range(first, steps + 1)])
        states = np.array([[row[name] for name in "x y z qx qy qz qw u v w p q r".split()] for row in mine])
        assert np.array_equal(states[:-1].astype(np.float32), np.array(seen)[first:, v])
    # The vehicle with the bad command did not move in the step of the failure.
    assert list(table[kept - 1].values())[3:] == pytest.approx(seen[-1][0].tolist(), rel=1e-6)


def test_a_state_that_broke_is_the_last_row_of_the_report(tmp_path):
    """If the motion itself overflowed, the last row contains the non-finite number."""
    simulator = simulation(worlds=1)
    simulator.step()
    spoil(simulator, 0, value=1e18, where="disturbance")
    for _ in range(3):
        simulator.step()
    (path,) = simulator.report_frozen(tmp_path)
    table = rows(path)
    assert not all(np.isfinite(list(table[-1].values())))
    assert all(np.isfinite(list(row.values())).all() for row in table[:-1])


def test_each_freeze_is_reported_once_and_a_reset_world_lives_again(tmp_path):
    """A second call reports nothing new; after `place` the world moves, and a new freeze is a new report."""
    simulator = simulation()
    spoil(simulator, 2)
    simulator.step()
    (first,) = simulator.report_frozen(tmp_path)
    assert simulator.report_frozen(tmp_path) == []

    simulator.place(position=(0.0, 0.0, -2.0), velocity=(0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    simulator.set_thrust(np.ones(8))
    simulator.step()
    assert simulator.frozen_worlds().tolist() == []
    assert simulator.numpy("position")[2, 0, 0] > 0.0
    spoil(simulator, 2)
    simulator.step()
    (second,) = simulator.report_frozen(tmp_path)
    assert second != first and second.exists() and first.exists()


def test_a_frozen_world_that_is_reset_alone_lives_again():
    """reset(mask) unfreezes it at its pose; the other worlds keep their clocks."""
    simulator = simulation()
    for _ in range(2):
        simulator.step()
    spoil(simulator, 2)
    simulator.step()
    simulator.set_thrust(np.ones(8))
    simulator.reset([False, False, True, False, False])
    at = simulator.numpy("position").copy()
    simulator.step()
    assert simulator.frozen_worlds().tolist() == []
    assert (simulator.numpy("position")[2] != at[2]).any()
    assert simulator.state.steps.numpy().tolist() == [4, 4, 1, 4, 4]
