"""The LQR's gains are optimal, its observer estimates the disturbance, and it holds every published setpoint."""

import math

import numpy as np
import pytest

from finssim.agents.controllers import controller
from finssim.agents.lqr import Lqr
from finssim.control import ControlError
from finssim.control.guidance import Goal
from finssim.core.rotations import quat_from_yaw, quat_inverse_rotate
from finssim.vehicles import load_vehicle
from reference.cases import THRUSTED
from reference.holding import T1, at_rest, run, settling_time


@pytest.fixture(scope="module")
def vehicle():
    return load_vehicle("finsrov")


@pytest.fixture(scope="module")
def lqr(vehicle):
    return Lqr.from_vehicle(vehicle)


def cost_of_an_axis(lqr, axis, gains):
    """Return the sum of (e / scale)² + (u / limit)² from e = 1 on, with the linear axis integrated in small steps."""
    model, limit = lqr.body.model, lqr.body.wrench_limits[axis]
    m, d, k = (x[axis] for x in (model.inertia, model.linear_damping, model.stiffness))
    scale = 0.25 if axis < 3 else math.radians(25.0)
    x, v, f, queue, total = 1.0, 0.0, 0.0, [0.0] * lqr.delays, 0.0
    small = lqr.period / 200
    for _ in range(round(12.0 / lqr.period)):
        u = -gains @ [x, v, f, *queue]
        total += (x / scale) ** 2 + (u / limit) ** 2
        arriving, queue = queue[0], [*queue[1:], u]
        for _ in range(200):
            x, v, f = x + small * v, v + small * (f - d * v - k * x) / m, f + small * (arriving - f) / lqr.lag
    return total


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 5])
def test_no_other_gains_cost_less(lqr, axis):
    """Changing any gain by 5 % in either direction costs more, by an amount of second order."""
    best = cost_of_an_axis(lqr, axis, lqr.gains[axis])
    for i in range(lqr.gains.shape[1]):
        for factor in (0.95, 1.05):
            changed = lqr.gains[axis].copy()
            changed[i] *= factor
            assert best * (1.0 - 1e-5) < cost_of_an_axis(lqr, axis, changed) < best * 1.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("period", "water"),
    [(0.05, {}), (0.1, {}), (0.05, {"current": (0.10, 0.05, 0.0)}), (0.05, {"load": 2.0})],
    ids=["20 Hz", "10 Hz", "current 0.11 m/s", "2 N heavier"],
)
def test_all_eight_setpoints_are_held(vehicle, pool, period, water):
    """Setpoints are held within the success limits, level, from 15 s on; within 1 mm and 0.1 degrees after 30 s."""
    log, _ = run(Lqr.from_vehicle(vehicle, period=period), pool(vehicle, 8, **water), T1, 30.0)
    assert (settling_time(log, period) < 15.0).all()
    assert np.abs(log[-1, :, :3]).max() < 1e-3 and np.abs(log[-1, :, 3]).max() < math.radians(0.1)
    assert log[..., 4].max() < math.radians(3.0)


@pytest.mark.slow
def test_the_observer_finds_what_pushes(vehicle, lqr, pool):
    """In a plant 2 N heavier than its file, the estimate is 2 N downwards in the world, at any heading, within 2 %."""
    goal = Goal(np.zeros((2, 3)) + [0.0, 0.0, -0.5], quat_from_yaw(np.array([0.0, 2.0])))
    _, memory = run(lqr, pool(vehicle, 2, load=2.0), goal, 15.0)
    np.testing.assert_allclose(memory.force, [[0.0, 0.0, -2.0]] * 2, atol=0.04)


@pytest.mark.slow
def test_a_current_is_observed_in_the_world_frame(vehicle, lqr, pool):
    """Turned by 90° in a current along x, the estimated force stays along x: the damping of 0.1 m/s, to 5 %."""
    start = Goal(np.array([[0.0, 0.0, -0.5]]), quat_from_yaw(np.array([0.0])))
    plant = pool(vehicle, 1, current=(0.1, 0.0, 0.0))
    _, memory = run(lqr, plant, start, 15.0)
    drag = lqr.body.model.damping(np.full(6, 0.1)) * 0.1
    assert memory.force[0, 0] == pytest.approx(drag[0], rel=0.05)
    turned = quat_from_yaw(np.array([math.pi / 2]))
    _, memory = run(lqr, plant, Goal(start.position, turned), 15.0)
    assert memory.force[0, 0] == pytest.approx(drag[1], rel=0.05) and abs(memory.force[0, 1]) < 0.05
    assert quat_inverse_rotate(turned, memory.force)[0, 1] == pytest.approx(-memory.force[0, 0], rel=1e-9)


@pytest.mark.slow
def test_it_settles_a_bluerov2_heavy_before_its_pid_does(pool):
    """Vectored thrusters are both strong and quick: despite the delay, optimal feedback needs half of the
    PID's time."""
    heavy = load_vehicle("bluerov2_heavy")
    times = {
        name: settling_time(run(controller(name, heavy), pool(heavy, 8), T1, 30.0)[0], 0.05)
        for name in ("lqr", "pid")
    }
    assert (times["lqr"] < times["pid"]).all()


@pytest.mark.parametrize("name", THRUSTED)
def test_every_vehicle_has_a_stable_one(name):
    """For every driven axis with the gains of the vehicle's file, the closed loop's state decays within a minute."""
    lqr = Lqr.from_vehicle(load_vehicle(name))
    for axis in np.flatnonzero(lqr.body.wrench_limits > 0.0):
        assert np.isfinite(cost_of_an_axis(lqr, axis, lqr.gains[axis]))
    assert (lqr.gains[lqr.body.wrench_limits <= 0.0] == 0.0).all()


def test_one_vehicle_and_a_batch_agree(vehicle, lqr):
    rng = np.random.default_rng(3)
    states = [
        at_rest(rng.normal(size=3), quat_from_yaw(rng.normal()), 0.1 * rng.normal(size=6)) for _ in range(3)
    ]
    goal = Goal(np.array([0.5, 0.2, -0.6]), quat_from_yaw(0.3))
    batch = at_rest(
        *(np.stack([getattr(s, part) for s in states]) for part in ("position", "quaternion", "nu"))
    )
    memory = lqr.reset(3)
    alone = [lqr.reset() for _ in states]
    for _ in range(3):
        tau, memory = lqr.command(memory, batch, goal)
        single = [lqr.command(m, s, goal) for m, s in zip(alone, states, strict=True)]
        alone = [m for _, m in single]
        np.testing.assert_allclose(tau, [t for t, _ in single], rtol=1e-12, atol=1e-12)


def test_a_period_of_zero_is_refused(vehicle):
    with pytest.raises(ControlError, match="period is 0"):
        Lqr.from_vehicle(vehicle, period=0.0)


def test_a_disturbance_is_bounded(lqr):
    """The estimate is at most half of the wrench limit, however far the velocity jumps."""
    memory = lqr.reset()._replace(nu=np.zeros(6))
    for _ in range(200):
        memory = memory._replace(nu=np.zeros(6))
        _, memory = lqr.command(memory, at_rest(np.zeros(3), quat_from_yaw(0.0), np.full(6, -5.0)), T1_ONE)
    assert (np.abs(memory.force) <= 0.5 * lqr.body.wrench_limits[:3] + 1e-12).all()


T1_ONE = Goal(np.array([0.0, 0.0, -0.5]), quat_from_yaw(0.0))
