"""The PID places its poles, holds every published setpoint in nominal and disturbed water, and never winds up."""

import math
from functools import cache

import numpy as np
import pytest

from finssim.agents.controllers import CONTROLLERS, controller
from finssim.agents.pid import Pid, place_poles
from finssim.control import ControlError
from finssim.control.axis_model import AxisModel
from finssim.control.guidance import Goal, tracking_error
from finssim.core.rotations import (
    quat_from_euler,
    quat_from_yaw,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
)
from finssim.vehicles import catalogue, load_vehicle
from reference.holding import T1, at_rest, run, settling_time


@pytest.fixture(scope="module")
def vehicle():
    return load_vehicle("finsrov")


@pytest.fixture(scope="module")
def held(vehicle, pool):
    """40 s of T1 in a plant: errors and memory of `run`, computed once for every plant."""

    @cache
    def run_once(period=0.05, **water):
        return run(Pid.from_vehicle(vehicle, period=period), pool(vehicle, 8, **water), T1, 40.0)

    return run_once


# -- gains ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("m", "d", "k"), [(27.1, 39.1, 0.0), (0.84, 0.3, 0.0), (40.0, 0.5, 0.0), (2.0, 3.0, 1.0)]
)
def test_the_closed_loop_has_the_poles_asked_for(m, d, k):
    """The state matrix of axis, lag and controller (x, v, thrust, integral) has the eigenvalues -w, -w, -w/5 and -b."""
    lag = 0.195
    gains = place_poles(AxisModel(*(np.full(6, value) for value in (m, d, 0.0, k))), lag)
    kp, kd, rate = gains.kp[0], gains.kd[0], gains.rate[0]
    A = np.array(
        [
            [0, 1, 0, 0],
            [-k / m, -d / m, 1 / m, 0],
            [-kp / lag, -kd / lag, -1 / lag, 1 / lag],
            [-rate * (kp + k), -rate * (kd - m * rate + d), 0, 0],
        ]
    )
    total = 1 / lag + d / m
    w = total / 4
    # A double pole varies by the square root of rounding.
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(A)), [-(total - 2.2 * w), -w, -w, -w / 5], atol=1e-5, rtol=1e-5
    )


def test_an_axis_that_water_holds_stiffly_is_left_to_it(vehicle):
    """The vehicle rights itself at 1.2 Hz, faster than its thrusters' 0.17 s: no proportional or derivative moment."""
    pid = Pid.from_vehicle(vehicle)
    np.testing.assert_array_equal(pid.gains.kp[3:5], 0.0)
    np.testing.assert_array_equal(pid.gains.kd[3:5], 0.0)
    assert (pid.gains.kp[[0, 1, 2, 5]] > 0.0).all()


# -- the published task ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("period", "water"),
    [
        (0.05, {}),
        (0.1, {}),
        (0.05, {"current": (0.10, 0.05, 0.0)}),
        (0.05, {"load": 2.0}),
        (0.05, {"load": -2.0}),
    ],
    ids=["20 Hz", "10 Hz", "current 0.11 m/s", "2 N heavier", "2 N lighter"],
)
def test_all_eight_setpoints_are_held(held, period, water):
    """Setpoints are held within 0.10 m and 10 degrees for 10 s from 15 s on, always level; 1 cm and 1 degree
    at the end."""
    log, _ = held(period=period, **water)
    assert (settling_time(log, period) < 15.0).all()
    assert np.abs(log[-1, :, :3]).max() < 0.01 and np.abs(log[-1, :, 3]).max() < math.radians(1.0)
    assert log[..., 4].max() < math.radians(3.0)


@pytest.mark.slow
def test_setpoints_are_reached_without_overshoot(held):
    """In nominal water, no axis passes its goal by more than 5 cm."""
    log, _ = held(period=0.05)
    passed = -log[..., :3] * np.sign(log[0, :, :3])
    far = np.abs(log[0, :, :3]) > 0.05
    assert passed.max(0)[far].max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"hydrodynamics.calibrated.added_mass": np.diag([22.5, 42.8, 35.0, 0.15, 0.15, 0.89]).tolist()},
        {"hydrodynamics.calibrated.added_mass": np.diag([7.5, 14.3, 11.7, 0.05, 0.05, 0.3]).tolist()},
        {"hydrodynamics.calibrated.linear_damping": np.diag([20.0, 26.0, 40.0, 0.5, 0.5, 0.15]).tolist()},
        {"thrusters.*.time_constant": 0.2, "thrusters.*.delay": 0.1},
    ],
    ids=["added mass x1.5", "added mass x0.5", "damping x0.5", "actuators twice as slow"],
)
def test_all_eight_setpoints_are_held_when_the_model_is_wrong(vehicle, pool, changes):
    log, _ = run(Pid.from_vehicle(vehicle), pool(vehicle.replace(changes), 8), T1, 32.0)
    assert (settling_time(log, 0.05) < 20.0).all()


