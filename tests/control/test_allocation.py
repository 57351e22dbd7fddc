"""Allocation is the exact optimum of the paper's problem, inside the limits, for any wrench and layout."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from finssim.control import ControlError
from finssim.control.allocation import (
    AllocationData,
    Allocator,
    allocate,
    allocate_row,
    allocation_data,
    regularisation_weight,
)
from finssim.control.modes import action_mode
from finssim.physics.types import vec6, vec8
from finssim.vehicles import load_vehicle
from reference.cases import THRUSTED


def allocator(layout, regularisation=1e-4):
    return Allocator(layout.B, layout.lower, layout.upper, layout.weights, regularisation)


def wrenches(layout, count, seed=0):
    """Random wrenches: a third small enough to be met, a third full-scale, a third far out of reach."""
    rng = np.random.default_rng(seed)
    scale = rng.choice([0.2, 1.0, 5.0], size=(count, 1))
    limits = np.where(layout.wrench_limits > 0.0, layout.wrench_limits, 1.0)
    return (scale * rng.uniform(-1.0, 1.0, (count, 6)) * limits).astype(np.float32).astype(float)


def stacked(layout, regularisation=1e-4):
    """M of ||M f - (W tau, 0)||^2, the objective as plain least squares, (6 + n, n)."""
    weight = regularisation_weight(layout.B, layout.weights, regularisation)
    return np.vstack([layout.weights[:, None] * layout.B, np.sqrt(weight) * np.eye(layout.B.shape[1])])


def objective(layout, f, tau, regularisation=1e-4):
    """Return ||W (B f - tau)||^2 + lambda ||f||^2 in float64."""
    weight = regularisation_weight(layout.B, layout.weights, regularisation)
    return (((f @ layout.B.T - tau) * layout.weights) ** 2).sum(-1) + weight * (f**2).sum(-1)


def optimality_gap(layout, f, tau, regularisation=1e-4):
    """Return an upper bound of the objective's distance from its minimum, in float64.

    With g = H (f - f0), every feasible x has q(x) >= q(f) + g'(x - f) + (x - f)'H(x - f)/2. Thrusters that g presses
    against a limit can only increase q, so with g zeroed there the objective is at most g' H^-1 g too high.
    """
    M = stacked(layout, regularisation)
    H = M.T @ M
    g = f @ H - (tau * layout.weights**2) @ layout.B
    low, high = (
        np.nextafter(layout.lower, 0, dtype=np.float32),
        np.nextafter(layout.upper, 0, dtype=np.float32),
    )
    pressed = ((f >= high) & (g <= 0.0)) | ((f <= low) & (g >= 0.0))
    g = np.where(pressed, 0.0, g)
    return np.einsum("ki,ij,kj->k", g, np.linalg.inv(H), g)


def test_a_hundred_thousand_allocations_carry_a_certificate_of_optimality(layout):
    """The objective is within 1e-5 of the minimum, by a bound computed in float64 without a solver."""
    tau = wrenches(layout, 25_000)
    f = allocator(layout).allocate(tau)
    assert (optimality_gap(layout, f, tau) <= 1e-5 * objective(layout, f, tau)).all()
    assert (f >= layout.lower).all() and (f <= layout.upper).all()
    saturated = (np.abs(f - layout.lower) < 1e-5) | (np.abs(f - layout.upper) < 1e-5)
    assert 0.2 < saturated.any(1).mean() < 0.95  # the sample contains both branches


@pytest.mark.parametrize("name", THRUSTED)
def test_allocations_of_every_catalogue_vehicle_are_optimal(finsrov, name):
    vehicle = load_vehicle(name)
    craft = type(finsrov)(name, vehicle.control_matrix, *vehicle.force_limits, vehicle.wrench_limits)
    tau = wrenches(craft, 5000, seed=5)
    f = Allocator.from_vehicle(vehicle).allocate(tau)
    assert (optimality_gap(craft, f, tau) <= 1e-5 * objective(craft, f, tau)).all()


def assert_as_good_as_lsq_linear(layout, tau, regularisation=1e-4):
    f = allocator(layout, regularisation).allocate(tau)
    M = stacked(layout, regularisation)
    rhs = np.hstack([tau * layout.weights, np.zeros((len(tau), layout.B.shape[1]))])
    best = np.array([lsq_linear(M, b, (layout.lower, layout.upper), "bvls", tol=1e-14).x for b in rhs])
    scores = [objective(layout, x, tau, regularisation) for x in (f, best)]
    np.testing.assert_allclose(*scores, rtol=1e-5)
    np.testing.assert_allclose(f, best, atol=2e-5 * layout.upper.max())


def test_objective_equals_that_of_lsq_linear(layout):
    assert_as_good_as_lsq_linear(layout, wrenches(layout, 2_500, seed=2))


@pytest.mark.parametrize("regularisation", [1e-6, 1e-3, 1e-1])
def test_objective_equals_that_of_lsq_linear_for_any_regularisation(finsrov, regularisation):
    """The objective equals lsq_linear's in float32, also for a small lambda, which is ill-conditioned (1e6 here)."""
    assert_as_good_as_lsq_linear(finsrov, wrenches(finsrov, 500, seed=3), regularisation)


