"""From command to thrust in the engine: delay, dead zone, lag, slew limit and curve."""

import numpy as np
import pytest

from finssim.sim import Simulator, SimulatorError
from reference.cases import load, weightless

STEP = 0.1


def motors(name="finsrov", **changes):
    """Return a vehicle with thrusters without dead zone and slew limit; given numbers apply to all thrusters."""
    plain = {"dead_rpm_minus": 0.0, "dead_rpm_plus": 0.0, "slew": 1e6} | changes
    return load(name).replace({f"thrusters.*.{key}": value for key, value in plain.items()})


def thrusts(vehicle, commands, substeps=10, **keywords):
    """Return the thrust of every thruster (steps, n) after each control step, each with its own command
    (steps, n)."""
    simulator = Simulator(vehicle, control_step=STEP, substeps=substeps, **keywords)
    simulator.place(position=(0.0, 0.0, -100.0))
    rows = []
    for command in commands:
        simulator.set_thrust(command)
        simulator.step()
        rows.append(simulator.numpy("thrust")[0, 0, : len(vehicle.thrusters)].astype(float))
    return np.array(rows)


def exact_lag(commands, delay, tau):
    """Return the exact response of tau dx/dt = u(t - delay) - x at the ends of the control steps, with u held
    between."""
    ends = STEP * np.arange(1, len(commands) + 1)
    steps = np.diff(commands, axis=0, prepend=0.0)
    response = np.zeros_like(commands)
    for i, change in enumerate(steps):
        since = ends - (i * STEP + delay)
        response += np.where(since > 0.0, -np.expm1(-np.maximum(since, 0.0) / tau), 0.0)[:, None] * change
    return response


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.1, 0.23])
@pytest.mark.parametrize("integrator", ["midpoint", "rk4"])
def test_a_delayed_lag_is_exact_when_the_delay_fits_the_substeps(delay, integrator):
    """Sums of F (1 - exp(-(t - delay)/T)) over 30 random commands match to float32; delays of 0 to 23
    substeps."""
    vehicle = motors(time_constant=0.12, delay=delay)
    lower, upper = vehicle.force_limits
    commands = np.random.default_rng(1).uniform(lower, upper, (30, 8))
    expected = exact_lag(commands.astype(np.float32).astype(float), delay, 0.12)
    assert thrusts(vehicle, commands, integrator=integrator) == pytest.approx(
        expected, abs=3e-6 * upper.max()
    )


@pytest.mark.parametrize("substeps", [2, 5, 20])
def test_a_delay_inside_a_substep_is_met_to_second_order(substeps):
    """A command that arrives within a substep acts as its mean over it: the error is at most F (h/T)²/8 each
    time."""
    vehicle = motors(time_constant=0.12, delay=0.0337)
    lower, upper = vehicle.force_limits
    commands = np.random.default_rng(2).uniform(lower, upper, (30, 8))
    bound = (STEP / substeps / 0.12) ** 2 / 8.0 * (upper - lower) / (1.0 - np.exp(-STEP / 0.12))
    error = np.abs(thrusts(vehicle, commands, substeps) - exact_lag(commands, 0.0337, 0.12))
    assert (error < bound + 1e-5).all()


def test_forces_change_no_faster_than_the_slew_limit():
    """From rest towards 5.5 N at 20 N/s, thrust grows by 2 N each 0.1 s, until the lag alone is slower."""
    vehicle = motors(time_constant=0.02, delay=0.0, slew=20.0)
    found = thrusts(vehicle, np.full((10, 8), 5.5))
    assert found[:2] == pytest.approx(np.array([[2.0], [4.0]]) * np.ones(8), abs=1e-5)
    assert (np.diff(found, axis=0) <= 2.0 + 1e-5).all()
    assert found[-1] == pytest.approx(np.full(8, 5.5), abs=1e-4)


def test_small_commands_are_dead_and_large_ones_saturate():
    """After 15 time constants, thrust is zero below that of the slowest speed, and at the limit beyond the range.

    WarpAUV's motors lag in speed and have a dead zone.
    """
    vehicle = load("warpauv")
    lower, upper = vehicle.force_limits
    thrusters = list(vehicle.thrusters.values())
    dead = np.array([t.c_plus * (t.dead_rpm_plus * np.pi / 30.0) ** 2 for t in thrusters])
    dead_reverse = np.array([-t.c_minus * (t.dead_rpm_minus * np.pi / 30.0) ** 2 for t in thrusters])
    cases = [
        (0.99 * dead, 0.0 * dead),
        (1.01 * dead, 1.01 * dead),
        (0.99 * dead_reverse, 0.0 * dead),
        (1.01 * dead_reverse, 1.01 * dead_reverse),
        (2.0 * upper, upper),
        (2.0 * lower, lower),
    ]
    for command, expected in cases:
        found = thrusts(vehicle, np.tile(command, (8, 1)), hydrodynamics="simplified")[-1]
        assert found == pytest.approx(expected, abs=1e-5 * upper.max())


