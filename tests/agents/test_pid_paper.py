"""The published controller pushes towards its goal with the published strength and stops at the published bounds."""

import math

import numpy as np
import pytest

from finssim.agents.pid import PaperPid
from finssim.control.allocation import Allocator
from finssim.control.guidance import Goal
from finssim.core.rotations import quat_from_euler, quat_from_yaw
from finssim.vehicles import load_vehicle

LEVEL = quat_from_yaw(0.0)


@pytest.fixture(scope="module")
def pid():
    return PaperPid.from_vehicle(load_vehicle("finsrov"))


def first_command(pid, goal_position=(0.0, 0.0, 0.0), goal_yaw=0.0, quaternion=LEVEL):
    state = type("State", (), {"position": np.zeros(3), "quaternion": quaternion, "nu": np.zeros(6)})
    return pid.command(pid.reset(), state, Goal(np.array(goal_position), quat_from_yaw(goal_yaw)))[0]


def test_runs_at_sixty_hertz(pid):
    assert pid.period == pytest.approx(1.0 / 60.0)


@pytest.mark.parametrize(("axis", "gain", "divisor"), [(0, 8.0, 20.0), (1, 8.0, 20.0), (2, 4.0, 10.0)])
def test_pushes_towards_the_goal_with_gain_over_axis_range(pid, axis, gain, divisor):
    """Half a metre ahead, to the left or above, the effort is kp e / range of the 7 N unit, on that axis only."""
    tau = first_command(pid, 0.5 * np.eye(3)[axis])
    np.testing.assert_allclose(
        tau, np.eye(6)[axis] * 7.0 * gain * 0.5 / divisor, rtol=1e-4
    )  # integral: one period


def test_position_errors_are_taken_in_the_bodys_axes(pid):
    """With the vehicle facing left, a goal ahead along the world's x axis lies to starboard."""
    tau = first_command(pid, (0.5, 0.0, 0.0), math.pi / 2, quat_from_yaw(math.pi / 2))
    assert tau[1] < 0.0 and abs(tau[0]) < 1e-12


def test_heading_gain_is_per_degree_and_turns_the_short_way(pid):
    """60 degrees to the left give 0.0006 * 60 / 5 of the unit to the left; to the right, as much to the right."""
    expected = 7.0 * 0.0006 * 60.0 / 5.0
    assert first_command(pid, goal_yaw=math.radians(60.0))[5] == pytest.approx(expected)
    assert first_command(pid, goal_yaw=math.radians(300.0))[5] == pytest.approx(-expected)


def test_heading_output_is_bounded_and_dead_within_five_degrees(pid):
    """180 degrees give 0.108, bounded to 0.10; 4.9 degrees give nothing."""
    assert abs(first_command(pid, goal_yaw=math.pi)[5]) == pytest.approx(7.0 * 0.10 / 5.0)
    assert first_command(pid, goal_yaw=math.radians(4.9))[5] == 0.0


def test_effort_is_bounded_by_one(pid):
    np.testing.assert_allclose(first_command(pid, (50.0, -50.0, 50.0))[:3], [7.0, -7.0, 7.0])


def test_roll_and_pitch_are_never_commanded(pid):
    tau = first_command(pid, (1.0, 1.0, 1.0), 1.0, quat_from_euler(0.2, -0.3, 0.0))
    np.testing.assert_array_equal(tau[3:5], 0.0)


def test_the_integral_decays_as_published(pid):
    """A constant error of e settles at e dt / (1 - 0.95), a twentieth of which is lost each period."""
    state = type("State", (), {"position": np.zeros(3), "quaternion": LEVEL, "nu": np.zeros(6)})
    memory = pid.reset()
    for _ in range(400):
        _, memory = pid.command(memory, state, Goal(np.array([0.4, 0.0, 0.0]), LEVEL))
    assert memory.integral[1] == pytest.approx(0.4 / 60.0 / 0.05)


@pytest.mark.slow
def test_reaches_setpoints_in_still_water_but_needs_half_a_minute(pid, pool):
    """The published gains work in ideal water and are slow: this is the baseline that `pid` has to beat."""
    vehicle = load_vehicle("finsrov")
    plant, memory, allocator = pool(vehicle, 1), pid.reset(1), Allocator.from_vehicle(vehicle)
    goal = Goal(np.array([[1.0, 0.3, -0.5]]), quat_from_yaw([0.0]))
    distance = []
    for _ in range(60 * 60):
        tau, memory = pid.command(memory, plant.measured, goal)
        plant.advance(allocator.allocate(tau), pid.period)
        distance.append(np.abs(plant.measured.position - goal.position).max())
    assert distance[-1] < 0.10 < 0.3 < distance[10 * 60]
