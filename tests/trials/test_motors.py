"""Commanded forces through the motors agree with the simulator's actuation and with closed forms."""

import numpy as np
import pytest

from finssim.sim import Simulator
from finssim.trials.inputs import channel_motors, delivered, wrench_motors
from finssim.vehicles import load_vehicle


@pytest.mark.parametrize(
    ("name", "changes", "step"),
    [
        ("finsrov", {}, 0.02),
        ("finsrov", {"thrusters.*.slew": 30.0, "thrusters.*.delay": 0.033}, 0.05),
        ("bluerov2", {}, 0.02),
        ("rexrov", {"thrusters.*.slew": 200.0, "thrusters.*.time_constant": 0.2}, 0.02),
        ("remus100", {}, 0.1),
    ],
)
def test_thrust_agrees_with_the_simulator(name, changes, step):
    """With delay, dead zone, limits, lag and slew, in force and in speed, it equals the engine at every step.

    The engine limits the slew once a substep, which allows an error of one substep's slew; else single precision.
    """
    vehicle = load_vehicle(name).replace(changes).model_copy(update={"actuators": {}})
    n, steps, substeps = len(vehicle.thrusters), 200, 50
    lower, upper = vehicle.force_limits
    rng = np.random.default_rng(1)
    command = np.repeat(rng.uniform(-1.3, 1.3, (steps // 5, n)), 5, axis=0) * np.maximum(-lower, upper)
    command[rng.random((steps, n)) < 0.2] *= 0.01  # into the dead zone
    command[0] = 0.0
    simulator = Simulator(vehicle, control_step=step, substeps=substeps, max_delay=0.2)
    thrust = np.zeros((steps + 1, n))
    for k in range(steps):
        simulator.set_thrust(command[k])
        simulator.step()
        thrust[k + 1] = simulator.numpy("thrust")[0, 0, :n]
    t = step * np.arange(steps + 1)
    ours = delivered(channel_motors(vehicle), t[:-1], command, t)
    scale = np.maximum(-lower, upper)
    slewed = {"thrusters.*.slew"} & set(changes) and vehicle.thrusters[
        vehicle.thruster_names[0]
    ].domain == "speed"
    np.testing.assert_allclose(ours / scale, thrust / scale, atol=2e-3 if slewed else 2e-5)


def test_a_step_of_force_is_an_exponential():
    """T = F (1 - exp(-(t - delay) / time_constant)) after the delay, at times between samples."""
    vehicle = load_vehicle("finsrov")
    motors = channel_motors(vehicle)
    command = np.zeros((3, 8))
    command[1:] = 5.0
    at = np.array([0.0, 1.0, 1.0 + motors.delay[0], 1.1234, 1.5, 9.0])
    thrust = delivered(motors, np.array([0.0, 1.0, 2.0]), command, at)
    since = np.maximum(at - 1.0 - motors.delay[0], 0.0)
    expected = 5.0 * (1.0 - np.exp(-since / motors.time_constant[0]))
    np.testing.assert_allclose(thrust, np.tile(expected[:, None], 8), rtol=1e-12, atol=1e-12)


def test_a_slew_limit_is_a_ramp_and_then_an_exponential():
    """While the remaining step exceeds slew x time_constant, the force rises at the slew rate."""
    vehicle = load_vehicle("finsrov").replace({"thrusters.*.slew": 10.0})
    motors = channel_motors(vehicle)
    command = np.array([[0.0], [7.0]]) * np.ones(8)
    knee = (7.0 - 10.0 * motors.time_constant[0]) / 10.0
    at = 1.0 + motors.delay[0] + np.array([0.0, 0.5 * knee, knee, knee + motors.time_constant[0]])
    thrust = delivered(motors, np.array([0.0, 1.0]), command, at)[:, 0]
    way = 10.0 * motors.time_constant[0]
    np.testing.assert_allclose(
        thrust, [0.0, 5.0 * knee, 7.0 - way, 7.0 - way * np.exp(-1.0)], rtol=1e-9, atol=1e-12
    )


def test_a_commanded_wrench_lags_like_equal_thrusters_do():
    """With equal motors that lag in force, the lagged wrench is the wrench of the lagged thrusts."""
    vehicle = load_vehicle("finsrov")
    rng = np.random.default_rng(3)
    t, at = np.arange(60) * 0.1, np.linspace(0.0, 6.0, 333)
    force = rng.uniform(-3.0, 3.0, (60, 8))
    B = vehicle.thruster_matrix()
    lagged = delivered(channel_motors(vehicle), t, force, at) @ B.T
    np.testing.assert_allclose(delivered(wrench_motors(vehicle), t, force @ B.T, at), lagged, atol=1e-9)
