"""The suite: equal seeds give equal bits however the worlds are batched; vehicles and worlds stay apart."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from finssim.sim import Simulator
from finssim.sim.sensors import SensorError, SensorSuite
from finssim.vehicles import catalogue, load_vehicle


def record(
    suite: SensorSuite, state: Any, steps: int = 12, slices: int = 1, threads: int = 1
) -> dict[str, np.ndarray]:
    """All readings after each step, (steps, W, V, ...), with a reset of every third world halfway."""
    edges = np.linspace(0, suite.worlds, slices + 1).astype(int)
    parts = [suite.launches(state, a, b - a) for a, b in zip(edges[:-1], edges[1:], strict=True) if b > a]
    suite.reset(state)
    log: list[dict[str, np.ndarray]] = []
    with ThreadPoolExecutor(threads) as pool:
        for k in range(steps):
            state.advance()
            if k == steps // 2:
                mask = state.steps.__class__((np.arange(suite.worlds) % 3 == 0).astype(np.int32))
                state.steps.numpy()[::3] = 0
                state.episode.numpy()[::3] += 1
                suite.reset(state, mask)
            list(pool.map(lambda part: [launch.launch() for launch in part], parts))
            log.append(
                {f"{b.kind}.{name}": value for b in suite.batches for name, value in b.numpy().items()}
            )
    return {name: np.stack([entry[name] for entry in log]) for name in log[0]}


def suite_of(vehicles: Any, worlds: int, **options: Any) -> SensorSuite:
    """A suite whose samples also get lost, at a step that no rate divides."""
    suite = SensorSuite(vehicles, worlds=worlds, control_step=0.03, **options)
    for batch in suite.batches:
        batch.set(dropout=0.3)
    return suite


@pytest.mark.parametrize(("slices", "threads"), [(1, 1), (2, 2), (5, 3), (23, 4)])
def test_slices_and_threads_do_not_change_a_bit(slices: int, threads: int, vehicle: Any, rest: Any) -> None:
    """Recorded launches over any partition of the worlds, run by any threads, give the readings of one update."""
    whole = record(suite_of(vehicle, 23), rest(23))
    parts = record(suite_of(vehicle, 23), rest(23), slices=slices, threads=threads)
    for name in whole:
        np.testing.assert_array_equal(parts[name], whole[name], err_msg=name)


@pytest.mark.parametrize("worlds", [1, 4, 100])
def test_a_world_does_not_depend_on_how_many_there_are(worlds: int, vehicle: Any, rest: Any) -> None:
    """World k reads the same among 1, 4 or 100."""
    few, many = record(suite_of(vehicle, 4), rest(4)), record(suite_of(vehicle, worlds), rest(worlds))
    n = min(4, worlds)
    for name in few:
        np.testing.assert_array_equal(many[name][:, :n], few[name][:, :n], err_msg=name)


def test_a_vehicle_does_not_depend_on_its_companions(vehicle: Any, rest: Any) -> None:
    """Vehicle 0 reads the same alone and in a team."""
    alone = record(suite_of(vehicle, 3), rest(3))
    team = record(suite_of([vehicle, load_vehicle("finsrov"), vehicle], 3), rest(3, 3))
    for name in alone:
        np.testing.assert_array_equal(team[name][:, :, :1], alone[name], err_msg=name)
    assert not np.array_equal(team["imu.gyro"][:, :, 0], team["imu.gyro"][:, :, 2])


def test_seeds_and_episodes_differ(vehicle: Any, rest: Any) -> None:
    """Another seed, another episode: other turn-on biases and other noise. The same again: the same."""
    biases = []
    for seed, episode in ((0, 0), (0, 1), (1, 0), (0, 0)):
        suite = SensorSuite(vehicle, worlds=4, control_step=0.1, seed=seed)
        suite.reset(rest(4).put(episode=episode))
        biases.append(suite.imu.gyro_bias.numpy().copy())
    np.testing.assert_array_equal(biases[0], biases[3])
    assert len(np.unique(np.stack(biases[:3]))) == 3 * biases[0].size


def test_a_reset_leaves_other_worlds_alone(vehicle: Any, rest: Any) -> None:
    """Masked worlds draw new turn-on errors, the others keep theirs and their readings."""
    suite, state = SensorSuite(vehicle, worlds=4, control_step=0.1), rest(4)
    suite.reset(state)
    before = suite.imu.gyro_bias.numpy().copy()
    readings = suite.imu.numpy()
    state.episode.numpy()[[1, 3]] += 1
    suite.reset(state, state.steps.__class__([0, 1, 0, 1], dtype=int))
    changed = (suite.imu.gyro_bias.numpy() != before).all(axis=(1, 2))
    assert changed.tolist() == [False, True, False, True]
    np.testing.assert_array_equal(suite.imu.numpy()["gyro"][::2], readings["gyro"][::2])


@pytest.mark.parametrize("name", catalogue())
def test_every_vehicle_of_the_catalogue_reads_what_its_file_lists(name: str, rest: Any) -> None:
    """A sensor is there exactly if the file lists it, and its first reading is there after a reset."""
    vehicle = load_vehicle(name)
    suite = SensorSuite(vehicle, worlds=2, control_step=0.1)
    suite.reset(rest(2))
    for kind in ("imu", "depth", "dvl"):
        listed = getattr(vehicle.sensors, kind) is not None
        assert (getattr(suite, kind) is not None) == listed
        if listed:
            assert getattr(suite, kind).fresh.numpy().all()


def test_a_vehicle_without_the_sensor_reads_nothing(vehicle: Any, rest: Any) -> None:
    """In a mixed team the column of a vehicle without a DVL stays zero, never fresh, stamp -1."""
    suite, state = SensorSuite([load_vehicle("finsrov"), vehicle], worlds=2, control_step=0.2), rest(2, 2)
    state.put(velocity=[1.0, 0, 0, 0, 0, 0])
    suite.reset(state)
    assert suite.dvl.fresh.numpy().tolist() == [[False, True]] * 2
    assert suite.dvl.stamp.numpy().tolist() == [[-1.0, 0.0]] * 2
    assert not suite.dvl.velocity.numpy()[:, 0].any()


def test_worlds_may_have_sensors_that_differ(vehicle: Any, rest: Any) -> None:
    """`set` broadcasts over worlds and vehicles: here the port of world 1 hangs half a metre lower."""
    suite = SensorSuite(vehicle, worlds=2, control_step=0.1)
    suite.depth.set(position=[[[0, 0, 0]], [[0, 0, -0.5]]], noise_std=0.0, bias_initial=0.0, quantisation=0.0)
    suite.reset(rest(2).put(position=[0.0, 0.0, -1.0]))
    np.testing.assert_allclose(suite.depth.depth.numpy().ravel(), [1.0, 1.5])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"worlds": 0}, "worlds is 0, expected at least 1"),
        ({"control_step": 0.0}, "control_step is 0.0, expected a positive time"),
        ({"seed": -1}, "seed is -1, expected 0 to 2147483647"),
    ],
)
def test_a_bad_number_is_refused(options: dict[str, Any], message: str, vehicle: Any) -> None:
    """The message names it and says what is expected."""
    with pytest.raises(SensorError, match=message):
        SensorSuite(vehicle, **{"worlds": 1, "control_step": 0.1, **options})


def test_an_unknown_parameter_is_refused(vehicle: Any) -> None:
    """The message lists the ones there are."""
    suite = SensorSuite(vehicle, worlds=1, control_step=0.1)
    with pytest.raises(SensorError, match="no depth parameter 'nois'; available: position, orientation, "):
        suite.depth.set(nois=1.0)


def test_stages_in_the_simulators_pipeline_give_what_update_gives() -> None:
    """Recorded behind the physics, over slices and threads, the sensors read what they read when called."""
    readings = []
    for recorded in (False, True):
        simulator = Simulator("finsrov", worlds=200, threads=2, control_step=0.05)
        suite = SensorSuite(simulator.vehicles, worlds=200, control_step=0.05)
        suite.reset(simulator.state)
        pipeline = simulator.pipeline()
        simulator.add_step(pipeline)
        for kernel, inputs in suite.update_stages(simulator.state) if recorded else []:
            pipeline.add(kernel, inputs, vehicles=1)
        for _ in range(5):
            pipeline.run()
            if not recorded:
                suite.update(simulator.state)
        readings.append({**suite.imu.numpy(), **suite.depth.numpy()})
    for name in readings[0]:
        np.testing.assert_array_equal(readings[1][name], readings[0][name], err_msg=name)
