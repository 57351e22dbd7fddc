"""Currents and waves: orbital motion derives from a potential, with its own surface and its own acceleration."""

import math

import numpy as np
import pytest
import warp as wp

from finssim.physics.water import Flow, WaterArrays, advance_drift, dispersion, flow_at, wave_number
from finssim.sim import RectangularPool, SeaState, Simulator, SurroundingsError, Water, Wave
from finssim.sim.water import sea_bands
from reference.water import flow

wp.set_module_options({"enable_backward": False})
G = 9.81
SEA = Water(
    current=(0.2, -0.1, 0.0),
    shear=(0.1, 0.05, 0.0),
    waves=(
        Wave(amplitude=0.05, wavelength=3.0, heading=0.3, phase=0.5),
        Wave(amplitude=0.03, wavelength=1.2, heading=-2.5, phase=2.0),
    ),
    depth=1.5,
)


@wp.kernel
def flow_kernel(
    water: WaterArrays,
    position: wp.array(dtype=wp.vec3),
    t: float,
    t_step: float,
    out: wp.array(dtype=Flow),
):
    i = wp.tid()
    out[i] = flow_at(water, 0, position[i], t, t_step)


def arrays_of(water, worlds=1):
    """Return the engine's arrays for a `Water`."""
    return water.arrays(worlds, 1000.0, G, wp.get_device("cpu"))


def flow_here(water, position, t, t_step=0.0):
    """Return the engine's flow at points (n, 3), a dictionary of the fields of `Flow` in float64."""
    arrays = arrays_of(water) if isinstance(water, Water) else water
    points = wp.array(np.asarray(position, np.float32), dtype=wp.vec3, device="cpu")
    out = wp.zeros(len(points), dtype=Flow, device="cpu")
    wp.launch(flow_kernel, len(points), [arrays, points, t, t_step, out], device="cpu")
    found = out.numpy()
    return {name: found[name].astype(float) for name in Flow.vars}


def in_space(water, name, position, t, d, axes=3):
    """Return central differences of a field over ±d along the world axes, on a new last axis."""
    ends = [[flow_here(water, position + s * d * a, t)[name] for s in (1, -1)] for a in np.eye(3)[:axes]]
    return np.stack([(ahead - behind) / (2 * d) for ahead, behind in ends], axis=-1)


def in_time(water, name, position, t, d):
    """Return the central difference of a field over ±d seconds."""
    return (flow_here(water, position, t + d)[name] - flow_here(water, position, t - d)[name]) / (2 * d)