def test_full_surge_matches_the_published_thrusts(finsrov):
    """Full forward thrust of the published vehicle gives 1.65 N on the verticals, 7 and 6.81 N on the horizontals."""
    f = allocator(finsrov).allocate([finsrov.wrench_limits[0], 0, 0, 0, 0, 0])
    np.testing.assert_allclose(f, [1.65, -1.65, -1.65, 1.65, 7.0, 7.0, -6.81, -6.81], atol=0.01)


@pytest.mark.parametrize("axis", range(6))
def test_pure_axis_limits_are_reached(finsrov, axis):
    tau = np.eye(6)[axis] * finsrov.wrench_limits[axis]
    reach = allocator(finsrov)
    np.testing.assert_allclose(
        reach.achieved(reach.allocate(tau)) / finsrov.wrench_limits, np.eye(6)[axis], atol=5e-4
    )


def test_attainable_wrenches_are_met_to_the_regularisation(finsrov):
    """Without saturation, the wrench falls short by lambda/(sigma^2 + lambda), about 1e-4 of itself."""
    tau = 0.2 * wrenches(finsrov, 1000) / 5.0
    exact = allocator(finsrov)
    achieved = exact.achieved(exact.allocate(tau))
    np.testing.assert_allclose(
        achieved / finsrov.wrench_limits, tau / finsrov.wrench_limits, atol=2e-4 * 0.35
    )


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(tau=st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6))
def test_never_outside_the_limits_by_one_ulp(measured_allocator, tau):
    f = measured_allocator.allocate(tau)
    assert (f >= measured_allocator.lower).all() and (f <= measured_allocator.upper).all()


@pytest.fixture(scope="module")
def measured_allocator():
    limits = np.array([(-7.9750, 8.4749), (-5.7618, 7.3809)])[[0, 1, 1, 0, 1, 0, 1, 0]]
    rng = np.random.default_rng(0)
    return Allocator(rng.normal(size=(6, 8)), limits[:, 0], limits[:, 1], np.ones(6))


def test_random_layouts_are_solved(finsrov):
    """The certificate holds for random matrices of 5 to 8 thrusters, without the symmetry of a vehicle."""
    rng = np.random.default_rng(4)
    for n in (5, 6, 7, 8) * 3:
        lower, upper = -rng.uniform(0.1, 10.0, n), rng.uniform(0.1, 10.0, n)
        random = type(finsrov)("random", rng.normal(size=(6, n)), lower, upper, rng.uniform(1.0, 30.0, 6))
        tau = wrenches(random, 2000, seed=n)
        f = allocator(random).allocate(tau)
        assert (optimality_gap(random, f, tau) <= 1e-5 * objective(random, f, tau)).all()


def test_a_dead_thruster_gives_nothing_and_the_others_make_up(finsrov):
    """With one vertical thruster held at zero, heave and yaw are still met exactly."""
    lower, upper = finsrov.lower.copy(), finsrov.upper.copy()
    lower[0] = upper[0] = 0.0
    hurt = Allocator(finsrov.B, lower, upper, finsrov.weights)
    tau = np.array([0.0, 0.0, 6.0, 0.0, 0.0, 1.0])
    f = hurt.allocate(tau)
    assert f[0] == 0.0
    np.testing.assert_allclose(hurt.achieved(f), tau, atol=5e-3)


