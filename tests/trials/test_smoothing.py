"""Smoothing is exact on noise-free signals, and otherwise as accurate as its own error bars."""

import numpy as np
import pytest

from finssim.trials.motion import longest_step, smooth, stretches, without_spikes


def times(rate, seconds=15.0, jitter=0.2, seed=0):
    """Return sample times that jitter by a fraction of their step."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate)
    return (np.arange(n) + jitter * rng.uniform(-1.0, 1.0, n)) / rate


def surge(t, time_constant=0.7):
    """Return velocity and acceleration of a vehicle that is pushed from 1 s to 10 s: two kinks."""
    up = 1.0 - np.exp(-np.maximum(t - 1.0, 0.0) / time_constant)
    top = 1.0 - np.exp(-9.0 / time_constant)
    down = top * np.exp(-np.maximum(t - 10.0, 0.0) / time_constant)
    v = np.where(t < 10.0, up, down)
    a = np.where(t < 1.0, 0.0, np.where(t < 10.0, 1.0 - up, -down)) / time_constant
    return 0.4 * v, 0.4 * a


@pytest.mark.parametrize("order", [2, 3])
def test_polynomials_of_the_order_pass_unchanged(order):
    """The penalty is zero for polynomials below its order: value and slope are unchanged."""
    t = times(20.0)
    at = np.linspace(0.5, 14.0, 77)
    c = [0.3, -0.2, 0.05][:order]
    s = smooth(t, np.polyval(c[::-1], t)[:, None], at, order=order)
    np.testing.assert_allclose(s.value[:, 0], np.polyval(c[::-1], at), atol=1e-6)
    np.testing.assert_allclose(s.slope[:, 0], np.polyval(np.polyder(c[::-1]), at), atol=1e-5)


@pytest.mark.parametrize("rate", [5.0, 20.0, 100.0])
def test_a_sine_without_noise_and_its_slope(rate):
    """sin and cos at 1.5 rad/s are recovered from 5 Hz on, away from the ends."""
    t = times(rate)
    at = np.linspace(1.0, 13.0, 301)
    s = smooth(t, np.sin(1.5 * t)[:, None], at, order=3)
    # Error of the cubic spline: h⁴ in the value and h³ in the slope, with margin for the jitter.
    h = 1.5 / rate
    np.testing.assert_allclose(s.value[:, 0], np.sin(1.5 * at), atol=0.2 * h**3 + 1e-6)
    np.testing.assert_allclose(s.slope[:, 0], 1.5 * np.cos(1.5 * at), atol=0.6 * h**2 + 1e-5)


@pytest.mark.parametrize("rate", [5.0, 20.0, 50.0, 100.0])
@pytest.mark.parametrize("noise", [0.003, 0.01, 0.03])
def test_the_strength_follows_the_noise(rate, noise):
    """Noise is estimated from the data, and the slope's error is about as large as stated."""
    at = np.linspace(0.5, 14.0, 500)
    v, a = surge(at)
    errors, found = [], []
    for seed in range(8):
        t = times(rate, seed=seed)
        y = surge(t)[0] + noise * np.random.default_rng(seed).normal(size=len(t))
        s = smooth(t, y[:, None], at)
        errors.append(
            [np.sqrt(np.mean((s.value[:, 0] - v) ** 2)), np.sqrt(np.mean((s.slope[:, 0] - a) ** 2))]
        )
        found.append([s.noise[0], s.slope_std[0]])
    (value, slope), (sigma, slope_std) = np.mean(errors, axis=0), np.mean(found, axis=0)
    assert sigma == pytest.approx(noise, rel=0.25, abs=0.002)
    assert value < noise
    assert 0.5 < slope / slope_std < 2.5


def test_smoothing_makes_no_delay():
    """Reversing time reverses the result, so the phase is zero."""
    t = np.arange(300) * 0.02
    y = surge(t * 2.0)[0] + 0.02 * np.random.default_rng(0).normal(size=300)
    forward = smooth(t, y[:, None], t)
    backward = smooth(t, y[::-1, None], t)
    np.testing.assert_allclose(forward.value[:, 0], backward.value[::-1, 0], atol=1e-9)
    np.testing.assert_allclose(forward.slope[:, 0], -backward.slope[::-1, 0], atol=1e-8)