@pytest.mark.slow
def test_all_eight_setpoints_are_held_with_noisy_measurements(vehicle, pool):
    """Setpoints are held with white noise of 2 cm, 2 degrees, 2 cm/s and 2 degrees/s on every sample."""
    rng = np.random.default_rng(0)

    def noise(state):
        tilt = np.radians(2.0) * rng.normal(size=(3, 8))
        quaternion = quat_multiply(state.quaternion, quat_from_euler(*tilt))
        scale = np.array([0.02] * 3 + [math.radians(2.0)] * 3)
        shaken = state.position + 0.02 * rng.normal(size=(8, 3))
        return type(state)(shaken, quaternion, state.nu + scale * rng.normal(size=(8, 6)))

    log, _ = run(Pid.from_vehicle(vehicle), pool(vehicle, 8), T1, 32.0, noise)
    assert (settling_time(log, 0.05) < 20.0).all()


def holds_a_pose(name):
    craft = load_vehicle(name)
    return {"surge", "sway", "heave", "yaw"} <= set(
        craft.controlled_axes
    ) and "calibrated" in craft.hydrodynamics


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in catalogue() if holds_a_pose(name)])
def test_every_vehicle_that_can_hold_a_pose_holds_it(name, pool):
    """From two body lengths away and turned by a radian or two, the vehicle holds the pose within 30 s."""
    craft = load_vehicle(name)
    away = 2.0 * craft.body.size[0] * np.array([[1.0, 0.5, -0.2], [-1.0, 0.3, 0.2]])
    start = np.array([0.0, 0.0, -10.0])
    goal = Goal(start + away, quat_from_yaw([1.0, -2.0]))
    log, _ = run(Pid.from_vehicle(craft), pool(craft, 2, position=start), goal, 30.0)
    assert np.abs(log[-1, :, :3]).max() < 0.02 * craft.body.size[0] and np.abs(log[-1, :, 3]).max() < 0.02


# -- its parts ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_integral_becomes_the_load_it_carries(held):
    """With 2 N added to the weight, the upward integral ends at 2 N and contains nothing else."""
    _, memory = held(period=0.05, load=2.0)
    np.testing.assert_allclose(memory.force, np.tile([0.0, 0.0, 2.0], (8, 1)), atol=0.02)


@pytest.mark.slow
def test_a_long_way_at_full_thrust_does_not_wind_up(vehicle, pool):
    """Over ten metres, 24 s of travel, the integral stays below a tenth of full thrust and the goal is not overshot."""
    pid = Pid.from_vehicle(vehicle)
    goal = Goal(np.array([[10.0, 0.0, -0.5]]), quat_from_yaw([0.0]))
    log, memory = run(pid, pool(vehicle, 1), goal, 60.0)
    assert log[..., 0].max() < 0.02
    assert np.abs(memory.force).max() < 0.1


def test_a_vehicle_that_cannot_move_does_not_wind_up(vehicle):
    """Held fast away from its goal for two minutes, its integral stays at the bound and its command at the limit."""
    pid = Pid.from_vehicle(vehicle)
    memory, held = pid.reset(), at_rest(np.zeros(3), quat_from_yaw(0.0))
    for _ in range(2400):
        tau, memory = pid.command(memory, held, Goal([3.0, 0.0, 0.0], quat_from_yaw(0.0)))
    assert tau[0] == pid.wrench_limits[0]
    assert np.abs(memory.force).max() <= 0.5 * pid.wrench_limits[0]