@pytest.mark.parametrize("name", ["lauv", "warpauv", "rexrov"])
def test_a_speed_lag_acts_on_the_propeller(name):
    """domain: speed - ω follows exactly and thrust is c± ω|ω|: when ω has completed a fraction a, T has
    completed a²."""
    vehicle = motors(name, time_constant=0.15, delay=0.1)
    n = len(vehicle.thrusters)
    lower, upper = vehicle.force_limits
    rng = np.random.default_rng(3)
    commands = rng.uniform(0.9 * lower, 0.9 * upper, (20, n))
    c = [(t.c_plus, t.c_minus) for t in vehicle.thrusters.values()]
    speed = np.sign(commands) * np.sqrt(np.abs(commands) / np.where(commands > 0, *np.array(c).T))
    omega = exact_lag(speed, 0.1, 0.15)
    expected = np.where(omega > 0, *np.array(c).T) * omega * np.abs(omega)
    model = sorted(vehicle.hydrodynamics)[0]
    found = thrusts(vehicle, commands, hydrodynamics=model)
    assert found == pytest.approx(expected, abs=1e-5 * upper.max())


def test_a_gain_scales_what_is_delivered_and_zero_is_a_dead_thruster():
    """plant.gain by world and thruster gives half, none, and one and a half of the nominal thrust."""
    vehicle = motors(time_constant=0.02, delay=0.0)
    simulator = Simulator(vehicle, worlds=2, control_step=STEP, substeps=10)
    gain = np.ones((2, 1, 8), np.float32)
    gain[1, 0, :3] = [0.5, 0.0, 1.5]
    simulator.plant.gain.assign(gain)
    simulator.refresh()
    simulator.set_thrust(np.full(8, 2.0))
    for _ in range(10):
        simulator.step()
    assert simulator.numpy("thrust")[:, 0] == pytest.approx(2.0 * gain[:, 0], abs=1e-5)


@pytest.mark.parametrize("substeps", [1, 4])
def test_the_mean_thrust_of_a_step_is_exact(substeps):
    """From rest M nu = B ∫ F (1 - exp(-t/T)) dt for any step, for motors faster and slower than it.

    For a motor that only slews, at 0.1 N/s from 0, it is ∫ 0.1 t dt. Rotation and damping by 0.02 N in 0.1 s are 1e-4
    of it.
    """
    vehicle = weightless(load("finsrov").replace({"water.gravity": 1e-6}), "simplified")
    chosen = int(np.argmax(np.abs(vehicle.thruster_matrix()[0])))
    for T, slew, delivered in (
        (0.01, 1e6, lambda t: 0.02 * (t + 0.01 * np.expm1(-t / 0.01))),
        (0.4, 1e6, lambda t: 0.02 * (t + 0.4 * np.expm1(-t / 0.4))),
        (1e-6, 0.1, lambda t: 0.05 * np.minimum(t, 0.2) ** 2),
    ):
        plain = {"dead_rpm_minus": 0.0, "dead_rpm_plus": 0.0, "delay": 0.0, "time_constant": T, "slew": slew}
        driven = vehicle.replace({f"thrusters.*.{key}": value for key, value in plain.items()})
        simulator = Simulator(driven, hydrodynamics="simplified", control_step=0.1, substeps=substeps)
        simulator.place(position=(0.0, 0.0, -10.0))
        force = np.zeros(8)
        force[chosen] = 0.02
        simulator.set_thrust(force)
        simulator.step()
        impulse = simulator.numpy("velocity")[0, 0].astype(float) @ driven.rigid_body_mass_matrix()[0]
        assert impulse == pytest.approx(vehicle.thruster_matrix()[0, chosen] * delivered(0.1), rel=1e-3)


def test_thrust_reaches_the_body_through_the_thruster_matrix():
    """From rest, in a step of 0.1 µs, M nu_dot = B f with each thruster alone and its motor without lag."""
    vehicle = motors(time_constant=1e-9, delay=0.0, slew=1e12).replace(
        {"water.gravity": 1e-6}  # no weight, no buoyancy: only thrust
    )
    force = 2.0 * np.eye(8)
    simulator = Simulator(vehicle, worlds=8, control_step=1e-7, substeps=1)
    simulator.place(position=(0.0, 0.0, -10.0))
    simulator.set_thrust(force[:, None])
    simulator.step()
    expected = force @ (np.linalg.inv(vehicle.mass_matrix()) @ vehicle.thruster_matrix()).T
    assert simulator.numpy("acceleration")[:, 0] == pytest.approx(expected, abs=1e-5)


def test_a_delay_beyond_the_line_is_refused_with_the_argument_to_give():
    """The delay line is as long as twice the vehicles' delay, or max_delay."""
    simulator = Simulator(motors(delay=0.05), control_step=STEP)
    simulator.plant.delay.fill_(0.35)
    with pytest.raises(SimulatorError, match="exceeds the delay line; give max_delay=0.35"):
        simulator.refresh()
    longer = Simulator(motors(delay=0.05), control_step=STEP, max_delay=0.35)
    longer.plant.delay.fill_(0.35)
    longer.refresh()
