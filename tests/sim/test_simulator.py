"""Interface of the simulator: inputs, outputs, and messages for invalid ones."""

import re

import numpy as np
import pytest
import torch
import warp as wp

from finssim.sim import RectangularPool, Simulator, SimulatorError
from finssim.vehicles import VehicleError
from reference.cases import EVERY_VEHICLE_AND_MODEL, ONE_VEHICLE_PER_MODEL, disturb, load, random_states

FIELDS = ("position", "quaternion", "velocity", "acceleration", "thrust")


@EVERY_VEHICLE_AND_MODEL
def test_every_vehicle_moves_in_every_model_it_has(name, model):
    """With all actuators at their limits for a second in open water, it moves, and the state is finite."""
    simulator = Simulator(name, hydrodynamics=model)
    simulator.set_actuators(load(name).channel_limits[1])
    for _ in range(10):
        simulator.step()
    assert simulator.frozen_worlds().tolist() == []
    assert np.abs(simulator.numpy("velocity")).max() > 0.01


@ONE_VEHICLE_PER_MODEL
def test_vehicles_of_one_world_move_as_they_would_alone(model):
    """Two kinds of vehicle in one world and one water each move bit-identically to a world of their own."""
    names = ["finsrov", "bluerov2_heavy_morgan"] if model != "simplified" else ["finsrov", "finsrov_sim7"]
    states = random_states(np.random.default_rng(1), 2, speed=0.3)
    thrust = np.random.default_rng(2).uniform(-3, 3, (2, 8))

    def run(vehicles, which):
        simulator = Simulator(vehicles, hydrodynamics=model)
        simulator.place(*(x[None, which] for x in states))
        simulator.set_thrust(thrust[which])
        for _ in range(10):
            simulator.step()
        return [simulator.numpy(name)[0].copy() for name in FIELDS]

    water = {"water.density": 1000.0, "water.gravity": 9.81}
    vehicles = [load(n).replace(water) for n in names]
    together = run(vehicles, [0, 1])
    for v, vehicle in enumerate(vehicles):
        alone = run([vehicle], [v])
        for a, b in zip(together, alone, strict=True):
            assert np.array_equal(a[v], b[0])


def test_numpy_and_torch_see_the_simulators_own_memory():
    """On a CPU, a view shows the next step, and values written to it take effect; nothing is copied."""
    simulator = Simulator("finsrov", worlds=3, substeps=2)
    for name in FIELDS:
        array, tensor = simulator.numpy(name), simulator.torch(name)
        assert array.__array_interface__["data"][0] == tensor.data_ptr() == getattr(simulator.state, name).ptr
        assert tuple(tensor.shape) == array.shape and tensor.dtype == torch.float32
    view = simulator.numpy("velocity")
    disturb(simulator, [10.0, 0, 0, 0, 0, 0])
    simulator.step()
    assert (view[:, 0, 0] > 0.0).all()
    simulator.torch("velocity")[1, 0, 1] = 0.75
    assert view[1, 0, 1] == np.float32(0.75)
    before = simulator.numpy("position")[:, 0, 1].copy()
    simulator.step()
    assert (np.abs(simulator.numpy("position")[:, 0, 1] - before) > 0.03).tolist() == [False, True, False]


def test_a_reset_by_mask_restarts_the_motors_and_clocks_of_its_worlds_only():
    """Thrust, delay line and clock of the masked worlds are those of a new simulation; pose and velocity stay."""
    simulator = Simulator("finsrov", worlds=4)
    simulator.set_thrust(np.full(8, 2.0))
    for _ in range(4):
        simulator.step()
    before = {name: simulator.numpy(name).copy() for name in FIELDS}
    simulator.reset([False, True, False, True])
    for name in ("position", "quaternion", "velocity"):
        assert np.array_equal(simulator.numpy(name), before[name])
    for name in ("acceleration", "thrust"):
        assert np.array_equal(simulator.numpy(name)[[0, 2]], before[name][[0, 2]])
        assert not simulator.numpy(name)[[1, 3]].any()
    assert simulator.state.steps.numpy().tolist() == [4, 0, 4, 0]
    # The delay line is empty: 0.05 s of zero thrust, then 0.05 s of lag from zero.
    simulator.step()
    fresh = Simulator("finsrov")
    fresh.set_thrust(np.full(8, 2.0))
    fresh.step()
    assert simulator.numpy("thrust")[1, 0] == pytest.approx(fresh.numpy("thrust")[0, 0], abs=1e-7)


