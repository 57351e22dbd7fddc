"""Capability of the thrusters, against the published table and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from finssim.vehicles import AXES, catalogue, load_vehicle
from finssim.vehicles.capability import (
    largest,
    restoring,
    terminal_speed,
    terminal_speeds,
    time_constants,
    trim,
    wrench_capability,
)

EVERY = pytest.mark.parametrize("name", catalogue())

# Published per controller axis: Fx, Fy (up), Fz (left), Mx, My (yaw), Mz (pitch). Forces map to ours as they are; the
# controller frame is left-handed, so its positive moment is our negative one.
REAL_PLUS = [18.586585, 18.068824, 27.243033, 3.791353, 3.247581, 6.947713]
REAL_MINUS = [18.586585, 18.586585, 25.636077, 3.791354, 2.535180, 8.019448]
SIMULATED = [19.528527, 18.415027, 22.501886, 3.863995, 3.079985, 7.080833]


def test_finsrov_capability_is_the_published_table():
    real, simulated = (
        wrench_capability(load_vehicle("finsrov")),
        wrench_capability(load_vehicle("finsrov_sim7")),
    )
    np.testing.assert_allclose(real.positive, REAL_PLUS, atol=1.1e-6)
    np.testing.assert_allclose(real.negative, REAL_MINUS, atol=1.1e-6)
    np.testing.assert_allclose(simulated.positive, SIMULATED, atol=1.1e-6)
    np.testing.assert_allclose(simulated.negative, SIMULATED, atol=1.1e-6)


def test_wrench_limits_are_the_published_symmetric_ones_in_policy_order():
    expected = [18.586585, 18.068824, 25.636077, 3.791353, 2.535180, 6.947713]
    np.testing.assert_allclose(load_vehicle("finsrov").wrench_limits, expected, atol=1.1e-6)


@EVERY
def test_no_sampled_thrust_beats_the_capability(name):
    """Duality: some f within limits reaches each bound, and the pure wrench of a random f never exceeds it."""
    vehicle = load_vehicle(name)
    capability = wrench_capability(vehicle)
    rows = [AXES.index(axis) for axis in vehicle.controlled_axes]
    B = vehicle.control_matrix[rows]
    lower, upper = vehicle.force_limits
    generator = np.random.default_rng(4)
    null = np.eye(B.shape[1]) - np.linalg.pinv(B) @ B
    for k, i in enumerate(rows):
        for sign, bound in ((1.0, capability.positive[i]), (-1.0, capability.negative[i])):
            for _ in range(20):
                f = np.linalg.pinv(B)[:, k] * sign + null @ generator.standard_normal(B.shape[1]) * 0.3
                reach = np.min(np.where(f > 1e-12, upper / np.maximum(f, 1e-12), np.inf))
                reach = min(reach, np.min(np.where(f < -1e-12, lower / np.minimum(f, -1e-12), np.inf)))
                assert reach <= bound * (1.0 + 1e-9)


@EVERY
def test_axes_that_are_not_controlled_have_no_limit_to_offer(name):
    vehicle = load_vehicle(name)
    for i, axis in enumerate(AXES):
        assert (vehicle.wrench_limits[i] > 0.0) == (axis in vehicle.controlled_axes)


def test_capability_about_the_centre_of_gravity_grows_with_the_limits():
    vehicle = load_vehicle("finsrov_sim7")
    half = vehicle.replace({"thrusters.*.force_max": 3.5, "thrusters.*.force_min": -3.5})
    np.testing.assert_allclose(half.wrench_limits, vehicle.wrench_limits / 2.0, rtol=1e-9)


def test_terminal_speed_solves_its_equation():
    v = terminal_speed(3.0, 7.0, 11.0)
    assert 3.0 * v + 7.0 * v * v == pytest.approx(11.0)
    assert terminal_speed(4.0, 0.0, 2.0) == 0.5
    assert terminal_speed(0.0, 4.0, 1.0) == 0.5
    assert terminal_speed(0.0, 0.0, 1.0) == math.inf
    assert terminal_speed(0.0, 0.0, 0.0) == 0.0


def test_finsrov_terminal_speeds_are_the_published_ones():
    speeds = terminal_speeds(load_vehicle("finsrov_sim7"))
    np.testing.assert_allclose(speeds[:3], [0.4998, 0.3521, 0.2203], atol=5.1e-5)
    assert speeds[5] == pytest.approx(3.549, abs=5.1e-4)


def test_finsrov_time_constants_are_the_published_ones():
    np.testing.assert_allclose(time_constants(load_vehicle("finsrov"))[:3], [0.69, 0.78, 0.44], atol=0.0051)


def test_finsrov_swings_as_published():
    vehicle = load_vehicle("finsrov_sim7")
    swing = restoring(vehicle)
    np.testing.assert_allclose(swing.stiffness, 13.08, atol=5.1e-3)
    np.testing.assert_allclose(swing.natural_frequency, [1.20, 1.00], atol=5.1e-3)
    np.testing.assert_allclose(swing.damping_ratio, [0.29, 0.24], atol=5.1e-3)
    np.testing.assert_allclose(np.degrees(swing.static_tilt), [17.2, 13.6], atol=0.051)


def test_finsrov_without_angular_added_mass_swings_as_published():
    vehicle = load_vehicle("finsrov").replace({"hydrodynamics.calibrated.added_mass": np.zeros(6)})
    # 1.195 Hz is printed as 1.19
    np.testing.assert_allclose(restoring(vehicle).natural_frequency, [1.59, 1.19], atol=5.5e-3)


@EVERY
def test_trim_thrust_balances_weight_and_buoyancy(name):
    """Thrust, weight and buoyancy sum to zero on the controlled axes, about any point."""
    vehicle = load_vehicle(name)
    level = trim(vehicle)
    assert level.forces is not None
    rows = [AXES.index(axis) for axis in vehicle.controlled_axes]
    np.testing.assert_allclose(
        (vehicle.control_matrix @ level.forces - level.wrench)[rows], 0.0, atol=1e-6 * vehicle.weight
    )
    assert level.wrench[2] == pytest.approx(vehicle.weight - vehicle.buoyancy)


def test_trim_holds_an_offset_centre_of_buoyancy():
    """Buoyancy 0.01 m ahead lifts the nose (a negative pitch moment), so trim pushes the nose down."""
    vehicle = load_vehicle("finsrov").replace({"body.center_of_buoyancy": [0.01, 0.0, 0.03]})
    assert trim(vehicle).wrench[4] == pytest.approx(0.01 * vehicle.buoyancy)


def test_trim_beyond_the_thrusters_is_said():
    assert trim(load_vehicle("finsrov").replace({"body.mass": 16.0})).forces is None


@pytest.mark.parametrize("seed", range(4))
def test_the_largest_thrust_is_that_of_a_linear_program(seed):
    """Against SciPy's HiGHS, for random thrusters: dependent rows, idle and one-way thrusters, equal limits."""
    from scipy.optimize import linprog

    rng = np.random.default_rng(seed)
    for _ in range(40):
        n, m = rng.integers(1, 13), rng.integers(0, 6)
        gain, zero = rng.normal(size=n), rng.normal(size=(m, n))
        lower, upper = -50.0 * rng.random(n), 50.0 * rng.random(n)
        if rng.random() < 0.4:
            idle = rng.random(n) < 0.4
            zero[:, idle] = gain[idle] = 0.0
        if rng.random() < 0.4 and m > 1:
            zero[-1] = 2.0 * zero[0]
        if rng.random() < 0.4:
            gain, zero, lower, upper = np.round(gain), np.round(zero), np.full(n, -40.0), np.full(n, 50.0)
        if rng.random() < 0.4:
            lower[rng.random(n) < 0.4] = 0.0
        f = largest(gain, zero, lower, upper)
        best = -linprog(-gain, A_eq=zero, b_eq=np.zeros(m), bounds=np.column_stack([lower, upper])).fun
        assert (f >= lower).all() and (f <= upper).all()
        assert np.abs(zero @ f).max(initial=0.0) < 1e-8  # 1e-10 of 12 thrusts of 50 N
        assert gain @ f == pytest.approx(best, rel=1e-8, abs=1e-8)
