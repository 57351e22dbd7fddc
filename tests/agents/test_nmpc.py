"""NMPC's prediction agrees with an independent simulation, keeps thruster limits, and rejects disturbances."""

import numpy as np
import pytest

from finssim.agents.controllers import controller
from finssim.cli.doctor import EXTRA_OF_MODULE
from finssim.control import ControlError
from finssim.control.guidance import Goal
from finssim.core.rotations import quat_from_yaw
from finssim.vehicles import load_vehicle
from reference.holding import T1, at_rest, run, settling_time

pytest.importorskip("casadi", reason="finssim[mpc] is not installed")


@pytest.fixture(scope="module")
def vehicle():
    return load_vehicle("finsrov")


@pytest.fixture(scope="module")
def nmpc(vehicle):
    return controller("nmpc", vehicle)


def setpoint(i):
    return Goal(T1.position[i : i + 1], T1.quaternion[i : i + 1])


@pytest.mark.slow
def test_it_predicts_as_the_independent_simulation_moves(vehicle, nmpc, pool):
    """After a second of random thrusts from a tilted, turning start, prediction and simulation agree to the midpoint
    step's error: 2 mm, 0.4 degrees, 5 mm/s."""
    rng = np.random.default_rng(5)
    plant = pool(vehicle, 1)
    plant.delay, plant.queue = 0, []
    lag = next(iter(vehicle.thrusters.values())).time_constant
    plant.nu[:] = [0.2, -0.1, 0.05, 0.1, -0.1, 0.3]
    state = np.concatenate(
        [plant.measured.position[0], plant.measured.quaternion[0], plant.measured.nu[0], np.zeros(8)]
    )
    for _ in range(10):
        thrust = rng.uniform(-4.0, 4.0, (1, 8))
        plant.advance(thrust, nmpc.period)
        state = np.asarray(nmpc.advance(state, thrust[0], np.zeros(6))).ravel()
    assert lag > 0.0
    np.testing.assert_allclose(state[:3], plant.measured.position[0], atol=2e-3)
    np.testing.assert_allclose(state[3:7], plant.measured.quaternion[0], atol=3.5e-3)
    np.testing.assert_allclose(state[7:10], plant.measured.nu[0, :3], atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("i", "water"),
    [(1, {}), (6, {"current": (0.10, 0.05, 0.0), "load": 1.0})],
    ids=["still", "current and 1 N heavier"],
)
def test_a_setpoint_is_held(vehicle, nmpc, pool, i, water):
    """The setpoint is held within 0.10 m and 10 degrees for 10 s, started within 8 s; 1 cm at the end although the
    model has no current."""
    log, _ = run(nmpc, pool(vehicle, 1, **water), setpoint(i), 18.0)
    assert settling_time(log, nmpc.period)[0] < 8.0
    assert np.abs(log[-1, :, :3]).max() < 0.01


def test_a_far_goal_is_approached_with_a_thruster_at_its_limit(vehicle, nmpc):
    """The planned thrusts are within their own limits and one is at its limit; no wrench is limited axis by axis."""
    goal = Goal(np.array([6.0, 0.0, -0.5]), quat_from_yaw(0.0))
    _, memory = nmpc.command(nmpc.reset(), at_rest(np.array([0.0, 0.0, -0.5]), quat_from_yaw(0.0)), goal)
    thrusts = np.reshape(memory.plan[:-21], (-1, 29))[:, 21:]
    lower, upper = vehicle.force_limits
    assert (thrusts >= lower - 1e-3).all() and (thrusts <= upper + 1e-3).all()
    assert min(np.min(upper - thrusts), np.min(thrusts - lower)) < 0.1


def test_the_sign_of_the_quaternion_makes_no_difference(nmpc):
    """q and -q are the same attitude: a filter or a motion capture may switch between them at any time."""
    goal, q = Goal(np.array([0.3, 0.0, -0.5]), quat_from_yaw(0.5)), quat_from_yaw(2.9)
    place = np.array([0.0, 0.0, -0.5])
    _, memory = nmpc.command(nmpc.reset(), at_rest(place, q), goal)
    (one, after), (other, after_other) = (
        nmpc.command(memory, at_rest(place, s * q), goal) for s in (1.0, -1.0)
    )
    np.testing.assert_allclose(other, one, rtol=1e-9)
    np.testing.assert_allclose(after_other.plan, after.plan, rtol=1e-9, atol=1e-12)


def test_commands_under_way_are_reckoned_with(pool):
    """A vehicle whose thrusters act 0.3 s late has three commands pending, and is held all the same."""
    plain = load_vehicle("finsrov")
    late = plain.replace({f"thrusters.{name}.delay": 0.3 for name in plain.thruster_names})
    nmpc = controller("nmpc", late)
    assert nmpc.delays == 3
    start = at_rest(np.array([0.0, 0.0, -0.5]), quat_from_yaw(0.0))
    tau, memory = nmpc.command(nmpc.reset(), start, Goal(np.array([0.2, 0.0, -0.5]), quat_from_yaw(0.0)))
    assert memory.queue.shape == (3, 8) and not memory.queue[:2].any()
    np.testing.assert_allclose(late.control_matrix @ memory.queue[2], tau, atol=1e-9)


def test_the_unknown_wrench_is_what_the_prediction_lacks(nmpc):
    """0.01 m/s more along x than predicted in a period gives the mass times that, by the observer's share of
    a period."""
    rest = at_rest(np.array([0.0, 0.0, -0.5]), quat_from_yaw(0.0))
    goal = Goal(rest.position, rest.quaternion)
    _, memory = nmpc.command(nmpc.reset(), rest, goal)
    moved = at_rest(rest.position, rest.quaternion, memory.predicted + [0.01, 0, 0, 0, 0, 0])
    _, after = nmpc.command(memory, moved, goal)
    share = 1.0 - np.exp(-nmpc.period / 1.0)
    assert after.force[0] == pytest.approx(share * nmpc.mass[0, 0] * 0.01 / nmpc.period, rel=1e-6)


def test_a_state_that_is_not_finite_is_refused(nmpc):
    lost = at_rest(np.full(3, np.nan), quat_from_yaw(0.0))
    with pytest.raises(ControlError, match="non-finite number"):
        nmpc.command(nmpc.reset(), lost, Goal(np.zeros(3), quat_from_yaw(0.0)))


def test_without_casadi_the_extra_is_named():
    assert EXTRA_OF_MODULE["casadi"] == "mpc"