def test_one_wrench_gives_bitwise_what_a_batch_gives(layout):
    """The robot's N = 1 and the training batch run the same code."""
    shared = allocator(layout)
    tau = wrenches(layout, 64)
    batch = shared.allocate(tau.reshape(4, 16, 6))
    single = [shared.allocate(one) for one in tau]
    assert batch.shape == (4, 16, layout.B.shape[1])
    assert (batch.reshape(64, -1) == single).all()


@wp.kernel(enable_backward=False)
def allocate_of_types(
    tau: wp.array(dtype=vec6), kind: wp.array(dtype=int), data: AllocationData, f: wp.array(dtype=vec8)
):
    i = wp.tid()
    f[i] = allocate(tau[i], kind[i], data)


def test_vehicle_types_of_one_batch_use_their_own_tables(finsrov):
    """Two types in one launch give the results of each alone; a type with fewer thrusters leaves the rest at zero."""
    five = Allocator(finsrov.B[:, :5], finsrov.lower[:5], finsrov.upper[:5], finsrov.weights)
    eight = allocator(finsrov)
    data = allocation_data(
        [five.B, eight.B], [five.lower, eight.lower], [five.upper, eight.upper], [finsrov.weights] * 2
    )
    tau = wrenches(finsrov, 32)
    kind = np.arange(32, dtype=np.int32) % 2
    f = wp.zeros(32, dtype=vec8, device="cpu")
    inputs = [wp.array(tau, dtype=vec6, device="cpu"), wp.array(kind, dtype=wp.int32, device="cpu"), data]
    wp.launch(allocate_of_types, 32, inputs, [f], device="cpu")
    assert (f.numpy()[0::2, :5] == five.allocate(tau[0::2])).all() and (f.numpy()[0::2, 5:] == 0.0).all()
    assert (f.numpy()[1::2] == eight.allocate(tau[1::2])).all()


def test_nan_in_a_kernel_stays_visible(finsrov):
    """A NaN wrench gives NaN thrusts, not a plausible limit."""
    data = allocator(finsrov).data
    f = wp.zeros(1, dtype=vec8, device="cpu")
    tau = wp.array(np.full((1, 6), np.nan), dtype=vec6, device="cpu")
    wp.launch(allocate_row, 1, [tau, data], [f], device="cpu")
    assert np.isnan(f.numpy()).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"B": np.zeros((5, 8))}, "expected"),
        ({"B": np.zeros((6, 8))}, "weights"),
        ({"lower": np.full(8, 1.0)}, "limits"),
        ({"upper": np.full(8, np.nan)}, "finite"),
        ({"weights": np.full(6, -1.0)}, "weights"),
        ({"regularisation": 0.0}, "regularisation"),
    ],
)
def test_bad_problems_are_refused(finsrov, change, message):
    given = {
        "B": finsrov.B,
        "lower": finsrov.lower,
        "upper": finsrov.upper,
        "weights": finsrov.weights,
    } | change
    with pytest.raises(ControlError, match=message):
        Allocator(**given)


@pytest.mark.parametrize("tau", [np.zeros(5), np.full(6, np.nan), np.full(6, np.inf)])
def test_bad_wrenches_are_refused(finsrov, tau):
    with pytest.raises(ControlError):
        allocator(finsrov).allocate(tau)


def test_a_first_allocation_waits_for_no_compiler(monkeypatch):
    """Kernels are loaded when an allocator or action mode is created: a robot's first decision only launches them."""
    vehicle = load_vehicle("finsrov")
    made, mode = Allocator.from_vehicle(vehicle), action_mode("wrench6", vehicle)
    monkeypatch.setattr(wp, "launch", None)
    assert np.allclose(made.allocate(np.zeros(6)), 0.0) and np.allclose(mode.to_thrusters(np.zeros(6)), 0.0)