def test_the_holding_wrench_balances_weight_and_buoyancy(vehicle):
    """At rest at a tilted goal, the command cancels the hydrostatic load, in force and moment."""
    heavy = vehicle.replace({"body.mass": 12.6, "body.center_of_buoyancy": [0.01, -0.004, 0.03]})
    pid = Pid.from_vehicle(heavy)
    q = quat_from_euler(0.1, -0.2, 2.0)
    tau, _ = pid.command(pid.reset(), at_rest(np.ones(3), q), Goal(np.ones(3), q))
    up = quat_inverse_rotate(q, [0.0, 0.0, 1.0])
    reference, body = np.array(heavy.wrench_reference), heavy.body
    loads = [(body.center_of_gravity, -heavy.weight * up), (body.center_of_buoyancy, heavy.buoyancy * up)]
    static = sum(np.concatenate([force, np.cross(np.array(at) - reference, force)]) for at, force in loads)
    np.testing.assert_allclose(tau + static, 0.0, atol=1e-12)


def test_the_command_does_not_depend_on_where_north_is(vehicle):
    """Rotating the whole world about the vertical leaves the body-frame command unchanged, integral included."""
    pid = Pid.from_vehicle(vehicle)
    q, away, goal = quat_from_euler(0.05, 0.1, 0.3), np.array([0.3, -0.2, 0.1]), quat_from_yaw(1.0)
    commands = []
    for turn in (0.0, 1.3, -2.5):
        world = quat_from_yaw(turn)
        memory = pid.reset()._replace(force=quat_rotate(world, [1.0, 2.0, 0.5]))
        measured = at_rest(np.zeros(3), quat_multiply(world, q), 0.1 * np.ones(6))
        commands.append(
            pid.command(memory, measured, Goal(quat_rotate(world, away), quat_multiply(world, goal)))[0]
        )
    np.testing.assert_allclose(commands[1:], [commands[0]] * 2, atol=1e-12)


def test_a_batch_of_n_equals_n_single_controllers(vehicle):
    pid, rng = Pid.from_vehicle(vehicle), np.random.default_rng(0)
    position, nu = rng.normal(size=(8, 3)), 0.1 * rng.normal(size=(8, 6))
    quaternion = quat_from_euler(*(0.2 * rng.normal(size=(3, 8))))
    tau, memory = pid.command(pid.reset(8), at_rest(position, quaternion, nu), T1)
    for i in range(8):
        single = at_rest(position[i], quaternion[i], nu[i])
        tau_i, memory_i = pid.command(pid.reset(), single, Goal(T1.position[i], T1.quaternion[i]))
        np.testing.assert_allclose(tau_i, tau[i], rtol=1e-12)
        np.testing.assert_allclose(memory_i.force, memory.force[i], atol=1e-12)


def test_half_a_turn_to_make_leaves_the_tilt_error_alone(vehicle):
    """Rolled by 0.1 rad and facing backwards, the tilt error is 0.1 rad about the roll axis, the heading error pi."""
    goal = Goal(np.zeros(3), quat_from_yaw(np.pi - 1e-9))
    error = tracking_error(at_rest(np.zeros(3), quat_from_euler(0.1, 0.0, 0.0)), goal, np.zeros(3)).pose
    np.testing.assert_allclose(error[3:5], [-0.1, 0.0], atol=1e-9)
    assert abs(error[5]) == pytest.approx(np.pi, abs=0.01)


def test_axes_without_authority_are_not_commanded():
    """A torpedo with one propeller gets only a surge command, however wrong its attitude is."""
    torpedo = load_vehicle("remus100")
    pid = Pid.from_vehicle(torpedo)
    measured = at_rest(np.zeros(3), quat_from_euler(0.3, 0.2, 1.0), 0.1 * np.ones(6))
    tau, _ = pid.command(pid.reset(), measured, Goal([5.0, 5.0, -5.0], quat_from_yaw(0.0)))
    assert tau[0] != 0.0 and (tau[1:] == 0.0).all()


def test_models_without_coefficients_and_impossible_periods_are_refused(vehicle):
    with pytest.raises(ControlError, match="no damping coefficients"):
        Pid.from_vehicle(vehicle, hydrodynamics="mesh")
    for name in CONTROLLERS:
        with pytest.raises(ControlError, match="period"):
            controller(name, vehicle, period=0.0)
    with pytest.raises(ControlError, match="available: pid, pid-paper"):
        controller("lqg", vehicle)