def test_nothing_is_said_inside_a_gap_or_beyond_the_ends():
    """Values without samples nearby are NaN, and each side of a gap is smoothed independently."""
    t = np.concatenate([np.arange(100), np.arange(150, 250)]) * 0.02
    y = np.where(t < 2.5, np.sin(t), 5.0 + np.cos(t))
    at = np.arange(-10, 260) * 0.02
    s = smooth(t, y[:, None], at)
    outside = (at < 0.0) | (at > t[-1]) | ((at > t[99] + 1e-6) & (at < t[100] - 1e-6))
    np.testing.assert_array_equal(np.isnan(s.value[:, 0]), outside)
    np.testing.assert_array_equal(np.isnan(s.slope[:, 0]), outside)
    np.testing.assert_allclose(
        s.value[~outside, 0], np.where(at < 2.5, np.sin(at), 5.0 + np.cos(at))[~outside], atol=1e-3
    )


def test_a_gap_is_judged_by_the_usual_step():
    """The limit is 0.2 s at high rates, four steps at low ones; runs too short for a curve are dropped."""
    assert longest_step(np.arange(50) * 0.01) == pytest.approx(0.2)
    assert longest_step(np.arange(50) * 0.2) == pytest.approx(0.8)
    assert [(s.start, s.stop) for s in stretches(np.array([0.0, 0.1, 0.9, 1.0, 1.1]), 0.2)] == [
        (0, 2),
        (2, 5),
    ]
    t = np.concatenate([np.arange(20) * 0.1, [10.0, 10.1]])
    assert np.isnan(smooth(t, t[:, None], np.array([10.05])).value).all()


def test_spikes_are_left_out_and_steps_are_not():
    """A spike is dropped; a jump to a new level, noise and a constant signal are kept."""
    rng = np.random.default_rng(0)
    t = np.arange(400) * 0.02
    y = surge(t * 2.0)[0] + 0.01 * rng.normal(size=400)
    wild = y.copy()
    wild[[50, 51, 200]] += [3.0, -2.0, 1.0]
    assert np.flatnonzero(~without_spikes(t, wild[:, None])).tolist() == [50, 51, 200]
    for quiet in (y, np.where(t > 4.0, 1.0, 0.0), np.zeros(400)):
        assert without_spikes(t, quiet[:, None]).all()
    np.testing.assert_allclose(smooth(t, wild[:, None], t).value, smooth(t, y[:, None], t).value, atol=0.01)


@pytest.mark.parametrize("n", [6, 100, 30_000])
@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("kind", ["zero", "constant", "line", "noise"])
def test_signals_without_shape_come_out_flat_and_straight(n, order, kind):
    """For any length and strength no rounding error grows, and noise is flat over windows of 4 s."""
    t = np.arange(n) * 0.01
    rng = np.random.default_rng(0)
    y = {"zero": 0.0 * t, "constant": 0.0 * t - 3.0, "line": 0.7 * t + 2.0, "noise": rng.normal(size=n)}[kind]
    s = smooth(t, y[:, None], t, order=order)
    straight = np.polyval(np.polyfit(t, y, 1 if kind == "line" else 0), t)
    tolerance = 8.0 / np.sqrt(min(n, 400)) if kind == "noise" and n > 6 else 3.0 if kind == "noise" else 1e-6
    np.testing.assert_allclose(s.value[:, 0], straight, atol=tolerance)
    if kind != "noise":
        np.testing.assert_allclose(s.slope[:, 0], 0.7 if kind == "line" else 0.0, atol=1e-6)


def test_a_burst_is_followed_and_the_calm_after_it_is_smooth():
    """Three seconds of handling at 2 Hz and a slow drift afterwards are each smoothed as if alone."""
    t = np.arange(2000) * 0.01
    burst = np.where(t < 3.0, 0.3 * np.sin(12.0 * t), 0.0)
    y = burst + 0.05 * np.sin(0.3 * t) + 0.01 * np.random.default_rng(0).normal(size=2000)
    s = smooth(t, y[:, None], t, order=2)
    early, late = (t > 0.2) & (t < 2.8), (t > 6.0) & (t < 19.8)
    error = s.slope[:, 0] - np.where(t < 3.0, 3.6 * np.cos(12.0 * t), 0.0) - 0.015 * np.cos(0.3 * t)
    assert np.std(error[early]) < 0.15 * 3.6 / np.sqrt(2.0)
    alone = smooth(t[late], y[late, None], t[late], order=2).slope[:, 0] - 0.015 * np.cos(0.3 * t[late])
    assert np.std(error[late]) < 2.0 * np.std(alone) + 0.002