def places(n=500, seed=0, top=0.2):
    """Return points in and slightly above the water."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-3, -3, -1.4], [3, 3, top], (n, 3)).astype(np.float32)


# The shorter wave has the largest derivatives; together A ω < 0.45 m/s.
K, OMEGA, SPEED = 2 * np.pi / 1.2, float(dispersion(2 * np.pi / 1.2, 1.5, G)), 0.45
D = 5e-3  # step of a central difference [m] or [s]: remainder (k d)²/6 of the derivative
ROUNDING = 3e-7 / D


@pytest.mark.parametrize("depth", [0.2, 1.0, 30.0, math.inf])
def test_dispersion_is_solved(depth):
    """ω² = g k tanh(k h), and its wave number is recovered to 1e-12."""
    k = 2.0 * np.pi / np.geomspace(0.1, 30.0, 40)
    omega = dispersion(k, depth, G)
    assert omega**2 == pytest.approx(G * k * np.tanh(k * min(depth, 1e6)), rel=1e-12)
    if math.isfinite(depth):
        assert wave_number(omega, depth, G) == pytest.approx(k, rel=1e-12)


def test_long_waves_travel_at_the_shallow_speed_and_short_ones_at_the_deep():
    """c = ω/k tends to sqrt(g h) and to sqrt(g/k): k h = 0.01 and k h = 10."""
    assert dispersion(0.01, 1.0, G) / 0.01 == pytest.approx(math.sqrt(G), rel=1e-4)
    assert dispersion(10.0, 1.0, G) / 10.0 == pytest.approx(math.sqrt(G / 10.0), rel=1e-8)


@pytest.mark.parametrize("t", [0.0, 7.3])
def test_flow_agrees_with_the_potential(t):
    """Velocity, acceleration, gradient, elevation and normal of `flow_at` agree at 500 points, to float32
    phases."""
    position = places()
    found, expected = flow_here(SEA, position, t), flow(SEA, G, position, t)
    for name, value in found.items():
        reference = getattr(expected, name)
        assert value == pytest.approx(reference, abs=5e-6 * np.abs(reference).max()), name


def test_water_is_conserved():
    """div v = 0 below the surface, by central differences."""
    gradient = in_space(SEA, "velocity", places(top=-0.01), 1.0, D)
    assert np.abs(np.trace(gradient, axis1=1, axis2=2)).max() < (K * D) ** 2 / 6 * SPEED * K + 3 * ROUNDING


def test_orbital_motion_has_no_curl_and_its_gradient_is_its_derivative():
    """The gradient without shear is symmetric (a potential), and matches central differences."""
    waves, position = Water(waves=SEA.waves, depth=SEA.depth), places(top=-0.01)
    gradient = flow_here(waves, position, 1.0)["gradient"]
    assert gradient == pytest.approx(np.swapaxes(gradient, 1, 2), abs=1e-6)
    differences = in_space(waves, "velocity", position, 1.0, D)
    assert gradient == pytest.approx(differences, abs=(K * D) ** 2 / 6 * SPEED * K + ROUNDING)


def test_acceleration_is_the_rate_of_the_velocity_in_place():
    """The acceleration is ∂v/∂t, by central differences."""
    position = places()
    found = flow_here(SEA, position, 2.0)["acceleration"]
    rate = in_time(SEA, "velocity", position, 2.0, D)
    assert found == pytest.approx(rate, abs=(OMEGA * D) ** 2 / 6 * SPEED * OMEGA + ROUNDING)


def test_the_surface_moves_with_the_water_and_tilts_with_its_slope():
    """∂η/∂t = w at z = 0 (kinematic condition, first order), and the normal follows the slope of η."""
    waves, position = Water(waves=SEA.waves, depth=SEA.depth), places()
    position[:, 2] = 0.0
    here = flow_here(waves, position, 1.0)
    rate = in_time(waves, "elevation", position, 1.0, D)
    assert here["velocity"][:, 2] == pytest.approx(rate, abs=(OMEGA * D) ** 2 / 6 * SPEED + ROUNDING / 4)
    slope = in_space(waves, "elevation", position, 1.0, D, axes=2)
    tilt = -here["normal"][:, :2] / here["normal"][:, 2:]
    assert tilt == pytest.approx(slope, abs=(K * D) ** 2 / 6 * 0.3 + ROUNDING / 4)


def test_water_does_not_pass_through_the_bottom():
    """w = 0 at z = -h for any wavelength."""
    bottom = places()
    bottom[:, 2] = -SEA.depth
    assert flow_here(SEA, bottom, 3.0)["velocity"][:, 2] == pytest.approx(0.0, abs=1e-7)


def test_a_sheared_current_changes_with_depth_alone():
    """v = current + z shear below the surface, and the surface value above it."""
    water = Water(current=(0.2, 0.1, 0.0), shear=(0.1, -0.3, 0.0))
    found = flow_here(water, [[5.0, 1.0, -0.5], [0.0, 0.0, 0.4]], 9.0)["velocity"]
    assert found == pytest.approx(np.array([[0.15, 0.25, 0.0], [0.2, 0.1, 0.0]]), abs=1e-7)


def test_drift_has_its_standard_deviation_and_correlation_time():
    """A Gauss-Markov current has std σ (1 ± 4/sqrt(2n)) after 5 correlation times, and correlation exp(-t/T).

    With 20 000 independent worlds the sampling error of a standard deviation is σ/sqrt(2n), of a correlation 1/sqrt(n).
    """
    n, T, step, std = 20_000, 2.0, 0.5, np.array([0.1, 0.05, 0.02])
    water = arrays_of(Water(drift_std=tuple(std), drift_time=T), n)
    episode, steps = (wp.zeros(n, dtype=int, device="cpu") for _ in range(2))

    def advance(first, count):
        for i in range(first, first + count):
            steps.fill_(i)
            wp.launch(advance_drift, n, [water, steps, step, 3, episode, 0], device="cpu")
        return water.drift.numpy().astype(float)

    settled = advance(0, 20).copy()
    later = advance(20, 4)
    assert settled.std(axis=0) == pytest.approx(std, rel=4.0 / math.sqrt(2 * n))
    assert settled.mean(axis=0) == pytest.approx(np.zeros(3), abs=4.0 * 0.1 / math.sqrt(n))
    correlation = (settled * later).mean(axis=0) / std**2
    assert correlation == pytest.approx(np.full(3, math.exp(-4 * step / T)), abs=6.0 / math.sqrt(n))
    assert np.abs(np.corrcoef(settled.T) - np.eye(3)).max() < 5.0 / math.sqrt(n)


def test_drift_is_continuous_between_commands():
    """The velocity at the end of a control step is that at the start of the next: the rate is its slope."""
    water = arrays_of(Water(drift_std=(0.1, 0.1, 0.1), drift_time=5.0))
    episode, steps = wp.zeros(1, dtype=int, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
    point, end = [[0.0, 0.0, -0.5]], None
    for i in range(5):
        steps.fill_(i)
        wp.launch(advance_drift, 1, [water, steps, 0.1, 3, episode, 0], device="cpu")
        start = flow_here(water, point, 0.0, 0.0)
        assert end is None or start["velocity"] == pytest.approx(end, abs=1e-7)
        end = flow_here(water, point, 0.0, 0.1)["velocity"]
        assert (end - start["velocity"]) / 0.1 == pytest.approx(start["acceleration"], abs=1e-6)


def test_waves_without_a_depth_are_those_of_deep_water():
    """u = A ω e^(kz) with ω² = g k: it fades with depth and has no floor below which it would grow."""
    wave = Wave(amplitude=0.05, wavelength=3.0)
    k = 2.0 * math.pi / 3.0
    z = np.array([0.0, -0.5, -1.0, -2.0, -30.0])
    found = flow_here(Water(waves=(wave,)), np.stack([0.0 * z, 0.0 * z, z], axis=1), 0.0)
    expected = 0.05 * math.sqrt(G * k) * np.exp(k * z)
    np.testing.assert_allclose(found["velocity"][:, 0], expected, rtol=2e-6, atol=1e-9)
    sea = SeaState(spectrum="jonswap", height=0.2, period=3.0)
    numbers = 2.0 * math.pi / np.array([one.wavelength for one in Water(waves=sea).components])
    ratios, _ = sea_bands("jonswap", sea.peak, sea.spread, sea.components)
    np.testing.assert_allclose(numbers, (ratios * 2.0 * math.pi / 3.0) ** 2 / G, rtol=1e-9)


def test_a_pool_gives_its_depth_to_water_that_states_none():
    """ω² = g k tanh(k h) with h of the pool; a stated depth is kept."""
    wave, k = Wave(amplitude=0.02, wavelength=3.0), 2.0 * math.pi / 3.0
    for pool, depth, h in ((0.8, None, 0.8), (0.8, 1.5, 1.5)):
        simulator = Simulator(
            "finsrov", water=Water(waves=(wave,), depth=depth), pool=RectangularPool(depth=pool)
        )
        omega = float(simulator.water.wave_frequency.numpy()[0, 0])
        assert omega == pytest.approx(math.sqrt(G * k * math.tanh(k * h)), rel=1e-6)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: Wave(amplitude=0.3, wavelength=3.0),
            "wave: amplitude 0.3 m is not small for a wavelength of 3.0 m",
        ),
        (lambda: Wave(amplitude=0.0, wavelength=0.0), "wave: wavelength is 0.0, expected a length above 0 m"),
        (lambda: Water(depth=0.0), "water: depth is 0.0, expected more than 0 m"),
        (lambda: Water(current=(math.nan, 0.0, 0.0)), "water: every number must be finite"),
        (
            lambda: Water(drift_std=(-0.1, 0.0, 0.0)),
            "water: drift_std is a standard deviation, expected 0 or more",
        ),
    ],
)
def test_water_that_cannot_be_is_refused(make, sentence):
    """Breaking waves, an invalid depth and non-finite numbers are refused in one sentence each."""
    with pytest.raises(SurroundingsError, match=sentence):
        make()