@pytest.mark.parametrize(
    ("field", "factor"),
    [
        ("mass", 1.1),
        ("volume", 1.1),
        ("M_A", 2.0),
        ("D1", 3.0),
        ("D2", 3.0),
        ("B", 0.5),
        ("time_constant", 2.0),
    ],
)
def test_a_parameter_acts_on_its_world_alone(field, factor):
    """The world with the changed parameter moves as with it everywhere, the others as before."""

    def run(change):
        simulator = Simulator("finsrov", worlds=4)
        simulator.place((0.0, 0.0, -2.0), velocity=(0.3, 0.1, 0.2, 0.1, 0.1, 0.1))
        array = getattr(simulator.plant, field)
        values = array.numpy().copy()
        values[change] *= factor
        array.assign(values)
        simulator.refresh()
        simulator.set_thrust(np.full(8, 1.5))
        for _ in range(5):
            simulator.step()
        return simulator.numpy("velocity").copy()

    nowhere, there, everywhere = run([]), run([2]), run([0, 1, 2, 3])
    assert np.array_equal(there[[0, 1, 3]], nowhere[[0, 1, 3]])
    assert np.array_equal(there[2], everywhere[2])
    assert (there[2] != nowhere[2]).any()


def test_placing_restarts_the_same_run():
    """place, run, place, run gives the same bits twice, in water without random parts."""
    simulator = Simulator("finsrov", worlds=2)
    results = []
    for _ in range(2):
        simulator.place((0.1, 0.0, -1.0), (0.0, 0.0, 0.6, 0.8), (0.1, 0.0, 0.0, 0.0, 0.0, 0.2))
        simulator.set_thrust(np.linspace(-2, 2, 8))
        for _ in range(5):
            simulator.step()
        results.append([simulator.numpy(name).copy() for name in FIELDS])
    assert all(np.array_equal(a, b) for a, b in zip(*results, strict=True))


def test_a_step_that_changes_on_the_way_goes_on_with_the_motion():
    """Half a second in steps of 10 ms and half in 5 ms end like a second of 5 ms; clocks continue."""
    simulators = [Simulator("bluerov2_heavy", control_step=h, substeps=1) for h in (0.01, 0.005)]
    for simulator, steps in zip(simulators, (50, 200), strict=True):
        simulator.place((0.0, 0.0, -5.0), velocity=(0.8, 0.3, -0.2, 0.2, 0.1, 0.5))
        for _ in range(steps):
            simulator.step()
    simulators[0].set_control_step(0.005, 1, 0.5)
    for _ in range(100):
        simulators[0].step()
    assert [int(s.numpy("steps")[0]) for s in simulators] == [200, 200]
    for name in ("position", "velocity"):
        np.testing.assert_allclose(*(s.numpy(name) for s in simulators), atol=5e-4)


def test_a_quaternion_is_made_of_unit_length():
    """(0, 0, 3, 4) is the rotation of (0, 0, 0.6, 0.8)."""
    simulator = Simulator("finsrov")
    simulator.place(quaternion=(0.0, 0.0, 3.0, 4.0))
    assert simulator.numpy("quaternion")[0, 0] == pytest.approx([0.0, 0.0, 0.6, 0.8], abs=1e-7)


def test_a_new_simulator_has_its_vehicles_in_the_water_at_rest():
    """Vehicles are level, at rest, in the middle of the pool's depth."""
    simulator = Simulator("finsrov", worlds=2, pool=RectangularPool(depth=3.0))
    assert simulator.numpy("position")[0, 0].tolist() == [0.0, 0.0, -1.5]
    assert not simulator.numpy("velocity").any()


