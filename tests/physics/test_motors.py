"""The steady thrust curve and the steps of a motor; the engine's tests check them in combination."""

import numpy as np
import pytest
import warp as wp

from finssim.physics.motors import admissible, first_order, speed_of_thrust, thrust_of_speed
from finssim.physics.types import vec8
from finssim.sim import Simulator

wp.set_module_options({"enable_backward": False})
N = 1000


@wp.kernel
def curve_kernel(
    thrust: wp.array(dtype=float), c_plus: wp.array(dtype=float), c_minus: wp.array(dtype=float),
    speed: wp.array(dtype=float), back: wp.array(dtype=float),
):  # fmt: skip
    i = wp.tid()
    speed[i] = speed_of_thrust(thrust[i], c_plus[i], c_minus[i])
    back[i] = thrust_of_speed(speed[i], c_plus[i], c_minus[i])


@wp.kernel
def admissible_kernel(
    command: wp.array(dtype=vec8),
    lower: vec8,
    upper: vec8,
    dead_minus: vec8,
    dead_plus: vec8,
    out: wp.array(dtype=vec8),
):
    i = wp.tid()
    out[i] = admissible(command[i], lower, upper, dead_minus, dead_plus)


@wp.kernel
def lag_kernel(
    x: wp.array(dtype=vec8),
    target: wp.array(dtype=vec8),
    alpha: vec8,
    change: vec8,
    out: wp.array(dtype=vec8),
):
    i = wp.tid()
    out[i] = first_order(x[i], target[i], alpha, change)


def run(kernel, arrays, constants, outputs):
    """Launch over the first dimension of float32 arrays; return results as float64."""

    def put(a):
        return wp.array(np.asarray(a, np.float32), dtype=float if np.ndim(a) == 1 else vec8, device="cpu")

    inputs = [put(a) for a in arrays]
    results = [wp.zeros_like(inputs[0]) for _ in range(outputs)]
    wp.launch(kernel, len(inputs[0]), [*inputs, *constants, *results], device="cpu")
    return [r.numpy().astype(float) for r in results]


def test_the_speed_for_a_thrust_gives_that_thrust():
    """T(ω(T)) = T in both directions, with different curves forward and reverse, over six decades."""
    rng = np.random.default_rng(0)
    thrust = np.concatenate([rng.choice([-1.0, 1.0], N - 1) * 10.0 ** rng.uniform(-3, 3, N - 1), [0.0]])
    thrust, *c = (
        x.astype(np.float32) for x in (thrust, 10.0 ** rng.uniform(-5, 1, N), 10.0 ** rng.uniform(-5, 1, N))
    )
    speed, back = run(curve_kernel, [thrust, *c], [], 2)
    assert back == pytest.approx(thrust, rel=1e-6)
    chosen = np.where(thrust >= 0, *c)
    assert speed == pytest.approx(np.sign(thrust) * np.sqrt(np.abs(thrust) / chosen), rel=1e-6)


def test_a_thruster_without_a_curve_does_not_turn():
    """Coefficients of zero give speed zero, not infinity."""
    assert run(curve_kernel, [np.ones(2), np.zeros(2), np.zeros(2)], [], 2)[0].tolist() == [0.0, 0.0]


def test_a_command_is_limited_and_dead_near_zero():
    """With its own limits and dead zone each thruster passes a command, limits it, or sets it to zero."""
    rng = np.random.default_rng(1)
    command = rng.uniform(-100.0, 100.0, (N, 8)).astype(np.float32) * rng.choice([0.05, 1.0], (N, 8)).astype(
        np.float32
    )
    lower, upper = np.float32(-rng.uniform(10, 90, 8)), np.float32(rng.uniform(10, 90, 8))
    dead = np.float32(-rng.uniform(0, 4, 8)), np.float32(rng.uniform(0, 4, 8))
    (found,) = run(admissible_kernel, [command], [vec8(*x) for x in (lower, upper, *dead)], 1)
    expected = np.where((command > dead[0]) & (command < dead[1]), 0.0, np.clip(command, lower, upper))
    assert np.array_equal(found, expected)


def test_one_step_of_the_lag_is_the_exact_exponential():
    """x(h) = target + (x - target) exp(-h/T) where the slew limit is far."""
    rng = np.random.default_rng(2)
    x, target = rng.uniform(-50, 50, (2, N, 8)).astype(np.float32)
    decay = np.exp(-rng.uniform(0.001, 3.0, 8))
    (found,) = run(lag_kernel, [x, target], [vec8(*(1.0 - decay)), vec8(*[1e9] * 8)], 1)
    assert found == pytest.approx(target + (x.astype(float) - target) * decay, abs=2e-5)


def test_the_slew_limit_holds_and_never_overshoots():
    """The change is towards the target, at most the limit, and not beyond the target."""
    rng = np.random.default_rng(3)
    x, target = rng.uniform(-1, 1, (2, N, 8)).astype(np.float32)
    (found,) = run(lag_kernel, [x, target], [vec8(*[1.0] * 8), vec8(*[0.5] * 8)], 1)
    assert found == pytest.approx(x + np.clip(target.astype(float) - x, -0.5, 0.5), abs=1e-6)


@pytest.mark.parametrize("ratio", [0.01, 0.049, 0.051, 0.5, 3.0])
def test_the_lags_share_and_its_mean_are_exact(ratio):
    """alpha = 1 - exp(-x) and beta = 1 - alpha / x, x = h / T, on both sides of where the series begins."""
    simulator = Simulator("finsrov", control_step=0.1, substeps=4)
    simulator.plant.time_constant.fill_(vec8(*[0.025 / ratio] * 8))
    simulator.refresh()
    alpha = -np.expm1(-ratio)
    np.testing.assert_allclose(simulator.plant.alpha.numpy()[0, 0], alpha, rtol=1e-6)
    np.testing.assert_allclose(
        simulator.plant.beta.numpy()[0, 0], 1.0 - alpha / ratio, rtol=5e-5
    )  # float32 in 1 - alpha / x