REFUSED = [
    (
        {"hydrodynamics": "fosen"},
        "unknown hydrodynamic model 'fosen'; available: calibrated, mesh, simplified",
    ),
    ({"hydrodynamics": "simplifed"}, "did you mean 'simplified'?"),
    ({"integrator": "rk45"}, "unknown integrator 'rk45'; available: midpoint, rk4; did you mean 'rk4'?"),
    ({"worlds": 0}, "worlds is 0, expected at least 1"),
    ({"substeps": 0}, "substeps is 0, expected at least 1"),
    ({"control_step": 0.0}, "control_step is 0.0 s, expected a finite time above 0 s"),
    ({"control_step": float("nan")}, "control_step is nan s, expected a finite time above 0 s"),
    ({"device": "tpu"}, "device 'tpu' is not available here; available: cpu"),
]


def test_an_unknown_field_of_the_state_is_refused_by_name():
    simulator = Simulator("finsrov")
    with pytest.raises(SimulatorError, match="unknown field of the state 'positon'.*did you mean 'position'"):
        simulator.numpy("positon")


@pytest.mark.parametrize(("arguments", "sentence"), REFUSED)
def test_a_simulator_that_cannot_be_is_refused_in_one_sentence(arguments, sentence):
    """The error names the given value and the available ones."""
    with pytest.raises(SimulatorError, match=re.escape(sentence)):
        Simulator("finsrov", **arguments)


def test_a_vehicle_without_the_model_or_without_a_file_is_refused():
    """LAUV has no hull, no vehicle is called 'finsrow', and no vehicle at all is refused."""
    with pytest.raises(
        (SimulatorError, VehicleError), match=r"no hydrodynamics 'simplified'; its file gives: calibrated"
    ):
        Simulator("lauv", hydrodynamics="simplified")
    with pytest.raises((SimulatorError, VehicleError), match="lauv"):
        Simulator("lauv", hydrodynamics="mesh")
    with pytest.raises(VehicleError, match="finsrow"):
        Simulator("finsrow")
    with pytest.raises(SimulatorError, match="vehicles is 0, expected at least 1"):
        Simulator([])


@pytest.mark.skipif(wp.is_cuda_available(), reason="this machine has CUDA")
def test_cuda_is_refused_where_there_is_none():
    """The message lists the available devices."""
    with pytest.raises(SimulatorError, match="device 'cuda' is not available here; available: cpu"):
        Simulator("finsrov", device="cuda")


@pytest.mark.parametrize(
    ("force", "sentence"),
    [
        (np.zeros(7), "thrust command has 7 numbers, expected 8: one per thruster"),
        (1.0, "thrust command has 0 numbers, expected 8: one per thruster"),
        (
            [np.nan] * 8,
            "thrust command has a number that is not finite: send a force in N for every thruster",
        ),
        (
            np.zeros((3, 1, 8)),
            "thrust command has shape (3, 1, 8), expected (worlds, vehicles, numbers) = (2, 1, 8)",
        ),
    ],
)
def test_a_bad_thrust_command_is_refused_and_changes_nothing(force, sentence):
    """The message names wrong length, wrong shape or NaN, and the last command remains in effect."""
    simulator = Simulator("finsrov", worlds=2)
    simulator.set_thrust(np.ones(8))
    with pytest.raises(SimulatorError, match=re.escape(sentence)):
        simulator.set_thrust(force)
    assert (simulator.command.thrust.numpy() == 1.0).all()


@pytest.mark.parametrize(
    ("start", "sentence"),
    [
        ({"position": (0.0, np.nan, 0.0)}, "position to place a vehicle at has a number that is not finite"),
        ({"velocity": [np.inf] * 6}, "velocity to place a vehicle at has a number that is not finite"),
        (
            {"quaternion": (0.0, 0.0, 0.0, 0.0)},
            "quaternion to place a vehicle at has length 0, expected 1 (xyzw)",
        ),
        (
            {"position": (0.0, 0.0)},
            "position has shape (2,), expected (worlds, vehicles, numbers) = (2, 1, 3)",
        ),
        ({"velocity": np.zeros((5, 1, 6))}, "velocity has shape (5, 1, 6), expected"),
    ],
)
def test_a_bad_place_is_refused(start, sentence):
    """NaN, an invalid attitude and a wrong shape are refused."""
    simulator = Simulator("finsrov", worlds=2)
    with pytest.raises(SimulatorError, match=re.escape(sentence)):
        simulator.place(**start)
